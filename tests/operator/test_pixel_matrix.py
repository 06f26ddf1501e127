"""W as a matrix: products, shifted systems and gradients, against the dense matrix."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradgradcheck

from nlfilter_torch import NonlocalOperator, nonlocal_operator, operator_from_features, polynomial_filter
from nlfilter_torch.operator.pixel_matrix import Columns, PixelMatrix
from tests.problems import build, guides, noise, options, picture, seeded

SHIFTS = torch.tensor([1e-9, 1e-4, 0.3], dtype=torch.float64)


def built(weighted: bool, batch: int = 2) -> NonlocalOperator:
    weights = noise(batch, 30, seed=3) + 0.3 if weighted else None
    return operator_from_features(
        3 * noise(batch, 3, 30), size=(5, 6), num_landmarks=8, weights=weights, landmarks="uniform"
    )


def matrix_of(operator: NonlocalOperator) -> PixelMatrix:
    parts = operator.factor, operator.scaling, operator.remainder
    return PixelMatrix(*parts, operator.weights, operator.communicator)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("transposed", [False, True])
def test_products_and_solutions_are_those_of_the_dense_matrix(weighted: bool, transposed: bool) -> None:
    operator, planes = built(weighted), noise(2, 4, 30, seed=1)
    matrix, dense = matrix_of(operator), operator.to_dense()
    if transposed:
        matrix, dense = matrix.transpose, dense.mT
    torch.testing.assert_close(matrix.product(planes), planes @ dense.mT)
    solutions = matrix.solve(planes, SHIFTS, matrix.capacitances(SHIFTS))
    for j, shift in enumerate(SHIFTS):
        shifted = dense + shift * torch.eye(30, dtype=torch.float64)
        wanted = shift * torch.linalg.solve(shifted, planes.mT).mT
        torch.testing.assert_close(solutions[:, j], wanted, atol=1e-6, rtol=1e-6)


def test_solutions_in_float32_are_those_in_float64() -> None:
    operator, planes = built(False), noise(2, 4, 30, seed=1)
    exact, single = (
        matrix_of(operator.to(dtype)).solve(
            planes.to(dtype), SHIFTS.to(dtype), matrix_of(operator.to(dtype)).capacitances(SHIFTS)
        )
        for dtype in (torch.float64, torch.float32)
    )
    torch.testing.assert_close(single.double(), exact, atol=2e-4, rtol=0)


def test_a_gram_matrix_with_rounding_errors_is_solved() -> None:
    """Two landmarks at one place: the Gram matrix has the eigenvalue 0, which rounding makes negative."""
    factor = noise(1, 4, 300).float()
    factor[:, 1] = factor[:, 0]
    scaling, remainder = torch.full((1, 300), 0.05), torch.zeros(1, 300)
    matrix = PixelMatrix(factor, scaling, remainder)
    inverses = matrix.capacitances(torch.tensor([1e-12]))
    assert inverses.isfinite().all()
    assert matrix.solve(noise(1, 1, 300).float(), torch.tensor([1e-12]), inverses).abs().max() < 2


@pytest.mark.parametrize("weighted", [False, True])
def test_the_gradient_is_that_of_autograd(weighted: bool) -> None:
    operator, (left, right) = built(weighted), noise(2, 2, 3, 30, seed=2)
    parts = [t.detach().clone().requires_grad_() for t in (operator.factor, operator.scaling, operator.remainder)]
    matrix = PixelMatrix(*parts, operator.weights, operator.communicator)
    assert matrix.needs_gradient
    (left * matrix.product(right)).sum().backward()
    with torch.no_grad():
        grads: tuple[Tensor, ...] = matrix.gradient(left, right)
    for part, grad in zip(parts, grads, strict=True):
        torch.testing.assert_close(part.grad, grad + torch.zeros_like(part))


@given(guide=guides(), chosen=options, channels=st.integers(1, 4))
def test_product_is_that_of_the_dense_matrix_and_keeps_the_mean(
    guide: torch.Tensor, chosen: dict[str, object], channels: int
) -> None:
    operator = build(guide, **chosen)
    image = noise(guide.shape[0], channels, *guide.shape[2:], seed=1)
    filtered = operator @ image
    dense = (operator.to_dense() @ image.flatten(2).mT).mT.reshape(image.shape)
    torch.testing.assert_close(filtered, dense, atol=1e-10, rtol=0)
    torch.testing.assert_close(operator.matmul(image), filtered, atol=0, rtol=0)
    torch.testing.assert_close(filtered.mean((2, 3)), image.mean((2, 3)), atol=1e-6, rtol=0)


SIZE = (5, 4)
ALPHA = (3.0, 0.5, 2.0, 1.05)
# Without completion, the method itself breaks down at a small bandwidth.
BANDWIDTHS = {"diagonal": 0.2, "none": 0.8}


def small(channels: int = 1, seed: int = 0, batch: int = 1) -> Tensor:
    return noise(batch, channels, *SIZE, seed=seed).requires_grad_()


def small_operator(guide: Tensor, completion: str, **options: object) -> NonlocalOperator:
    options = {"photometric_bandwidth": BANDWIDTHS[completion], "num_landmarks": 7, "patch_size": 3} | options
    return nonlocal_operator(guide, completion=completion, guide_channels="all", **options)  # type: ignore[arg-type]


def test_second_derivatives_in_image_and_alpha_of_a_fitted_operator() -> None:
    operator = small_operator(small().detach(), "diagonal")
    alpha = torch.tensor(ALPHA, dtype=torch.float64, requires_grad=True)

    def call(image: Tensor, alpha: Tensor) -> Tensor:
        return polynomial_filter(operator, image, alpha).square()

    assert gradgradcheck(call, (small(seed=1), alpha))


def test_one_operator_evaluates_a_batch_of_points_and_several_operators_one_set() -> None:
    features, points = noise(2, 3, 60, seed=1).float(), noise(3, 3, 40, seed=2).float()
    both = operator_from_features(features, size=(60,), num_landmarks=20)
    single = operator_from_features(features[:1], size=(60,), num_landmarks=20)
    many, pair = single.at(points), both.at(points[:1])
    for result, expected in (
        *((many.factor[i : i + 1], single.at(points[i : i + 1]).factor) for i in range(3)),
        *((many.scaling[i : i + 1], single.at(points[i : i + 1]).scaling) for i in range(3)),
        (pair.factor, both.at(points[:1].repeat(2, 1, 1)).factor),
        (pair.scaling, both.at(points[:1].repeat(2, 1, 1)).scaling),
    ):
        torch.testing.assert_close(result, expected, atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match="features must have batch size 1 or 2, like the operator, got 3"):
        both.at(points)


def test_columns_at_the_points_themselves_are_those_of_the_operator() -> None:
    image = picture("coffee", 30, 30)
    operator = nonlocal_operator(image)
    columns = operator.at(operator.kernel.recipe(image))
    assert isinstance(columns, Columns)
    torch.testing.assert_close(columns.factor, operator.factor, atol=1e-12, rtol=0)
    torch.testing.assert_close(columns.scaling, operator.scaling, atol=1e-9, rtol=0)
    torch.testing.assert_close(columns.remainder, operator.remainder, atol=1e-9, rtol=0)


def test_columns_of_other_features_are_checked() -> None:
    operator = operator_from_features(noise(1, 3, 12), size=(3, 4), num_landmarks=4)
    assert operator.at(noise(1, 3, 5, dtype=torch.float32)).factor.shape == (1, 4, 5)
    with pytest.raises(ValueError, match="features must have 3 features per point"):
        operator.at(noise(1, 2, 5))


def test_columns_are_differentiable_in_the_features_of_the_operator() -> None:
    points = torch.rand(1, 2, 30, generator=seeded(5), dtype=torch.float64) * 2
    others = torch.rand(1, 2, 5, generator=seeded(6), dtype=torch.float64) * 2

    def total(features: torch.Tensor) -> torch.Tensor:
        built = operator_from_features(
            features, size=(30,), num_landmarks=6, landmarks="random", tolerance=1e-13, generator=seeded(0)
        )
        return built.at(others).scaling.sum()

    leaf = points.clone().requires_grad_()
    (result,) = torch.autograd.grad(total(leaf), leaf)
    for index in range(0, 30, 5):
        step = torch.zeros_like(points)
        step[0, 0, index] = 1e-5
        wanted = float(total(points + step) - total(points - step)) / 2e-5
        assert float(result[0, 0, index]) == pytest.approx(wanted, rel=1e-4, abs=1e-7)
