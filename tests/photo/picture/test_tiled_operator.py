"""The filter of a picture read by rows is the filter in memory."""

from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.photo.picture import sampling
from tests.tiles import ALPHA, LEVEL, cat, in_memory, streamed


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"residual": 1.0},
        {"spatial_bandwidth": 30.0},
        {"landmarks": "uniform"},
        {"landmarks": "random", "patch_size": 1},
        {"guide_channels": "all", "photometric_bandwidth": 0.1, "patch_size": 3},
        {"completion": "none"},
        {"alpha": torch.tensor([2.0, 1.0])},
        {"alpha": torch.tensor([1.5, 2.0, 0.5, 2.0, 1.0, 1.0])},
    ],
)
def test_full_passes_are_the_filter_in_memory(options: dict[str, Any]) -> None:
    picture = cat(83, 121)
    edited = streamed(picture, statistics="full", tile_rows=7, num_landmarks=50, **options)
    # The part captured by the eigenvectors involves division by small eigenvalues, which amplifies rounding.
    bound = 1e-5 if "residual" not in options else 5e-5
    assert np.abs(edited - in_memory(picture, num_landmarks=50, **options)).max() < bound


def test_float64_is_worked_out_in_float64() -> None:
    picture = cat(40, 50).astype(np.float64)
    edited = streamed(picture, statistics="full", num_landmarks=40)
    assert np.abs(edited - in_memory(picture, num_landmarks=40, tolerance=1e-12)).max() < 1e-7


def test_all_channels_on_request() -> None:
    picture = cat(50, 60)
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    operator = nonlocal_operator(image, num_landmarks=40)
    wanted = polynomial_filter(operator, image, ALPHA)[0].permute(1, 2, 0).numpy()
    edited = streamed(picture, statistics="full", channels="all", num_landmarks=40)
    assert np.abs(edited - wanted).max() < 1e-5


def test_sample_is_within_a_grey_level(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "PILOT", 1 << 12)
    picture = cat(270, 350)
    edited = streamed(picture, sample=1 << 13)
    difference = np.abs(edited - in_memory(picture)).max()
    assert 1e-5 < difference < LEVEL


def test_a_residual_takes_every_pixel() -> None:
    picture = cat(60, 80)
    edited, full = (
        streamed(picture, residual=1.0, statistics=statistics, sample=1500, num_landmarks=30)
        for statistics in ("sample", "full")
    )
    np.testing.assert_array_equal(edited, full)
