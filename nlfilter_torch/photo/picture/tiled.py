"""A picture that is read a few rows at a time as the source of an edit: sums in passes, output in tiles."""

import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.checks import check_count
from nlfilter_torch.core.inner import Inner
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.workers import Result, in_order, single_threaded
from nlfilter_torch.operator.eigenvalue_bound import is_bounded
from nlfilter_torch.operator.hidden import fill_nearby
from nlfilter_torch.photo.declared.rows import RowSource, Stored
from nlfilter_torch.photo.picture.counted import CountedPixels, counted_pixels
from nlfilter_torch.photo.picture.ends import ends_of
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.pictures import Picture, Rows, Tile
from nlfilter_torch.photo.picture.pixels import Pixels, part_of, whole_image
from nlfilter_torch.photo.picture.resizing import (
    block_counts,
    block_parts,
    counted_means,
    resized,
    resized_parts,
    weights_of,
)
from nlfilter_torch.photo.picture.sampling import ColumnCache, GuidePicture, take_pilot, visit
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Fitted, Guide, Kept, Planes, Source
from nlfilter_torch.photo.picture.tiled_operator import TiledOperator, TilePixels
from nlfilter_torch.photo.picture.tiled_scribbles import (
    WeightRows,
    check_scribble_memory,
    floats_per_scribbled_pixel,
    overlay,
    read_scribbles,
    region_rows,
)
from nlfilter_torch.photo.picture.tiles import TILE_PIXELS, Passes, Tiling, cacheable_pixels, rows_that_fit

CACHED_SHARE = 1 / 16  # largest share of the memory for planes that an edit reuses
FINISH_FLOATS = 64  # floats per pixel of a tile during ``Fitted.finish``: images, their transforms and products


def _pixels(tile: Tile) -> Tensor:
    return tile.pixels


def _features(tile: Tile, operator: TiledOperator) -> Tensor:
    return operator.features(tile)


def _of_tile(function: Callable[[Tensor, Inner, int], Kept], tile: Tile) -> Kept:
    above, below = tile.halo
    return function(tile.pixels, (slice(above, tile.pixels.shape[2] - below), slice(None)), tile.start)


def _call(compute: Callable[[], Tensor]) -> Tensor:
    return compute()


class WeightReader:
    """Reads rows (H, W, K) or (H, W) of weights, and notes the least and largest value of each plane.

    Interpolation may exceed them, but must not hide an invalid weight.
    """

    def __init__(self, weights: RowSource) -> None:
        self._weights = weights
        self._least: list[Tensor] = []
        self._largest: list[Tensor] = []

    def __call__(self, start: int, stop: int) -> Tensor:
        """The rows (1, K, h, W) from ``start`` to ``stop``."""
        rows = torch.from_numpy(np.atleast_3d(np.array(self._weights[start:stop], np.float32)))
        rows = rows.permute(2, 0, 1)[None]
        self._least.append(rows.amin((2, 3), keepdim=True))
        self._largest.append(rows.amax((2, 3), keepdim=True))
        return rows

    def clamp(self, planes: Tensor) -> Tensor:
        """Limit planes (1, K, h, w) to the values that were read."""
        return planes.clamp(torch.cat(self._least).amin(0), torch.cat(self._largest).amax(0))


class TileFeatures:
    """Features of the parts of a tile, computed for the whole tile at once."""

    def __init__(self, tile: Tile, part_pixels: int) -> None:
        self._tile, self._part_pixels = tile, part_pixels
        self._features: dict[TiledOperator, tuple[Tensor, ...]] = {}

    def of_part(self, part: int, operator: TiledOperator) -> Tensor:
        """Features (1, D, n) of a part, numbered from 0, for an operator."""
        if operator not in self._features:
            self._features[operator] = operator.features(self._tile).split(self._part_pixels, dim=2)
        return self._features[operator][part]


@dataclass(frozen=True, eq=False)
class Finish:
    """The second half of an edit that depends on the neighbourhood of a pixel: :attr:`Fitted.finish` of tiles.

    Attributes:
        function: ``finish`` of the edit.
        planes: result of the first half, of the whole picture.
        margin: radius of the neighbourhood.
    """

    function: Callable[[Tensor, Tensor, Inner], Tensor]
    planes: Picture
    margin: int

    def __call__(self, tile: Tile) -> Tensor:
        """The edited rows (1, C, h, W) of a tile that has the margin."""
        stop = tile.start + tile.inner.shape[2]
        inner = slice(tile.halo[0], tile.pixels.shape[2] - tile.halo[1]), slice(None)
        return self.function(tile.pixels, self.planes.tile(tile.start, stop, self.margin).pixels, inner)[..., *inner]


