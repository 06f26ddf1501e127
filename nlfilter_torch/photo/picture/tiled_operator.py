"""The filter of a picture that is read a few rows at a time: the sums that define it, and its columns."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.core.workers import in_order
from nlfilter_torch.filtering.filters import layers_of_columns
from nlfilter_torch.filtering.rational_product import weigh_poles
from nlfilter_torch.operator.columns import Columns
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.operator import Kernel
from nlfilter_torch.operator.pixel_matrix import shifted_remainder, sums_exactly
from nlfilter_torch.operator.scaling import Pass, PixelScaling, Result
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.pictures import Tile
from nlfilter_torch.photo.picture.sampling import (
    ColumnCache,
    Draws,
    GuidePicture,
    PassOverPicture,
    Pilot,
    Report,
    in_silence,
    patches_at,
    scaled_patches,
    visit,
)
from nlfilter_torch.photo.picture.source import SAMPLE, Blocks, Pixels, Planes, sampled_pairs, sampled_places
from nlfilter_torch.photo.picture.statistics import (
    CONVERGED,
    Block,
    Guess,
    ShiftedSums,
    ShiftedTerms,
    Sums,
    Totals,
    balance_by_passes,
    limiter_by_passes,
    sum_up,
    sum_up_shifted,
)

SAMPLE_BLOCKS = 8  # blocks that a sample is split into, to be shared among workers


@dataclass(eq=False)
class TilePixels:
    """Pixels of a tile.

    Attributes:
        image: their colours, (1, C, h, W).
        features: computes the features (1, D, h W) that an operator compares.
        first: row-major index of the first pixel in the picture.
        width: W of the picture.
    """

    image: Tensor
    features: "Callable[[TiledOperator], Tensor]"
    first: int
    width: int
    _columns: dict["TiledOperator", Columns] = field(default_factory=dict)
    _layers: "tuple[LayerPlanes, Tensor] | None" = None

    def columns(self, operator: "TiledOperator") -> Columns:
        """Columns of the pixels, computed once per operator."""
        if operator not in self._columns:
            known = None
            if self.image.shape[3] == self.width:
                known = operator.cache.find(slice(self.first, self.first + self.image[0, 0].numel()))
            self._columns[operator] = (
                operator.columns(self.features(operator)) if known is None else operator.scaled(*known)
            )
        return self._columns[operator]

    def layers(self, planes: "LayerPlanes") -> Tensor:
        """The detail layers of the pixels, cached until the layers of other planes are requested."""
        if self._layers is None or self._layers[0] is not planes:
            self._layers = planes, planes.compute(self)
        return self._layers[1]


@dataclass(frozen=True, eq=False)
class BlockPixels:
    """Pixels in a sum of an operator: their colours (1, C, 1, n), and their columns."""

    image: Tensor
    known_columns: Columns

    @property
    def first(self) -> int:
        """A sample of pixels has no place in the picture."""
        raise TypeError("planes that are summed over pixels must not depend on their place, got planes that do")

    @property
    def width(self) -> int:
        """A sample of pixels has no place in the picture."""
        return self.first

    def columns(self, operator: "TiledOperator") -> Columns:
        """Columns of the pixels."""
        return self.known_columns

    def layers(self, planes: "LayerPlanes") -> Tensor:
        """The detail layers of the pixels."""
        return planes.compute(self)


def with_columns(pixels: Pixels) -> TilePixels | BlockPixels:
    """The pixels, with their columns.

    Raises:
        TypeError: if they are not of a picture that is read in tiles.
    """
    if isinstance(pixels, TilePixels | BlockPixels):
        return pixels
    raise TypeError(
        f"pixels must be of a picture in tiles, got {type(pixels).__name__}; use the planes of its own source"
    )


def first_plane(pixels: Pixels) -> Tensor:
    """The first channel of a picture."""
    return pixels.image[:, :1]


@dataclass(frozen=True, eq=False)
class ColumnPlanes:
    """Planes computed by a function of the columns of an operator."""

    operator: "TiledOperator"
    function: Callable[[Columns], Tensor]

    def __call__(self, pixels: Pixels) -> Tensor:
        """The planes (1, C, h, w) at the pixels."""
        height, width = pixels.image.shape[-2:]
        return self.function(with_columns(pixels).columns(self.operator)).unflatten(2, (height, width))


@dataclass(frozen=True, eq=False)
class LayerPlanes:
    """Detail layers of planes of the picture, from the coefficients of powers of W."""

    operator: "TiledOperator"
    planes: Planes
    coefficients: Tensor

    def __call__(self, pixels: Pixels) -> Tensor:
        """The layers (1, k+1, C, h, w) at the pixels."""
        return with_columns(pixels).layers(self)

    def compute(self, pixels: Pixels) -> Tensor:
        """The layers at the pixels, without a cache."""
        image = self.planes(pixels)
        layers = layers_of_columns(with_columns(pixels).columns(self.operator), self.coefficients, image.flatten(2))
        return layers.unflatten(-1, image.shape[-2:])


@dataclass(frozen=True, eq=False)
class RationalPlanes:
    """A rational function of W without a polynomial, of planes y of the picture.

    Attributes:
        operator: W.
        planes: y.
        shifts: t, (J,).
        weights: w, (1, 1 + J).
        inner: coefficients of the factor in the solutions of the shifted systems, (1, J, M, C).
    """

    operator: "TiledOperator"
    planes: Planes
    shifts: Tensor
    weights: Tensor
    inner: Tensor

    def __call__(self, pixels: Pixels) -> Tensor:
        """The planes (1, C, h, W) at the pixels."""
        image, columns = self.planes(pixels), with_columns(pixels).columns(self.operator)
        planes, inner = image.flatten(2), self.inner.to(columns.factor)
        rows = inner.transpose(2, 3).flatten(1, 2)  # (1, J C, M)
        smooth = spread(rows, columns.factor, columns.scaling).unflatten(1, (len(self.shifts), -1))
        lowered = shifted_remainder(columns.remainder, self.shifts.to(planes))
        result = weigh_poles(planes, lowered * (planes.unsqueeze(1) - smooth), self.weights)
        return result.unflatten(2, image.shape[-2:])


@dataclass(frozen=True)
class PassOverBlocks:
    """A pass over blocks in memory."""

    blocks: list[Block]
    workers: int

    def __call__(self, function: Callable[[Block], Result]) -> Iterator[Result]:
        """Apply a function to each block, and yield the results in order."""
        return in_order(function, self.blocks, self.workers)


@dataclass(frozen=True)
class SampleDraw:
    """Draws the sample of a block, and computes the sums over all its pixels at a guess."""

    guess: Guess
    draws: Draws

    def __call__(self, block: Block) -> tuple[Block, Totals]:
        """The drawn pixels, and the sums."""
        columns, totals = self.guess.totals(block)
        return self.draws(block, columns), totals

    def totals(self, block: Block) -> Totals:
        """The sums alone."""
        return self.guess.totals(block)[1]


@dataclass(eq=False)
class TiledOperator:
    """The filter of a picture, represented by the sums over pixels that define it.

    The sums are computed on first use; the passes for balancing also yield the sums of the filtered planes.

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
    _sums: dict[Planes, Sums] = field(default_factory=dict)
    _grams: Tensor | float = 0.0  # correction of the Gram matrices of the sample

    def __getstate__(self) -> dict[str, object]:
        """The operator in another process: without columns that can be computed again."""
        return self.__dict__ | {"report": in_silence, "cache": ColumnCache(1, 0)}

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
            total = balance_by_passes(
                self.over("Balancing"), total, self.guide.dtype, completed=completed, bias=difference.moment
            )
        if self.full_passes:
            self._sample = difference = None
            total = balance_by_passes(self.over("Balancing"), total, self.guide.dtype, completed=completed)
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
        self._sums[planes] = replace(sample, correction=difference.coefficients)

    def _draw_sample(self, count: int, planes: Planes, order: int) -> tuple[list[Block], Totals]:
        """Draw about ``count`` pixels; also return the sums over all pixels minus theirs, both at the pilot's guess."""
        pilot, values = self.pilot, partial(_planes_of_block, planes)
        guess = Guess(pilot.moment, torch.empty(1, 0, pilot.moment.shape[1], 1), values, self.guide.guide.spectral)
        columns = guess.columns(pilot.sample)
        known = sum_up(
            PassOverBlocks([pilot.sample], self.workers), lambda block: (values(block, columns), columns), order
        )
        guess = replace(guess, coefficients=known.coefficients()[:, :-1])
        draw, drawn, total = SampleDraw(guess, Draws(pilot, columns, count, self.guide.pixels)), [], None
        for block, totals in self._over_picture("Sampling")(draw):
            drawn.append(block)
            total = totals if total is None else total.plus(totals)
        assert total is not None  # for mypy; a picture has a pixel
        step = -(-len(drawn) // SAMPLE_BLOCKS)
        sample = [Block.concatenate(drawn[first : first + step]) for first in range(0, len(drawn), step)]
        for totals in PassOverBlocks(sample, self.workers)(draw.totals):
            total = total.plus(totals, sign=-1)
        return sample, total

    def _over_picture(self, stage: str) -> PassOverPicture:
        """A pass over every pixel."""
        return PassOverPicture(self.guide, self.kernel, self.report, stage, self.workers, self.cache)

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

    def over(self, stage: str) -> Pass[Block]:
        """A pass over the sample, or over all pixels if there is none."""
        if self._sample is None:
            return self._over_picture(stage)
        self.report(stage, 0, 1)
        return PassOverBlocks(self._sample, self.workers)

    def pixels(self, block: Block) -> BlockPixels:
        """The pixels of a block, with their columns."""
        return BlockPixels(block.image.unsqueeze(2), self.scaled(block.factor, block.diagonal))

    @torch.no_grad()
    @full_precision
    def sums(self, planes: Planes, order: int) -> Sums:
        """Sums for the first ``order`` powers of W and the given planes.

        Sums of other planes than the argument of :meth:`prepare` are taken over all pixels: the sample is drawn for
        balancing, and is off by several grey levels for planes that are large at a few pixels.
        """
        self.prepare(planes, order)
        known = self._sums.get(planes)
        if known is None or known.moments.shape[1] < order:
            known = self._sums[planes] = self._summed_up(planes, order, self._over_picture("Summing up"))
        return known

    def _summed_up(self, planes: Planes, order: int, blocks: Pass[Block]) -> Sums:
        return sum_up(blocks, partial(self._planes_and_columns, planes), order)

    def _planes_and_columns(self, planes: Planes, block: Block) -> tuple[Tensor, Columns]:
        """Planes (1, C, n) of the pixels of a block, and their columns."""
        pixels = self.pixels(block)
        return planes(pixels).flatten(2), pixels.known_columns

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum."""
        count = self.guide.pixels
        if self.guide.guide.sampled and count > SAMPLE:
            places = sampled_places(self.guide.size)
            blocks = map(self._weighted_columns, places.split(sampling.CHUNK))
            return sampled_pairs(blocks, count, self.guide.dtype)
        sums = next(iter(self._sums.values()), None) or self.sums(first_plane, 1)
        return RitzPairs.of_sums(sums.grams[:, :2] + self._grams, sums.dtype)

    def _weighted_columns(self, places: Tensor) -> Columns:
        """Columns of single pixels, whose scaling is multiplied by the roots of their weights."""
        columns, counted = self.columns(self.features_at(places)), self.guide.counted
        if counted is None:
            return columns
        return replace(columns, scaling=columns.scaling * counted.at(places).to(columns.scaling).sqrt())

    def of_columns(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Planes computed by a function of columns."""
        return ColumnPlanes(self, function)

    def at(self, places: Tensor) -> Blocks:
        """Columns of single pixels, whose features are read now and kept in memory."""
        return partial(self._factors, self.features_at(places))

    def _factors(self, features: Tensor) -> Iterator[Tensor]:
        """Columns (1, M, n) of the factor at pixels with features (1, D, n), block by block."""
        for part in features.split(sampling.CHUNK, dim=2):
            yield self.columns(part).factor

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers, from the sums for powers of W."""
        return LayerPlanes(self, planes, self.sums(planes, order).coefficients())

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y``."""
        return self.sums(planes, 1).coefficients()[:, 0].mT

    def rational(self, planes: Planes, form: RationalForm, weights: Tensor) -> Planes:
        """A rational function of W, from the sums for shifted systems."""
        return RationalPlanes(self, planes, form.shifts, weights, self.shifted_sums(planes, form.shifts).inner())

    @torch.no_grad()
    @full_precision
    def shifted_sums(self, planes: Planes, shifts: Tensor) -> ShiftedSums:
        """Sums over all pixels for shifted systems: a sample, drawn for balancing, lacks rare pixels."""
        self.prepare()
        return self._shifted(planes, shifts, self._over_picture("Summing up"))

    def _shifted(self, planes: Planes, shifts: Tensor, blocks: Pass[Block]) -> ShiftedSums:
        exact = sums_exactly(self.guide.dtype, self.guide.pixels)
        return sum_up_shifted(blocks, ShiftedTerms(partial(self._planes_and_columns, planes), shifts, exact))

    @torch.no_grad()
    @full_precision
    def mean(self, planes: Planes) -> Tensor:
        """Means over the sample, or over all pixels if there is none."""
        total, weight = torch.zeros(()), torch.zeros((), dtype=torch.float64)
        self.prepare()
        for values, weights in self.over("Averaging")(partial(self._weighted_sums, planes)):
            total, weight = total + values, weight + weights
        return (total / weight).to(self.guide.dtype)

    def _weighted_sums(self, planes: Planes, block: Block) -> tuple[Tensor, Tensor]:
        """Weighted sums (1, C) of planes over a block, and the sum of the weights."""
        values = planes(self.pixels(block)).flatten(2) * block.weights.unsqueeze(1)
        return values.double().sum(2), block.weights.double().sum()

    def features_at(self, places: Tensor) -> Tensor:
        """Features (1, D, n) of single pixels, read from their rows."""
        recipe, report = self.kernel.recipe, self.report
        size, patches = recipe.patch_weights.shape[0], []
        for tile, chosen in visit(self.guide.picture, self.margin, places, report, "Comparing strokes", every=False):
            seen = self.guide.seen(tile, size // 2)
            guide = reduce_channels(seen.pixels, recipe.guide_channels)
            patches.append(patches_at(guide, seen, chosen, size))
        return scaled_patches(torch.cat(patches, dim=2), places, self.guide, recipe)


def _planes_of_block(planes: Planes, block: Block, columns: Columns) -> Tensor:
    """Planes (1, C, n) of the pixels of a block with the given columns."""
    return planes(BlockPixels(block.image.unsqueeze(2), columns)).flatten(2)
