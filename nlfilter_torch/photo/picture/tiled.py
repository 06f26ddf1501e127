"""A picture that is read a few rows at a time as the source of an edit: blocks for its statistics, output in tiles."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Concatenate, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.workers import in_order, single_threaded
from nlfilter_torch.operator.eigenvalue_bound import is_bounded
from nlfilter_torch.operator.hidden import fill_nearby
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.picture.counted import CountedPixels, counted_pixels
from nlfilter_torch.photo.picture.measuring import everywhere
from nlfilter_torch.photo.picture.pictures import Picture, Rows, Tile
from nlfilter_torch.photo.picture.pixels import Block, Fitted, WorkingRange
from nlfilter_torch.photo.picture.regions import check_scribble_memory, floats_per_scribbled_pixel, read_scribbles
from nlfilter_torch.photo.picture.resizing import ResizedPart, resized_parts, weights_of
from nlfilter_torch.photo.picture.sampling import ColumnCache, GuidePicture, take_pilot
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Guide, P, Rest, Source
from nlfilter_torch.photo.picture.tiled_operator import TiledOperator
from nlfilter_torch.photo.picture.tiles import TILE_PIXELS, Passes, Tiling, cacheable_pixels, inner, rows_that_fit

FINISH_FLOATS = 64  # floats per pixel of a tile during ``Fitted.finish``: images, their transforms and products
Part = TypeVar("Part")


@dataclass(eq=False)
class Room:
    """The memory that an edit of a picture in tiles takes.

    Attributes:
        picture: to be edited.
        passes: tiling options.
        operators: filters fitted to the picture.
        scribbled_pixels: number of pixels under scribbles.
        cached_floats: floats of cached columns.
        guide_floats: floats of stored guides.
    """

    picture: Picture
    passes: Passes
    operators: list[TiledOperator] = field(default_factory=list)
    scribbled_pixels: int = 0
    cached_floats: int = 0
    guide_floats: int = 0

    @cached_property
    def counted(self) -> CountedPixels | None:
        """How much the pixels count; None is 1 each."""
        if not self.picture.hides:
            return None
        (height, _), step = self.picture.size, self.picture.statistics_rows
        starts = range(0, height, step)
        return counted_pixels(
            np.concatenate([self.picture.opacity(start, min(start + step, height)) for start in starts])
        )

    @property
    def num_landmarks(self) -> int:
        """Largest number of landmarks of the filters; 0 without a filter."""
        return max((operator.kernel.landmarks.shape[2] for operator in self.operators), default=0)

    @property
    def margin(self) -> int:
        """Number of rows around a tile that its columns depend on."""
        return max((operator.picture_margin for operator in self.operators), default=0)

    def prepare(self) -> None:
        """Compute what the filters need before several workers use them."""
        for operator in self.operators:
            operator.prepare()

    def forget_columns(self) -> None:
        """Free the columns cached between passes."""
        for operator in self.operators:
            operator.cache = ColumnCache(1, 0)
        self.cached_floats = 0

    def rows(self, num_features: int, num_landmarks: int) -> int:
        """Rows of a tile that fit in memory, with ``num_features`` more features per pixel.

        Raises:
            MemoryError: if not even one row fits, or the samples do not.
        """
        scribbled = floats_per_scribbled_pixel(num_features)
        check_scribble_memory(self.picture, self.scribbled_pixels, scribbled, self.passes.memory)
        floats = 8 * self.picture.colours + 40 + num_features  # per pixel; each operator adds its features
        floats += sum(operator.kernel.landmarks.shape[1] for operator in self.operators)
        kept = self.cached_floats + self.stored_floats(num_features)
        return rows_that_fit(self.picture, self.passes, floats, num_features, num_landmarks, kept)

    def stored_floats(self, num_features: int) -> int:
        """Floats of stored guides, and of scribbles with ``num_features`` features per pixel."""
        return self.guide_floats + self.scribbled_pixels * floats_per_scribbled_pixel(num_features)

    def tile_rows(self, together: int) -> int:
        """Rows of a tile, a multiple of those that are computed together."""
        landmarks = self.num_landmarks
        fitting = self.rows(0, landmarks) if landmarks else TILE_PIXELS // self.picture.size[1]
        return max(1, (self.passes.tile_rows or fitting) // together) * together

    def rows_to_finish(self, fitted: Fitted, rows: int, workers: int) -> tuple[int, int]:
        """Rows per tile and number of workers for ``finish``.

        A tile has at least as many rows as the margin, or several times as many if ``tile_rows`` is None, as far as
        memory allows. Several workers are used only if memory allows such a tile for each.

        Raises:
            MemoryError: if no tile fits.
        """
        picture, memory = self.picture, self.passes.memory
        row = picture.size[1] * FINISH_FLOATS * picture.dtype.itemsize
        most = memory // row - 2 * fitted.margin
        if picture.size[0] > most and most < fitted.step:
            raise MemoryError(
                f"{picture.name} needs at least {row * (2 * fitted.margin + fitted.step) / 1e6:.0f} MB of memory, "
                f"but only {memory / 1e6:.0f} MB may be used; allow more, or use a smaller picture"
            )
        rows = max(rows, (1 if self.passes.tile_rows else 4) * fitted.margin)
        if (1 + workers) * row * (rows + 2 * fitted.margin) > memory:
            workers = 1
        rows = rows if picture.size[0] <= most else min(rows, most)
        return max(1, rows // fitted.step) * fitted.step, workers


@dataclass(frozen=True, eq=False)
class TileHalves:
    """An edit of tiles in two halves, of which the second, :attr:`Fitted.finish`, sees the neighbourhood of a pixel.

    Attributes:
        fitted: the edit.
        together: rows that are computed at once; the same for tiles of any height, since the rounding of a matrix
            product depends on its shape.
        planes: result of the first half, of the whole picture; None until it is computed.
    """

    fitted: Fitted
    together: int
    planes: Picture | None = None

    @full_precision
    def first(self, tile: Tile) -> Tensor:
        """The edited rows (1, C, h, W) of a tile, or the planes that ``finish`` takes."""
        seen = tile.in_range(self.fitted.working)
        result = torch.cat([self.fitted.pixels(part) for part in seen.parts(self.together)], dim=2)
        return result if self.fitted.finish is not None else self.fitted.output(tile.image, result)

    def second(self, tile: Tile) -> Tensor:
        """The edited rows (1, C, h, W) of a tile that has the margin."""
        assert self.fitted.finish is not None  # for mypy
        assert self.planes is not None
        stop = tile.start + len(tile.stored)
        planes = self.planes.tile(tile.start, stop, self.fitted.margin).pixels
        result = self.fitted.finish(tile.in_range(self.fitted.working).pixels, planes, tile.inner)
        return self.fitted.output(tile.pixels, result)[..., *tile.inner]


class Tiled:
    """A picture that is read in tiles, as the source of an edit; errors call its scribbles ``strokes``.

    ``room`` is that of the same picture in another range of values, if there is one.
    """

    batch = 1

    def __init__(self, picture: Picture, passes: Passes, strokes: str = "strokes", room: Room | None = None) -> None:
        self.picture, self.passes, self.strokes = picture, passes, strokes
        self.size, self.channels, self.dtype = picture.size, picture.colours, picture.dtype
        self.room = Room(picture, passes) if room is None else room

    @property
    def memory(self) -> float:
        """Bytes that may be used."""
        return self.passes.memory

    @property
    def counted(self) -> CountedPixels | None:
        """How much the pixels count; None is 1 each."""
        return self.room.counted

    def in_range(self, working: WorkingRange | None) -> Self:
        """The picture in a range of values."""
        self.picture.accept_any_scale()
        return self if working is None else self._of(self.picture.in_range(working))

    def _of(self, picture: Picture) -> Self:
        """Another source of the same picture, for the same edit."""
        return type(self)(picture, self.passes, self.strokes, self.room)

    def over(
        self,
        function: Callable[[Block, *Rest], Part],
        stage: str,
        *arguments: *Rest,
        margin: int = 0,
        step: int = 1,
        places: Tensor | None = None,
    ) -> Iterator[Part]:
        """Apply a function to blocks of rows, and yield the results in order.

        The first block is finished before the others begin, since it may compute the sums of an operator.
        """
        (height, width), counted = self.size, self.counted
        rows = max(1, self.picture.statistics_rows // step) * step
        starts = list(range(0, height, rows))
        if places is not None:
            starts = ((places // (width * rows)).unique() * rows).tolist()
        tiles = (
            replace(self.picture.tile(start, min(start + rows, height), margin), counted=counted) for start in starts
        )
        self.passes.report(stage, 0, height)
        for tile in (next(tiles) for _ in starts[:1]):
            with torch.no_grad():
                result = function(tile, *arguments)
            yield result
        others = in_order(function, tiles, self.passes.workers(1), *arguments)
        for start, result in zip(starts[1:], others, strict=True):
            self.passes.report(stage, start, height)  # those before this one
            yield result

    @torch.no_grad()
    @full_precision
    def operator(self, guide: Guide) -> "TiledOperator":
        """The filter of the whole picture, balanced on a sample of the pixels or on all of them.

        Raises:
            MemoryError: if the samples or a row do not fit in memory.
        """
        options = guide.options
        patch_size, count = options.patch_size, options.num_landmarks
        check_count(patch_size, "patch_size")
        check_count(count, "num_landmarks")
        compared = guide.channels or (self.channels if options.guide_channels == "all" else 1)
        num_features = patch_size**2 * compared + 2
        passes, room, picture = self.passes, self.room, self.picture
        seen = GuidePicture(picture, guide, self.counted)
        room.forget_columns()
        room.rows(num_features, count)
        workers = passes.workers(count)
        if guide.margin and passes.stores_guide(picture.pixels * compared * self.dtype.itemsize):
            room.guide_floats += picture.pixels * compared
            room.rows(num_features, count)
            seen.store(max(1, TILE_PIXELS // self.size[1]), workers)
        pilot = take_pilot(seen, passes.report, workers)
        sampled, count = passes.sample < picture.pixels, pilot.moment.shape[1]
        cached_pixels = cacheable_pixels(picture, passes, num_features, count, room.stored_floats(num_features))
        room.cached_floats = cached_pixels * (count + 2)
        operator = TiledOperator(
            seen,
            pilot,
            passes.report,
            passes.sample if sampled else None,
            full_passes=not sampled or passes.statistics == "full" or guide.exact,
            kernel=pilot.kernel,
            bounded=is_bounded(options.landmarks, picture.pixels, count),
            workers=workers,
            cache=ColumnCache(picture.statistics_rows * self.size[1], cached_pixels),
        )
        room.operators.append(operator)
        return operator

    def scribbles(
        self, mask: RowSource | None, colours: RowSource | None, name: str, *, needed: bool = True
    ) -> Scribbles:
        """Read scribbles from a mask, rows (H, W) or (H, W, 1), and colours, rows (H, W, 3).

        Without a mask, colours are rows (H, W, 4), whose last channel is the mask.

        Raises:
            ValueError: if the size or number of channels of an input does not fit, a weight is outside [0, 1], or
                scribbles are ``needed`` and cover no pixel.
            MemoryError: if there are too many scribbled pixels.
        """
        scribbles = read_scribbles(
            self.picture,
            mask,
            colours,
            name=name,
            strokes=self.strokes,
            memory=self.passes.memory,
            report=self.passes.report,
        )
        if self.counted is not None and len(scribbles.places):
            scribbles = scribbles.weighted_by(self.counted.at(scribbles.places))
            if needed and len(scribbles.places) == 0:
                raise ValueError(f"{name} must cover a pixel that is not hidden, got none that does; move it")
        if needed and len(scribbles.places) == 0:
            called = self.strokes if mask is None else name
            raise ValueError(f"{called} must hold a painted pixel, got none; paint at least one")
        self.room.scribbled_pixels += len(scribbles.places)
        return scribbles

    @torch.no_grad()
    def resized(self, size: tuple[int, int]) -> "Tiled":
        """The picture in a smaller size, in memory, as another tiled source."""
        planes, passes = self._resized(inner, size), replace(self.plain, tile_rows=None)
        if self.counted is not None:
            weights = weights_of(self._resized(_weights, size))
            planes = torch.cat([fill_nearby(planes, weights > 0), weights], dim=1)
        rows = np.ascontiguousarray(planes[0].permute(1, 2, 0).numpy())
        return Tiled(Picture(rows, self.picture.name), passes, self.strokes)

    def _resized(self, planes: Callable[[Tile], Tensor], size: tuple[int, int]) -> Tensor:
        """Resize planes of tiles, which are read here, and computed by several threads."""
        parts = ((part, deque(map(self._to_resize, part.pieces))) for part in resized_parts(self.size, size))
        return torch.cat(list(in_order(_resized_part, parts, self.passes.workers(1), planes)), dim=2)

    def _to_resize(self, rows: slice) -> Tile:
        self.passes.report("Reducing", rows.start, self.size[0])
        return replace(self.picture.tile(rows.start, rows.stop, 0), counted=self.counted)

    def all(self, fitted: Fitted) -> Tensor:
        """The planes (1, C, H, W) that an edit makes of all pixels."""
        return everywhere(self, fitted)

    def emit(self, fitted: Fitted) -> Iterator[tuple[Tensor, Tensor | None]]:
        """Yield rows of the edited picture, in the dtype of the computation, and how much their pixels count."""
        for rows, values in self.rows(fitted, plain=True):
            planes = torch.from_numpy(values).permute(2, 0, 1)[None]
            yield planes, None if self.counted is None else self.counted.rows(rows.start, rows.stop)

    @torch.no_grad()
    def measured(
        self, function: Callable[Concatenate[Source[RowSource], P], Tensor], *args: P.args, **kwargs: P.kwargs
    ) -> Tensor:
        """Apply a measurement to the picture."""
        return function(self, *args, **kwargs)

    @property
    def plain(self) -> Passes:
        """Tiling options for output in the dtype of the computation."""
        return replace(self.passes, kind="float32" if self.dtype == torch.float32 else "float64")

    def rows(self, fitted: Fitted, *, plain: bool = False) -> Rows:
        """Yield the rows (h, W, S) of the edited picture, in order; arguments as those of :meth:`tiling`."""
        with self.tiling(fitted, plain=plain) as tiling:
            yield from tiling

    @contextmanager
    def tiling(self, fitted: Fitted, *, plain: bool = False) -> Iterator[Tiling]:
        """Yield the rows of the edited picture, not yet computed; they can be computed within the block.

        With ``plain`` they are in the dtype of the computation, without transparency.
        """
        passes = replace(self.plain, processes=None) if plain else self.passes  # for an edit that is being fitted
        landmarks, room = self.room.num_landmarks, self.room
        together, workers = self.passes.chunk_rows(self.size[1], landmarks), self.passes.workers(landmarks)
        rows = room.tile_rows(together)
        with single_threaded(workers):
            room.prepare()
        halves, margin = TileHalves(fitted, together), room.margin
        tiling = Tiling(passes, self.picture, halves.first, margin, rows, together, workers, transparent=not plain)
        if fitted.finish is None:
            yield tiling
            return
        before = replace(tiling, passes=replace(passes, kind=self.plain.kind), transparent=False, stage="Comparing")
        with passes.stored(before) as planes:
            halves = replace(halves, planes=Picture(planes, self.picture.name, channels=planes.shape[2]))
            rows, workers = room.rows_to_finish(fitted, rows, workers)
            margin, together = fitted.margin, fitted.step
            yield replace(tiling, edit=halves.second, margin=margin, rows=rows, together=together, workers=workers)


def _weights(tile: Tile) -> Tensor:
    """The weights (1, 1, h, W) of a tile."""
    return torch.ones_like(tile.image[:, :1]) if tile.weights is None else tile.weights


def _resized_part(read: tuple[ResizedPart, deque[Tile]], planes: Callable[[Tile], Tensor]) -> Tensor:
    """A part of resized planes of tiles; a tile that was used, which keeps its pixels, is dropped."""
    part, tiles = read
    return part.of(planes(tiles.popleft()) for _ in part.pieces)
