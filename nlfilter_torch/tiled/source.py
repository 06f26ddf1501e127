"""A picture that is read a few rows at a time, as the source of an edit: sums in passes, and tiles of edited rows."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.components import Scribbles
from nlfilter_torch.edits.pixels import corner
from nlfilter_torch.edits.resizing import Read, resized_parts
from nlfilter_torch.edits.source import Fitted, Guide, InMemory, Pixels, Planes, Source, block_means
from nlfilter_torch.operator.eigenvalue_bound import is_bounded
from nlfilter_torch.tiled.intermediate import intermediate
from nlfilter_torch.tiled.operator import TiledOperator, TilePixels
from nlfilter_torch.tiled.sampling import KeptColumns, take_pilot, visit
from nlfilter_torch.tiled.scribbles import RegionRows, check_room, floats_of_scribbled, read_scribbles
from nlfilter_torch.tiled.sources import GuidePicture, Picture, Rows, RowSource, Tile
from nlfilter_torch.tiled.tiles import TILE_PIXELS, Passes, pixels_kept, rows_that_fit
from nlfilter_torch.tiled.workers import Result, in_order, undivided

HELD = 1 / 16  # of the memory that planes may take which an edit needs again
FINISHED = 64  # floats for each pixel of a tile while an edit finishes it: images, their transforms and products


class Tiled:
    """A picture, and how it is read.

    Args:
        picture: rows.
        passes: options of the tiling.
        strokes: what errors call scribbles.
    """

    batch = 1
    whole = False
    stride = 1

    def __init__(self, picture: Picture, passes: Passes, strokes: str = "strokes") -> None:
        self.picture, self.passes, self.strokes = picture, passes, strokes
        self.size, self.channels, self.dtype = picture.size, picture.colours, picture.dtype
        self.operators: list[TiledOperator] = []
        self.floats = 8 * picture.colours + 40  # floats for each pixel of a tile, without features
        self.scribbled = 0  # pixels
        self.kept = 0  # floats of columns
        self.stored = 0  # floats of guides

    @torch.no_grad()
    @full_precision
    def operator(self, guide: Guide) -> "TiledOperator":
        """The filter of the whole picture, its balancing from a sample of the pixels or from all of them.

        Raises:
            MemoryError: if there is no room for the samples or for a row.
        """
        options = dict(guide.options)
        patch_size, count = options.get("patch_size", 5), options.get("num_landmarks", 100)
        check_count(patch_size, "patch_size")
        check_count(count, "num_landmarks")
        compared = guide.planes or (self.channels if options.get("guide_channels") == "all" else 1)
        numbers = patch_size**2 * compared + 2
        for other in self.operators:
            other.kept = KeptColumns(1, 0)  # makes room
        self.kept = 0
        self.room(numbers, count)
        passes, picture = self.passes, GuidePicture(self.picture, guide)
        workers = passes.workers(count)
        if guide.margin and passes.stores(picture.pixels * compared * self.dtype.itemsize):
            self.stored += picture.pixels * compared
            self.room(numbers, count)
            picture.store(max(1, TILE_PIXELS // self.size[1]), workers)
        pilot = take_pilot(picture, passes.report, workers, **options)
        sampled, count = passes.sample < picture.pixels, pilot.balancing.shape[1]
        kept = pixels_kept(picture, passes, numbers, count, self.floats_stored(numbers))
        self.kept = kept * (count + 2)
        found = TiledOperator(
            picture,
            pilot,
            passes.report,
            passes.sample if sampled else None,
            full=not sampled or passes.statistics == "full" or guide.exact,
            kernel=pilot.kernel,
            bounded=is_bounded(options.get("landmarks", "kmeans"), picture.pixels, count),
            workers=workers,
            kept=KeptColumns(picture.statistics_rows * self.size[1], kept),
        )
        self.operators.append(found)
        self.floats += numbers
        return found

    def room(self, numbers: int, num_landmarks: int) -> int:
        """Rows of a tile that fit in memory, with so many features of each pixel more.

        Raises:
            MemoryError: if there is not one, or no room for the samples.
        """
        check_room(self.picture, self.scribbled, numbers, self.passes.memory)
        return rows_that_fit(
            self.picture,
            self.passes,
            floats=self.floats + numbers,
            planes=numbers,
            num_landmarks=num_landmarks,
            held=self.kept + self.floats_stored(numbers),
        )

    def floats_stored(self, numbers: int) -> int:
        """Floats of scribbles, with so many features of each pixel, and of guides."""
        return self.stored + self.scribbled * floats_of_scribbled(numbers)

    def scribbles(
        self, mask: RowSource | None, colours: RowSource | None, name: str, *, needed: bool = True
    ) -> Scribbles:
        """From rows (H, W) or (H, W, 1) and (H, W, 3); or from (H, W, 4) alone, whose last channel is the mask.

        Raises:
            ValueError: if one of them has another size or another number of channels, a weight exceeds [0, 1], or they
                are ``needed`` and cover no pixel.
            MemoryError: if there are too many scribbled pixels.
        """
        found = read_scribbles(
            self.picture,
            mask,
            colours,
            name=name,
            strokes=self.strokes,
            memory=self.passes.memory,
            report=self.passes.report,
        )
        if needed and len(found.places) == 0:
            called = self.strokes if mask is None else name
            raise ValueError(f"{called} must hold a painted pixel, got none; paint at least one")
        self.scribbled += len(found.places)
        return found

    def regions(self, masks: RowSource, name: str) -> list[Scribbles]:
        """From rows (H, W, K) in [0, 1].

        Raises:
            ValueError, MemoryError: as of :meth:`scribbles`.
        """
        if len(masks.shape) == 2:
            return [self.scribbles(masks, None, name)]
        return [self.scribbles(RegionRows(masks, k), None, name) for k in range(masks.shape[2])]

    def colours(self, places: Tensor) -> Tensor:
        """The colours (1, C, n) of single pixels, read from their rows."""
        seen = visit(self.picture, 0, places, self.passes.report, "Looking", every=False)
        return torch.cat([tile.inner.flatten(2)[:, :, chosen] for tile, chosen in seen], dim=2)

    @torch.no_grad()
    def resized(self, size: tuple[int, int]) -> "Tiled":
        """The picture in a smaller size, in memory: a source of its own, which is read as this one is."""

        def read(start: int, stop: int) -> Tensor:
            self.passes.report("Reducing", start, self.size[0])
            return self.picture.tile(start, stop, 0).pixels

        planes = self._resized(read, size)[0].permute(1, 2, 0).numpy()
        passes = replace(self.plain, tile_rows=None)
        return Tiled(Picture(np.ascontiguousarray(planes), self.picture.name), passes, self.strokes)

    @torch.no_grad()
    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes (1, C, h, w) of all pixels in a smaller size."""

        def read(start: int, stop: int) -> Tensor:
            self.passes.report("Reducing", start, self.size[0])
            return planes(self.pixels_of(self.picture.tile(start, stop, 0)))

        return self._resized(read, size)

    @torch.no_grad()
    def resized_weights(self, weights: RowSource, size: tuple[int, int], name: str) -> RowSource:
        """Weights, rows (H, W, K) or (H, W), in a smaller size."""
        if tuple(weights.shape[:2]) != self.size:
            raise ValueError(
                f"{name} must have the height and width of the picture, {self.size}, got {tuple(weights.shape[:2])}; "
                "resize them"
            )
        ends: list[float] = []  # interpolation may go beyond them, but hides no weight that is invalid

        def read(start: int, stop: int) -> Tensor:
            rows = torch.from_numpy(np.atleast_3d(np.array(weights[start:stop], np.float32)))
            rows = rows.permute(2, 0, 1)[None]
            ends.extend((float(rows.min()), float(rows.max())))
            return rows

        found = self._resized(read, size)  # fills the list
        return found.clamp(min(ends), max(ends))[0].permute(1, 2, 0).contiguous().numpy()

    def _resized(self, read: Read, size: tuple[int, int]) -> Tensor:
        """Rows of this size in a smaller one."""
        parts = resized_parts(read, self.size, size)
        return torch.cat(list(in_order(lambda part: part(), parts, self.passes.workers(1))), dim=2)

    def all(self, fitted: Fitted) -> Tensor:
        """The planes (1, C, H, W) that an edit makes of all pixels."""
        rows = np.concatenate([values for _, values in self.rows(fitted, plain=True)])
        return torch.from_numpy(rows).permute(2, 0, 1)[None]

    def held(self, fitted: Fitted) -> Fitted:
        """With its planes in memory, if they take a small part of it; else they are worked out as often as needed."""
        if self.picture.pixels * self.channels * self.dtype.itemsize > HELD * self.passes.memory:
            return fitted
        planes = self.all(fitted)

        def part(pixels: Pixels) -> Tensor:
            (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
            return planes[:, :, top : top + height, left : left + width]

        return Fitted(part)

    @torch.no_grad()
    def mean_of(self, fitted: Fitted, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means over all pixels, with a pass over the picture."""

        def parts() -> Iterator[tuple[Tensor, Tensor]]:
            for part, values in self.rows(fitted, plain=True):
                image = self.picture.tile(part.start, part.stop, 0).pixels
                yield image, torch.from_numpy(values).permute(2, 0, 1)[None].to(image)

        def summed(part: tuple[Tensor, Tensor]) -> Tensor:
            return function(*part).double().sum((2, 3), keepdim=True)

        total = sum(in_order(summed, parts(), self.passes.workers(1)))
        return torch.as_tensor(total / self.picture.pixels).to(self.dtype)

    @torch.no_grad()
    def mean(self, planes: Planes) -> Tensor:
        """Means (1, C, 1, 1) over all pixels."""

        def summed(tile: Tile) -> Tensor:
            return planes(self.pixels_of(tile)).double().sum((2, 3), keepdim=True)

        total = sum(self._of_tiles(summed, 0, self.picture.statistics_rows, "Averaging"))
        return torch.as_tensor(total / self.picture.pixels).to(self.dtype)

    @torch.no_grad()
    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means over blocks of ``step`` pixels in both directions."""
        rows = max(1, self.picture.statistics_rows // step) * step

        def part(tile: Tile) -> Tensor:
            return block_means(planes(self.pixels_of(tile)), step)

        return torch.cat(list(self._of_tiles(part, 0, rows, "Reducing")), dim=2)

    def _of_tiles(self, function: Callable[[Tile], Result], margin: int, rows: int, stage: str) -> Iterator[Result]:
        """What a function gives of each tile, in order.

        That of the first tile is worked out before the others, since it may take sums of an operator.
        """

        def tiles() -> Iterator[Tile]:
            for tile in self.picture.tiles(margin, rows):
                self.passes.report(stage, tile.start, self.size[0])
                yield tile

        each = tiles()
        yield function(next(each))
        yield from in_order(function, each, self.passes.workers(1))

    def blocks(self, step: float, floats: int) -> InMemory:
        """The picture reduced by means over blocks of an integer number of pixels each way, in memory.

        Raises:
            MemoryError: if there is no room for so many floats for each of its pixels.
        """
        needed = math.prod(math.ceil(side / step) for side in self.size) * floats * self.dtype.itemsize
        if needed > self.passes.memory:
            raise MemoryError(
                f"{self.picture.name} needs {needed / 1e6:.0f} MB of memory at least, but "
                f"{self.passes.memory / 1e6:.0f} MB may be used; allow more, or use a smaller picture"
            )
        return InMemory(self.reduced(lambda pixels: pixels.image, round(step)))

    @torch.no_grad()
    def measured(self, function: Callable[[Source], Tensor]) -> Tensor:
        """What a function finds."""
        return function(self)

    def pixels_of(self, tile: Tile) -> TilePixels:
        """All pixels of a tile of the picture."""
        width = self.size[1]
        return TilePixels(tile.inner, lambda operator: operator.features(tile), tile.start * width, width)

    def parts_of(self, tile: Tile) -> Iterator[TilePixels]:
        """The pixels of a tile, a few rows at a time, and the same rows together in tiles of any height.

        The rounding of a product depends on its shape.
        """
        width, step = self.size[1], self.passes.rows_together(self.size[1])
        features: dict[int, tuple[Tensor, ...]] = {}

        def part_of(operator: TiledOperator, part: int) -> Tensor:
            if id(operator) not in features:
                features[id(operator)] = operator.features(tile).split(step * width, dim=2)
            return features[id(operator)][part]

        for part, image in enumerate(tile.inner.split(step, dim=2)):
            first = (tile.start + part * step) * width
            yield TilePixels(image, lambda operator, part=part: part_of(operator, part), first, width)  # type: ignore[misc]

    @full_precision
    def edited(self, fitted: Fitted, tile: Tile) -> Tensor:
        """The planes (1, C, h, W) that an edit makes of a tile, before it finishes them."""
        return torch.cat([fitted.pixels(part) for part in self.parts_of(tile)], dim=2)

    @property
    def margin(self) -> int:
        """How many rows around a tile its columns depend on."""
        return max((operator.margin for operator in self.operators), default=0)

    @property
    def plain(self) -> Passes:
        """How it is read where the output is numbers as they are computed."""
        return replace(self.passes, kind="float32" if self.dtype == torch.float32 else "float64")

    def rows(self, fitted: Fitted, *, plain: bool = False) -> Rows:
        """The rows (h, W, S) of the picture under an edit, in order.

        Args:
            fitted: to this source.
            plain: whether they are numbers as they are computed, without transparency.
        """
        passes = self.plain if plain else self.passes
        landmarks = max((operator.kernel.landmarks.shape[2] for operator in self.operators), default=1)
        rows = self.passes.tile_rows or (self.room(0, landmarks) if self.operators else TILE_PIXELS // self.size[1])
        together, workers = self.passes.rows_together(self.size[1]), self.passes.workers(landmarks)
        rows = max(1, rows // together) * together
        with undivided(workers):
            for operator in self.operators:
                operator.settle()  # before several tiles at once need it
        if fitted.finish is None:
            yield from passes.work_out(
                self.picture,
                lambda tile: self.edited(fitted, tile),
                self.margin,
                rows,
                workers=workers,
                transparent=not plain,
            )
            return
        finish, margin = fitted.finish, fitted.margin
        before = self.plain.work_out(
            self.picture,
            lambda tile: self.edited(fitted, tile),
            self.margin,
            rows,
            workers=workers,
            transparent=False,
            stage="Comparing",
        )
        with intermediate(before, self.size, self.passes.folder) as planes:
            stored = Picture(planes, self.picture.name, planes=planes.shape[2])

            def finished(tile: Tile) -> Tensor:
                stop = tile.start + tile.inner.shape[2]
                found = finish(tile.pixels, stored.tile(tile.start, stop, margin).pixels)
                return found[..., tile.halo[0] : found.shape[2] - tile.halo[1], :]

            rows, workers = self._rows_to_finish(fitted, rows, workers)
            yield from passes.work_out(self.picture, finished, margin, rows, workers=workers, transparent=not plain)

    def _rows_to_finish(self, fitted: Fitted, rows: int, workers: int) -> tuple[int, int]:
        """Rows of a tile that is finished: its margins, several times if none were asked for, as far as memory allows.

        And the workers: all, if such tiles fit in memory for each of them, or one.

        Raises:
            MemoryError: if it allows none.
        """
        row = self.size[1] * FINISHED * self.dtype.itemsize
        most = self.passes.memory // row - 2 * fitted.margin
        if self.size[0] > most and most < fitted.step:
            raise MemoryError(
                f"{self.picture.name} needs {row * (2 * fitted.margin + fitted.step) / 1e6:.0f} MB of memory at least, "
                f"but {self.passes.memory / 1e6:.0f} MB may be used; allow more, or use a smaller picture"
            )
        rows = max(rows, (1 if self.passes.tile_rows else 4) * fitted.margin)
        if (1 + workers) * row * (rows + 2 * fitted.margin) > self.passes.memory:
            workers = 1
        rows = rows if self.size[0] <= most else min(rows, most)
        return max(1, rows // fitted.step) * fitted.step, workers
