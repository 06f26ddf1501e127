"""What every edit by rows shares: how many rows fit the memory, and tile after tile from a source to a target."""

from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.checks import check_choice, check_count
from nlfilter_torch.streaming import sampling
from nlfilter_torch.streaming.rows import KINDS, Picture, RowTarget, Tile, stored_as, transparency
from nlfilter_torch.streaming.sampling import Report

SAMPLE = 1 << 20  # pixels; see docs/scale.md for what more or fewer of them are worth
TILE_PIXELS = 1 << 17  # longer tiles are no faster
Statistics = Literal["sample", "full"]
Edit = Callable[[Tile], Tensor]  # to the colours (1, C, h, W) of its rows
Rows = Iterator[tuple[slice, NDArray[Any]]]


def check_settings(kind: str, statistics: Statistics, sample: int, tile_rows: int | None) -> None:
    """Raise unless these are what every edit by rows takes."""
    check_choice(statistics, "statistics", ("sample", "full"))
    check_choice(kind, "dtype of the target", KINDS)
    check_count(sample, "sample")
    if tile_rows is not None:
        check_count(tile_rows, "tile_rows")


def coloured_shape(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Shape of the rows (H, W, 3 or 4) that a grey or coloured source of this shape becomes in colour."""
    samples = shape[2] if len(shape) == 3 else 1
    return shape[0], shape[1], 3 if samples in (1, 3) else 4


def check_target(target: RowTarget, shape: tuple[int, ...], what: str = "the shape of the source") -> None:
    """Raise unless rows of this shape can be assigned to the target."""
    if tuple(target.shape) != shape:
        raise ValueError(f"target must have {what}, {shape}, got {tuple(target.shape)}; make one of that shape")


def fill(target: RowTarget, rows: Rows) -> None:
    """Assign the rows (h, W, S) to their places."""
    for part, values in rows:
        target[part] = values.reshape(values.shape[0], *target.shape[1:])


def work_out(picture: Picture, edit: Edit, kind: str, margin: int, rows: int, report: Report) -> Rows:
    """The edited rows, a tile at a time, with the transparency that they had."""
    for tile in picture.tiles(margin, rows):
        report("Filtering", tile.start, picture.size[0])
        with torch.no_grad():
            values = stored_as(edit(tile), kind)
        yield slice(tile.start, tile.start + len(values)), np.concatenate([values, transparency(tile, kind)], axis=2)
    report("Filtering", picture.size[0], picture.size[0])


def rows_that_fit(
    picture: Picture,
    memory: int,
    *,
    floats: int,
    planes: int,
    num_landmarks: int,
    sample: int,
    held: int = 0,
) -> int:
    """Rows of a tile that can be worked out in ``memory`` bytes.

    Args:
        picture: to be edited.
        memory: in bytes.
        floats: for each pixel of a tile.
        planes: features of a pixel.
        num_landmarks: M.
        sample: pixels of the sample.
        held: floats that are held beside it.

    Raises:
        MemoryError: if there is not one, or no room for the samples.
    """
    size = 8 if picture.dtype == torch.float64 else 4
    row = picture.size[1] * floats * size
    # Statistics: the pilot with copies of its features and its factor; later the features of both samples and a block.
    pilot, block = min(sampling.PILOT, picture.pixels), min(picture.statistics_rows * picture.size[1], picture.pixels)
    later = (pilot + min(picture.pixels, sample)) * planes + block * (num_landmarks + planes + 8)
    least = size * (held + max(pilot * (num_landmarks + 3 * planes), later))
    if max(row, least) > memory:
        raise MemoryError(
            f"{picture.name} needs {max(row, least) / 1e6:.0f} MB of memory at least, but {memory / 1e6:.0f} MB may be "
            "used; allow more, or use fewer landmarks"
        )
    return max(1, min((memory - size * held) // (2 * row), TILE_PIXELS // picture.size[1]))
