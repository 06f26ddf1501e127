"""Automatic levels, and tone curves of the parts of a picture."""

import numpy as np
import pytest
import torch

from nlfilter_torch.photo import apply_look
from tests.looks import CAT, LOCAL, STRETCH


@pytest.mark.parametrize("scaled", [False, True])
def test_local_contrast_is_the_clipped_histogram_of_the_tiles_around(scaled: bool) -> None:
    image = CAT[:, :, :77, :90].double()  # tiles of 9.6 by 11.3 pixels
    strengths = [0.0] * 8
    strengths[4 * scaled + 1] = 1.0  # a limit of 2
    changes = apply_look(image, local=strengths) - image
    weights = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64).view(3, 1, 1)
    light = (image[0].amax(0) if scaled else (image[0] * weights).sum(0)).numpy()
    value = light
    if scaled:
        light = (light - light.min()) / (light.max() - light.min())
    hats = np.maximum(1 - np.abs(light * 32 - np.arange(33)[:, None, None]), 0)

    def inside(tile: int, length: int) -> np.ndarray:  # how much of each pixel is in it
        edges = np.array([tile, tile + 1]) * length / 8
        starts = np.arange(length)
        return np.clip(np.minimum(starts + 1, edges[1]) - np.maximum(starts, edges[0]), 0, None)

    def curve(row: int, column: int) -> np.ndarray:  # of the tile with that number
        shares = np.outer(inside(row, 77), inside(column, 90))
        clipped = np.minimum((hats * shares).sum((1, 2)) / shares.sum(), 2 / 33)
        clipped += (1 - clipped.sum()) / 33
        return clipped.cumsum() - clipped / 2 - np.linspace(0, 1, 33)

    for row, column in ((0, 0), (2, 2), (40, 33), (76, 89), (74, 12)):
        place = [
            min(max((i + 0.5) * 8 / length - 0.5, 0), 7) for i, length in ((row, 77), (column, 90))
        ]  # in numbers of tiles
        blended = np.zeros(33)
        for i in {int(place[0]), min(int(place[0]) + 1, 7)}:
            for j in {int(place[1]), min(int(place[1]) + 1, 7)}:
                blended += (1 - abs(place[0] - i)) * (1 - abs(place[1] - j)) * curve(i, j)
        change = np.interp(light[row, column], np.linspace(0, 1, 33), blended)
        colours = image[0, :, row, column] / value[row, column] if scaled else torch.ones(3)
        assert changes[0, :, row, column].tolist() == pytest.approx((change * colours).tolist(), abs=1e-6)
    even = torch.full((1, 3, 5, 40), 0.5)  # tiles of less than a pixel
    assert torch.isfinite(apply_look(even, local=LOCAL)).all()


def test_automatic_levels_reach_from_black_to_white() -> None:
    dull = CAT * 0.4 + 0.2
    weights = torch.tensor([0.299, 0.587, 0.114]).view(3, 1, 1)
    for kind, tone in enumerate((lambda x: (x * weights).sum(1), lambda x: x.amax(1), lambda x: x)):
        strengths = [0.0] * 3
        strengths[kind] = 1.0
        stretched = tone(apply_look(dull, stretch=strengths))
        low, high = tone(dull).min(), tone(dull).max()
        if kind == 2:
            low, high = (torch.stack([of(x) for x in dull[0]]).view(3, 1, 1) for of in (torch.min, torch.max))
        assert torch.allclose(stretched, (tone(dull) - low) / (high - low), atol=1e-5)
    value = apply_look(dull, stretch=(0.0, 1.0, 0.0))
    assert torch.allclose(value * dull.amax(1, True), dull * value.amax(1, True), atol=1e-5)  # hue and saturation stay
    grey = apply_look(dull[:, :1], stretch=(0.0, 0.0, 1.0))
    assert [float(grey.min()), float(grey.max())] == pytest.approx([0, 1], abs=1e-5)


def test_automatic_levels_leave_flat_pictures_alone() -> None:
    for even in (torch.zeros(1, 3, 9, 9), torch.full((1, 3, 9, 9), 0.7)):
        assert torch.equal(apply_look(even, stretch=STRETCH), even)
        assert torch.isfinite(apply_look(even, local=LOCAL)).all()