class Tiled:
    """A picture that is read in tiles, as the source of an edit; errors call its scribbles ``strokes``."""

    batch = 1

    def __init__(self, picture: Picture, passes: Passes, strokes: str = "strokes") -> None:
        self.picture, self.passes, self.strokes = picture, passes, strokes
        self.size, self.channels, self.dtype = picture.size, picture.colours, picture.dtype
        self.operators: list[TiledOperator] = []
        self.tile_floats = 8 * picture.colours + 40  # floats per pixel of a tile; each operator adds its features
        self.scribbled_pixels = 0
        self.cached_floats = 0  # floats of cached columns
        self.guide_floats = 0  # floats of stored guides

    def accept_any_scale(self) -> None:
        """Do not warn of values far outside [0, 1] from now on."""
        self.picture.accept_any_scale()

    def __getstate__(self) -> dict[str, object]:
        """The source in another process, which takes no means over it."""
        return {name: value for name, value in self.__dict__.items() if name != "counted"}

    @cached_property
    def counted(self) -> CountedPixels | None:
        """How much the pixels count; None is 1 each."""
        if not self.picture.hides:
            return None
        (height, _), step = self.size, self.picture.statistics_rows
        parts = [self.picture.opacity(start, min(start + step, height)) for start in range(0, height, step)]
        return counted_pixels(np.concatenate(parts))

    @property
    def weight(self) -> float:
        """Sum of the weights."""
        return self.picture.pixels if self.counted is None else self.counted.total

    def weights(self, tile: Tile) -> Tensor | None:
        """The weights (1, 1, h, W) of a tile's pixels; None is 1 each."""
        if self.counted is None:
            return None
        return self.counted.rows(tile.start, tile.start + len(tile.stored)).to(self.dtype)

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
        for other in self.operators:
            other.cache = ColumnCache(1, 0)  # frees memory
        self.cached_floats = 0
        self.fitting_rows(num_features, count)
        passes, picture = self.passes, GuidePicture(self.picture, guide, self.counted)
        workers = passes.workers(count)
        if guide.margin and passes.stores_guide(picture.pixels * compared * self.dtype.itemsize):
            self.guide_floats += picture.pixels * compared
            self.fitting_rows(num_features, count)
            picture.store(max(1, TILE_PIXELS // self.size[1]), workers)
        pilot = take_pilot(picture, passes.report, workers)
        sampled, count = passes.sample < picture.pixels, pilot.moment.shape[1]
        cached_pixels = cacheable_pixels(picture, passes, num_features, count, self.stored_floats(num_features))
        self.cached_floats = cached_pixels * (count + 2)
        operator = TiledOperator(
            picture,
            pilot,
            passes.report,
            passes.sample if sampled else None,
            full_passes=not sampled or passes.statistics == "full" or guide.exact,
            kernel=pilot.kernel,
            bounded=is_bounded(options.landmarks, picture.pixels, count),
            workers=workers,
            cache=ColumnCache(picture.statistics_rows * self.size[1], cached_pixels),
        )
        self.operators.append(operator)
        self.tile_floats += num_features
        return operator

    def fitting_rows(self, num_features: int, num_landmarks: int) -> int:
        """Rows of a tile that fit in memory, with ``num_features`` more features per pixel.

        Raises:
            MemoryError: if not even one row fits, or the samples do not.
        """
        floats = floats_per_scribbled_pixel(num_features)
        check_scribble_memory(self.picture, self.scribbled_pixels, floats, self.passes.memory)
        floats, kept = self.tile_floats + num_features, self.cached_floats + self.stored_floats(num_features)
        return rows_that_fit(self.picture, self.passes, floats, num_features, num_landmarks, kept)

    def stored_floats(self, num_features: int) -> int:
        """Floats of stored guides, and of scribbles with ``num_features`` features per pixel."""
        return self.guide_floats + self.scribbled_pixels * floats_per_scribbled_pixel(num_features)

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
        self.scribbled_pixels += len(scribbles.places)
        return scribbles

    def regions(self, masks: RowSource, name: str, *, needed: bool = True) -> list[Scribbles]:
        """Read the scribbles of K regions from rows (H, W, K) in [0, 1].

        Raises:
            ValueError, MemoryError: as :meth:`scribbles`.
        """
        if len(masks.shape) == 2:
            return [self.scribbles(masks, None, name, needed=needed)]
        return [self.scribbles(region_rows(masks, k), None, name, needed=needed) for k in range(masks.shape[2])]

    def weights_of(self, masks: RowSource, name: str) -> WeightRows:
        """Weights of given pixels in masks, rows (H, W) or (H, W, K); values are limited to [0, 1]."""
        return WeightRows(overlay(self.picture, masks, name, channels=self.num_regions(masks, name)))

    def num_regions(self, masks: RowSource, name: str) -> int:
        """K, of rows (H, W, K), or 1 for rows (H, W)."""
        return 1 if len(masks.shape) == 2 else masks.shape[2]

    def check_all_in_memory(self, sentence: str) -> None:
        """Raise ValueError with this sentence."""
        raise ValueError(sentence)

    def colours(self, places: Tensor) -> Tensor:
        """Read the colours (1, C, n) of single pixels."""
        parts = visit(self.picture, 0, places, self.passes.report, "Looking", every=False)
        return torch.cat([tile.inner.flatten(2)[:, :, chosen] for tile, chosen in parts], dim=2)

    def weights_at(self, places: Tensor) -> Tensor | None:
        """The weights of single pixels."""
        return None if self.counted is None else self.counted.at(places).to(self.dtype)[None, None]

    @torch.no_grad()
    def resized(self, size: tuple[int, int]) -> "Tiled":
        """The picture in a smaller size, in memory, as another tiled source."""
        planes, passes = self._resized(_pixels, size), replace(self.plain, tile_rows=None)
        if self.counted is not None:
            weights = weights_of(self._resized(self._weights_of_tile, size))
            planes = torch.cat([fill_nearby(planes, weights > 0), weights], dim=1)
        rows = np.ascontiguousarray(planes[0].permute(1, 2, 0).numpy())
        return Tiled(Picture(rows, self.picture.name), passes, self.strokes)

    def _weights_of_tile(self, tile: Tile) -> Tensor:
        """The weights (1, 1, h, W) of a tile."""
        weights = self.weights(tile)
        return torch.ones_like(tile.inner[:, :1]) if weights is None else weights

    @torch.no_grad()
    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes (1, C, h, w) of all pixels in a smaller size."""
        return self._resized(partial(self._planes_of, planes), size)

    def _planes_of(self, planes: Planes, tile: Tile) -> Tensor:
        """Planes (1, C, h, W) of a tile of the picture."""
        return planes(self.pixels_of(tile))

    @torch.no_grad()
    def resized_weights(self, weights: RowSource, size: tuple[int, int], name: str) -> RowSource:
        """Weights, rows (H, W, K) or (H, W), in a smaller size."""
        if tuple(weights.shape[:2]) != self.size:
            raise ValueError(
                f"{name} must have the height and width of the picture, {self.size}, got {tuple(weights.shape[:2])}; "
                "resize them"
            )
        reader = WeightReader(weights)
        planes = reader.clamp(resized(reader, self.size, size))
        return planes[0].permute(1, 2, 0).contiguous().numpy()

    def _resized(self, planes: Callable[[Tile], Tensor], size: tuple[int, int]) -> Tensor:
        """Resize planes of tiles, which are computed by several threads."""
        parts = resized_parts(partial(self._to_resize, planes), self.size, size)
        return torch.cat(list(in_order(_call, parts, self.passes.workers(1))), dim=2)

    def _to_resize(self, planes: Callable[[Tile], Tensor], start: int, stop: int) -> Callable[[], Tensor]:
        """A function that computes the planes of the rows from ``start`` to ``stop``, which are read now."""
        self.passes.report("Reducing", start, self.size[0])
        return partial(planes, self.picture.tile(start, stop, 0))

    def all(self, fitted: Fitted) -> Tensor:
        """The planes (1, C, H, W) that an edit makes of all pixels."""
        rows = np.concatenate([values for _, values in self.rows(fitted, plain=True)])
        return torch.from_numpy(rows).permute(2, 0, 1)[None]

    def cached(self, fitted: Fitted) -> Fitted:
        """Compute the planes of an edit and keep them in memory, if small; else they are recomputed on every use."""
        if self.picture.pixels * self.channels * self.dtype.itemsize > CACHED_SHARE * self.passes.memory:
            return fitted
        return Fitted(part_of(self.all(fitted)))

    @torch.no_grad()
    def mean_of(self, fitted: Fitted, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means over all pixels, in a pass over the picture."""
        total = sum(self._row_sums(rows, values) for rows, values in self.rows(fitted.then(function), plain=True))
        return torch.as_tensor(total / self.weight).to(self.dtype).view(1, -1, 1, 1)

    def _row_sums(self, rows: slice, values: Stored) -> NDArray[np.float64]:
        """Sums (S,) of values (h, W, S) of rows."""
        if self.counted is not None:
            values = values * self.counted.rows(rows.start, rows.start + len(values))[0, 0, :, :, None].numpy()
        return np.asarray(values.sum((0, 1), dtype=np.float64))

    @torch.no_grad()
    def mean(self, planes: Planes) -> Tensor:
        """Means (1, C, 1, 1) over all pixels."""
        total = sum(self._map_tiles(partial(self._sums_of, planes), self.picture.statistics_rows, "Averaging"))
        return torch.as_tensor(total / self.weight).to(self.dtype)

    def _sums_of(self, planes: Planes, tile: Tile) -> Tensor:
        """Sums (1, C, 1, 1) of planes over a tile."""
        values, weights = self._planes_of(planes, tile).double(), self.weights(tile)
        return (values if weights is None else values * weights).sum((2, 3), keepdim=True)

    @torch.no_grad()
    def ends(self, planes: Planes) -> tuple[Tensor, Tensor]:
        """Least and largest values over all pixels."""
        rows, stage = self.picture.statistics_rows, "Finding black and white"
        parts = list(self._map_tiles(partial(self._ends_of, planes), rows, stage))
        least, largest = (torch.cat(values, dim=2) for values in zip(*parts, strict=True))
        return least.amin(2, keepdim=True), largest.amax(2, keepdim=True)

    def _ends_of(self, planes: Planes, tile: Tile) -> tuple[Tensor, Tensor]:
        """Least and largest values of planes in a tile."""
        return ends_of(self._planes_of(planes, tile), self.weights(tile))

    @torch.no_grad()
    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means over blocks of ``step`` pixels in both directions."""
        if self.counted is None:
            return self._reduced(planes, step)
        means, weighted = self._reduced(partial(self._weighted, planes), step).tensor_split([-1], dim=1)
        means, weighted, weights = *means.chunk(2, dim=1), weighted
        return counted_means(means, weighted, weights)

    def _weighted(self, planes: Planes, pixels: Pixels) -> Tensor:
        """Planes of pixels, the same times their weights, and the weights."""
        values, start = planes(pixels), pixels.first // pixels.width
        weights = torch.ones_like(values[:, :1])
        if self.counted is not None:
            weights = self.counted.rows(start, start + values.shape[2]).to(values)
        return torch.cat([values, values * weights, weights], dim=1)

    def _reduced(self, planes: Planes, step: int) -> Tensor:
        """Means over blocks of all pixels."""
        rows, counts = max(1, self.picture.statistics_rows // step) * step, block_counts(self.size, step)
        total: Tensor | None = None
        for first, part in self._map_tiles(partial(self._block_parts, planes, step), rows, "Reducing"):
            total = part.new_zeros(*part.shape[:2], *counts) if total is None else total
            total[:, :, first : first + part.shape[2]] += part
        assert total is not None  # for mypy
        return total.to(self.dtype)

    def _block_parts(self, planes: Planes, step: int, tile: Tile) -> tuple[int, Tensor]:
        """What a tile contributes to the means over blocks."""
        return block_parts(self._planes_of(planes, tile), tile.start, self.size, step)

    def _map_tiles(
        self, function: Callable[[Tile], Result], rows: int, stage: str, margin: int = 0
    ) -> Iterator[Result]:
        """Apply a function to each tile, and yield the results in order.

        The first tile is finished before the others begin, since it may compute the sums of an operator.
        """
        tiles, height = self.picture.tiles(margin, rows), self.size[0]
        self.passes.report(stage, 0, height)
        yield function(next(tiles))
        for number, result in enumerate(in_order(function, tiles, self.passes.workers(1)), start=1):
            self.passes.report(stage, min(number * rows, height), height)  # those before this one
            yield result

    def blocks(self, step: float, floats: int) -> InMemory:
        """The picture, reduced by means over blocks of an integer number of pixels along each axis, in memory.

        Raises:
            MemoryError: if ``floats`` numbers for each of its pixels do not fit.
        """
        needed = math.prod(math.ceil(side / step) for side in self.size) * floats * self.dtype.itemsize
        if needed > self.passes.memory:
            raise MemoryError(
                f"{self.picture.name} needs at least {needed / 1e6:.0f} MB of memory, but only "
                f"{self.passes.memory / 1e6:.0f} MB may be used; allow more, or use a smaller picture"
            )
        weights = None
        if self.counted is not None:
            weights = weights_of(self._reduced(partial(self._weighted, whole_image), round(step))[:, -1:])
        return InMemory(self.reduced(whole_image, round(step)), weights=weights)

    def kept(self, name: Hashable, tensors: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
        """The result of a function, of which nothing is kept."""
        return compute()

    @torch.no_grad()
    def parts(self, function: Callable[[Tensor, Inner, int], Kept], margin: int) -> list[Kept]:
        """The results for tiles."""
        rows = self.picture.statistics_rows
        return list(self._map_tiles(partial(_of_tile, function), rows, "Looking closely", margin))

    @torch.no_grad()
    def measured(self, function: Callable[[Source[RowSource]], Tensor]) -> Tensor:
        """Apply a measurement to the picture."""
        return function(self)

    def pixels_of(self, tile: Tile) -> TilePixels:
        """All pixels of a tile of the picture."""
        width = self.size[1]
        return TilePixels(tile.inner, partial(_features, tile), tile.start * width, width)

    def parts_of(self, tile: Tile) -> Iterator[TilePixels]:
        """Split a tile into groups of a few rows, which are the same for tiles of any height.

        The height of tiles therefore does not affect results, although the rounding of a matrix product depends on its
        shape.
        """
        width, step = self.size[1], self.passes.chunk_rows(self.size[1], self.num_landmarks)
        features = TileFeatures(tile, step * width)
        for part, image in enumerate(tile.inner.split(step, dim=2)):
            first = (tile.start + part * step) * width
            yield TilePixels(image, partial(features.of_part, part), first, width)

    @full_precision
    def edited(self, fitted: Fitted, tile: Tile) -> Tensor:
        """The planes (1, C, h, W) that an edit computes from a tile, before ``finish``."""
        return torch.cat([fitted.pixels(part) for part in self.parts_of(tile)], dim=2)

    @property
    def num_landmarks(self) -> int:
        """Largest number of landmarks of the filters fitted to the picture; 0 without a filter."""
        return max((operator.kernel.landmarks.shape[2] for operator in self.operators), default=0)

    @property
    def margin(self) -> int:
        """Number of rows around a tile that its columns depend on."""
        return max((operator.picture_margin for operator in self.operators), default=0)

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
        landmarks = self.num_landmarks
        rows = self.passes.tile_rows or (self.fitting_rows(0, landmarks) if landmarks else TILE_PIXELS // self.size[1])
        together, workers = self.passes.chunk_rows(self.size[1], landmarks), self.passes.workers(landmarks)
        rows = max(1, rows // together) * together
        with single_threaded(workers):
            for operator in self.operators:
                operator.prepare()  # before several workers need it
        tiling = Tiling(
            passes,
            self.picture,
            partial(self.edited, fitted),
            self.margin,
            rows,
            together,
            workers,
            transparent=not plain,
        )
        if fitted.finish is None:
            yield tiling
            return
        before = replace(tiling, passes=replace(passes, kind=self.plain.kind), transparent=False, stage="Comparing")
        with passes.stored(before) as planes:
            finish = Finish(fitted.finish, Picture(planes, self.picture.name, channels=planes.shape[2]), fitted.margin)
            rows, workers = self._rows_to_finish(fitted, rows, workers)
            yield replace(tiling, edit=finish, margin=fitted.margin, rows=rows, together=fitted.step, workers=workers)

    def _rows_to_finish(self, fitted: Fitted, rows: int, workers: int) -> tuple[int, int]:
        """Rows per tile and number of workers for ``finish``.

        A tile has at least as many rows as the margin, or several times as many if ``tile_rows`` is None, as far as
        memory allows. Several workers are used only if memory allows such a tile for each.

        Raises:
            MemoryError: if no tile fits.
        """
        row = self.size[1] * FINISH_FLOATS * self.dtype.itemsize
        most = self.passes.memory // row - 2 * fitted.margin
        if self.size[0] > most and most < fitted.step:
            raise MemoryError(
                f"{self.picture.name} needs at least {row * (2 * fitted.margin + fitted.step) / 1e6:.0f} MB of memory, "
                f"but only {self.passes.memory / 1e6:.0f} MB may be used; allow more, or use a smaller picture"
            )
        rows = max(rows, (1 if self.passes.tile_rows else 4) * fitted.margin)
        if (1 + workers) * row * (rows + 2 * fitted.margin) > self.passes.memory:
            workers = 1
        rows = rows if self.size[0] <= most else min(rows, most)
        return max(1, rows // fitted.step) * fitted.step, workers
