"""The filter of a picture that is read a few rows at a time: the sums that define it, and its columns."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.core.workers import in_order
from nlfilter_torch.filtering.filters import layers_of_columns
from nlfilter_torch.filtering.matrix_function import weigh_poles
from nlfilter_torch.operator.eigenvalue_bound import exceeds, limiter, slack
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.operator import Kernel
from nlfilter_torch.operator.pixel_matrix import Columns, capacitance_inverse, sums_exactly
from nlfilter_torch.operator.scaling import Pass, PixelScaling, Rest, summed
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.pictures import Tile, TileFilter, TileLayers
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
from nlfilter_torch.photo.picture.statistics import CONVERGED, Block, Guess, Sums, balance_by_passes, sums_of_powers

SAMPLE_BLOCKS = 8  # blocks that a sample is split into, to be shared among workers


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

    def columns(self, operator: TileFilter) -> Columns:
        """Columns of the pixels."""
        return self.known_columns

    def layers(self, planes: TileLayers) -> Tensor:
        """The detail layers of the pixels."""
        return planes.compute(self)


def with_columns(pixels: Pixels) -> Tile | BlockPixels:
    """The pixels, with their columns.

    Raises:
        TypeError: if they are not of a picture that is read in tiles.
    """
    if isinstance(pixels, Tile | BlockPixels):
        return pixels
    raise TypeError(
        f"pixels must be of a picture in tiles, got {type(pixels).__name__}; use the planes of its own source"
    )


def first_plane(pixels: Pixels) -> Tensor:
    """The first channel of a picture."""
    return pixels.image[:, :1]


@dataclass(frozen=True, eq=False)
class OperatorPlanes:
    """Planes computed by a function of the columns of an operator.

    Attributes:
        operator: W.
        function: returns (1, ..., n) for columns, further arguments, and the values of ``planes``, if there are any.
        arguments: of the function.
        planes: y, of the picture, or None.
    """

    operator: "TiledOperator"
    function: Callable[..., Tensor]
    arguments: tuple[object, ...]
    planes: Planes | None = None

    def compute(self, pixels: Pixels) -> Tensor:
        """The planes (1, ..., h, w) at the pixels."""
        values = () if self.planes is None else (self.planes(pixels).flatten(2),)
        columns = with_columns(pixels).columns(self.operator)
        return self.function(columns, *self.arguments, *values).unflatten(-1, pixels.image.shape[-2:])

    def cached(self, pixels: Pixels) -> Tensor:
        """The same; tiles keep them until other planes are requested so."""
        return with_columns(pixels).layers(self)


def _rational(columns: Columns, shifts: Tensor, weights: Tensor, inner: Tensor, planes: Tensor) -> Tensor:
    """A rational function of W without a polynomial, of planes (1, C, n); see :meth:`Columns.shifted_solutions`."""
    return weigh_poles(planes, columns.shifted_solutions(planes, shifts, inner), weights)


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
        total, tolerance = self.pilot.moment, CONVERGED[self.guide.picture.dtype]
        biases: tuple[Tensor, ...] | None = None
        if self.sample_size is not None:
            self._sample, biases = self._draw_sample(self.sample_size, planes, order)
            total = self._balanced(total, biases[0])
        if self.full_passes:
            self._sample = biases = None
            total = self._balanced(total)
        self._pixel_scaling = PixelScaling(total, self.pilot.completed, tolerance)
        limit = self._limiter(total) if self.bounded else None
        if limit is not None:
            self.kernel = replace(self.kernel, limiter=limit.to(self.kernel.landmarks))
            self.cache.blocks.clear()
        if self._sample is None or biases is None:
            return
        _, moments, grams = biases
        if limit is not None:
            self._sample = [replace(block, factor=limit.to(block.factor) @ block.factor) for block in self._sample]
            moments, grams = limit @ moments, limit @ grams.to(limit) @ limit
        self._grams = grams
        sample = self._summed_up(planes, order, self.over("Summing up"))
        self._sums[planes] = replace(sample, moments=sample.moments + moments)

    def _balanced(self, total: Tensor, bias: Tensor | float = 0.0) -> Tensor:
        """The moment of all pixels, or of the sample and a ``bias`` that stands for the others."""
        blocks, completed = self.over("Balancing"), self.pilot.completed
        return balance_by_passes(blocks, total, self.guide.picture.dtype, completed=completed, bias=bias)

    def _limiter(self, total: Tensor) -> Tensor | None:
        """The ``X^(1/2)`` (1, M, M) to multiply the factor by, or None if no eigenvalue exceeds 1."""
        blocks, allowed = self.over("Bounding"), slack(self.guide.picture.dtype, CONVERGED[self.guide.picture.dtype])
        gram = partial(self._gram_below, blocks)
        return limiter(gram, total, allowed) if exceeds(gram, total, allowed) else None

    def _gram_below(self, blocks: Pass[Block], at: Tensor, power: int) -> Tensor:
        """:meth:`Columns.gram_below` of all pixels, in a pass over them."""
        return summed(blocks(self._gram_of_block, at, power))[0]

    def _gram_of_block(self, block: Block, at: Tensor, power: int) -> tuple[Tensor]:
        return (self.block_columns(block).gram_below(at, power),)

    def _draw_sample(self, count: int, planes: Planes, order: int) -> tuple[list[Block], tuple[Tensor, ...]]:
        """Draw about ``count`` pixels; also return the sums over all pixels minus theirs, both at the pilot's guess."""
        pilot, values = self.pilot, partial(_planes_of_block, planes)
        guess = Guess(pilot.moment, torch.empty(1, 0, pilot.moment.shape[1], 1), values, self.guide.guide.spectral)
        columns = guess.columns(pilot.sample)
        known = Sums(*sums_of_powers(columns, values(pilot.sample, columns), order))
        guess = replace(guess, coefficients=known.coefficients()[:, :-1])
        draws = Draws(pilot, columns, count, self.guide.picture.pixels)
        drawn, totals = zip(*self._over_picture("Sampling")(_draw_and_sum, guess, draws), strict=True)
        step = -(-len(drawn) // SAMPLE_BLOCKS)
        sample = [Block.concatenate(drawn[first : first + step]) for first in range(0, len(drawn), step)]
        own = summed(totals for _, totals in in_order(guess.totals, sample, self.workers))
        return sample, tuple(map(torch.sub, summed(totals), own))

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
        """Features (1, D, n) of the pixels of a tile of the picture."""
        seen = self.guide.seen(tile, self.kernel.recipe.patch_weights.shape[0] // 2)
        features = self.kernel.recipe(seen.pixels, origin=seen.origin, halo=seen.halo)
        if tile.inside is None:
            return features
        return features.unflatten(2, tile.stored.shape[:2])[..., tile.inside].flatten(2)

    def columns_of(self, tile: Tile) -> Columns:
        """Columns of the pixels of a tile, from the cache if they are there."""
        known = None
        if tile.image.shape[3] == tile.width:
            known = self.cache.find(slice(tile.first, tile.first + tile.image[0, 0].numel()))
        return self.columns(tile.features(self)) if known is None else self.scaled(*known)

    def columns(self, features: Tensor) -> Columns:
        """Columns of pixels with features (1, D, n)."""
        self.prepare()  # may change the kernel
        return self.scaled(*self.kernel.factor(features))

    def scaled(self, factor: Tensor, diagonal: Tensor) -> Columns:
        """Columns of pixels with a given factor and diagonal."""
        return Columns(factor, *self.pixel_scaling(factor, diagonal))

    def over(self, stage: str) -> PassOverPicture:
        """A pass over the sample, or over all pixels if there is none."""
        return replace(self._over_picture(stage), sample=self._sample)

    def pixels(self, block: Block) -> BlockPixels:
        """The pixels of a block, with their columns."""
        return BlockPixels(block.image.unsqueeze(2), self.block_columns(block))

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

    def block_columns(self, block: Block) -> Columns:
        """The columns of a block, with its weights."""
        return replace(self.scaled(block.factor, block.diagonal), weights=block.weights)

    def _summed_up(self, planes: Planes, order: int, blocks: Pass[Block]) -> Sums:
        return Sums(*summed(blocks(self._sums_of_block, planes, order)))

    def _sums_of_block(self, block: Block, planes: Planes, order: int) -> tuple[Tensor, Tensor]:
        pixels = self.pixels(block)
        return sums_of_powers(pixels.known_columns, planes(pixels).flatten(2), order)

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum."""
        count = self.guide.picture.pixels
        if self.guide.guide.sampled and count > SAMPLE:
            places = sampled_places(self.guide.picture.size)
            blocks = map(self._weighted_columns, places.split(sampling.CHUNK))
            return sampled_pairs(blocks, count, self.guide.picture.dtype)
        sums = next(iter(self._sums.values()), None) or self.sums(first_plane, 1)
        return RitzPairs.of_sums(sums.grams[:, :2] + self._grams, self.guide.picture.dtype)

    def _weighted_columns(self, places: Tensor) -> Columns:
        """Columns of single pixels, whose scaling is multiplied by the roots of their weights."""
        columns, counted = self.columns(self.features_at(places)), self.guide.counted
        if counted is None:
            return columns
        return replace(columns, scaling=columns.scaling * counted.at(places).to(columns.scaling).sqrt())

    def of_columns(self, function: Callable[[Columns, *Rest], Tensor], *arguments: *Rest) -> Planes:
        """Planes computed by a function of columns."""
        return OperatorPlanes(self, function, arguments).compute

    def at(self, places: Tensor) -> Blocks:
        """Columns of single pixels, whose features are read now and kept in memory."""
        return partial(self._factors, self.features_at(places))

    def _factors(self, features: Tensor) -> Iterator[Tensor]:
        """Columns (1, M, n) of the factor at pixels with features (1, D, n), block by block."""
        for part in features.split(sampling.CHUNK, dim=2):
            yield self.columns(part).factor

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers, from the sums for powers of W."""
        return OperatorPlanes(self, layers_of_columns, (self.sums(planes, order).coefficients(),), planes).cached

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y``."""
        return self.sums(planes, 1).coefficients()[:, 0].mT

    def rational(self, planes: Planes, form: RationalForm, weights: Tensor) -> Planes:
        """A rational function of W, from the sums for shifted systems."""
        inner = self.shifted_inner(planes, form.shifts)
        return OperatorPlanes(self, _rational, (form.shifts, weights, inner), planes).compute

    @torch.no_grad()
    @full_precision
    def shifted_inner(self, planes: Planes, shifts: Tensor) -> Tensor:
        """The ``inner`` of shifted systems, from all pixels: a sample, drawn for balancing, lacks rare pixels."""
        self.prepare()
        return self._shifted(planes, shifts, self._over_picture("Summing up"))

    def _shifted(self, planes: Planes, shifts: Tensor, blocks: Pass[Block]) -> Tensor:
        """Coefficients of the factor in the solutions of shifted systems, (1, J, M, C)."""
        grams, sums = summed(blocks(self._shifted_of_block, planes, shifts))
        return capacitance_inverse(grams) @ sums

    def _shifted_of_block(self, block: Block, planes: Planes, shifts: Tensor) -> tuple[Tensor, Tensor]:
        pixels, exact = self.pixels(block), sums_exactly(self.guide.picture.dtype, self.guide.picture.pixels)
        columns, values = pixels.known_columns, planes(pixels).flatten(2)
        return columns.shifted_grams(shifts, exact=exact), columns.shifted_sums(values, shifts)

    @torch.no_grad()
    @full_precision
    def mean(self, planes: Planes) -> Tensor:
        """Means over the sample, or over all pixels if there is none."""
        self.prepare()
        total, weight = summed(self.over("Averaging")(self._weighted_sums, planes))
        return (total / weight).to(self.guide.picture.dtype)

    def _weighted_sums(self, block: Block, planes: Planes) -> tuple[Tensor, Tensor]:
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
        return scaled_patches(torch.cat(patches, dim=2), places, self.guide.picture, recipe)


def _planes_of_block(planes: Planes, block: Block, columns: Columns) -> Tensor:
    """Planes (1, C, n) of the pixels of a block with the given columns."""
    return planes(BlockPixels(block.image.unsqueeze(2), columns)).flatten(2)


def _draw_and_sum(block: Block, guess: Guess, draws: Draws) -> tuple[Block, tuple[Tensor, ...]]:
    """The pixels that are drawn from a block, and its sums at a guess."""
    columns, totals = guess.totals(block)
    return draws(block, columns), totals
