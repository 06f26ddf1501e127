"""The scaling as the root for a moment, and the damped method, which converges from any start."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from nlfilter_torch.operator.nystrom import inverse_cholesky, nystrom_factor
from nlfilter_torch.operator.scaling import (
    LARGEST_ROOT,
    Balancing,
    KernelMatrix,
    balance_kernel,
    conjugate,
    conjugate_gradients,
    damped,
    newton,
    scaling_from_moment,
)
from nlfilter_torch.operator.sinkhorn import solve
from tests.native import LEVELS, by_torch
from tests.pairwise import pairwise
from tests.problems import noise


@pytest.mark.parametrize("diagonal", [1e-3, 0.1, 1.0])
def test_the_scaling_is_the_root_for_either_sign(diagonal: float) -> None:
    for half in [-3.0, -1e-3, 0.0, 1e-3, 3.0]:
        factor, rest = torch.ones(1, 1, 1, dtype=torch.float64), torch.full((1, 1), diagonal, dtype=torch.float64)
        scaling = scaling_from_moment(factor, rest, torch.full((1, 1, 1), 2 * half, dtype=torch.float64))
        assert scaling > 0
        torch.testing.assert_close(
            scaling * (2 * half + diagonal * scaling), torch.ones_like(scaling), atol=0, rtol=1e-9
        )


@pytest.mark.parametrize("start", [1e-6, 1.0, 1e6])
def test_the_damped_method_converges_from_any_start(start: float) -> None:
    factor = noise(2, 5, 60, seed=3) - 0.3  # with negative affinities
    factor = factor / factor.norm(dim=1, keepdim=True).clamp(min=1.0)
    diagonal = (1 - factor.square().sum(1)).clamp(min=0.01)
    assert (factor.mT @ factor).min() < -0.05
    scaling = torch.full((2, 60), start, dtype=torch.float64)
    infinite = torch.full((2,), torch.inf, dtype=torch.float64)
    matrix, identity = KernelMatrix(factor, diagonal), torch.eye(5).double().expand(2, -1, -1)
    begun = Balancing(matrix, scaling, factor @ scaling.unsqueeze(2), infinite, 0, identity)
    result = damped(matrix, begun, 1e-12)
    sums = result.scaling * ((factor.mT @ result.moment).squeeze(2) + diagonal * result.scaling)
    torch.testing.assert_close(sums, torch.ones_like(sums), atol=1e-11, rtol=0)
    assert result.residual.max() < 1e-11


def test_damped_steps_take_over_where_sweeps_do_not_converge() -> None:
    """The scaling d of a pixel exceeds the bound of the sweeps."""
    factor = torch.tensor([[[1.0, -0.9, -0.9, 0.4]]], dtype=torch.float64)
    diagonal = 1 - factor.square().sum(1) + 1e-3
    result = solve(KernelMatrix(factor, diagonal), 1e-12, True)
    assert result.scaling.max() > LARGEST_ROOT
    sums = result.scaling * ((factor.mT @ result.moment).squeeze(2) + diagonal * result.scaling)
    torch.testing.assert_close(sums, torch.ones_like(sums), atol=1e-11, rtol=0)


def test_damped_steps_balance_weighted_points() -> None:
    factor = noise(1, 4, 30, seed=3) - 0.3
    factor = factor / factor.norm(dim=1, keepdim=True).clamp(min=1.0)
    diagonal, weights = (1 - factor.square().sum(1)).clamp(min=0.01), noise(1, 30, seed=5) * 9 + 0.5
    scaling = torch.full((1, 30), 1e4, dtype=torch.float64)
    matrix, infinite = KernelMatrix(factor, diagonal, weights), torch.full((1,), torch.inf).double()
    start = Balancing(matrix, scaling, factor @ scaling.unsqueeze(2), infinite, 0, torch.eye(4).double())
    result = damped(matrix, start, 1e-12)
    sums = result.scaling * ((factor.mT @ result.moment).squeeze(2) + diagonal * result.scaling)
    torch.testing.assert_close(sums, torch.ones_like(sums), atol=1e-11, rtol=0)
    total = factor @ (weights * result.scaling).unsqueeze(2)
    torch.testing.assert_close(result.moment, total, atol=1e-9, rtol=0)


def system(steepness: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Factor, weights and right side of a linear system, and its solution; the spectrum grows with the steepness."""
    generator = torch.Generator().manual_seed(0)
    factor = torch.linalg.qr(torch.randn(1, 60, 30, generator=generator, dtype=torch.float64)).Q.mT.contiguous()
    weight = torch.logspace(0, steepness, 60, dtype=torch.float64).expand(1, -1) - 1
    right = torch.randn(1, 30, 1, generator=generator, dtype=torch.float64)
    matrix = torch.eye(30, dtype=torch.float64) + (factor * weight.unsqueeze(1)) @ factor.mT
    return factor, weight, right, torch.linalg.solve(matrix, right)


def test_conjugate_gradients_solve_systems_with_the_spectrum_of_balancing() -> None:
    factor, weight, right, expected = system(0.3)
    identity = torch.eye(30, dtype=torch.float64).expand(1, -1, -1)
    solution = conjugate_gradients(KernelMatrix(factor, weight), weight, right, identity)
    torch.testing.assert_close(solution, expected, atol=1e-12, rtol=0)


