"""Mistakes that give no error are warned of, with the remedy; correct calls are not."""

import re
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalFilter, nonlocal_operator
from tests.problems import noise

IMAGE = noise(1, 3, 24, 20, dtype=torch.float32)
FEATURES = noise(1, 4, 24, 20, seed=1, dtype=torch.float32)
TRAPS: dict[str, tuple[Tensor, dict[str, Any], str]] = {
    "grey levels": (IMAGE, {"photometric_bandwidth": 20.0}, "photometric_bandwidth must be in units of the guide, wh"),
    "learned": (IMAGE, {"photometric_bandwidth": torch.tensor([20.0])}, "photometric_bandwidth must be in units"),
    "channels last": (IMAGE.permute(0, 2, 3, 1), {}, "guide must have its channels in the second dimension, got"),
    "too large": (10 * FEATURES, {"photometric_bandwidth": 0.2}, "guide must have .* no two pixels are similar"),
    "too small": (FEATURES / 100, {"photometric_bandwidth": 1.0}, "guide must have .* all pixels are alike; lower"),
}


@pytest.mark.parametrize("trap", list(TRAPS))
def test_a_trap_is_warned_of_once_with_the_remedy(trap: str) -> None:
    guide, options, message = TRAPS[trap]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nonlocal_operator(guide, num_landmarks=20, patch_size=1, **options)
    assert len(caught) == 1
    assert re.match(message, str(caught[0].message))
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nonlocal_operator(guide.to("meta"), num_landmarks=20, patch_size=1, **options | {"photometric_bandwidth": 20.0})


CALLS = [
    (IMAGE, {"photometric_bandwidth": 2.0}),
    (IMAGE, {"photometric_bandwidth": 1e4}),
    (255 * IMAGE, {"photometric_bandwidth": 20.0}),
    (torch.full_like(FEATURES, 0.5), {"photometric_bandwidth": 1.0}),
    (FEATURES, {"photometric_bandwidth": 0.3}),
    (FEATURES, {}),
    (noise(1, 24, 20, 8), {}),
    (IMAGE[..., :3], {}),
]


def test_correct_calls_are_silent() -> None:
    for guide, options in CALLS:
        nonlocal_operator(guide, num_landmarks=20, patch_size=1, **options)


def test_the_layer_warns_at_the_line_of_the_user() -> None:
    with pytest.warns(UserWarning, match="divide grey levels by 255") as caught:
        NonlocalFilter(photometric_bandwidth=20.0, num_landmarks=20)(IMAGE)
    assert caught[0].filename == __file__
