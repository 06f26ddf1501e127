"""Balancing by passes over the pixels."""

import pytest
import torch

from nlfilter_torch import nonlocal_operator
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.pixel_matrix import Columns, PixelMatrix, capacitance_inverse
from nlfilter_torch.operator.scaling import summed
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.sampling import GuidePicture
from nlfilter_torch.photo.picture.source import Guide
from nlfilter_torch.photo.picture.statistics import balance_by_passes
from tests.problems import noise
from tests.tiles import cat


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def test_balancing_that_does_not_settle_warns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.statistics.MAX_PASSES", 1)
    picture = GuidePicture(Picture(cat(30, 40)), Guide(FilterOptions(num_landmarks=20)))
    pilot = sampling.take_pilot(picture, silent)
    with pytest.warns(UserWarning, match="balancing still changed by .* after 1 passes"):
        balance_by_passes(pilot.sample.whole, 9 * pilot.moment, torch.float32, completed=True)


def test_sums_over_weighted_blocks_solve_shifted_systems() -> None:
    shifts, planes = torch.tensor([0.001, 0.5], dtype=torch.float64), noise(1, 2, 70, seed=1)
    operator = nonlocal_operator(noise(1, 1, 7, 10), num_landmarks=9, photometric_bandwidth=0.4)
    weights = torch.rand(1, 70, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.5
    parts = operator.factor, operator.scaling, operator.remainder, weights
    matrix = PixelMatrix(*parts)
    wanted = matrix.solve(planes, shifts, matrix.capacitances(shifts))
    cuts = [slice(0, 30), slice(30, 70)]
    blocks = [(Columns(*(part[..., cut] for part in parts)), planes[..., cut]) for cut in cuts]
    grams, sums = summed(
        (block.shifted_grams(shifts, exact=False), block.shifted_sums(values, shifts)) for block, values in blocks
    )
    inner = capacitance_inverse(grams) @ sums
    solutions = [block.shifted_solutions(values, shifts, inner) for block, values in blocks]
    torch.testing.assert_close(torch.cat(solutions, dim=3), wanted, atol=1e-9, rtol=0)
