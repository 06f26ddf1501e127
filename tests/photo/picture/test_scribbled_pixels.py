"""Scribbled pixels: their places and weights, on parts of a picture and joined."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.pixels import Strip
from nlfilter_torch.photo.picture.resizing import block_counts, block_means
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, blocks_at, scribbled_blocks, sums_in_blocks
from tests.problems import box, noise

SIZE = (12, 15)
IMAGE = noise(2, 3, *SIZE)
MASKS = torch.cat([0.5 * box(2, 3, size=SIZE), box(6, 9, 3, 5, size=SIZE)]).double()  # a box in each image


def scribbles_of(mask: Tensor) -> Scribbles:
    return InMemory(IMAGE).scribbles(mask, None, "mask")


@dataclass(frozen=True)
class Rectangle:
    """Some rows and columns of a picture."""

    image: Tensor
    first: int
    width: int


def test_scribbles_are_the_pixels_under_a_mask_of_any_image() -> None:
    scribbles = scribbles_of(MASKS)
    covered = (MASKS > 0).any(0).flatten().nonzero().squeeze(1)
    assert torch.equal(scribbles.places, covered)
    assert torch.equal(scribbles.weights, MASKS.flatten(2)[:, :, covered])
    assert torch.equal(scribbles.image, IMAGE.flatten(2)[:, :, covered])


def test_the_planes_of_a_part_are_a_part_of_the_planes() -> None:
    scribbles = scribbles_of(MASKS)
    assert torch.equal(scribbles.planes(InMemory(IMAGE)), MASKS)
    for rows in (slice(0, 3), slice(3, 7), slice(10, 12)):
        strip = Strip(IMAGE[:, :, rows], rows.start * SIZE[1], SIZE[1])
        assert torch.equal(scribbles.planes(strip), MASKS[:, :, rows])
    rows, columns = slice(1, 8), slice(5, 11)
    part = Rectangle(IMAGE[:, :, rows, columns], rows.start * SIZE[1] + columns.start, SIZE[1])
    assert torch.equal(scribbles.planes(part), MASKS[:, :, rows, columns])


def test_joined_scribbles_are_those_of_both_and_the_first_cover_the_second() -> None:
    other = torch.cat([box(4, 5, size=SIZE), box(6, 9, 2, 2, size=SIZE)]).double()
    joined = scribbles_of(MASKS).joined(scribbles_of(other))
    assert (joined.places.diff() > 0).all()
    assert torch.equal(joined.image, IMAGE.flatten(2)[:, :, joined.places])
    planes = joined.planes(InMemory(IMAGE))
    assert torch.equal(planes[:, :1], MASKS)
    assert torch.equal(planes[:, 1:], other * (MASKS == 0))


def test_weights_can_be_replaced() -> None:
    scribbles = scribbles_of(MASKS)
    regions = scribbles.weighted(torch.cat([scribbles.weights, 1 - scribbles.weights], dim=1))
    assert torch.equal(regions.places, scribbles.places)
    planes = regions.planes(InMemory(IMAGE))
    assert planes.shape == (2, 2, *SIZE)
    assert torch.equal(planes[:, :1], MASKS)


def test_colours_that_are_missing_are_asked_for() -> None:
    with pytest.raises(TypeError, match=r"strokes must be a torch\.Tensor, got NoneType; pass the colours"):
        scribbles_of(MASKS).shown  # noqa: B018
    painted = InMemory(IMAGE).scribbles(MASKS, IMAGE.flip(1), "mask")
    assert torch.equal(painted.shown, painted.image.flip(1))


def test_blocks_of_columns_come_with_their_weights_and_values() -> None:
    columns, weights, values = noise(1, 4, 7), noise(1, 1, 7, seed=1), noise(1, 2, 7, seed=2)
    fewer, own, changed = noise(1, 4, 2, seed=3), noise(1, 1, 2, seed=4), noise(1, 2, 2, seed=5)
    known = [(lambda: columns.split(3, dim=2), weights, values), (lambda: [fewer], own, changed)]
    blocks = list(scribbled_blocks(known))
    assert [block.shape[2] for block, _, _ in blocks] == [3, 3, 1, 2]
    for number, wanted in enumerate(((columns, fewer), (weights, own), (values, changed))):
        assert torch.equal(torch.cat([block[number] for block in blocks], dim=2), torch.cat(wanted, dim=2))


@pytest.mark.parametrize("step", [1.0, 4.0, 2.5])
def test_sums_over_blocks_are_those_of_the_pixels_in_them(step: float) -> None:
    shape = block_counts(SIZE, step)
    scribbles = scribbles_of(MASKS)
    sums = sums_in_blocks(scribbles.weights, scribbles.places, SIZE, shape)
    area = SIZE[0] * SIZE[1] / (shape[0] * shape[1])
    torch.testing.assert_close(sums, area * block_means(MASKS, step).to(sums))
    places = torch.tensor([0, 14, 11 * 15 + 14])
    assert blocks_at(places, SIZE, shape).tolist() == [0, shape[1] - 1, shape[0] * shape[1] - 1]
