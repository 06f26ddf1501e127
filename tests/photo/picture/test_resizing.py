"""Resizing: interpolation by rows, weights, and enlarging of blocks."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch.photo.picture import resizing
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.regions import resized_masks
from nlfilter_torch.photo.picture.resizing import block_means, enlarged, resize, resized
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from tests.problems import cat, colour, noise


@pytest.mark.parametrize("wanted", [(10, 15), (40, 60), (17, 33), (80, 61)])
def test_resizing_is_antialiased_bicubic_and_can_go_by_rows(wanted: tuple[int, int]) -> None:
    image = colour("coffee", 40, 60).double()
    small = resize(image, wanted)
    expected = F.interpolate(image, wanted, mode="bicubic", antialias=True)
    torch.testing.assert_close(small, expected, atol=1e-6 if wanted[0] <= 40 else 1e-4, rtol=0)
    rows = range(3, min(wanted[0], 9))
    part = resized(lambda start, stop: image[:, :, start:stop], (40, 60), wanted, rows)
    torch.testing.assert_close(part, small[:, :, 3:9])
    columns = range(2, min(wanted[1], 13))
    part = resized(lambda start, stop: image[:, :, start:stop], (40, 60), wanted, rows, columns)
    torch.testing.assert_close(part, small[:, :, 3:9, 2:13])


def test_weights_are_resized_by_themselves() -> None:
    mask = torch.zeros(2, 1, 40, 56)
    mask[..., 5:25, 5:30] = 1
    mask[0] *= 0.6
    both = resized_masks(InMemory(torch.zeros(2, 3, 40, 56)), mask, (20, 28), "mask")
    alone = resized_masks(InMemory(torch.zeros(1, 3, 40, 56)), mask[:1], (20, 28), "mask")
    assert torch.equal(both[:1], alone)
    assert both[0].max() == pytest.approx(0.6)
    rows = mask[:, 0].permute(1, 2, 0).numpy()  # the two as planes of one picture
    tiled = Tiled(Picture(np.zeros((40, 56, 3), np.float32)), Passes("float32"), "mask")
    small = torch.from_numpy(np.asarray(resized_masks(tiled, rows, (20, 28), "mask"))).permute(2, 0, 1)
    torch.testing.assert_close(small, both[:, 0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("step", [1, 3, 2.5])
def test_parts_of_enlarged_blocks_are_those_of_the_whole(step: float) -> None:
    blocks = noise(1, 2, 7, 5)
    height, width = int(7 * step), int(5 * step)
    whole = enlarged(blocks, (step, step), (0, 0), (height, width))
    for row, column, h, w in ((0, 0, 4, width), (3, 2, 3, 1), (5, 1, height - 5, width - 1), (height - 1, 0, 1, 2)):
        part = enlarged(blocks, (step, step), (row, column), (h, w))
        torch.testing.assert_close(part, whole[:, :, row : row + h, column : column + w])


@pytest.mark.parametrize("step", [1, 2, 3])
def test_enlarged_blocks_are_interpolated_bilinearly(step: int) -> None:
    blocks = noise(1, 2, 7, 5)
    whole = enlarged(blocks, (step, step), (0, 0), (7 * step, 5 * step))
    expected = torch.nn.functional.interpolate(blocks, scale_factor=step, mode="bilinear", align_corners=False)
    torch.testing.assert_close(whole, expected)


def test_blocks_of_a_fractional_step() -> None:
    """Pixels are weighted by their overlap; blocks equal those of the picture with each pixel repeated four times."""
    row = torch.tensor([0.0, 3.0, 6.0, 9.0, 12.0, 15.0]).expand(1, 1, 6, 6)
    torch.testing.assert_close(block_means(row, 1.5)[0, 0, 0], torch.tensor([1.0, 5.0, 10.0, 14.0]))
    twice = row.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
    torch.testing.assert_close(block_means(row, 1.5), block_means(twice, 3))
    blocks = block_means(cat(), 5)
    torch.testing.assert_close(
        enlarged(blocks, (5 + 1e-9,) * 2, (7, 12), (20, 30)), enlarged(blocks, (5, 5), (7, 12), (20, 30))
    )


def test_wide_pictures_are_reduced_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    image = noise(1, 3, 150, 90)
    whole = resize(image, (20, 12))
    rows: list[int] = []

    def read(start: int, stop: int) -> torch.Tensor:
        rows.append(stop - start)
        return image[:, :, start:stop]

    monkeypatch.setattr(resizing, "PIECE", 10 * 90)
    assert torch.equal(resized(read, (150, 90), (20, 12)), whole)
    assert max(rows) == 10