def test_conjugate_gradients_that_run_out_of_steps_say_so() -> None:
    factor, weight, right, expected = system(12.0)
    identity = torch.eye(30, dtype=torch.float64).expand(1, -1, -1)
    with pytest.warns(UserWarning, match="balancing left a linear system unsolved"):
        solution = conjugate_gradients(KernelMatrix(factor, weight), weight, right, identity)
    assert float((solution - expected).norm() / expected.norm()) > 0.01


def test_blocks_are_balanced_like_the_whole() -> None:
    """Newton's method over blocks and, with a bias, over a sample of them."""
    factor = noise(1, 5, 60, seed=3)
    factor = factor / factor.norm(dim=1, keepdim=True) * 0.9
    matrix = KernelMatrix(factor, 1 - factor.square().sum(1))
    parts = zip(factor.split(25, dim=2), matrix.diagonal.split(25, dim=1), strict=True)
    blocks = [KernelMatrix(*part) for part in parts]
    expected = solve(matrix, 1e-12, True).moment

    def over(function: Callable[..., Any], *arguments: object) -> Iterator[Any]:
        return (function(block, *arguments) for block in blocks)

    total, _, change = newton(over, 3 * expected, steps=20, tolerance=1e-9)
    torch.testing.assert_close(total, expected)
    assert change <= 1e-9
    sampled = blocks[0]
    bias = matrix.sweep(expected)[1] - sampled.sweep(expected)[1]
    total, _, _ = newton(sampled.whole, 2 * expected, steps=20, bias=bias)
    torch.testing.assert_close(total, expected)


def kernels(pixels: int, marks: int, batch: int = 1) -> tuple[Tensor, Tensor]:
    """Factors and diagonals of points in a plane, in float32."""
    points = 6 * noise(batch, 2, pixels, seed=1).float()
    landmarks = points[:, :, :: max(1, pixels // marks)][:, :, :marks]
    return nystrom_factor(points, landmarks, inverse_cholesky(landmarks), "diagonal")


@pytest.mark.parametrize(
    ("level", "pixels", "marks", "weighted"),
    pairwise(LEVELS, [1, 60, 900, 20_000], [1, 7, 40], [False, True], possible=lambda _, n, m, __: m <= n),
    indirect=["level"],
)
def test_kernels_in_c_balance_like_the_definition(level: int, pixels: int, marks: int, weighted: bool) -> None:
    factor, diagonal = kernels(pixels, marks, batch=2)
    weights = 3 * noise(2, pixels, seed=4).float() * (torch.arange(pixels) % 5 != 1) if weighted else None
    found, expected = (
        balance_kernel(factor, diagonal, weights, 1e-6),
        by_torch(balance_kernel, factor, diagonal, weights, 1e-6),
    )
    for own, other in zip(found[:2], expected[:2], strict=True):
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-6)
    scaling, moment, residual, inverse, sweeps = found
    masses = scaling if weights is None else scaling * weights
    torch.testing.assert_close(moment, factor.double() @ masses.double().unsqueeze(2), rtol=1e-5, atol=1e-5)
    sums = scaling * ((factor.mT @ moment.float()).squeeze(2) + diagonal * scaling)
    assert (sums - 1).abs().max() < 1e-5
    assert residual.max() < 1e-5
    assert sweeps.max() <= expected[4].max()
    solution = inverse @ moment  # the inverse is that of a sample
    share = masses * scaling / (1 + scaling.square() * diagonal)
    exact = torch.linalg.solve(
        torch.eye(factor.shape[1]).double() + (factor * share.unsqueeze(1)).double() @ factor.double().mT, moment
    )
    assert (solution - exact).norm() <= (1e-4 if pixels < 900 else 0.3) * exact.norm()


@pytest.mark.parametrize(
    ("level", "pixels", "marks", "count"), pairwise(LEVELS, [1, 60, 20_000], [1, 7, 40], [1, 2]), indirect=["level"]
)
def test_kernels_in_c_solve_like_the_definition(
    level: int, pixels: int, marks: int, count: int, threads: Callable[[int], None]
) -> None:
    threads(count)
    factor, _ = kernels(max(pixels, marks), marks, batch=2)
    weight, right = noise(2, factor.shape[2], seed=4).float() / 20, noise(2, marks, 1, seed=5) - 0.5
    inverse = torch.eye(marks).double().expand(2, -1, -1)
    for own, other in zip(
        conjugate(factor, weight, right, inverse), by_torch(conjugate, factor, weight, right, inverse), strict=True
    ):
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-6)
    zero, left = conjugate(factor, weight, torch.zeros_like(right), inverse)
    assert not zero.any()
    assert not left.any()


def test_images_are_balanced_in_a_batch_as_alone(threads: Callable[[int], None]) -> None:
    """Also on two threads, where each has an image."""
    factor, diagonal = kernels(3000, 20, batch=3)
    expected = [balance_kernel(*parts, None, 1e-6) for parts in zip(factor.split(1), diagonal.split(1), strict=True)]
    for count in (1, 2):
        threads(count)
        for whole, parts in zip(balance_kernel(factor, diagonal, None, 1e-6), zip(*expected, strict=True), strict=True):
            torch.testing.assert_close(whole, torch.cat(parts), rtol=1e-6, atol=1e-6)
