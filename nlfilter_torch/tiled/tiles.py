"""Shared by all tiled edits: the rows that fit in memory, and the loop over tiles from a source to a target."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.checks import check_choice, check_count
from nlfilter_torch.tiled import sampling
from nlfilter_torch.tiled.pictures import KINDS, Picture, Rows, RowSource, RowTarget, Tile, stored_as, transparency
from nlfilter_torch.tiled.sampling import Report
from nlfilter_torch.tiled.workers import in_order

SAMPLE = 1 << 16  # pixels; docs/scale.md shows the effect of more or fewer
TILE_PIXELS = 1 << 17  # longer tiles are no faster
CHUNK_PIXELS, LARGE_MEMORY = 1 << 14, 1 << 28  # pixels computed together, for speed, if that many bytes may be used
Statistics = Literal["sample", "full"]
TileEdit = Callable[[Tile], Tensor]  # to the colours (1, C, h, W) of its rows


def in_silence(stage: str, done: int, rows: int) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class Passes:
    """Tiling options of an edit.

    Attributes:
        kind: dtype of the output.
        statistics: from a sample of the pixels or from all of them.
        sample: number of pixels of that sample.
        tile_rows: rows of a tile, see :meth:`chunk_rows`; None is as many as fit in memory.
        memory: bytes that may be used.
        report: called with the progress.
        folder: for planes between two passes; None is the system's folder for temporary files.
        threads: number of threads that tiles are divided among.
    """

    kind: str
    statistics: Statistics = "sample"
    sample: int = SAMPLE
    tile_rows: int | None = None
    memory: int = 1 << 30
    report: Report = in_silence
    folder: Path | None = None
    threads: int = field(default_factory=torch.get_num_threads)

    @staticmethod
    def of(
        target: RowTarget,
        statistics: Statistics,
        sample: int,
        tile_rows: int | None,
        memory: int,
        report: Report | None,
    ) -> "Passes":
        """The options of an edit that writes to a target."""
        return Passes(np.dtype(target.dtype).name, statistics, sample, tile_rows, memory, report or in_silence)

    def __post_init__(self) -> None:
        """Raise unless all options are valid."""
        check_choice(self.statistics, "statistics", ("sample", "full"))
        check_choice(self.kind, "dtype of the target", KINDS)
        check_count(self.sample, "sample")
        if self.tile_rows is not None:
            check_count(self.tile_rows, "tile_rows")

    def chunk_rows(self, width: int) -> int:
        """Number of rows that are always computed together; the height of a tile is a multiple of it."""
        return max(1, (CHUNK_PIXELS if self.memory >= LARGE_MEMORY else 1) // width)

    def workers(self, num_landmarks: int) -> int:
        """Number of tiles computed at once, each by its own thread: as many as memory allows."""
        if self.memory < LARGE_MEMORY:
            return 1
        return max(1, min(self.threads, self.memory // (4 * factor_bytes(CHUNK_PIXELS, num_landmarks))))

    def stores_guide(self, guide_bytes: int) -> bool:
        """Whether a guide of ``guide_bytes`` bytes is kept from one pass to the next."""
        return self.memory >= LARGE_MEMORY and guide_bytes <= self.memory // 4

    def apply_in_tiles(
        self,
        picture: Picture,
        edit: TileEdit,
        margin: int,
        rows: int,
        *,
        workers: int = 1,
        transparent: bool = True,
        stage: str = "Filtering",
    ) -> Rows:
        """Yield the edited rows in tiles of ``rows``, with their transparency if ``transparent``."""

        def tiles() -> Iterator[Tile]:
            for tile in picture.tiles(margin, rows):
                self.report(stage, tile.start, picture.size[0])
                yield tile

        def edited_tile(tile: Tile) -> tuple[slice, NDArray[Any]]:
            values = stored_as(edit(tile), self.kind)
            if transparent:
                values = np.concatenate([values, transparency(tile, self.kind)], axis=2)
            return slice(tile.start, tile.start + len(values)), values

        yield from in_order(edited_tile, tiles(), workers)
        self.report(stage, picture.size[0], picture.size[0])


def factor_bytes(pixels: int, num_landmarks: int) -> int:
    """Memory in bytes for pixels that are computed together: their factor, and products of the same size."""
    return 16 * pixels * num_landmarks


def check_target(target: RowTarget, source: RowSource, *, coloured: bool = False) -> None:
    """Raise unless the source can be read, and the target has the shape of the output."""
    picture, shape, what = Picture(source), tuple(source.shape), "the shape of the source"
    if coloured:
        shape = (*picture.size, 3 if picture.samples in (1, 3) else 4)
        what = "the height and width of the source, three colours, and its transparency if it has one"
    if tuple(target.shape) != shape:
        raise ValueError(f"target must have {what}, {shape}, got {tuple(target.shape)}; pass one of that shape")


def fill(target: RowTarget, rows: Rows) -> None:
    """Assign the rows (h, W, S) to their positions."""
    for part, values in rows:
        target[part] = values.reshape(values.shape[0], *target.shape[1:])


def bytes_needed(picture: Picture, passes: Passes, num_features: int, num_landmarks: int, extra_floats: int = 0) -> int:
    """Smallest memory in bytes for statistics and for rows; arguments as in :func:`rows_that_fit`."""
    size = picture.dtype.itemsize
    workers, rows = passes.workers(num_landmarks), passes.chunk_rows(picture.size[1])
    factors = workers * factor_bytes(rows * picture.size[1], num_landmarks) // 4
    # First the pilot, with copies of its features and its factor; later the factors of both samples, and blocks.
    pilot, block = min(sampling.PILOT, picture.pixels), min(picture.statistics_rows * picture.size[1], picture.pixels)
    some = (pilot + min(picture.pixels, passes.sample)) * (num_landmarks + picture.colours + 2)
    later = some + workers * block * (num_landmarks + num_features + 8)
    return size * (extra_floats + factors + max(pilot * (num_landmarks + 3 * num_features), later))


def rows_that_fit(
    picture: Picture,
    passes: Passes,
    *,
    floats: int,
    num_features: int,
    num_landmarks: int,
    extra_floats: int = 0,
) -> int:
    """Number of rows of a tile that fit in memory.

    Args:
        picture: to be edited.
        passes: tiling options.
        floats: per pixel of a tile.
        num_features: features per pixel.
        num_landmarks: M.
        extra_floats: floats that are kept in memory besides.

    Raises:
        MemoryError: if not even one row fits, or the samples do not.
    """
    row = picture.size[1] * floats * picture.dtype.itemsize
    least = bytes_needed(picture, passes, num_features, num_landmarks, extra_floats)
    if max(row, least) > passes.memory:
        raise MemoryError(
            f"{picture.name} needs at least {max(row, least) / 1e6:.0f} MB of memory, but only "
            f"{passes.memory / 1e6:.0f} MB may be used; allow more, or use fewer landmarks"
        )
    tiles, together = 1 + passes.workers(num_landmarks), passes.chunk_rows(picture.size[1]) * picture.size[1]
    taken = picture.dtype.itemsize * extra_floats + (tiles - 1) * factor_bytes(together, num_landmarks)
    return max(1, min((passes.memory - taken) // (tiles * row), TILE_PIXELS // picture.size[1]))


def cacheable_pixels(picture: Picture, passes: Passes, num_features: int, num_landmarks: int, extra_floats: int) -> int:
    """Number of pixels whose columns can be kept from one pass to the next."""
    if passes.memory < LARGE_MEMORY:
        return 0
    spare = passes.memory * 7 // 10 - bytes_needed(picture, passes, num_features, num_landmarks, extra_floats)
    return min(picture.pixels, max(0, spare // (picture.dtype.itemsize * (num_landmarks + 2))))
