"""Eigenvalues limited to 1, and operators whose eigenvalues were limited."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NonlocalOperator,
    detail_layers,
    fit_filter,
    nonlocal_operator,
    polynomial_filter,
)
from nlfilter_torch.operator.sinkhorn import sinkhorn
from tests.problems import noise, picture, seeded
from tests.streams import stream_detail

FLOATS = (torch.float32, torch.float64)


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


def limited() -> tuple[Tensor, NonlocalOperator]:
    """An operator whose eigenvalues would exceed 1."""
    image = picture("camera", 40, 40)
    operator = nonlocal_operator(image, spatial_bandwidth=3.0, num_landmarks=50, landmarks="random")
    assert operator.kernel.limiter is not None
    return image, operator


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize(
    ("image", "options"),
    [
        ("noise", {"photometric_bandwidth": 25 / 255, "num_landmarks": 5, "landmarks": "uniform", "patch_size": 1}),
        ("camera", {"spatial_bandwidth": 3.0, "num_landmarks": 50, "landmarks": "random"}),
        ("camera", {"photometric_bandwidth": 2 / 255, "num_landmarks": 60, "landmarks": "uniform"}),
    ],
)
def test_no_eigenvalue_exceeds_one(image: str, options: dict[str, object], dtype: torch.dtype) -> None:
    guides = (
        [noise(1, 1, 18, 5, seed=seed, dtype=dtype) for seed in range(12)]
        if image == "noise"
        else [picture(image, 40, 40, dtype)]
    )
    for guide in guides:
        assert_sound(nonlocal_operator(guide, **options))


def test_a_limited_operator_is_the_unlimited_one_below_one() -> None:
    """Only eigenvalues above 1 change, to 1; repeated products stay bounded."""
    image, operator = limited()
    whole = operator.kernel.recipe(image, origin=(0, 0), halo=(0, 0))
    factor, _ = replace(operator.kernel, limiter=None).factor(whole)
    scaled = factor * operator.scaling.unsqueeze(1)
    before = torch.linalg.eigvalsh(scaled.mT @ scaled + torch.diag_embed(operator.remainder))[0]
    after = torch.linalg.eigvalsh(dense(operator))[0]
    assert before.max() > 1.001
    exceeded = int((before > 1 + 1e-9).sum())
    torch.testing.assert_close(after[-exceeded:], torch.ones(exceeded, dtype=after.dtype), atol=1e-6, rtol=0)
    assert (after <= before + 1e-9).all()
    powers = operator.powers(image, 50)
    assert powers.abs().max() <= image.norm()


@pytest.mark.parametrize("recorded", [False, True])
def test_only_images_whose_eigenvalues_exceed_one_are_limited(recorded: bool) -> None:
    options: dict[str, object] = {"spatial_bandwidth": 3.0, "num_landmarks": 50, "landmarks": "random"}
    images = [noise(1, 1, 40, 40, seed=1).float(), picture("camera", 40, 40).float(), noise(1, 1, 40, 40).float()]
    alone = [nonlocal_operator(image, photometric_bandwidth=0.05, **options) for image in images]
    assert [operator.kernel.limiter is None for operator in alone] == [True, False, True]
    batch = torch.cat(images).requires_grad_(recorded)
    together = nonlocal_operator(batch, photometric_bandwidth=0.05, **options)
    assert together.kernel.limiter is not None
    identity = torch.eye(50).expand(2, -1, -1)
    assert torch.equal(together.kernel.limiter[[0, 2]], identity)
    torch.testing.assert_close(together.factor, torch.cat([operator.factor for operator in alone]), rtol=0, atol=1e-5)
    if recorded:
        assert torch.autograd.grad(together.factor.square().sum(), batch)[0].abs().amax((1, 2, 3)).isfinite().all()


def test_other_pixels_follow_a_limited_operator() -> None:
    image, operator = limited()
    fitted = fit_filter(operator, image)
    torch.testing.assert_close(fitted.layers(image), detail_layers(operator, image), atol=1e-9, rtol=0)
    again = operator.balancing(*operator.kernel.factor(operator.kernel.recipe(image, origin=(0, 0), halo=(0, 0))))
    torch.testing.assert_close(again[1], operator.remainder, atol=1e-9, rtol=0)


def test_tiles_follow_a_limited_operator() -> None:
    image, operator = limited()
    alpha, rows = (
        torch.tensor([3.0, 3.0, 4.0, 1.05], dtype=torch.float64),
        image[0].permute(1, 2, 0).contiguous().numpy(),
    )
    out = rows.copy()
    options = {"spatial_bandwidth": 3.0, "num_landmarks": 50, "landmarks": "random"}
    options |= {"photometric_bandwidth": "auto", "limits": "none", "threshold": 0.0}
    stream_detail(rows, out, alpha, tile_rows=16, statistics="full", **options)
    expected = polynomial_filter(operator, image, alpha)[0].permute(1, 2, 0)
    torch.testing.assert_close(torch.from_numpy(out), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("landmarks", ["uniform", "random"])
def test_the_gradient_of_a_limited_operator_is_exact(landmarks: str) -> None:
    guide = noise(1, 1, 12, 11, seed=5)
    weights = noise(1, 1, 12, 11, seed=1)

    def loss(bandwidth: Tensor) -> Tensor:
        options = {"num_landmarks": 8, "patch_size": 1, "landmarks": landmarks}
        operator = nonlocal_operator(guide, photometric_bandwidth=bandwidth, **options)
        result.append(operator.kernel.limiter is not None)
        return (weights * (operator @ (operator @ guide))).sum()

    result: list[bool] = []
    bandwidth = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(loss, (bandwidth,), eps=1e-6, atol=1e-6)
    assert all(result)


def test_a_loose_tolerance_bounds_the_eigenvalues_as_well() -> None:
    ramp, tolerance = torch.linspace(0, 1, 49 * 34, dtype=torch.float64).view(1, 1, 49, 34), 0.01
    for seed in range(2):
        operator = nonlocal_operator(
            ramp,
            photometric_bandwidth=0.01,
            num_landmarks=40,
            landmarks="random",
            completion="none",
            tolerance=tolerance,
            spatial_bandwidth=50.0,
            generator=seeded(seed),
        )
        assert torch.linalg.eigvalsh(dense(operator)).max() < 1 + tolerance


def test_eigenvalues_above_one_in_a_graph_are_warned_of() -> None:
    guide = picture("camera", 40, 40)
    operator = nonlocal_operator(guide, spatial_bandwidth=3.0, num_landmarks=50, landmarks="random")
    unlimited = replace(operator.kernel, limiter=None).factor(operator.kernel.recipe(guide))
    with pytest.warns(UserWarning, match="eigenvalues exceed 1, which compiled programs do not correct"):
        sinkhorn(*unlimited, 1e-5, True, True)
