"""Parts of photographs that other pictures show at another size."""

import pytest
import torch

from nlfilter_torch.photo.look_fitting.scaled_crop import scaled_crop
from nlfilter_torch.photo.picture.resizing import resize
from tests.looks import CAT, CUP

GREY = resize(CAT, (160, 200)).mean((0, 1)).double().clamp(0, 1)


@pytest.mark.parametrize(
    ("row", "column", "height", "width", "size"),
    [
        (30, 50, 100, 120, (60, 72)),
        (2, 4, 154, 192, (231, 288)),
    ],
)
def test_parts_are_found_to_a_pixel(row: int, column: int, height: int, width: int, size: tuple[int, int]) -> None:
    part = resize(GREY[None, None, row : row + height, column : column + width] ** 0.6, size)[0, 0]
    place = scaled_crop(GREY, part)
    assert place is not None
    assert max(abs(got - wanted) for got, wanted in zip(place, (row, column, height, width), strict=True)) <= 2
    top, left, rows, columns = place
    shown = resize(part[None, None], (rows, columns))[0, 0]
    inside = GREY[top : top + rows, left : left + columns]
    assert torch.stack([inside.flatten(), shown.flatten()]).corrcoef()[0, 1] > 0.97


def test_pictures_without_anything_to_compare() -> None:
    assert scaled_crop(GREY, torch.full((30, 40), 0.5, dtype=torch.float64)) is None
    assert scaled_crop(GREY[:1, :1], GREY[:1, :1]) is None
    place = scaled_crop(torch.zeros(40, 50, dtype=torch.float64), CUP.mean((0, 1)).double()[:20, :25])
    assert place is not None
    top, left, height, width = place
    assert 0 <= top < top + height <= 40
    assert 0 <= left < left + width <= 50


@pytest.mark.parametrize("side", [40, 60, 61])
def test_parts_of_small_pictures_are_found_to_a_pixel(side: int) -> None:
    small = resize(GREY[None, None], (side, round(1.25 * side)))[0, 0].clamp(0, 1)
    row, column, height, width = round(0.1 * side), round(0.3 * side), round(0.63 * side), round(0.69 * side)
    part = small[row : row + height, column : column + width] ** 0.6
    for size in ((height, width), (2 * height, 2 * width)):
        place = scaled_crop(small, resize(part[None, None], size)[0, 0])
        assert place is not None
        assert max(abs(got - wanted) for got, wanted in zip(place, (row, column, height, width), strict=True)) <= 1
