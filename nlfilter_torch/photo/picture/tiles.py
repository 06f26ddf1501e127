"""Tiles of rows: how many rows fit in memory, and the loop over tiles from a source to a target."""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_choice, check_count
from nlfilter_torch.core.workers import in_order
from nlfilter_torch.photo.declared.rows import RowSource, Stored, is_hidden, keep_apart
from nlfilter_torch.photo.files.writing import FileRows
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.pictures import (
    FLOAT32,
    KINDS,
    Picture,
    Rows,
    RowTarget,
    Tile,
    put_back,
    stored_as,
    transparency,
)
from nlfilter_torch.photo.picture.sampling import Report, in_silence

SAMPLE = 1 << 16  # pixels; docs/scale.md shows the effect of more or fewer
TILE_PIXELS = 1 << 17  # longer tiles are no faster
# Pixels that are computed together for speed, with a filter and without, if LARGE_MEMORY bytes or more may be used.
CHUNK_PIXELS, PLAIN_CHUNK_PIXELS, LARGE_MEMORY = 1 << 14, 1 << 16, 1 << 28
Statistics = Literal["sample", "full"]
TileEdit = Callable[[Tile], Tensor]  # computes the colours (1, C, h, W) of its rows
Comparison = tuple[float, int]  # a sum over pixels of rows before and after an edit, and the number of values


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
        processes: compute the tiles of the output in place of these threads, if given.
    """

    kind: str
    statistics: Statistics = "sample"
    sample: int = SAMPLE
    tile_rows: int | None = None
    memory: int = 1 << 30
    report: Report = in_silence
    folder: Path | None = None
    threads: int = field(default_factory=torch.get_num_threads)
    processes: "Processes | None" = None

    def __post_init__(self) -> None:
        """Raise unless all options are valid."""
        check_choice(self.statistics, "statistics", ("sample", "full"))
        check_choice(self.kind, "dtype of the target", KINDS)
        check_count(self.sample, "sample")
        if self.tile_rows is not None:
            check_count(self.tile_rows, "tile_rows")

    def __getstate__(self) -> dict[str, object]:
        """The options in another process, which reports nothing."""
        return self.__dict__ | {"report": in_silence, "processes": None}

    def chunk_rows(self, width: int, num_landmarks: int) -> int:
        """Number of rows that are always computed together; the height of a tile is a multiple of it.

        Without a filter, ``num_landmarks`` is 0.
        """
        pixels = CHUNK_PIXELS if num_landmarks else PLAIN_CHUNK_PIXELS
        return max(1, (pixels if self.memory >= LARGE_MEMORY else 1) // width)

    def workers(self, num_landmarks: int) -> int:
        """Number of tiles computed at once, each by its own thread: as many as memory allows."""
        if self.memory < LARGE_MEMORY:
            return 1
        return max(1, min(self.threads, self.memory // (4 * factor_bytes(CHUNK_PIXELS, max(1, num_landmarks)))))

    def stores_guide(self, guide_bytes: int) -> bool:
        """Whether a guide of ``guide_bytes`` bytes is kept from one pass to the next."""
        return self.memory >= LARGE_MEMORY and guide_bytes <= self.memory // 4

    def stored(self, tiling: "Tiling") -> AbstractContextManager[RowSource]:
        """Compute rows and store them for a further pass over them, in a temporary file or array."""
        if self.processes is not None:
            return self.processes.stored(tiling, self.folder)
        return intermediate(iter(tiling), tiling.picture.size, self.folder)


@dataclass(frozen=True)
class Tiling:
    """The rows of an edited picture, which can be computed in any order, and in other processes.

    Iteration computes them in order, in tiles.

    Attributes:
        passes: tiling options.
        picture: to be edited.
        edit: computes the colours of a tile.
        margin: number of rows around a tile that ``edit`` reads.
        rows: of a tile, a multiple of ``together``.
        together: number of rows that are always computed together; tiles begin at multiples of it.
        workers: number of threads of this process, with a tile each.
        transparent: whether the output has the transparency of the picture, and the stored colours of hidden pixels.
        nodata: value of hidden pixels in the output, which then has no transparency; None otherwise.
        stage: its name for the progress.
        compare: compares rows before and after the edit, both as they are stored.
        compared: called with each of these comparisons, in this process.
    """

    passes: Passes
    picture: Picture
    edit: TileEdit
    margin: int
    rows: int
    together: int = 1
    workers: int = 1
    transparent: bool = True
    nodata: float | None = None
    stage: str = "Filtering"
    compare: Callable[[Stored, Stored], Comparison] | None = None
    compared: Callable[[Comparison], None] | None = None

    def __getstate__(self) -> dict[str, object]:
        """The tiling in another process."""
        return self.__dict__ | {"compared": None}

    def __iter__(self) -> Rows:
        """Yield the edited rows, in order."""
        self.passes.report(self.stage, 0, self.picture.size[0])
        for part, values, comparison in in_order(self._rows, self.picture.tiles(self.margin, self.rows), self.workers):
            self.note(comparison)
            yield part, values
            self.passes.report(self.stage, part.stop, self.picture.size[0])

    def _rows(self, tile: Tile) -> tuple[slice, Stored, list[Comparison]]:
        """The place of a tile's rows, these rows after the edit, and what :attr:`compare` returns for them."""
        values = self._edited(tile)
        return slice(tile.start, tile.start + len(values)), values, self._comparison(tile.stored, values)

    @torch.no_grad()
    def part(self, start: int, stop: int) -> tuple[Stored, list[Comparison]]:
        """The edited rows from ``start`` to ``stop``, computed in this thread, and the results for :meth:`note`."""
        last = min(-(-stop // self.together) * self.together, self.picture.size[0])
        parts, comparisons = [], []
        for first in range(start // self.together * self.together, last, self.rows):
            tile = self.picture.tile(first, min(first + self.rows, last), self.margin)
            wanted = slice(max(start - first, 0), stop - first)
            parts.append(self._edited(tile)[wanted])
            comparisons += self._comparison(tile.stored[wanted], parts[-1])
        return np.concatenate(parts), comparisons

    @property
    def fill(self) -> Callable[[Path], None] | None:
        """Computes the rows by worker processes, which write them to the zarr array in a folder; None without them."""
        return None if self.passes.processes is None else partial(self.passes.processes.fill, self)

    def note(self, comparisons: list[Comparison]) -> None:
        """Pass comparisons on to :attr:`compared`."""
        if self.compared is not None:
            for comparison in comparisons:
                self.compared(comparison)

    def _edited(self, tile: Tile) -> Stored:
        values = stored_as(self.edit(tile), self.passes.kind)
        if not self.transparent:
            return values
        if self.picture.hides and (hidden := is_hidden(tile.stored)).any():
            put_back(values, tile.stored[hidden][:, : self.picture.colours], hidden)
        if self.nodata is not None:
            keep_apart(values, is_hidden(tile.stored), self.nodata)
            return values
        return np.concatenate([values, transparency(tile, self.passes.kind)], axis=2)

    def _comparison(self, before: Stored, after: Stored) -> list[Comparison]:
        return [] if self.compare is None else [self.compare(before, after)]


class Processes(Protocol):
    """Processes that compute tiles and write them to arrays of zarr."""

    @property
    def on_this_machine(self) -> int:
        """Number of processes that share the memory of this machine."""

    def fill(self, tiling: Tiling, path: Path) -> None:
        """Compute rows and write them to the array in a folder."""

    def stored(self, tiling: Tiling, folder: Path | None) -> AbstractContextManager[RowSource]:
        """Compute rows and store them where all processes can read them."""


@contextmanager
def intermediate(rows: Rows, size: tuple[int, int], folder: Path | None) -> Iterator[FileRows]:
    """Write rows (h, W, S) of a picture (H, W) between two steps to a temporary file, and yield that as a source.

    Without a folder for the file, it is in the system's folder for temporary files.

    Raises:
        OSError: if the file does not fit.
    """
    with TemporaryFile(dir=folder) as file:
        shape, kind = (*size, 0), FLOAT32
        for _, values in rows:
            shape, kind = (*size, values.shape[2]), values.dtype
            try:
                file.write(np.ascontiguousarray(values).tobytes())
            except OSError as error:
                megabytes = max(1.0, kind.itemsize * math.prod(shape) / 1e6)
                needed = f"{megabytes / 1000:.1f} GB" if megabytes >= 1000 else f"{megabytes:.0f} MB"
                reason = f"{error.strerror}, for a temporary file of {needed}"
                raise OSError(error.errno, reason, str(folder or gettempdir())) from error
        file.flush()
        yield FileRows(file, shape, kind)


def between_steps(passes: Passes, source: RowSource) -> Passes:
    """Tiling options for the rows between two steps: floats, which hold all values of the source."""
    return replace(passes, kind="float64" if source.dtype == np.float64 else "float32")


def tile_by_tile(passes: Passes, picture: Picture, edit: TileEdit) -> Tiling:
    """The rows of an edit that computes each pixel from the same pixel of the picture."""
    return Tiling(passes, picture, edit, 0, passes.tile_rows or max(1, TILE_PIXELS // picture.size[1]))


def inner(tile: Tile) -> Tensor:
    """The pixels of a tile."""
    return tile.image


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


def bytes_needed(picture: Picture, passes: Passes, num_features: int, num_landmarks: int, extra_floats: int) -> int:
    """Smallest memory in bytes for statistics and for rows; arguments as in :func:`rows_that_fit`."""
    size = picture.dtype.itemsize
    workers, rows = passes.workers(num_landmarks), passes.chunk_rows(picture.size[1], num_landmarks)
    factors = workers * factor_bytes(rows * picture.size[1], num_landmarks) // 4
    # First the pilot, with copies of its features and its factor; later the factors of both samples, and blocks.
    pilot, block = min(sampling.PILOT, picture.pixels), min(picture.statistics_rows * picture.size[1], picture.pixels)
    samples = (pilot + min(picture.pixels, passes.sample)) * (num_landmarks + picture.colours + 2)
    later = samples + workers * block * (num_landmarks + num_features + 8)
    return size * (extra_floats + factors + max(pilot * (num_landmarks + 3 * num_features), later))


def rows_that_fit(
    picture: Picture, passes: Passes, floats: int, num_features: int, num_landmarks: int, extra_floats: int
) -> int:
    """Number of rows of a tile that fit in memory, with ``floats`` per pixel, and ``extra_floats`` in memory besides.

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
    at_once = passes.workers(num_landmarks) if passes.processes is None else passes.processes.on_this_machine
    tiles, together = 1 + max(1, at_once), passes.chunk_rows(picture.size[1], num_landmarks) * picture.size[1]
    taken = picture.dtype.itemsize * extra_floats + (tiles - 1) * factor_bytes(together, num_landmarks)
    return max(1, min((passes.memory - taken) // (tiles * row), TILE_PIXELS // picture.size[1]))


def cacheable_pixels(picture: Picture, passes: Passes, num_features: int, num_landmarks: int, extra_floats: int) -> int:
    """Number of pixels whose columns can be kept from one pass to the next."""
    if passes.memory < LARGE_MEMORY:
        return 0
    spare = passes.memory * 7 // 10 - bytes_needed(picture, passes, num_features, num_landmarks, extra_floats)
    return min(picture.pixels, max(0, spare // (picture.dtype.itemsize * (num_landmarks + 2))))
