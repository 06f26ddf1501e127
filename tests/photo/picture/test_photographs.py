"""A photograph in memory that is developed, with what does not count in it."""

import numpy as np
import pytest
import torch

from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.picture.light import develop_image, develop_photograph
from nlfilter_torch.photo.picture.photographs import HiddenPixels, Photograph
from tests.problems import colour

SIZE = (40, 60)


def hidden() -> HiddenPixels:
    """Pixels without data, each with a colour of its own."""
    places = np.zeros(SIZE, np.bool_)
    places[10:20, 30:50] = True
    return HiddenPixels(places, np.arange(3 * 200, dtype=np.float32).reshape(200, 3), None)


def test_pixels_are_those_of_the_image() -> None:
    photograph = Photograph(colour("chelsea", *SIZE))
    for development in (
        Development(),
        Development(exposure=0.4, warmth=0.2, straighten=3.0),
        Development(crop=(0.1, 0.2, 0.9, 1.0)),
    ):
        edited = develop_photograph(photograph, development)
        assert torch.equal(edited.pixels, develop_image(photograph.pixels, development))
        assert edited.alpha is edited.hidden is edited.weights is None


def test_hidden_pixels_are_cut_with_their_own_colours() -> None:
    photograph = Photograph(colour("chelsea", *SIZE), hidden=hidden())
    edited = develop_photograph(photograph, Development(exposure=1.0, crop=(0.6, 0.3, 1.0, 1.0)))
    assert edited.hidden is not None
    assert edited.hidden.places.sum() == len(edited.hidden.colours) == 8 * 14
    channels = np.zeros((*edited.size, 3), np.float32)
    edited.hidden.put_back(channels)
    assert channels[0, 0, 0] == 3 * (2 * 20 + 6)  # the third row of the hidden pixels, from the seventh column on


@pytest.mark.parametrize("nodata", [None, -1.0])
def test_hidden_pixels_are_turned(nodata: float | None) -> None:
    alpha = None if nodata is not None else torch.from_numpy(~hidden().places)[None, None].float()
    values = HiddenPixels(hidden().places, hidden().colours, nodata)
    photograph = Photograph(colour("chelsea", *SIZE), "float32", alpha, hidden=values)
    edited = develop_photograph(photograph, Development(straighten=10.0))
    frame = Development(straighten=10.0).frame(SIZE)
    assert edited.hidden is not None
    places = edited.hidden.places
    middle = np.argwhere(places).mean(0) + 0.5
    x, y = frame.inward(40 / 60, 15 / 40)
    assert middle == pytest.approx([y * frame.height, x * frame.width], abs=0.4)
    if nodata is not None:
        assert (edited.hidden.colours == nodata).all()
        assert places.sum() == pytest.approx(200, rel=0.05)
    weights = edited.weights
    assert weights is not None
    assert weights[0, 0][torch.from_numpy(places)].max() == 0
    assert 0 <= float(weights.min()) <= float(weights.max()) <= 1
