"""Features and landmarks to the factor of the affinities and the diagonal that completes it."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nlfilter_torch import (
    NonlocalOperator,
    nonlocal_operator,
    operator_from_features,
)
from nlfilter_torch.operator.nystrom import inverse_cholesky, nystrom_factor
from tests import reference
from tests.problems import picture, seeded


def cloud(batch: int, dimension: int, pixels: int, *, seed: int = 0, spread: float = 1.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, dimension, pixels, generator=generator, dtype=torch.float64) * spread


def completed(factor: torch.Tensor, diagonal: torch.Tensor) -> torch.Tensor:
    return factor.mT @ factor + torch.diag_embed(diagonal)


def affinities(x: torch.Tensor) -> np.ndarray:
    return np.stack([reference.affinity(image.T.numpy(), image.T.numpy()) for image in x])


def test_with_every_pixel_a_landmark_it_is_the_kernel() -> None:
    x = cloud(2, 3, 70)
    factor, diagonal = nystrom_factor(x, x, inverse_cholesky(x), "diagonal")
    np.testing.assert_allclose(completed(factor, diagonal), affinities(x), atol=2e-5)  # twice the jitter


def test_rows_of_landmarks_are_those_of_the_kernel() -> None:
    x = cloud(1, 3, 200)
    factor, _ = nystrom_factor(x, x[:, :, :40], inverse_cholesky(x[:, :, :40]), "none")
    np.testing.assert_allclose((factor.mT @ factor)[:, :40], affinities(x)[:, :40], atol=3e-3)
    np.testing.assert_allclose((factor.mT @ factor)[:, :40, :40], affinities(x)[:, :40, :40], atol=2e-5)


@given(spread=st.floats(1e-3, 1e3), landmarks=st.integers(1, 50), dtype=st.sampled_from([torch.float32, torch.float64]))
def test_completion_keeps_the_unit_diagonal(spread: float, landmarks: int, dtype: torch.dtype) -> None:
    x = cloud(2, 5, 120, spread=spread).to(dtype)
    z = x[:, :, :landmarks]
    factor, diagonal = nystrom_factor(x, z, inverse_cholesky(z), "diagonal")
    norms = factor.square().sum(1)
    assert (diagonal >= 0).all()
    assert (norms <= 1 + 1e-5).all()
    torch.testing.assert_close(norms + diagonal, torch.ones_like(norms), atol=1e-5, rtol=0)


def test_without_completion_there_is_no_diagonal() -> None:
    x = cloud(1, 5, 60, spread=3)
    factor, diagonal = nystrom_factor(x, x[:, :, :5], inverse_cholesky(x[:, :, :5]), "none")
    assert (diagonal == 0).all()
    assert factor.square().sum(1).min() < 0.01  # a pixel that no landmark resembles has a row of about zero


def test_the_residual_of_the_plain_factor_is_positive() -> None:
    x = cloud(1, 3, 150)
    factor, _ = nystrom_factor(x, x[:, :, ::5], inverse_cholesky(x[:, :, ::5]), "none")
    assert np.linalg.eigvalsh(affinities(x)[0] - (factor.mT @ factor)[0].numpy()).min() > -1e-12


@given(order=st.permutations(list(range(40))))
def test_pixels_in_another_order_give_columns_in_that_order(order: list[int]) -> None:
    x = cloud(1, 3, 40)
    z = x[:, :, 5:15]
    factor, diagonal = nystrom_factor(x, z, inverse_cholesky(z), "diagonal")
    other, other_diagonal = nystrom_factor(x[:, :, order], z, inverse_cholesky(z), "diagonal")
    torch.testing.assert_close(other, factor[:, :, order], atol=1e-13, rtol=0)
    torch.testing.assert_close(other_diagonal, diagonal[:, order], atol=1e-13, rtol=0)


@given(order=st.permutations(list(range(10))))
def test_the_order_of_the_landmarks_does_not_matter(order: list[int]) -> None:
    x = cloud(1, 3, 40)
    z = x[:, :, 5:15]
    matrix, other = (completed(*nystrom_factor(x, y, inverse_cholesky(y), "diagonal")) for y in (z, z[:, :, order]))
    torch.testing.assert_close(matrix, other, atol=1e-10, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_common_offset_does_not_matter(dtype: torch.dtype) -> None:
    x = (cloud(1, 4, 80) * 64).round().div(64)  # exact relative to the offset, in float32 too
    tolerance = 2e-3 if dtype == torch.float32 else 1e-9
    results = []
    for offset in (0.0, 100.0):
        y = (x + offset).to(dtype)
        results.append(completed(*nystrom_factor(y, y[:, :, :30], inverse_cholesky(y[:, :, :30]), "diagonal")))
    torch.testing.assert_close(*results, atol=tolerance, rtol=0)


def test_repeated_landmarks_are_no_harm() -> None:
    x = cloud(1, 3, 60).float()
    once, twice = x[:, :, :10], torch.cat([x[:, :, :10]] * 2, dim=2)
    matrix, other = (completed(*nystrom_factor(x, z, inverse_cholesky(z), "diagonal")) for z in (once, twice))
    torch.testing.assert_close(matrix, other, atol=1e-3, rtol=0)


def test_single_precision_is_double_precision_rounded() -> None:
    x = cloud(1, 25, 500, spread=0.3)
    z = x[:, :, ::10]
    exact = completed(*nystrom_factor(x, z, inverse_cholesky(z), "diagonal"))
    single = completed(*nystrom_factor(x.float(), z.float(), inverse_cholesky(z.float()), "diagonal"))
    torch.testing.assert_close(single.double(), exact, atol=2e-3, rtol=0)


def test_a_batch_is_its_images() -> None:
    x = cloud(3, 4, 9000)  # longer than a block of pixels
    z = x[:, :, ::200]
    together = nystrom_factor(x, z, inverse_cholesky(z), "diagonal")
    for i in range(3):
        alone = nystrom_factor(x[i : i + 1], z[i : i + 1], inverse_cholesky(z[i : i + 1]), "diagonal")
        for batch, other in zip(together, alone, strict=True):
            torch.testing.assert_close(batch[i : i + 1], other, atol=1e-11, rtol=0)


@pytest.mark.parametrize("completion", ["diagonal", "none"])
def test_gradients_are_those_of_the_formula(completion: str) -> None:
    """The backward pass with recomputation, compared with autograd through the same three lines."""
    x, z = cloud(2, 3, 50, spread=0.7).requires_grad_(), cloud(2, 3, 8, seed=1, spread=0.7).requires_grad_()
    a = inverse_cholesky(z.detach()).requires_grad_()
    weights = cloud(2, 9, 50, seed=2)

    def formula() -> tuple[torch.Tensor, torch.Tensor]:
        squared = (x.unsqueeze(2) - z.unsqueeze(3)).square().sum(1)  # (B, M, N)
        factor = a @ torch.exp(-squared)
        if completion == "none":
            return factor, torch.zeros(2, 50, dtype=torch.float64)
        norm = factor.square().sum(1)
        return factor / norm.clamp(min=1).sqrt().unsqueeze(1), (1 - norm).clamp(min=0)

    gradients = []
    for factor, diagonal in (nystrom_factor(x, z, a, completion), formula()):
        loss = (factor * weights[:, :8]).sum() + (diagonal * weights[:, 8]).sum()
        gradients.append(torch.autograd.grad(loss, (x, z, a)))
    for result, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(result, expected, atol=1e-9, rtol=1e-7)


PRECISION = {torch.float32: 2e-5, torch.float64: 1e-11}


def dense(operator: NonlocalOperator) -> Tensor:
    """W in float64, from what the operator stores."""
    scaled = operator.factor.double() * operator.scaling.double().unsqueeze(1)
    return scaled.mT @ scaled + torch.diag_embed(operator.remainder.double())


def assert_sound(operator: NonlocalOperator) -> None:
    matrix, precision = dense(operator), PRECISION[operator.factor.dtype]
    errors = (matrix.sum(2) - 1).abs().amax(1)
    assert (errors < precision).all()
    assert (errors < 1.5 * operator.residual + precision).all()
    values = torch.linalg.eigvalsh(matrix)
    assert values.min() > -1e-6
    assert values.max() < 1.0001
    certificate, diagnostics = operator.certify(), operator.diagnostics()
    assert max(certificate.row_sums) < 2 * precision
    assert max(certificate.symmetry) < precision
    for figures in (certificate.largest_eigenvalue, diagnostics.largest_eigenvalue):
        torch.testing.assert_close(torch.tensor(figures).double(), values.amax(1), atol=1e-4, rtol=0)
    assert (torch.tensor(certificate.smallest_eigenvalue) <= values.amin(1) + 1e-6).all()


@pytest.mark.parametrize("options", [{"photometric_bandwidth": 2e-4}, {"spatial_bandwidth": 0.05}])
def test_tiny_bandwidths_are_right_in_float32(options: dict[str, float]) -> None:
    """Features are so large that squared distances would lose all digits in float32."""
    image = picture("camera", 40, 40).float()
    options = {"photometric_bandwidth": 0.1, "num_landmarks": 1600, "patch_size": 1, **options}
    operator = nonlocal_operator(image, **options)
    rows = reference.features(
        image[0, 0].double().numpy(), 1, options["photometric_bandwidth"], options.get("spatial_bandwidth")
    )
    exact = reference.balanced(reference.affinity(rows, rows))
    torch.testing.assert_close(operator.to_dense()[0].double(), torch.from_numpy(exact), atol=1e-3, rtol=0)


def test_landmarks_far_apart_for_their_bandwidth_have_a_cholesky_factor() -> None:
    # At 1e10 bandwidths, squared distances computed by products have errors of 1e4 in float64.
    points = 1e10 + torch.rand(1, 1, 60, generator=seeded(0), dtype=torch.float64).sort().values * 3
    features = torch.cat([points, -points], dim=2)
    operator = operator_from_features(features, size=(10, 12), num_landmarks=80)
    assert_sound(operator)
