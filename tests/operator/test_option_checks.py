"""Options of an operator that must be refused in one sentence, and numbers of landmarks that are reduced."""

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch

from nlfilter_torch import (
    estimate_bandwidth,
    nonlocal_operator,
    operator_from_features,
)
from tests.problems import build, noise, seeded

GUIDE = noise(2, 1, 8, 9)


NAN, INFINITY = float("nan"), float("inf")


def raises(call: Callable[[], object], error: type[Exception], message: str) -> None:
    """Check for ``<argument> must <requirement>, got <value>; <remedy>`` on one line that begins with ``message``."""
    with pytest.raises(error) as caught:
        call()
    result = str(caught.value)
    assert result.startswith(message), result
    assert re.fullmatch(r"\w+ must .+, got .+; .+", result), result
    assert not re.search(r"\n|[^.]\.$", result), result


TWO = "must be a number, or two for vertical and horizontal distances, got"
POSITIVE = "must be positive and finite, got"


NUMBER = "must be a number or a tensor, got"


INT = "must be an int, got"


ODD = "must be odd and at least 1, got"


SQUARE = "must have shape (p, p) with odd p, or (p, p, p) for volumes, got"


BAD_OPTIONS: list[tuple[str, Any, type[Exception], str]] = [
    ("patch_size", 4, ValueError, f"{ODD} 4; try 5"),
    ("patch_size", 0, ValueError, f"{ODD} 0; try 1"),
    ("patch_size", -3, ValueError, f"{ODD} -3; try 3"),
    ("patch_size", 5.0, TypeError, f"{INT} float"),
    ("patch_size", True, TypeError, f"{INT} bool"),
    ("photometric_bandwidth", 0.0, ValueError, f"{POSITIVE} 0.0"),
    ("photometric_bandwidth", -1, ValueError, f"{POSITIVE} -1"),
    ("photometric_bandwidth", NAN, ValueError, f"{POSITIVE} nan"),
    ("photometric_bandwidth", INFINITY, ValueError, f"{POSITIVE} inf"),
    ("photometric_bandwidth", "wide", ValueError, "must be "),
    ("photometric_bandwidth", None, TypeError, f"{NUMBER} NoneType"),
    ("photometric_bandwidth", True, TypeError, f"{NUMBER} bool"),
    ("photometric_bandwidth", torch.tensor([0.5, -0.5]), ValueError, f"{POSITIVE} [0.5, -0.5]"),
    ("photometric_bandwidth", torch.ones(3), ValueError, "must be a number or have shape () or (2,), got (3,)"),
    ("spatial_bandwidth", 0, ValueError, f"{POSITIVE} 0"),
    ("spatial_bandwidth", "auto", TypeError, f"{NUMBER} str"),
    ("spatial_bandwidth", (4.0, 0.0), ValueError, f"{POSITIVE} 0.0"),
    ("spatial_bandwidth", (4.0, 5.0, 6.0), ValueError, f"{TWO} 3 in a tuple; pass two numbers"),
    ("spatial_bandwidth", [4.0], ValueError, f"{TWO} 1 in a list; pass two numbers"),
    ("spatial_bandwidth", torch.ones(2, 1), ValueError, "must be a number or have shape () or (2,), got (2, 1)"),
    ("num_landmarks", 0, ValueError, "must be at least 1, got 0"),
    ("num_landmarks", 20.0, TypeError, f"{INT} float"),
    ("num_landmarks", True, TypeError, f"{INT} bool"),
    ("landmarks", "k-means", ValueError, "must be one of 'kmeans', 'uniform', 'random', got 'k-means'"),
    ("completion", None, ValueError, "must be one of 'diagonal', 'none', got None"),
    ("guide_channels", "rgb", ValueError, "must be one of 'luminance', 'all', got 'rgb'"),
    ("tolerance", 0.0, ValueError, f"{POSITIVE} 0.0"),
    ("patch_weights", [[1.0]], TypeError, "must be a torch.Tensor, got list; convert it"),
    ("patch_weights", torch.ones(3, 5), ValueError, f"{SQUARE} (3, 5)"),
    ("patch_weights", torch.ones(4, 4), ValueError, f"{SQUARE} (4, 4)"),
    ("patch_weights", torch.ones(9), ValueError, f"{SQUARE} (9,)"),
    ("patch_weights", -torch.ones(3, 3), ValueError, "must be non-negative with a positive sum, got"),
    ("patch_weights", torch.zeros(3, 3), ValueError, "must be non-negative with a positive sum, got"),
    ("patch_weights", torch.ones(3, 3) * NAN, ValueError, "must be finite, got 9 NaN"),
]


TWO = "must have at least two entries, got 1"


@pytest.mark.parametrize(("option", "value", "error", "message"), BAD_OPTIONS)
def test_bad_options_of_the_operator(option: str, value: Any, error: type[Exception], message: str) -> None:
    options = {"num_landmarks": 20, option: value}
    raises(lambda: nonlocal_operator(GUIDE, **options), error, f"{option} {message}")


def test_bad_channels_of_the_estimate() -> None:
    raises(lambda: estimate_bandwidth(GUIDE, guide_channels="rgb"), ValueError, "guide_channels must be one of 'lum")


def test_more_landmarks_than_pixels_are_reduced_with_a_warning() -> None:
    guide = noise(1, 1, 4, 5)
    with pytest.warns(UserWarning, match="num_landmarks must be at most the number of pixels, 20, got 100"):
        operator = nonlocal_operator(guide)
    torch.testing.assert_close(operator.to_dense(), build(guide, num_landmarks=20).to_dense())


def test_more_landmarks_than_points_are_reduced() -> None:
    with pytest.warns(UserWarning, match="num_landmarks must be at most the number of pixels, 12, got 100"):
        operator = operator_from_features(noise(1, 3, 12), size=(3, 4), generator=seeded())
    assert operator.factor.shape == (1, 12, 12)
