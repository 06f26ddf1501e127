"""W as a matrix: products, shifted systems and gradients, against the dense matrix."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalOperator, operator_from_features
from nlfilter_torch.operator.pixel_matrix import PixelMatrix
from tests.problems import noise

SHIFTS = torch.tensor([1e-9, 1e-4, 0.3], dtype=torch.float64)


def built(weighted: bool, batch: int = 2) -> NonlocalOperator:
    weights = noise(batch, 30, seed=3) + 0.3 if weighted else None
    return operator_from_features(
        3 * noise(batch, 3, 30), size=(5, 6), num_landmarks=8, weights=weights, landmarks="uniform"
    )


def matrix_of(operator: NonlocalOperator) -> PixelMatrix:
    parts = operator.factor, operator.scaling, operator.remainder
    return PixelMatrix(*parts, operator.communicator, operator.weights)


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
    matrix = PixelMatrix(factor, scaling, remainder, built(False).communicator)
    inverses = matrix.capacitances(torch.tensor([1e-12]))
    assert inverses.isfinite().all()
    assert matrix.solve(noise(1, 1, 300).float(), torch.tensor([1e-12]), inverses).abs().max() < 2


@pytest.mark.parametrize("weighted", [False, True])
def test_the_gradient_is_that_of_autograd(weighted: bool) -> None:
    operator, (left, right) = built(weighted), noise(2, 2, 3, 30, seed=2)
    parts = [t.detach().clone().requires_grad_() for t in (operator.factor, operator.scaling, operator.remainder)]
    matrix = PixelMatrix(*parts, operator.communicator, operator.weights)
    assert matrix.needs_gradient
    (left * matrix.product(right)).sum().backward()
    with torch.no_grad():
        grads: tuple[Tensor, ...] = matrix.gradient(left, right)
    for part, grad in zip(parts, grads, strict=True):
        torch.testing.assert_close(part.grad, grad + torch.zeros_like(part))
