"""Balancing: the scaling that gives W unit row sums, its reported residual, and its implicit gradient."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nlfilter_torch import (
    NonlocalOperator,
    estimate_bandwidth,
    nonlocal_operator,
)
from nlfilter_torch.operator.scaling import KernelMatrix
from nlfilter_torch.operator.sinkhorn import sinkhorn_balance
from tests import reference
from tests.images import reduced
from tests.pairwise import each_value, pairwise
from tests.problems import picture, seeded


def problem(
    batch: int, marks: int, pixels: int, *, seed: int = 0, dtype: torch.dtype = torch.float64
) -> tuple[torch.Tensor, torch.Tensor]:
    """A positive factor (B, M, N) with columns of norm below 1, and the diagonal that completes it."""
    generator = torch.Generator().manual_seed(seed)
    factor = torch.rand(batch, marks, pixels, generator=generator, dtype=torch.float64)
    factor = factor / factor.norm(dim=1, keepdim=True) * torch.rand(batch, 1, pixels, generator=generator).double()
    return factor.to(dtype), (1 - factor.square().sum(1)).to(dtype)


def row_sums(factor: torch.Tensor, diagonal: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    factor, diagonal, d = factor.double(), diagonal.double(), d.double()
    return d * ((factor.mT @ (factor @ d.unsqueeze(2))).squeeze(2) + diagonal * d)


@pytest.mark.parametrize(
    ("dtype", "tolerance", "pixels", "completed"),
    [
        (dtype, tolerance, pixels, completed)
        for (dtype, tolerance), pixels, completed in pairwise(
            [(torch.float32, 5e-5), (torch.float64, 1e-10)], [1, 2, 300, 20000, 70000], [False, True]
        )
    ],
)
def test_row_sums_are_one(pixels: int, dtype: torch.dtype, tolerance: float, completed: bool) -> None:
    factor, diagonal = problem(2, 6, pixels, dtype=dtype)
    result = sinkhorn_balance(KernelMatrix(factor, diagonal), completed=completed)
    assert (result.scaling > 0).all()
    assert (row_sums(factor, diagonal, result.scaling) - 1).abs().max() <= tolerance


@pytest.mark.parametrize("completed", [False, True])
def test_scaling_is_the_reference_scaling(completed: bool) -> None:
    factor, diagonal = problem(1, 5, 80)
    kernel = (factor.mT @ factor + torch.diag_embed(diagonal))[0].numpy()
    d = sinkhorn_balance(KernelMatrix(factor, diagonal), completed=completed).scaling[0].numpy()
    np.testing.assert_allclose(d[:, None] * kernel * d, reference.balanced(kernel), atol=1e-11)


@given(scale=st.floats(1e-2, 1e2))
def test_a_kernel_times_c_is_scaled_by_its_root(scale: float) -> None:
    factor, diagonal = problem(1, 5, 80)
    d = sinkhorn_balance(KernelMatrix(factor, diagonal)).scaling
    scaled = sinkhorn_balance(KernelMatrix(factor * scale**0.5, diagonal * scale)).scaling
    torch.testing.assert_close(scaled, d / scale**0.5, rtol=1e-9, atol=0)


@pytest.mark.parametrize(("completed", "pixels"), [(False, 500), (True, 500), (True, 20000)])
def test_the_residual_is_that_of_the_scaling(completed: bool, pixels: int) -> None:
    factor, diagonal = problem(3, 6, pixels)
    result = sinkhorn_balance(KernelMatrix(factor, diagonal), tolerance=1e-3, completed=completed)
    measured = (row_sums(factor, diagonal, result.scaling) - 1).abs().amax(1)
    torch.testing.assert_close(result.residual, measured, atol=1e-12, rtol=0)
    assert result.residual.max() <= 1e-3
    assert 1 <= result.steps <= sinkhorn_balance(KernelMatrix(factor, diagonal), completed=completed).steps


def test_one_slow_step_is_not_the_end() -> None:
    """On this picture the residual decreases by less than half in one step, at 1e-4, and then converges to rounding."""
    image = torch.from_numpy(reduced("hubble_deep_field", 160).copy())[None, None]
    operator = nonlocal_operator(image, photometric_bandwidth=2 * estimate_bandwidth(image))
    assert operator.residual.item() <= 1e-12


@pytest.mark.parametrize("completed", [False, True])
def test_identity_is_balanced_already(completed: bool) -> None:
    result = sinkhorn_balance(KernelMatrix(torch.zeros(1, 3, 50), torch.ones(1, 50)), completed=completed)
    torch.testing.assert_close(result.scaling, torch.ones(1, 50))


@pytest.mark.parametrize(("completed", "pixels"), [(False, 500), (True, 500), (True, 20000)])
def test_a_batch_is_its_images(completed: bool, pixels: int) -> None:
    factor, diagonal = problem(3, 6, pixels)
    together = sinkhorn_balance(KernelMatrix(factor, diagonal), completed=completed).scaling
    images = [KernelMatrix(factor[i : i + 1], diagonal[i : i + 1]) for i in range(3)]
    alone = [sinkhorn_balance(image, completed=completed).scaling for image in images]
    torch.testing.assert_close(together, torch.cat(alone), rtol=1e-10, atol=0)


def test_the_estimated_jacobian_leaves_the_gradient_exact() -> None:
    """The solution, and so its gradient, is the same with a sample of the pixels and with all of them."""
    problems = [[t.requires_grad_() for t in problem(2, 4, 4000)] for _ in range(2)]
    gradients = []
    for (factor, diagonal), completed in zip(problems, (False, True), strict=True):
        weights = torch.randn(2, 4000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        loss = (sinkhorn_balance(KernelMatrix(factor, diagonal), completed=completed).scaling * weights).sum()
        gradients.append(torch.autograd.grad(loss, (factor, diagonal)))
    for result, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(result, expected, atol=1e-10, rtol=1e-8)


@pytest.mark.parametrize("name", ["retina", "astronaut", "rocket"])
def test_few_sweeps_balance_a_photograph(name: str) -> None:
    image = torch.from_numpy(reduced(name, 256).copy()).float()[None, None]
    operator = nonlocal_operator(image, num_landmarks=50, tolerance=1e-4)
    assert operator.balancing_steps <= 6
    assert operator.residual.item() <= 1e-4


def test_row_sums_that_stay_off_are_told() -> None:
    factor = torch.tensor([[[1.0, 1.0, -1.0, 1e-3]]])  # a negative affinity, which plain Nystrom produces
    with pytest.warns(
        UserWarning, match=r"balancing left row sums that differ from 1 by up to .*completion='diagonal'"
    ):
        result = sinkhorn_balance(KernelMatrix(factor, torch.zeros(1, 4)))
    assert result.scaling.isfinite().all()
    assert (result.scaling > 0).all()


@pytest.mark.parametrize("completed", [False, True])
def test_implicit_gradient_is_the_unrolled_one(completed: bool) -> None:
    factor, diagonal = (t.requires_grad_() for t in problem(2, 4, 40))
    weights = torch.randn(2, 40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    implicit = torch.autograd.grad(
        (sinkhorn_balance(KernelMatrix(factor, diagonal), completed=completed).scaling * weights).sum(),
        (factor, diagonal),
    )

    d = torch.ones(2, 40, dtype=torch.float64)
    for _ in range(60):
        d = d * (d * ((factor.mT @ (factor @ d.unsqueeze(2))).squeeze(2) + diagonal * d)) ** (-2 / 3)
    unrolled = torch.autograd.grad((d * weights).sum(), (factor, diagonal))
    for result, expected in zip(implicit, unrolled, strict=True):
        torch.testing.assert_close(result, expected, atol=1e-9, rtol=1e-8)


def lonely() -> tuple[Tensor, Tensor]:
    """A factor (1, 3, 6) with negative affinities, and its diagonal: the last pixel resembles no other."""
    factor = torch.tensor([[[1.0, 0.9, 0.8, 0.9, 0.7, -0.6], [0, 0.3, 0.4, 0.1, 0.5, 0.1], [0, 0.1, 0.2, 0.3, 0, 0.2]]])
    return factor, (1 - factor.square().sum(1)).clamp(min=0)


@pytest.mark.filterwarnings("ignore:eigenvalues exceed 1")
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
@pytest.mark.parametrize("completed", [True, False])
def test_balancing_in_a_graph_is_that_without_one(completed: bool) -> None:
    actual = []
    for balance in (sinkhorn_balance, torch.compile(sinkhorn_balance, backend="aot_eager", fullgraph=True)):
        factor, diagonal = (tensor.clone().requires_grad_() for tensor in lonely())
        result = balance(KernelMatrix(factor, diagonal), tolerance=1e-5, completed=completed)
        kept, rest = result.matrix.factor, result.matrix.diagonal
        repeated = sum(torch.equal(total, result.moment) for total in result.before)
        gradients = torch.autograd.grad((result.scaling * kept[:, 0] + rest).square().sum(), [factor, diagonal])
        rounds = torch.tensor(len(result.before) - repeated)
        actual.append((kept, rest, result.scaling, result.moment, result.residual, *gradients, rounds))
    assert int(actual[0][-1]) == completed  # the lonely pixel is removed in one round
    for ours, theirs in zip(*actual, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-5)


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


def checkerboard(height: int, width: int, dtype: torch.dtype) -> Tensor:
    return ((torch.arange(height)[:, None] + torch.arange(width)) % 2).to(dtype)[None, None]


@pytest.mark.parametrize("dtype", FLOATS)
def test_row_sums_hold_where_affinities_to_the_landmarks_are_negative(dtype: torch.dtype) -> None:
    image = picture("coffee", 40, 40, dtype)
    options = {"photometric_bandwidth": 5 / 255, "landmarks": "uniform", "num_landmarks": 40, "patch_size": 1}
    operator = nonlocal_operator(image, **options)
    assert (operator.factor.mT @ operator.factor).min() < -1e-3
    assert_sound(operator)


@pytest.mark.parametrize("dtype", FLOATS)
def test_the_reproduction_of_a_false_residual(dtype: torch.dtype) -> None:
    import skimage.data
    from skimage.color import rgb2gray
    from skimage.transform import resize

    grey = resize(rgb2gray(skimage.data.stereo_motorcycle()[0]), (96, 96), anti_aliasing=True)
    image = torch.from_numpy(grey).to(dtype)[None, None]
    operator = nonlocal_operator(image, photometric_bandwidth=10 / 255, landmarks="uniform")
    scaled = operator.factor.double() * operator.scaling.double().unsqueeze(1)
    sums = (scaled.mT @ scaled.sum(2, keepdim=True)).squeeze(2) + operator.remainder.double()
    assert (sums - 1).abs().max() < min(1e-4, 1.5 * operator.residual.max() + PRECISION[dtype])


@pytest.mark.parametrize(("dtype", "seed"), each_value(FLOATS, range(4)))
def test_periodic_images_are_balanced(seed: int, dtype: torch.dtype) -> None:
    image = checkerboard(64, 9, dtype)
    options = {"photometric_bandwidth": 10 / 255, "landmarks": "random", "num_landmarks": 1}
    assert_sound(nonlocal_operator(image, generator=seeded(seed), **options))


@pytest.mark.parametrize("dtype", FLOATS)
def test_a_ramp_of_unlike_pixels_is_balanced(dtype: torch.dtype) -> None:
    ramp = torch.linspace(0, 1, 24, dtype=dtype).view(1, 1, 1, 24)
    options = {"photometric_bandwidth": 0.003, "num_landmarks": 3, "landmarks": "uniform", "patch_size": 1}
    assert_sound(nonlocal_operator(ramp, **options))


def test_a_warning_names_a_remedy_that_is_not_in_force() -> None:
    factor = torch.tensor([[[1.0, 1.0, -1.0, 1e-3]]])
    with pytest.warns(UserWarning, match="row sums that differ from 1 by up to .*num_landmarks$") as caught:
        sinkhorn_balance(KernelMatrix(factor, torch.zeros(1, 4)), completed=True)
    assert "completion" not in str(caught[0].message)


def test_a_tolerance_that_was_asked_for_is_no_reason_to_warn(recwarn: pytest.WarningsRecorder) -> None:
    operator = nonlocal_operator(picture("camera", 40, 40), tolerance=5e-2)
    assert 1e-12 < operator.residual.max() < 5e-2
    assert not recwarn
