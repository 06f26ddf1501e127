"""Crops, shifts, sizes and frames of edited photographs."""

import pytest
import torch

from nlfilter_torch.photo.looks.alignment import align, scaled_crop
from nlfilter_torch.photo.picture.resizing import resize
from tests.looks import CAT, CUP


@pytest.mark.parametrize(
    ("cut", "row", "column"), [((slice(7, 67), slice(12, 92)), 7, 12), ((slice(0, 60), slice(20, 100)), 0, 20)]
)
def test_crops_are_found(cut: tuple[slice, slice], row: int, column: int) -> None:
    after = (CAT**0.6)[(..., *cut)]
    part, edited, done = align(CAT, after, "before", "after")
    assert torch.equal(part, CAT[(..., *cut)])
    assert torch.equal(edited, after)
    assert f"row {row}, column {column}" in done


def test_shifts_and_sizes_are_found() -> None:
    before, after = CAT[..., 5:, :-3], (CAT**0.6)[..., :-5, 3:]
    first, second, done = align(before, after, "before", "after")
    assert "5 pixels down and -3" in done
    assert torch.allclose(first**0.6, second, atol=1e-6)
    small = torch.nn.functional.interpolate(CAT**0.6, (40, 50), mode="area")
    _, resized, done = align(CAT, small, "before", "after")
    assert resized.shape == CAT.shape
    assert "resized from 50x40 to 100x80" in done
    framed = torch.nn.functional.pad(CAT**0.6, (6, 6, 6, 12), value=0.95)
    first, second, done = align(CAT, framed, "before", "after")
    assert torch.equal(first, CAT)
    assert torch.equal(second, CAT**0.6)
    assert done == "after has a frame of one colour, which is left out"
    small = torch.nn.functional.interpolate(CAT**0.6, (68, 85), mode="area")
    framed = torch.nn.functional.pad(small, (7, 8, 6, 6), value=1.0)  # of the size of the photograph
    first, second, done = align(CAT, framed, "before", "after")
    assert torch.equal(first, CAT)
    assert (second - CAT**0.6).abs().mean() < 0.02
    assert "enlarged to 100x80" in done
    with pytest.raises(ValueError, match="after must have the size of before"):
        align(CAT, CUP[..., :30, :70], "before", "after")


def test_pictures_of_one_brightness_are_not_shifted(recwarn: pytest.WarningsRecorder) -> None:
    for before, after in ((torch.zeros_like(CAT), CAT), (CAT, torch.full_like(CAT, 0.4))):
        first, second, done = align(before, after, "before", "after")
        assert torch.equal(first, before)
        assert torch.equal(second, after)
        assert done == ""
    assert not recwarn


def test_crops_of_another_size_are_found() -> None:
    crop = (CAT**0.6)[..., 6:74, 10:94]
    small = torch.nn.functional.interpolate(crop, (51, 63), mode="area")
    first, second, done = align(CAT, small, "before", "after")
    row, column = 6, 10
    assert f"after is resized from 63x51 to {second.shape[-1]}x{second.shape[-2]}, a crop of before from row" in done
    assert abs(second.shape[-2] - 68) <= 1
    assert abs(second.shape[-1] - 84) <= 1
    assert (first - CAT[..., row : row + first.shape[-2], column : column + first.shape[-1]]).abs().mean() < 0.02
    assert (first**0.6 - second).abs().mean() < 0.02


def test_other_photographs_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="after must have the size of before"):
        align(CAT, CUP[..., :40, :30], "before", "after")


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
