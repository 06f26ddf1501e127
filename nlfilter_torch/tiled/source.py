"""A picture that is read a few rows at a time, as the source of an edit: sums in passes, and tiles of edited rows."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.components import Scribbles
from nlfilter_torch.edits.source import Blocks, Fitted, Guide, Planes
from nlfilter_torch.filtering.fitted import layers_of_columns
from nlfilter_torch.filtering.masks import check_negative, mask_of_exponents, squared_distances
from nlfilter_torch.operator.eigenvalue_bound import is_bounded
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.operator import Columns
from nlfilter_torch.operator.scaling import PixelScaling
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.tiled import sampling
from nlfilter_torch.tiled.intermediate import intermediate
from nlfilter_torch.tiled.sampling import (
    Sample,
    all_blocks,
    patches_at,
    sample_by_influence,
    scaled_patches,
    take_pilot,
    visit,
)
from nlfilter_torch.tiled.scribbles import FLOATS_OF_SCRIBBLED, read_scribbles
from nlfilter_torch.tiled.sources import GuidePicture, Picture, Rows, RowSource, Tile
from nlfilter_torch.tiled.statistics import CONVERGED, Block, Sums, balance_by_passes, limiter_by_passes, sum_up
from nlfilter_torch.tiled.tiles import TILE_PIXELS, Passes, rows_that_fit

LARGE_PATCHES = 50  # numbers in a patch above which the sample has half as many of them


@dataclass(eq=False)
class TilePixels:
    """Pixels of a tile.

    Attributes:
        image: their colours, (1, C, h, W).
        features: the same for each operator that asks for them, (1, D, h W).
        first: number of the first pixel, along the rows of the picture.
    """

    image: Tensor
    features: "Callable[[TiledOperator], Tensor]"
    first: int = 0
    _columns: dict[int, Columns] = field(default_factory=dict)

    def columns(self, operator: "TiledOperator") -> Columns:
        """Their columns, worked out once for each operator."""
        if id(operator) not in self._columns:
            self._columns[id(operator)] = operator.columns(self.features(operator))
        return self._columns[id(operator)]


@dataclass(frozen=True, eq=False)
class BlockPixels:
    """Pixels that an operator sums up over: their colours (1, C, 1, n), and their columns."""

    image: Tensor
    found: Columns

    def columns(self, operator: "TiledOperator") -> Columns:
        """Their columns."""
        return self.found


class Tiled:
    """A picture, and how it is read.

    Args:
        picture: rows.
        passes: options of the tiling.
        strokes: what errors call scribbles.
    """

    batch = 1
    whole = False

    def __init__(self, picture: Picture, passes: Passes, strokes: str = "strokes") -> None:
        self.picture, self.passes, self.strokes = picture, passes, strokes
        self.size, self.channels, self.dtype = picture.size, picture.colours, picture.dtype
        self.operators: list[TiledOperator] = []
        self.planes = 8 * picture.colours + 40  # floats for each pixel of a tile, without features
        self.cached = 0  # floats that are there all the time

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
        numbers = patch_size**2 * (self.channels if options.get("guide_channels") == "all" else 1) + 2
        self.room(numbers, count)
        passes = self.passes if numbers < LARGE_PATCHES else replace(self.passes, sample=-(-self.passes.sample // 2))
        picture = GuidePicture(self.picture, guide)
        pilot = take_pilot(picture, passes.report, **options)
        found = TiledOperator(picture, pilot.kernel, PixelScaling(pilot.balancing, pilot.completed), passes)
        total, chosen = pilot.balancing, None
        if passes.sample < picture.pixels:
            chosen = sample_by_influence(picture, pilot, passes.sample, passes.report, spectral=guide.spectral)
            found.sample = chosen
            total = balance_by_passes(lambda: found.blocks("Balancing"), total, completed=pilot.completed)
        if chosen is None or passes.statistics == "full" or guide.exact:
            found.sample = None
            total = balance_by_passes(lambda: found.blocks("Balancing"), total, completed=pilot.completed)
        found.balancing = PixelScaling(total, pilot.completed, CONVERGED[self.dtype])
        if is_bounded(options.get("landmarks", "kmeans"), picture.pixels, total.shape[1]):
            limiter = limiter_by_passes(lambda: found.blocks("Bounding"), found.balancing)
            found.kernel = replace(found.kernel, limiter=limiter)
        self.operators.append(found)
        self.planes += numbers
        return found

    def room(self, numbers: int, num_landmarks: int) -> int:
        """Rows of a tile that fit in memory, with so many features of each pixel more.

        Raises:
            MemoryError: if there is not one, or no room for the samples.
        """
        return rows_that_fit(
            self.picture,
            self.passes,
            floats=self.planes + numbers,
            planes=numbers,
            num_landmarks=num_landmarks,
            held=self.cached,
        )

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
        self.cached += len(found.places) * FLOATS_OF_SCRIBBLED
        return found

    @torch.no_grad()
    def mean(self, planes: Planes) -> Tensor:
        """Means (1, C, 1, 1) over all pixels."""
        total: Tensor | float = 0.0
        for tile in self.picture.tiles(0, self.picture.statistics_rows):
            self.passes.report("Averaging", tile.start, self.size[0])
            total = total + planes(self.pixels_of(tile)).double().sum((2, 3), keepdim=True)
        return torch.as_tensor(total / self.picture.pixels).to(self.dtype)

    @torch.no_grad()
    def medians(self, response: Callable[[Tensor], Tensor], margin: int) -> Tensor:
        """Medians (1, C) over all pixels but ``margin`` at the borders, in float32.

        Numbers above 0 are in the order of their bits: the upper half of these is counted first, then, for those with
        the median's upper half, the lower one.
        """
        rank = ((self.size[0] - 2 * margin) * (self.size[1] - 2 * margin) - 1) // 2
        ranks, upper = torch.full((self.channels, 1), rank), torch.zeros(self.channels, dtype=torch.long)
        for half in (16, 0):
            counts = torch.zeros(self.channels, 1 << 16, dtype=torch.long)
            for tile in self.picture.tiles(margin, self.picture.statistics_rows):
                self.passes.report("Estimating noise", tile.start, self.size[0])
                if tile.pixels.shape[2] <= 2 * margin:
                    continue
                bits = response(tile.pixels).float().flatten(2)[0].contiguous().view(torch.int32)
                for channel, row in enumerate(bits):
                    part = row if half else row[row >> 16 == upper[channel]]
                    counts[channel] += torch.bincount(part >> half & 0xFFFF, minlength=1 << 16)
            summed = counts.cumsum(1)
            found = torch.searchsorted(summed, ranks, right=True)
            ranks = ranks - torch.where(found > 0, summed.gather(1, (found - 1).clamp(min=0)), 0)
            upper = upper << 16 | found[:, 0]
        return upper.int().view(torch.float32)[None].to(self.dtype)

    @torch.no_grad()
    @full_precision
    def masks(
        self, guide: Guide, regions: RowSource, negative: RowSource | None, *, time: float, width: float
    ) -> Planes:
        """Diffusion masks (1, K, h, W) of regions, rows (H, W, K) of weights. Paper: eq. (15) to (17).

        Raises:
            ValueError: if a region does not fit, is negative or empty.
        """
        for rows, name in ((regions, "regions"), (negative, "negative")):
            if rows is not None and (tuple(rows.shape[:2]) != self.size or len(rows.shape) != 3):
                raise ValueError(
                    f"{name} must have the shape {(*self.size, 'K')}, the picture's and the number of regions, got "
                    f"{tuple(rows.shape)}; resize them"
                )
        check_negative(1 if negative is None else negative.shape[2], regions.shape[2])
        operator = self.operator(guide)
        core = operator.pairs.basis(lambda eigenvalues: eigenvalues.pow(time))
        centres = [(core @ operator.region_means(rows, name)).mT if rows is not None else None
                   for rows, name in ((regions, "regions"), (negative, "negative"))]  # fmt: skip
        scale = self.picture.pixels / width

        def masks(pixels: Any) -> Tensor:
            columns = pixels.columns(operator)
            coordinates = core.to(columns.factor) @ (columns.factor * columns.scaling.unsqueeze(1))
            exponents = [
                None if c is None else scale * squared_distances(coordinates, c.to(coordinates)) for c in centres
            ]
            assert exponents[0] is not None  # regions are given
            return mask_of_exponents(exponents[0], exponents[1]).unflatten(2, pixels.image.shape[-2:])

        return masks

    def pixels_of(self, tile: Tile) -> TilePixels:
        """All pixels of a tile of the picture."""
        return TilePixels(tile.inner, lambda operator: operator.features(tile), tile.start * self.size[1])

    def rows_of(self, tile: Tile) -> Iterator[TilePixels]:
        """The pixels of a tile row by row.

        The rounding of a product depends on its shape. Row by row it is the same in tiles of any height.
        """
        features: dict[int, list[Tensor]] = {}
        width = self.size[1]

        def row_of(operator: TiledOperator, row: int) -> Tensor:
            if id(operator) not in features:
                features[id(operator)] = list(operator.features(tile).split(width, dim=2))
            return features[id(operator)][row]

        for row, image in enumerate(tile.inner.split(1, dim=2)):
            yield TilePixels(image, lambda operator, row=row: row_of(operator, row), (tile.start + row) * width)  # type: ignore[misc]

    @full_precision
    def edited(self, fitted: Fitted, tile: Tile) -> Tensor:
        """The planes (1, C, h, W) that an edit makes of a tile, before it finishes them."""
        return torch.cat([fitted.pixels(row) for row in self.rows_of(tile)], dim=2)

    @property
    def margin(self) -> int:
        """How many rows around a tile its columns depend on."""
        return max((operator.margin for operator in self.operators), default=0)

    def rows(self, fitted: Fitted, folder: Path | None = None) -> Rows:
        """The rows (h, W, S) of the picture under an edit, in order.

        Args:
            fitted: to this source.
            folder: with room for planes that an edit makes before it finishes them; None is the system's.
        """
        landmarks = max((operator.kernel.landmarks.shape[2] for operator in self.operators), default=1)
        rows = self.room(0, landmarks) if self.operators else max(1, TILE_PIXELS // self.size[1])
        if fitted.finish is None:
            yield from self.passes.work_out(self.picture, lambda tile: self.edited(fitted, tile), self.margin, rows)
            return
        finish, margin = fitted.finish, fitted.margin
        plain = replace(self.passes, kind="float32" if self.dtype == torch.float32 else "float64")
        before = plain.work_out(
            self.picture,
            lambda tile: self.edited(fitted, tile),
            self.margin,
            rows,
            transparent=False,
            stage="Comparing",
        )
        with intermediate(before, self.size, folder) as planes:
            stored = Picture(planes, self.picture.name, planes=planes.shape[2])

            def finished(tile: Tile) -> Tensor:
                stop = tile.start + tile.inner.shape[2]
                found = finish(tile.pixels, stored.tile(tile.start, stop, margin).pixels)
                return found[..., tile.halo[0] : found.shape[2] - tile.halo[1], :]

            yield from self.passes.work_out(self.picture, finished, margin, max(rows, margin))


@dataclass(eq=False)
class TiledOperator:
    """The filter of a picture, by the few sums that it consists of.

    Attributes:
        guide: what it compares.
        kernel: landmarks, bandwidths and window.
        balancing: what the scaling of a pixel is a function of.
        passes: options of the tiling.
        sample: pixels that stand for all, or None.
    """

    guide: GuidePicture
    kernel: Kernel
    balancing: PixelScaling
    passes: Passes
    sample: list[Sample] | None = None
    _sums: dict[int, tuple[Planes, Sums]] = field(default_factory=dict)

    @property
    def margin(self) -> int:
        """How many pixels around a pixel its column depends on."""
        return self.kernel.recipe.patch_weights.shape[0] // 2 + self.guide.guide.margin

    def features(self, tile: Tile) -> Tensor:
        """Features (1, D, h W) of a tile of the picture."""
        seen = self.guide.seen(tile, self.kernel.recipe.patch_weights.shape[0] // 2)
        return self.kernel.recipe(seen.pixels, origin=seen.origin, halo=seen.halo)

    def columns(self, features: Tensor) -> Columns:
        """Columns of pixels with features (1, D, n)."""
        factor, diagonal = self.kernel.factor(features)
        return Columns(factor, *self.balancing(factor, diagonal))

    def blocks(self, stage: str) -> Iterator[Block]:
        """The sample, or all pixels."""
        if self.sample is None:
            yield from all_blocks(self.guide, self.kernel, self.passes.report, stage)
            return
        self.passes.report(stage, 0, 1)
        for part in self.sample:
            yield from part.blocks(self.kernel)

    def pixels(self, stage: str) -> Iterator[tuple[BlockPixels, Tensor]]:
        """The same with columns, and how many pixels each stands for, (1, n)."""
        for block in self.blocks(stage):
            columns = Columns(block.factor, *self.balancing(block.factor, block.diagonal))
            yield BlockPixels(block.image.unsqueeze(2), columns), block.weights

    @torch.no_grad()
    @full_precision
    def sums(self, planes: Planes, order: int) -> Sums:
        """The sums for the first ``order`` powers of W, and some planes."""
        known = self._sums.get(id(planes))
        if known is not None and known[1].moments.shape[1] >= order:
            return known[1]
        found = sum_up(((planes(pixels).flatten(2), pixels.found, weights)
                        for pixels, weights in self.pixels("Summing up")), order)  # fmt: skip
        self._sums[id(planes)] = (planes, found)  # the planes are kept, so that no other ones get their number
        return found

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum."""
        known = next((sums for _, sums in self._sums.values()), None)
        sums = known or self.sums(lambda pixels: pixels.image[:, :1], 1)
        return RitzPairs.of_sums(sums.grams[:, :2], sums.dtype)

    def each(self, function: Callable[[Columns], Tensor]) -> Planes:
        """The planes that a function of columns gives."""

        def planes(pixels: Any) -> Tensor:
            shape: tuple[int, int] = pixels.image.shape[-2:]
            return function(pixels.columns(self)).unflatten(2, shape)

        return planes

    def at(self, places: Tensor) -> Blocks:
        """The columns of single pixels, whose features are read at once and kept."""
        features = self.features_at(places)
        return lambda: (self.kernel.factor(part)[0] for part in features.split(sampling.CHUNK, dim=2))

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers, by the sums for powers of W."""
        coefficients = self.sums(planes, order).coefficients()

        def layers(pixels: Any) -> Tensor:
            image = planes(pixels)
            found = layers_of_columns(pixels.columns(self), coefficients, image.flatten(2))
            return found.unflatten(-1, image.shape[-2:])

        return layers

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y``."""
        return self.sums(planes, 1).moments[:, 0].mT

    @torch.no_grad()
    @full_precision
    def mean(self, planes: Planes) -> Tensor:
        """Means over the pixels, or over the sample."""
        total, weight = torch.zeros(()), torch.zeros((), dtype=torch.float64)
        for pixels, weights in self.pixels("Averaging"):
            total = total + (planes(pixels).flatten(2) * weights.unsqueeze(1)).double().sum(2)
            weight = weight + weights.double().sum()
        return (total / weight).to(self.guide.dtype)

    def features_at(self, places: Tensor) -> Tensor:
        """Features (1, D, n) of single pixels, read from their rows."""
        recipe, report = self.kernel.recipe, self.passes.report
        size, patches = recipe.patch_weights.shape[0], []
        for tile, chosen in visit(self.guide.picture, self.margin, places, report, "Comparing strokes"):
            if len(chosen):
                seen = self.guide.seen(tile, size // 2)
                guide = reduce_channels(seen.pixels, recipe.guide_channels)
                patches.append(patches_at(guide, seen, chosen, size))
        scales = (recipe.patch_weights, recipe.photometric_bandwidth, recipe.spatial_bandwidth)
        return scaled_patches(torch.cat(patches, dim=2), places, self.guide, *scales)

    def region_means(self, regions: RowSource, name: str) -> Tensor:
        """The mean column of F over each region, (1, M, K) in float64."""
        rows, size = self.guide.statistics_rows, self.guide.size
        total = torch.zeros(1, self.balancing.moment.shape[1], regions.shape[2], dtype=torch.float64)
        weight = torch.zeros(regions.shape[2], dtype=torch.float64)
        for start in range(0, size[0], rows):
            self.passes.report("Finding regions", start, size[0])
            stop = min(start + rows, size[0])
            weights = torch.from_numpy(np.array(regions[start:stop], np.float32)).flatten(0, 1)  # (n, K)
            if bool((weights < 0).any()) or not bool(torch.isfinite(weights).all()):
                raise ValueError(f"{name} must be non-negative and finite, got others; clamp them at 0")
            if not bool((weights > 0).any()):
                continue
            columns = self.columns(self.features(self.guide.picture.tile(start, stop, self.margin)))
            total += ((columns.factor * columns.scaling.unsqueeze(1)) @ weights.to(columns.factor)).double()
            weight += weights.double().sum(0)
        if not bool((weight > 0).all()):
            raise ValueError(f"{name} must each hold a pixel of positive weight, got an empty one; select some pixels")
        return total / weight
