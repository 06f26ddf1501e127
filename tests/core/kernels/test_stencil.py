"""Linear systems of pixels and their neighbours, compared with dense ones."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.kernels import definitions_only, stencil
from nlfilter_torch.core.kernels.stencil import solve_stencil
from tests.native import random


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


SIZES = [(1, 1), (1, 7), (6, 1), (2, 2), (5, 8), (9, 4)]


def test_a_dense_solve_gives_the_same() -> None:
    for size in SIZES:
        stencil, right = problem(*size)
        result = solve_stencil(stencil, right)
        for image in range(2):
            wanted = torch.linalg.solve(dense(stencil[image]), right[image].flatten(1).mT).mT
            torch.testing.assert_close(result[image].flatten(1), wanted)


def test_float32_is_as_good_and_stays_so_under_autocast() -> None:
    stencil, right = problem(40, 30, dtype=torch.float32)
    wanted = solve_stencil(stencil.double(), right.double())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = solve_stencil(stencil, right)
    assert result.dtype == torch.float32
    torch.testing.assert_close(result, wanted.float())


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")
@pytest.mark.parametrize("size", [(4, 5), (5, 3)])
def test_coefficients_and_right_sides_have_gradients(size: tuple[int, int]) -> None:
    inputs = tuple(tensor.requires_grad_() for tensor in problem(*size))
    batched = {"check_forward_ad": True, "check_batched_grad": True, "check_batched_forward_grad": True}
    assert torch.autograd.gradcheck(solve_stencil, inputs, **batched)
    assert torch.autograd.gradgradcheck(solve_stencil, inputs, fast_mode=True)


def test_transforms_of_functions_and_compilation() -> None:
    stencil, right = problem(4, 6)

    def loss(stencil: Tensor, right: Tensor) -> Tensor:
        return solve_stencil(stencil, right).square().sum()

    wanted = torch.autograd.grad(loss(stencil.requires_grad_(), right), stencil)
    result = torch.func.grad(loss)(stencil.detach(), right)
    torch.testing.assert_close(result, *wanted)
    solutions = torch.vmap(lambda coefficients, side: solve_stencil(coefficients[None], side[None])[0])(
        stencil.detach(), right
    )
    torch.testing.assert_close(solutions, solve_stencil(stencil.detach(), right))
    compiled = torch.compile(loss, fullgraph=True, backend="eager")
    torch.testing.assert_close(torch.autograd.grad(compiled(stencil, right), stencil), wanted)


@pytest.mark.parametrize("size", [(1, 1), (1, 90), (11, 1), (5, 6), (23, 51), (64, 40)], ids=str)
def test_systems_of_pixels(size: tuple[int, int]) -> None:
    coefficients = random(2, 3, 3, *size).double()
    coefficients[:, 1, 1] = coefficients.abs().sum((1, 2))
    right = random(2, 3, *size, seed=1).double()
    result = stencil.solve_stencil(coefficients, right)
    with definitions_only():
        torch.testing.assert_close(stencil.solve_stencil(coefficients, right), result, rtol=1e-11, atol=1e-11)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert torch.equal(stencil.solve_stencil(coefficients, right), result)
    finally:
        torch.set_num_threads(threads)
