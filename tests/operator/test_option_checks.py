"""Options of an operator that must be refused in one sentence, and numbers of landmarks that are reduced."""

import pytest
import torch

from nlfilter_torch import (
    nonlocal_operator,
    operator_from_features,
)
from tests.problems import build, noise, seeded

NAN, INFINITY = float("nan"), float("inf")


def test_more_landmarks_than_pixels_are_reduced_with_a_warning() -> None:
    guide = noise(1, 1, 4, 5)
    with pytest.warns(UserWarning, match="num_landmarks must be at most the number of pixels, 20, got 100"):
        operator = nonlocal_operator(guide)
    torch.testing.assert_close(operator.to_dense(), build(guide, num_landmarks=20).to_dense())


def test_more_landmarks_than_points_are_reduced() -> None:
    with pytest.warns(UserWarning, match="num_landmarks must be at most the number of pixels, 12, got 100"):
        operator = operator_from_features(noise(1, 3, 12), size=(3, 4), generator=seeded())
    assert operator.factor.shape == (1, 12, 12)
