"""How much pixels count in a picture that is read by rows: the same pixels are drawn as in memory."""

import numpy as np
import pytest
import torch

from nlfilter_torch.operator.landmarks import drawn_candidates
from nlfilter_torch.operator.orientation import ORIENTATIONS, source_pixels
from nlfilter_torch.photo.picture.counted import CountedPixels, counted_pixels
from nlfilter_torch.photo.picture.source import seeded


def counted_of(opacity: np.ndarray) -> CountedPixels:
    counted = counted_pixels(opacity)
    assert counted is not None
    return counted


def spots(*, soft: bool) -> np.ndarray:
    draw = np.random.default_rng(0)
    opacity = draw.integers(0, 256, (40, 50)) * (draw.random((40, 50)) < 0.5)
    opacity[:5], opacity[:, 45:] = 0, 0
    return (opacity if soft else 255 * (opacity > 0)).astype(np.uint8)


def test_weights_and_the_rectangle_that_holds_them() -> None:
    opacity = spots(soft=True)
    counted = counted_of(opacity)
    weights = torch.from_numpy(opacity / np.float32(255))
    assert torch.equal(counted.rows(7, 20)[0, 0], weights[7:20])
    places = torch.tensor([3, 777, 1999])
    assert torch.equal(counted.at(places), weights.flatten()[places])
    assert counted.count == int((opacity > 0).sum())
    assert counted.total == pytest.approx(float(weights.double().sum()))
    assert not counted.even
    assert counted.corner == (5, 0)
    assert counted.box == (35, 45)
    assert counted.whole(torch.tensor([0, 46])).tolist() == [250, 301]
    assert (counted.in_box(slice(6, 9)) == (opacity[6:9, :45] > 0)).all()


def test_pictures_that_count_as_a_whole() -> None:
    for opacity in (np.zeros((4, 5), np.uint8), np.full((4, 5), 255, np.uint8), np.ones((4, 5), np.float32)):
        assert counted_pixels(opacity) is None
    assert counted_of(np.full((4, 5), 128, np.uint8)).even


@pytest.mark.parametrize("soft", [False, True])
def test_candidates_are_those_of_the_picture_in_memory(soft: bool) -> None:
    counted = counted_of(spots(soft=soft))
    (height, width), weights = counted.box, counted.rows(5, 40)[0, 0, :, :45].flatten()
    for number in range(ORIENTATIONS):
        places = source_pixels(torch.tensor([number]), counted.box, torch.arange(height * width))[0]
        order = (weights[places] > 0).nonzero().squeeze(1)
        amounts = weights[places[order]].unsqueeze(0)
        drawn = drawn_candidates((1, len(order)), 9, "kmeans", seeded(), amounts if soft else None)
        assert torch.equal(counted.candidates(9, "kmeans", seeded(), number), order[drawn])
    for sampling in ("random", "uniform"):
        drawn = drawn_candidates((1, counted.count), 9, sampling, seeded(), None)
        expected = (weights > 0).nonzero().squeeze(1)[drawn]
        assert torch.equal(counted.candidates(9, sampling, seeded(), 0), expected)
