"""Checks of arguments: numbers of numpy, scales, and warnings at the line of the caller."""

import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NonlocalFilter,
    nonlocal_operator,
    spectral_filter,
)
from nlfilter_torch.core.checks import check_finite
from nlfilter_torch.photo import (
    Step,
    abstract,
    adjust_tone,
    colorize,
    defocus,
    denoise,
    enhance,
    filter_frames,
    recolor,
    sharpen,
)
from tests.problems import noise

IMAGE = noise(2, 3, 8, 9, dtype=torch.float32)


GREY = IMAGE[:, :1]


PAINTED = torch.zeros(2, 1, 8, 9).index_fill(3, torch.tensor([2]), 1.0)


OPTIONS: dict[str, Any] = {"num_landmarks": 20, "photometric_bandwidth": 0.3}


SPECTRUM = nonlocal_operator(GREY, **OPTIONS).spectrum()


ONES = torch.ones(4)


EDITS: dict[str, Callable[[Tensor], object]] = {
    "recolor": lambda x: recolor(x, IMAGE, PAINTED, num_landmarks=20),
    "colorize": lambda x: colorize(x[:, :1], IMAGE, PAINTED, num_landmarks=20),
    "nonlocal_operator": lambda x: nonlocal_operator(x, num_landmarks=20),
    "small bandwidth": lambda x: nonlocal_operator(x, num_landmarks=20, photometric_bandwidth=0.1),
    "NonlocalFilter": lambda x: NonlocalFilter(num_landmarks=20)(x),
}
#: These see images in the range that they use.
OF_ANY_SCALE: dict[str, Callable[[Tensor], object]] = {
    "defocus": lambda x: defocus(x, PAINTED, num_landmarks=20),
    "abstract": lambda x: abstract(x, num_landmarks=20),
    "denoise": lambda x: denoise(x, num_landmarks=20),
    "sharpen": lambda x: sharpen(x, num_landmarks=20),
    "adjust_tone": lambda x: adjust_tone(x, num_landmarks=20),
    "enhance": lambda x: enhance(x, ONES, PAINTED, num_landmarks=20),
    "filter_frames": lambda x: filter_frames([], ONES, references=[x[:1]], num_landmarks=20),
}


def test_integers_of_numpy_are_taken() -> None:
    options = {"num_landmarks": np.int64(20), "patch_size": np.int32(3), "photometric_bandwidth": np.float32(0.25)}
    usual = {"num_landmarks": 20, "patch_size": 3, "photometric_bandwidth": 0.25}
    assert torch.equal(enhance(IMAGE, ONES, **options), enhance(IMAGE, ONES, **usual))
    assert torch.equal(nonlocal_operator(GREY, **options).factor, nonlocal_operator(GREY, **usual).factor)
    level = torch.tensor([0.1, 0.2])
    assert torch.equal(denoise(IMAGE, noise_level=level), denoise(IMAGE, noise_level=level.view(2, 1, 1, 1)))
    assert Step("detail", alpha=(np.float32(2), np.int64(1))).to_json() == Step("detail", alpha=(2.0, 1)).to_json()


def test_a_constant_response_may_be_learned() -> None:
    spectrum = nonlocal_operator(GREY.clone().requires_grad_(), **OPTIONS).spectrum()
    gain = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    filtered = spectral_filter(spectrum, IMAGE, lambda s: gain * torch.ones_like(s))
    filtered.square().sum().backward()
    unit = spectral_filter(SPECTRUM, IMAGE, torch.ones_like)
    torch.testing.assert_close(filtered.detach(), 2 * unit)
    torch.testing.assert_close(gain.grad.float(), 4 * unit.square().sum(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("edit", list(EDITS))
def test_one_warning_for_an_image_in_0_to_255(edit: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        EDITS[edit](255 * IMAGE)
    about = [w for w in caught if "[0, 1]" in str(w.message)]
    assert len(about) == 1
    assert re.fullmatch(r"(image|grey|guide|references) must be .+, got values up to 25\d.*; .+", str(about[0].message))
    assert about[0].filename == __file__


@pytest.mark.parametrize("edit", list(OF_ANY_SCALE))
@pytest.mark.filterwarnings("error")
def test_no_warning_for_edits_of_any_scale(edit: str) -> None:
    OF_ANY_SCALE[edit](255 * IMAGE)


def test_no_warning_for_feature_maps_and_high_dynamic_range() -> None:
    nonlocal_operator(255 * noise(1, 8, 8, 9, dtype=torch.float32), num_landmarks=20)
    nonlocal_operator(255 * IMAGE, num_landmarks=20, photometric_bandwidth=20.0)
    nonlocal_operator(12 * IMAGE, num_landmarks=20)
    sharpen(12 * IMAGE, num_landmarks=20)


GUIDE = noise(2, 1, 8, 9)


def test_values_whose_sum_overflows_are_finite() -> None:
    image = torch.full((1, 1, 8, 9), 3e38)
    assert not image.sum().isfinite()
    check_finite(image, "image")


@pytest.mark.parametrize(("landmarks", "alarm"), [(100, 1.0), (20, 0.0)], ids=["too many landmarks", "no balance"])
def test_warnings_point_at_the_caller(landmarks: int, alarm: float, monkeypatch: pytest.MonkeyPatch) -> None:
    # Row sums of small images are too accurate for a warning, so here any deviation raises one.
    monkeypatch.setattr("nlfilter_torch.operator.sinkhorn.ALARM", {GUIDE.dtype: alarm})
    monkeypatch.setattr("nlfilter_torch.operator.sinkhorn.TOLERANCE", {GUIDE.dtype: 1e-17})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nonlocal_operator(GUIDE, num_landmarks=landmarks)
    assert [w.filename for w in caught] == [__file__]
