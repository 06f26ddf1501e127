"""Balancing by passes over the pixels."""

import pytest

from nlfilter_torch.photo.picture.source import Guide
from nlfilter_torch.photo.tiled import sampling
from nlfilter_torch.photo.tiled.pictures import Picture
from nlfilter_torch.photo.tiled.sampling import GuidePicture
from nlfilter_torch.photo.tiled.statistics import balance_by_passes
from tests.tiles import cat


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def test_balancing_that_does_not_settle_warns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.tiled.statistics.MAX_PASSES", 1)
    picture = GuidePicture(Picture(cat(30, 40)), Guide({}))
    pilot = sampling.take_pilot(picture, silent, num_landmarks=20)
    with pytest.warns(UserWarning, match="balancing still changed by .* after 1 passes"):
        balance_by_passes(lambda of: [of(pilot.sample)], 9 * pilot.moment, completed=True)
