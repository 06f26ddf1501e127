"""Samples of the pixels of a picture."""

from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch.operator import landmarks as landmarks_module
from nlfilter_torch.operator.landmarks import candidate_pixels
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.sampling import ColumnCache, Draws, GuidePicture, PassOverPicture, draw
from nlfilter_torch.photo.picture.source import Guide
from nlfilter_torch.photo.picture.statistics import Block, Guess
from tests.tiles import Array, cat, streamed


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("completion", ["diagonal", "none"])
def test_sample_holds_about_as_many_pixels_as_asked_for_and_stands_for_all(completion: Any) -> None:
    picture = GuidePicture(Picture(cat(90, 120)), Guide(FilterOptions(num_landmarks=30, completion=completion)))
    pilot = sampling.take_pilot(picture, silent)
    guess = Guess(pilot.moment, torch.zeros(1, 0, 30, 1), lambda block, _: block.image, spectral=True)
    draw_from, moment, grams = Draws(pilot, guess.columns(pilot.sample), 3000, picture.picture.pixels), 0.0, 0.0
    drawn = []
    for block in PassOverPicture(picture, pilot.kernel, silent, "Sampling", 2, ColumnCache(2400, 5000))(
        lambda block: block
    ):
        columns, totals = guess.totals(block)
        drawn.append(draw_from(block, columns))
        moment, grams = moment + totals[0], grams + totals[2]
    assert len(drawn) > 1
    sample = Block.concatenate(drawn)
    assert 2500 < sample.weights.numel() < 3500
    assert abs(float(sample.weights.sum()) / picture.picture.pixels - 1) < 0.1
    estimated, _, estimate = guess.totals(sample)[1]
    assert (estimated - moment).norm() < 0.02 * torch.as_tensor(moment).norm()
    assert (estimate - grams).norm() < 0.025 * torch.as_tensor(grams).norm()


def test_draws_follow_the_rates_and_leave_no_gap() -> None:
    generator = np.random.default_rng(0)
    rates = torch.from_numpy(generator.random(500).clip(0.01)) * 0.9
    rates[::50] = 1.0
    drawn, rounds = torch.zeros(500), 4000
    for _ in range(rounds):
        chosen, counts = draw(rates, generator)
        assert (chosen.diff() > 0).all()
        assert counts.max() <= 2
        assert abs(int(counts.sum()) - float(rates.sum())) <= 1
        drawn[chosen] += counts
    assert (drawn[::50] == rounds).all()
    # Six standard deviations of a count whose variance is at most that of independent draws.
    assert ((drawn / rounds - rates).abs() < 6 * (rates / rounds).sqrt()).all()


def test_draws_meet_no_period() -> None:
    rates, ways = torch.full((4000,), 0.25, dtype=torch.float64), np.random.default_rng(0)
    even = [int((draw(rates, ways)[0] % 4 == 1).sum()) for _ in range(20)]  # a texture of four pixels
    assert max(abs(count - 250) for count in even) < 100


def test_equal_seeds_give_equal_pictures() -> None:
    picture = cat(40, 60)

    def edited(seed: int) -> Array:
        return streamed(picture, sample=1000, num_landmarks=20, generator=torch.Generator().manual_seed(seed))

    np.testing.assert_array_equal(edited(1), edited(1))
    assert not np.array_equal(edited(1), edited(2))


def test_random_landmarks_of_many_pixels_are_distinct(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landmarks_module, "MANY", 400)
    chosen = candidate_pixels((21, 20), 30, "random", torch.Generator().manual_seed(0))
    assert len(chosen) == len(set(chosen.tolist())) == 30
    assert 0 <= int(chosen.min()) < int(chosen.max()) < 420
