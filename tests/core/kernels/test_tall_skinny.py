"""Products with few rows equal plain matrix products, whether divided into parts or not."""

from collections.abc import Callable
from contextlib import nullcontext

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.blocks import SWEPT
from nlfilter_torch.core.kernels import definitions_only, tall_skinny
from nlfilter_torch.core.kernels.tall_skinny import compute_grams, gather, moment, spread, sum_grams, weigh
from nlfilter_torch.operator.scaling import KernelMatrix
from tests.native import LEVELS, by_torch, random
from tests.pairwise import pairwise
from tests.rounding import SPREAD


def doubles(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize(
    ("count", "pixels", "rows", "batch"),
    pairwise([1, 2, 3], [1, 7, 64, SWEPT, 2 * SWEPT + 5], [1, 3, 5, 30], [1, 2]),
)
def test_equal_to_matrix_products(count: int, pixels: int, rows: int, batch: int, threads: Callable[[int], None]):
    threads(count)
    factor, vectors, images = doubles(batch, 6, pixels), doubles(batch, rows, 6), doubles(batch, rows, pixels)
    gathered = images @ factor.mT
    torch.testing.assert_close(spread(vectors, factor), vectors @ factor)
    scaling = doubles(batch, pixels)
    torch.testing.assert_close(spread(vectors, factor, scaling), vectors @ factor * scaling.unsqueeze(1))
    torch.testing.assert_close(gather(images, factor), gathered)
    torch.testing.assert_close(moment(factor, images), gathered.mT)


@pytest.mark.parametrize("count", [1, 3])
def test_factors_of_any_layout(count: int, threads: Callable[[int], None]):
    threads(count)
    factor, vectors, images = doubles(1, 64, 6).mT, doubles(1, 6, 2).mT, doubles(1, 64, 2).mT
    torch.testing.assert_close(spread(vectors, factor), vectors @ factor)
    torch.testing.assert_close(gather(images, factor), images @ factor.mT)


@pytest.mark.parametrize("count", [1, 3])
def test_derivatives_of_any_order(count: int, threads: Callable[[int], None]):
    threads(count)
    leaves = [part.requires_grad_() for part in (doubles(1, 2, 3), doubles(1, 3, 8), doubles(1, 2, 8))]
    torch.autograd.gradgradcheck(lambda rows, factor, _: spread(rows, factor), leaves)
    torch.autograd.gradgradcheck(lambda _, factor, images: gather(images, factor), leaves)


def swept(factor: Tensor, diagonal: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    return KernelMatrix(factor, diagonal).sweep(total)


def fits(_: int, pixels: int, marks: int) -> bool:
    """Whether not both are large; all other sizes have full blocks of either kind."""
    return pixels * marks <= 8_000_000


@pytest.mark.parametrize(
    ("level", "pixels", "marks"),
    pairwise(LEVELS, [1, 7, 255, 8256, 40_000], [1, 3, 50, 900], possible=fits),
    indirect=["level"],
)
def test_sweep(level: int, pixels: int, marks: int) -> None:
    factor = random(2, marks, pixels).abs()
    factor = factor / factor.square().sum(1, keepdim=True).sqrt() * torch.linspace(0, 1, pixels)
    diagonal = 1 - factor.square().sum(1).clamp(max=1)
    total = random(2, marks, 1, seed=1).abs().double() * pixels**0.5
    exact = swept(factor.double(), diagonal.double(), total)
    result = swept(factor, diagonal, total)
    plain = by_torch(swept, factor, diagonal, total)
    torch.testing.assert_close(result[0], exact[0].float(), rtol=1e-5, atol=0)
    error, usual = (result[1] - exact[1]).abs().max(), (plain[1] - exact[1]).abs().max()
    assert error <= SPREAD * usual + 1e-5 * exact[1].abs().max(), (error, usual)


@pytest.mark.parametrize(
    ("level", "pixels", "rows", "marks"),
    pairwise(LEVELS, [1, 9, 63, 4128, 4129, 30_001], [1, 2, 3, 8], [1, 2, 3, 5, 100]),
    indirect=["level"],
)
def test_products_with_few_rows(level: int, pixels: int, rows: int, marks: int) -> None:
    batch = 1 if pixels in (1, 4129, 30_001) else 2
    factor, vectors, images = random(batch, marks, pixels), random(batch, rows, marks), random(batch, rows, pixels)
    image = (vectors.double() @ factor.double()).float()
    torch.testing.assert_close(spread(vectors, factor), image, atol=1e-5, rtol=1e-6)
    scaling = random(batch, pixels, seed=1)
    torch.testing.assert_close(spread(vectors, factor, scaling), image * scaling.unsqueeze(1), atol=1e-4, rtol=1e-6)
    result = moment(factor, images)
    assert result.dtype == torch.float64
    size = (factor.double().abs() @ images.double().mT.abs()) * 1e-6
    assert ((result - factor.double() @ images.double().mT).abs() <= size).all()


@pytest.mark.parametrize(
    ("level", "pixels", "marks"),
    pairwise(LEVELS, [1, 300, 8256, 40_000], [1, 3, 50, 900], possible=fits),
    indirect=["level"],
)
def test_weighted_moments(level: int, pixels: int, marks: int) -> None:
    arguments = random(2, marks, pixels), random(2, pixels, seed=1).exp(), random(2, marks)
    factor, weights, total = (t.double() for t in arguments)
    exact = (factor @ (weights.unsqueeze(2) * (factor.mT @ total.unsqueeze(2)))).squeeze(2)
    result = weigh(*arguments)
    plain = by_torch(weigh, *arguments)
    error, usual = (result - exact).abs().max(), (plain - exact).abs().max()
    assert error <= SPREAD * usual + 1e-6 * exact.abs().max(), (error, usual)


def test_weights_count_pixels() -> None:
    factor, diagonal = random(2, 6, 40).abs() / 10, random(2, 40).sigmoid()
    half, copies = random(2, 6, seed=1).abs(), torch.arange(40) % 3 + 1
    repeated = (part.repeat_interleave(copies, dim=-1) for part in (factor, diagonal))
    for context in (nullcontext(), definitions_only()):
        with context:
            scaling, result = tall_skinny.sweep(factor, diagonal, half, 2.0, copies.expand(2, -1).float())
    many, expected = tall_skinny.sweep(*repeated, half, 2.0)
    torch.testing.assert_close(scaling.repeat_interleave(copies, dim=1), many)
    torch.testing.assert_close(result, expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("level", "pixels", "marks", "count"),
    pairwise(
        LEVELS,
        [1, 17, 1024, 1025, 9000],
        [1, 3, 6, 7, 50, 400],
        [1, 2, 4],
        possible=lambda _, pixels, marks, __: pixels * marks <= 3_000_000,  # smaller sizes have full blocks of either
    ),
    indirect=["level"],
)
def test_grams(level: int, pixels: int, marks: int, count: int) -> None:
    factor, scaling, remainder = random(2, marks, pixels), random(2, pixels, seed=1).exp(), random(2, pixels).sigmoid()
    result = sum_grams(factor, scaling, remainder, count)
    plain = by_torch(sum_grams, factor, scaling, remainder, count)
    scaled = (factor * scaling.unsqueeze(1)).double()
    for j in range(count):
        exact = (scaled * remainder.double().unsqueeze(1) ** j) @ scaled.mT
        size = exact.diagonal(dim1=1, dim2=2).amax() * 3e-7
        assert (result[:, j] - exact).abs().max() <= size
        assert (plain[:, j] - exact).abs().max() <= 10 * size
    assert torch.equal(result, result.mT)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_gradients_of_grams(count: int) -> None:
    factor, scaling, remainder = (doubles(*shape).requires_grad_() for shape in ((2, 4, 9), (2, 9), (2, 9)))
    assert torch.autograd.gradcheck(lambda *parts: compute_grams(*parts, count), (factor, scaling, remainder))
