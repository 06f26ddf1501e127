"""The filter of a picture that is read a few rows at a time: the sums that define it, and its columns."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.filtering.filters import layers_of_columns
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.operator import Kernel
from nlfilter_torch.operator.products import Columns
from nlfilter_torch.operator.scaling import PixelScaling
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.photo.picture.source import SAMPLE, Blocks, Planes, sampled_pairs, sampled_places
from nlfilter_torch.photo.tiled import sampling
from nlfilter_torch.photo.tiled.pictures import Tile
from nlfilter_torch.photo.tiled.sampling import (
    ColumnCache,
    Draws,
    GuidePicture,
    Pilot,
    Report,
    in_silence,
    over_all,
    patches_at,
    scaled_patches,
    visit,
)
from nlfilter_torch.photo.tiled.statistics import (
    CONVERGED,
    Block,
    Guess,
    Pass,
    Sums,
    Totals,
    balance_by_passes,
    limiter_by_passes,
    sum_up,
)
from nlfilter_torch.photo.tiled.workers import in_order

SAMPLE_BLOCKS = 8  # blocks that a sample is split into, to be shared among workers


@dataclass(eq=False)
class TilePixels:
    """Pixels of a tile.

    Attributes:
        image: their colours, (1, C, h, W).
        features: computes their features (1, D, h W) for the guide of an operator.
        first: row-major index of the first pixel in the picture.
        width: W of the picture.
    """

    image: Tensor
    features: "Callable[[TiledOperator], Tensor]"
    first: int
    width: int
    _columns: dict[int, Columns] = field(default_factory=dict)
    _layers: tuple[Planes, Tensor] | None = None

    def columns(self, operator: "TiledOperator") -> Columns:
        """Columns of the pixels, computed once per operator."""
        if id(operator) not in self._columns:
            known = None
            if self.image.shape[3] == self.width:
                known = operator.cache.find(slice(self.first, self.first + self.image[0, 0].numel()))
            self._columns[id(operator)] = (
                operator.columns(self.features(operator)) if known is None else operator.scaled(*known)
            )
        return self._columns[id(operator)]

    def cached(self, layers: Planes) -> Tensor:
        """Apply a function to the pixels, and cache its result until another function is given."""
        if self._layers is None or self._layers[0] is not layers:
            self._layers = layers, layers(self)
        return self._layers[1]


@dataclass(frozen=True, eq=False)
class BlockPixels:
    """Pixels in a sum of an operator: their colours (1, C, 1, n), and their columns."""

    image: Tensor
    found: Columns

    def columns(self, operator: "TiledOperator") -> Columns:
        """Columns of the pixels."""
        return self.found


def first_plane(pixels: Any) -> Tensor:
    """The first channel of a picture."""
    image: Tensor = pixels.image[:, :1]
    return image


@dataclass(eq=False)
class TiledOperator:
    """The filter of a picture, represented by the sums over pixels that define it.

    The sums are computed on first use, those for balancing together with those of the filtered planes.

    Attributes:
        guide: guide of the picture.
        pilot: kernel, even sample and initial balancing.
        report: called with the progress.
        sample_size: size of the sample that complements the first pass; None for no sample.
        full_passes: whether to make further passes over all pixels.
        kernel: landmarks, bandwidths and window.
        bounded: whether eigenvalues are to be kept from exceeding 1.
        workers: number of tiles computed at once.
        cache: columns cached from earlier passes.
    """

    guide: GuidePicture
    pilot: Pilot
    report: Report
    sample_size: int | None
    full_passes: bool
    kernel: Kernel
    bounded: bool
    workers: int
    cache: ColumnCache
    _pixel_scaling: PixelScaling | None = None
    _sample: list[Block] | None = None
    _sums: dict[int, tuple[Planes, Sums]] = field(default_factory=dict)
    _grams: Tensor | float = 0.0  # added to those of the sample

    def __getstate__(self) -> dict[str, Any]:
        """The operator in another process: without columns that can be computed again."""
        sums = list(self._sums.values())
        return self.__dict__ | {"report": in_silence, "cache": ColumnCache(1, 0), "_sums": sums}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the operator; planes have other ids in another process."""
        self.__dict__.update(state | {"_sums": {id(known[0]): known for known in state["_sums"]}})

    @torch.no_grad()
    @full_precision
    def prepare(self, planes: Planes = first_plane, order: int = 1) -> None:
        """Balance, and compute the sums for powers of W and planes that depend on colours alone.

        Further calls do nothing.
        """
        if self._pixel_scaling is not None:
            return
        total, completed, difference = self.pilot.moment, self.pilot.completed, None
        if self.sample_size is not None:
            self._sample, difference = self._draw_sample(self.sample_size, planes, order)
            total = balance_by_passes(self.over("Balancing"), total, completed=completed, correction=difference.moment)
        if self.full_passes:
            self._sample = difference = None
            total = balance_by_passes(self.over("Balancing"), total, completed=completed)
        self._pixel_scaling = PixelScaling(total, completed, CONVERGED[self.guide.dtype])
        limiter = (
            limiter_by_passes(self.over("Bounding"), self._pixel_scaling, self.guide.dtype) if self.bounded else None
        )
        if limiter is not None:
            self.kernel = replace(self.kernel, limiter=limiter.to(self.kernel.landmarks))
            self.cache.blocks.clear()
        if self._sample is None or difference is None:
            return
        if limiter is not None:
            self._sample = [replace(block, factor=limiter.to(block.factor) @ block.factor) for block in self._sample]
            difference = Totals(
                difference.moment, limiter @ difference.coefficients, limiter @ difference.grams.to(limiter) @ limiter
            )
        self._grams = difference.grams
        sample = self._summed_up(planes, order, self.over("Summing up"))
        self._sums[id(planes)] = (planes, replace(sample, correction=difference.coefficients))

    def _draw_sample(self, count: int, planes: Planes, order: int) -> tuple[list[Block], Totals]:
        """Draw about ``count`` pixels; also return the sums over all pixels minus theirs, both at the pilot's guess."""
        pilot = self.pilot

        def values(block: Block, columns: Columns) -> Tensor:
            return planes(BlockPixels(block.image.unsqueeze(2), columns)).flatten(2)

        guess = Guess(pilot.moment, torch.empty(1, 0, pilot.moment.shape[1], 1), values, self.guide.guide.spectral)
        columns = guess.columns(pilot.sample)
        known = sum_up(self._over_blocks([pilot.sample]), lambda block: (values(block, columns), columns), order)
        guess = replace(guess, coefficients=known.coefficients()[:, :-1])
        draw, drawn, total = Draws(pilot, columns, count, self.guide.pixels), [], None

        def look(block: Block) -> tuple[Block, Totals]:
            columns, totals = guess.totals(block)
            return draw(block, columns), totals

        for some, totals in self._over_all("Sampling")(look):
            drawn.append(some)
            total = totals if total is None else total.plus(totals)
        assert total is not None  # for mypy; a picture has a pixel
        each = -(-len(drawn) // SAMPLE_BLOCKS)
        sample = [Block.concatenate(drawn[first : first + each]) for first in range(0, len(drawn), each)]
        for totals in self._over_blocks(sample)(lambda block: guess.totals(block)[1]):
            total = total.plus(totals, sign=-1)
        return sample, total

    def _over_all(self, stage: str) -> Pass:
        """A pass over every pixel."""
        return lambda of: over_all(self.guide, self.kernel, self.report, stage, self.workers, self.cache)(of)

    def _over_blocks(self, blocks: list[Block]) -> Pass:
        """A pass over the given blocks."""
        return lambda function: in_order(function, blocks, self.workers)

    @property
    def pixel_scaling(self) -> PixelScaling:
        """Computes the scaling of any pixel from its column."""
        self.prepare()
        assert self._pixel_scaling is not None  # for mypy
        return self._pixel_scaling

    @property
    def margin(self) -> int:
        """Number of pixels around a pixel that its column depends on."""
        return self.kernel.recipe.patch_weights.shape[0] // 2 + self.guide.margin

    @property
    def picture_margin(self) -> int:
        """Number of pixels of the picture around a pixel that its column depends on if no guide is stored."""
        return self.kernel.recipe.patch_weights.shape[0] // 2 + self.guide.guide.margin

    def features(self, tile: Tile) -> Tensor:
        """Features (1, D, h W) of a tile of the picture."""
        seen = self.guide.seen(tile, self.kernel.recipe.patch_weights.shape[0] // 2)
        return self.kernel.recipe(seen.pixels, origin=seen.origin, halo=seen.halo)

    def columns(self, features: Tensor) -> Columns:
        """Columns of pixels with features (1, D, n)."""
        self.prepare()  # may change the kernel
        return self.scaled(*self.kernel.factor(features))

    def scaled(self, factor: Tensor, diagonal: Tensor) -> Columns:
        """Columns of pixels with a given factor and diagonal."""
        return Columns(factor, *self.pixel_scaling(factor, diagonal))

    def over(self, stage: str) -> Pass:
        """A pass over the sample, or over all pixels if there is none."""
        if self._sample is None:
            return self._over_all(stage)
        self.report(stage, 0, 1)
        return self._over_blocks(self._sample)

    def pixels(self, block: Block) -> BlockPixels:
        """The pixels of a block, with their columns."""
        return BlockPixels(block.image.unsqueeze(2), self.scaled(block.factor, block.diagonal))

    @torch.no_grad()
    @full_precision
    def sums(self, planes: Planes, order: int) -> Sums:
        """Sums for the first ``order`` powers of W and the given planes.

        Sums of planes other than those given to :meth:`prepare` are over all pixels: the sample is drawn for balancing,
        and is off by several grey levels for planes that are large at a few pixels.
        """
        self.prepare(planes, order)
        known = self._sums.get(id(planes))
        if known is None or known[1].moments.shape[1] < order:
            known = (planes, self._summed_up(planes, order, self._over_all("Summing up")))
            self._sums[id(planes)] = known  # holds the planes too, so that their id is not reused
        return known[1]

    def _summed_up(self, planes: Planes, order: int, blocks: Pass) -> Sums:
        def values(block: Block) -> tuple[Tensor, Columns]:
            pixels = self.pixels(block)
            return planes(pixels).flatten(2), pixels.found

        return sum_up(blocks, values, order)

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum."""
        count = self.guide.pixels
        if self.guide.guide.sampled and count > SAMPLE:
            features = self.features_at(sampled_places(count))
            return sampled_pairs(map(self.columns, features.split(sampling.CHUNK, dim=2)), count, self.guide.dtype)
        known = next((sums for _, sums in self._sums.values()), None)
        sums = known or self.sums(first_plane, 1)
        return RitzPairs.of_sums(sums.grams[:, :2] + self._grams, sums.dtype)

    def each(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Planes computed by a function of columns."""

        def planes(pixels: Any) -> Tensor:
            shape: tuple[int, int] = pixels.image.shape[-2:]
            return function(pixels.columns(self)).unflatten(2, shape)

        return planes

    def at(self, places: Tensor) -> Blocks:
        """Columns of single pixels, whose features are read now and kept in memory."""
        features = self.features_at(places)
        return lambda: (self.columns(part).factor for part in features.split(sampling.CHUNK, dim=2))

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers, from the sums for powers of W."""
        coefficients = self.sums(planes, order).coefficients()

        def layers(pixels: Any) -> Tensor:
            image = planes(pixels)
            found = layers_of_columns(pixels.columns(self), coefficients, image.flatten(2))
            return found.unflatten(-1, image.shape[-2:])

        return lambda pixels: pixels.cached(layers) if isinstance(pixels, TilePixels) else layers(pixels)

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y``."""
        return self.sums(planes, 1).coefficients()[:, 0].mT

    @torch.no_grad()
    @full_precision
    def mean(self, planes: Planes) -> Tensor:
        """Means over the sample, or over all pixels if there is none."""
        total, weight = torch.zeros(()), torch.zeros((), dtype=torch.float64)
        self.prepare()

        def part(block: Block) -> tuple[Tensor, Tensor]:
            values = planes(self.pixels(block)).flatten(2) * block.weights.unsqueeze(1)
            return values.double().sum(2), block.weights.double().sum()

        for values, weights in self.over("Averaging")(part):
            total, weight = total + values, weight + weights
        return (total / weight).to(self.guide.dtype)

    def features_at(self, places: Tensor) -> Tensor:
        """Features (1, D, n) of single pixels, read from their rows."""
        recipe, report = self.kernel.recipe, self.report
        size, patches = recipe.patch_weights.shape[0], []
        for tile, chosen in visit(self.guide.picture, self.margin, places, report, "Comparing strokes", every=False):
            seen = self.guide.seen(tile, size // 2)
            guide = reduce_channels(seen.pixels, recipe.guide_channels)
            patches.append(patches_at(guide, seen, chosen, size))
        return scaled_patches(torch.cat(patches, dim=2), places, self.guide, recipe)
