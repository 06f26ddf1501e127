"""Rough masks: the regression against a dense one."""

import numpy as np
import pytest
import torch

from nlfilter_torch import nonlocal_operator
from nlfilter_torch.photo.picture.in_memory import InMemory, InMemoryOperator
from nlfilter_torch.photo.picture.regions import read_regions
from nlfilter_torch.photo.selections import rough_mask
from nlfilter_torch.photo.selections.rough_mask import Points, RoughMasks, region_guide
from nlfilter_torch.photo.selections.scribbled_colours import frame_places
from tests.filtering.test_scribbles import kriging
from tests.problems import box, colour, noise


@pytest.mark.parametrize("enlarged", [1.0, 3.0])
def test_the_regression_is_the_best_estimate_from_scribbles_frame_and_grid(
    monkeypatch: pytest.MonkeyPatch, enlarged: float
) -> None:
    monkeypatch.setattr(rough_mask, "FRAME_PIXELS", 20 * 24 / enlarged)
    image = colour("coffee", 20, 24).double()
    front, back = box(9, 10, 3, 4, size=(20, 24)).double(), box(2, 3, 2, 3, size=(20, 24)).double()
    source = InMemory(image)
    options = {"photometric_bandwidth": 0.2, "num_landmarks": 60, "patch_size": 1, "guide_channels": "all"}
    operator = nonlocal_operator(region_guide(image), **options)
    scribbles = read_regions(source, front, "a")[0].joined(read_regions(source, back, "b")[0])
    held = InMemoryOperator(operator, source)
    places = frame_places((20, 24))
    grid = torch.tensor([24 * row + column for row in (7, 14) for column in (3, 8, 18)])
    unlike, linked, within = (noise(1, 1, n, seed=k) for k, n in ((4, len(places)), (5, len(places)), (6, len(grid))))
    points = [Points.of(source, held, at) for at in (places, grid)]
    rough = RoughMasks(source, held, *points, torch.tensor(0.2), reach=0.6)
    known = rough.scribbled(scribbles)
    outside = rough.outside(known, unlike)
    estimated = rough.regression(known, outside, linked, within)(source)

    def estimate(values: torch.Tensor, weights: torch.Tensor, strength: float = 1.0) -> np.ndarray:
        flat = (values.flatten().numpy(), weights.flatten().numpy())
        return kriging(operator.spectrum(), *flat, strength, 0.6, 0.25)

    apart = torch.from_numpy((1 - estimate(front, front + back, 0.0)).clip(0, 1) ** 2)[places]
    expected_outside = apart * unlike[0, 0]
    torch.testing.assert_close(outside[0, 0], expected_outside, atol=2e-5, rtol=0)
    values, weights = front.flatten().clone(), (front + back).flatten()
    assert not bool(weights[torch.cat([places, grid])].any())  # here the scribbles touch neither
    assert len(torch.cat([places, grid]).unique()) == len(places) + len(grid)
    weights[places] = enlarged * expected_outside
    values[places], weights[grid], values[grid] = linked[0, 0], within[0, 0], 1.0
    expected = estimate(values, weights)
    np.testing.assert_allclose(estimated.flatten(), expected, atol=2e-5)


def test_scribbles_on_the_background_take_nothing_from_what_the_frame_says_elsewhere() -> None:
    image = torch.full((1, 3, 24, 40), 0.5) + 0.02 * noise(1, 3, 24, 40, dtype=torch.float32)
    image[:, 0, 8:16, 12:20] += 0.4
    image[:, 2, 8:16, 26:34] += 0.4
    source = InMemory(image)
    options = {"photometric_bandwidth": 0.05, "num_landmarks": 60, "guide_channels": "all"}
    held = InMemoryOperator(nonlocal_operator(region_guide(image), **options), source)
    frame = Points.of(source, held, frame_places((24, 40)))
    rough = RoughMasks(source, held, frame, frame, torch.tensor(0.05), reach=0.6)
    strokes = [read_regions(source, box(10, left, 3, 4, size=(24, 40)), "a")[0] for left in (14, 28)]
    outside = rough.outside(rough.scribbled(strokes[0].joined(strokes[1])), torch.ones(1, 1, len(frame.places)))
    assert outside.min() > 0.8
