"""Pictures read by rows as the source of an edit: regions, and tiles of any size."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch import estimate_noise, noise_profile, nonlocal_operator
from nlfilter_torch.filtering.filters import filter_regions
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.noise import noise_of, profile_of
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from tests import problems
from tests.recipes import by_rows, rows_of
from tests.tiles import ALPHA, LEVEL, Array, cat, in_memory, spots, streamed


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("alpha", [ALPHA, torch.stack([ALPHA, torch.tensor([0.2, 0.5, 1.0, 1.0])])])
def test_regions_are_those_in_memory(alpha: Tensor) -> None:
    picture, regions = cat(60, 90), spots(60, 90)
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    options: dict[str, Any] = {"num_landmarks": 50, "spatial_bandwidth": 60.0}
    masks = region_mask(
        image, torch.from_numpy(regions).permute(2, 0, 1)[None], extent="near", reach=0.7, num_landmarks=50
    )
    operator = nonlocal_operator(reduce_channels(image, "luminance"), **options)
    wanted = edit_luminance(image, lambda planes: filter_regions(operator, planes, masks, alpha.expand(2, -1)))
    edited = streamed(picture, alpha, regions=regions, reach=0.7, statistics="full", tile_rows=17, **options)
    assert np.abs(edited - wanted[0].permute(1, 2, 0).numpy()).max() < 2e-5


def test_regions_of_a_sample_are_close(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "PILOT", 1 << 13)
    picture, regions = cat(200, 260), spots(200, 260)
    full, sampled = (
        streamed(picture, regions=regions, statistics=statistics, sample=1 << 15, num_landmarks=30)
        for statistics in ("full", "sample")
    )
    assert 0 < np.abs(full - sampled).max() < 3 * LEVEL  # with a thirtieth of the sample of a large picture
    assert np.abs(full - picture).max() > 10 * LEVEL


@pytest.mark.parametrize(
    ("regions", "alpha", "message"),
    [
        (np.ones((20, 31, 1), np.float32), ALPHA, "regions must"),
        (np.zeros((20, 30, 1), np.float32), ALPHA, "must hold a painted pixel, got none"),
        (-np.ones((20, 30, 1), np.float32), ALPHA, "regions must"),
        (np.ones((20, 30, 2), np.float32), ALPHA[None], r"alpha must have shape \(2, k\+1\), a row of sliders"),
    ],
)
def test_regions_that_cannot_be_used_are_named(regions: Array, alpha: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        streamed(cat(20, 30), alpha, regions=regions, num_landmarks=20)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("statistics", ["sample", "full"])
def test_tiles_of_any_size_give_the_same(statistics: str) -> None:
    picture = cat(150, 67)
    for options in ({}, {"regions": spots(150, 67)}):
        first, *others = (
            streamed(picture, statistics=statistics, sample=4000, num_landmarks=50, tile_rows=rows, **options)
            for rows in (1, 16, 4096)
        )
        assert max(np.abs(other - first).max() for other in others) < 2.5e-7  # of the colour conversion alone


def test_more_landmarks_than_pixels_are_reduced() -> None:
    picture = cat(5, 6)
    assert np.abs(streamed(picture, num_landmarks=50) - in_memory(picture, num_landmarks=30)).max() < 1e-5


def test_tiles_and_their_margins_fit_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image, recipe = problems.cat(), Recipe((Step("abstract", landmarks=20, edges=1.0),))
    monkeypatch.setattr("nlfilter_torch.photo.picture.tiled.FINISH_FLOATS", 4000)  # 2.4 MB a row
    few = by_rows(recipe, rows_of(image), tmp_path, memory=60_000_000)  # and so two tiles or more
    assert np.abs(few - by_rows(recipe, rows_of(image), tmp_path)).max() < 1e-5
    monkeypatch.setattr("nlfilter_torch.photo.picture.tiled.FINISH_FLOATS", 20_000)
    with pytest.raises(MemoryError, match=r"scan.tif needs at least \d+ MB of memory, but only 60 MB may be used"):
        by_rows(recipe, rows_of(image), tmp_path, memory=60_000_000)


def test_noise_is_estimated_by_rows_as_in_memory() -> None:
    image = problems.cat()
    tiled = Tiled(Picture(rows_of(image)), Passes("float32"))
    assert torch.equal(noise_of(tiled).level, estimate_noise(image))
    assert torch.equal(profile_of(tiled).levels, noise_profile(image).levels)
