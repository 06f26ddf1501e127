"""Crops, shifts, sizes and frames of edited photographs."""

import pytest
import torch

from nlfilter_torch.photo.look_fitting.alignment import align
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
