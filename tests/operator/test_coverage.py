"""As many landmarks as cover the points, by the same measure that operators report."""

from itertools import pairwise

import pytest
import torch

from nlfilter_torch import NonlocalAffinity, nonlocal_operator, operator_from_features
from nlfilter_torch.operator.coverage import AIMED, MOST, WANTED, cover
from nlfilter_torch.operator.options import FIRST
from tests.problems import noise, picture, seeded


def test_the_number_grows_until_the_points_are_covered() -> None:
    image = picture("camera", 64, 64, torch.float32)
    operator = nonlocal_operator(image, photometric_bandwidth=8 / 255, num_landmarks="auto")
    count = operator.landmarks.shape[2]
    assert FIRST < count < MOST
    assert float(operator.badly_covered()) <= 1.5 * WANTED
    few = nonlocal_operator(image, photometric_bandwidth=8 / 255, num_landmarks=FIRST)
    assert float(few.badly_covered()) > AIMED
    asked = nonlocal_operator(image, photometric_bandwidth=8 / 255, num_landmarks=count)
    assert torch.equal(operator.factor, asked.factor)
    drawn = nonlocal_operator(image, photometric_bandwidth=8 / 255, num_landmarks="auto", generator=seeded(0))
    assert torch.equal(operator.factor, drawn.factor)


def test_a_pattern_that_repeats_needs_few() -> None:
    tile = noise(1, 1, 4, 4, dtype=torch.float32).repeat(1, 1, 16, 16)
    operator = nonlocal_operator(tile, photometric_bandwidth=0.05, num_landmarks="auto")
    assert operator.landmarks.shape[2] == FIRST
    assert float(operator.badly_covered()) == 0


def test_hidden_pixels_do_not_count() -> None:
    image = picture("camera", 48, 48, torch.float32)
    padded = torch.nn.functional.pad(image, (0, 16, 0, 0))
    weights = torch.nn.functional.pad(torch.ones_like(image), (0, 16, 0, 0))
    operators = [
        nonlocal_operator(image, photometric_bandwidth=8 / 255, num_landmarks="auto"),
        nonlocal_operator(padded, photometric_bandwidth=8 / 255, num_landmarks="auto", weights=weights),
    ]
    counts = [operator.landmarks.shape[2] for operator in operators]
    assert counts[1] == pytest.approx(counts[0], rel=0.3)


def test_points_and_given_landmarks() -> None:
    points = torch.randn(1, 2, 3000, generator=seeded(0)) / 0.2
    operator = operator_from_features(points, size=(3000,), num_landmarks="auto")
    assert float(operator.badly_covered()) <= 1.5 * WANTED
    kept = operator_from_features(points, size=(3000,), num_landmarks="auto", landmarks=operator)
    assert torch.equal(kept.landmarks, operator.landmarks)
    assert len(nonlocal_operator(torch.zeros(0, 1, 8, 8), num_landmarks="auto")) == 0
    assert nonlocal_operator(noise(1, 1, 5, 5), num_landmarks="auto").landmarks.shape[2] == 25


def test_the_limit_warns() -> None:
    counts = []
    with pytest.warns(UserWarning, match="got 10.0% that are badly covered with 1000"):
        assert cover(lambda count: (counts.append(count) or 0.1, count), 10**6) == MOST
    assert counts[0] == FIRST
    assert all(1 < after / before <= 2.1 for before, after in pairwise(counts))
    assert cover(lambda count: (0.1, count), 80) == 80  # every point is a landmark


def test_refusals() -> None:
    with pytest.raises(ValueError, match=r"^num_landmarks must be one of 'auto', got 'many'"):
        nonlocal_operator(noise(1, 1, 8, 8), num_landmarks="many")
    with pytest.raises(TypeError, match=r"^num_landmarks must be an int, got str"):
        NonlocalAffinity(num_landmarks="auto")
