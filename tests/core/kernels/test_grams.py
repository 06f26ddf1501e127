"""Gram matrices of a factor: the kernel in C agrees with the definition in torch."""

import pytest
import torch

from nlfilter_torch.core.kernels.grams import sum_grams
from tests.native import LEVELS, by_torch, random
from tests.pairwise import pairwise


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
