"""The filter of a picture that is read a few rows at a time: the few sums that it consists of, and its columns."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.source import Blocks, Planes
from nlfilter_torch.filtering.fitted import layers_of_columns
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.operator import Columns
from nlfilter_torch.operator.scaling import PixelScaling
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.tiled import sampling
from nlfilter_torch.tiled.sampling import Report, Sample, all_blocks, patches_at, scaled_patches, visit
from nlfilter_torch.tiled.sources import GuidePicture, RowSource, Tile
from nlfilter_torch.tiled.statistics import Block, Sums, sum_up


@dataclass(eq=False)
class TilePixels:
    """Pixels of a tile.

    Attributes:
        image: their colours, (1, C, h, W).
        features: of these pixels, (1, D, h W), for the guide of an operator.
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


@dataclass(eq=False)
class TiledOperator:
    """The filter of a picture, by the few sums that it consists of.

    Attributes:
        guide: what it compares.
        kernel: landmarks, bandwidths and window.
        balancing: what the scaling of a pixel is a function of.
        report: told of the progress.
        sample: pixels that stand for all, or None.
    """

    guide: GuidePicture
    kernel: Kernel
    balancing: PixelScaling
    report: Report
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
            yield from all_blocks(self.guide, self.kernel, self.report, stage)
            return
        self.report(stage, 0, 1)
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
        recipe, report = self.kernel.recipe, self.report
        size, patches = recipe.patch_weights.shape[0], []
        for tile, chosen in visit(self.guide.picture, self.margin, places, report, "Comparing strokes", every=False):
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
            self.report("Finding regions", start, size[0])
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
