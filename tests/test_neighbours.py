"""Weights between neighbouring pixels, and linear systems of pixels and their neighbours, compared with dense ones."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.filtering.neighbours import SIDES, neighbour_weights, solve_stencil


def problem(height: int, width: int, batch: int = 2, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """A stencil that is not symmetric, with positive and negative coefficients, and right sides of three channels."""
    generator = torch.Generator().manual_seed(height * width)
    stencil = torch.rand(batch, 3, 3, height, width, dtype=dtype, generator=generator) - 0.7
    stencil[:, 1, 1] = stencil.abs().sum((1, 2)) + 0.01
    return stencil, torch.rand(batch, 3, height, width, dtype=dtype, generator=generator)


def dense(stencil: Tensor) -> Tensor:
    """The matrix (N, N) of a stencil (3, 3, H, W), pair by pair."""
    height, width = stencil.shape[2:]
    matrix = torch.zeros(height * width, height * width, dtype=stencil.dtype)
    for y in range(height):
        for x in range(width):
            for b in range(max(y - 1, 0), min(y + 2, height)):
                for a in range(max(x - 1, 0), min(x + 2, width)):
                    matrix[y * width + x, b * width + a] = stencil[b - y + 1, a - x + 1, y, x]
    return matrix


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1), (2, 2), (5, 8), (9, 4)])
def test_a_dense_solve_gives_the_same(size: tuple[int, int]) -> None:
    stencil, right = problem(*size)
    found = solve_stencil(stencil, right)
    for image in range(2):
        wanted = torch.linalg.solve(dense(stencil[image]), right[image].flatten(1).mT).mT
        torch.testing.assert_close(found[image].flatten(1), wanted)


def test_float32_is_as_good_and_stays_so_under_autocast() -> None:
    stencil, right = problem(40, 30, dtype=torch.float32)
    wanted = solve_stencil(stencil.double(), right.double())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = solve_stencil(stencil, right)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, wanted.float())


@pytest.mark.parametrize("size", [(4, 5), (5, 3)])
def test_coefficients_and_right_sides_have_gradients(size: tuple[int, int]) -> None:
    given = tuple(tensor.requires_grad_() for tensor in problem(*size))
    assert torch.autograd.gradcheck(solve_stencil, given, fast_mode=True)
    assert torch.autograd.gradgradcheck(solve_stencil, given, fast_mode=True)


def test_weights_of_neighbours_are_those_of_pairs() -> None:
    guide = torch.rand(1, 2, 4, 5, generator=torch.Generator().manual_seed(3))
    weights = neighbour_weights(guide, lambda squared: torch.exp(-4 * squared))
    assert weights.shape == (1, 4, 4, 5)
    for number, (here, there) in enumerate(SIDES):
        wanted = torch.exp(-4 * (guide[..., *here] - guide[..., *there]).square().sum(1))
        torch.testing.assert_close(weights[:, number, *here], wanted)
        assert float(weights[:, number].sum()) == pytest.approx(float(wanted.sum()))
