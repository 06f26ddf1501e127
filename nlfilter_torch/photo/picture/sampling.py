"""The guide of a picture that is read by rows, and samples of it.

One pass over the picture yields the pilot: the kernel of its filter and an even sample of its pixels. A second sample,
for the sums that define the filter, favours rare pixels and has no gaps.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.blocks import stratified
from nlfilter_torch.core.workers import in_order, single_threaded
from nlfilter_torch.operator.features import (
    GuideFeatures,
    bandwidth_of_gradient,
    gradients,
    gradients_within,
    pad_border,
    reduce_channels,
)
from nlfilter_torch.operator.landmarks import candidate_pixels, condense
from nlfilter_torch.operator.nystrom import inverse_cholesky
from nlfilter_torch.operator.operator import Kernel
from nlfilter_torch.operator.options import Sampling, check_bandwidths, check_options, landmark_count
from nlfilter_torch.operator.orientation import (
    ORIENTATIONS,
    Layout,
    Orientation,
    canonical_points,
    orientation_of,
    orientation_sums,
    source_pixels,
    stretched_sums,
)
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.scaling import Rest, Result
from nlfilter_torch.operator.sinkhorn import solve, warn_of_residual
from nlfilter_torch.photo.picture.counted import CountedPixels
from nlfilter_torch.photo.picture.pictures import Picture, Tile
from nlfilter_torch.photo.picture.source import Guide
from nlfilter_torch.photo.picture.statistics import Block

PILOT = 1 << 15  # pixels of the first sample: their factor, 13 MB at m = 100, is balanced in memory
PILOT_TOLERANCE = 1e-3  # tolerance of its balancing, which is an initial guess
CHUNK = 1 << 16  # scribbled pixels whose factor is in memory at once

Report = Callable[[str, int, int], None]


def in_silence(stage: str, done: int, rows: int) -> None:
    """Report nothing."""


@dataclass(eq=False)
class GuidePicture:
    """The guide of a picture.

    Attributes:
        picture: whose guide this is.
        guide: computes the guide from the picture.
        counted: how much its pixels count; None is 1 each.
        stored: the whole guide (1, C, H, W), if kept in memory.
    """

    picture: Picture
    guide: Guide
    counted: CountedPixels | None = None
    stored: Tensor | None = None

    def __getstate__(self) -> dict[str, object]:
        """The guide in another process, which computes it from the picture."""
        return self.__dict__ | {"stored": None, "counted": None}

    def weights(self, tile: Tile) -> Tensor | None:
        """The weights (1, 1, h, W) of a tile's pixels; None is 1 each."""
        return None if self.counted is None else self.counted.rows(tile.start, tile.start + len(tile.stored))

    def store(self, rows: int, workers: int) -> None:
        """Compute the whole guide in tiles of ``rows``, and keep it in memory for further passes."""
        planes: Tensor | None = None
        tiles = self.picture.tiles(self.margin, rows)
        for start, part in in_order(self._start_and_guide, tiles, workers):
            if planes is None:
                planes = part.new_empty(*part.shape[:2], *self.picture.size)
            planes[:, :, start : start + part.shape[2]] = part
        self.stored = planes

    def _start_and_guide(self, tile: Tile) -> tuple[int, Tensor]:
        """The first row of a tile of the picture, and its guide."""
        return tile.start, self.seen(tile, 0).pixels

    @property
    def margin(self) -> int:
        """Number of pixels around a pixel that are read to compute its guide."""
        return 0 if self.stored is not None else self.guide.margin

    def seen(self, tile: Tile, margin: int) -> Tile:
        """The guide, with ``margin``, of a tile of the picture that has a margin large enough to compute it."""
        stop = tile.start + tile.stored.shape[0]
        halo = (min(tile.start, margin), min(self.picture.size[0] - stop, margin))
        if self.stored is not None:
            columns = slice(tile.left, tile.left + tile.stored.shape[1])
            return replace(tile, known=self.stored[:, :, tile.start - halo[0] : stop + halo[1], columns], halo=halo)
        above, below = (min(have, want + self.guide.margin) for have, want in zip(tile.halo, halo, strict=True))
        image = tile.pixels[:, :, tile.halo[0] - above : tile.pixels.shape[2] - tile.halo[1] + below]
        guide = self.guide(image)[:, :, above - halo[0] : image.shape[2] - below + halo[1]]
        return replace(tile, known=guide, halo=halo)


class ColumnCache:
    """Cache of columns between passes, in blocks of ``block_pixels``, for the first ``max_pixels`` of a picture."""

    def __init__(self, block_pixels: int, max_pixels: int) -> None:
        self.block_pixels, self.max_pixels = block_pixels, max_pixels
        self.blocks: dict[int, tuple[Tensor, Tensor]] = {}

    def keep(self, first: int, columns: tuple[Tensor, Tensor]) -> None:
        """Store the columns of the block that begins at pixel ``first``, if there is room."""
        if first + columns[1].shape[1] <= self.max_pixels:
            self.blocks[first] = columns

    def find(self, pixels: slice) -> tuple[Tensor, Tensor] | None:
        """Factor and diagonal of some pixels, or None unless all are in one stored block."""
        first = pixels.start // self.block_pixels * self.block_pixels
        known = self.blocks.get(first)
        if known is None or pixels.stop > first + known[1].shape[1]:
            return None
        inside = slice(pixels.start - first, pixels.stop - first)
        return known[0][:, :, inside], known[1][:, inside]


@dataclass(frozen=True)
class PassOverPicture:
    """A pass over every pixel of a picture, or over those of a sample.

    Attributes:
        guide: of the picture.
        kernel: computes the columns of the pixels.
        report: called with the progress of the ``stage``.
        stage: name for the progress.
        workers: number of tiles computed at once.
        cache: columns cached from earlier passes.
        sample: blocks of the pixels of the sample, if only these are visited.
    """

    guide: GuidePicture
    kernel: Kernel
    report: Report
    stage: str
    workers: int
    cache: ColumnCache
    sample: list[Block] | None = None

    def __call__(self, function: Callable[[Block, *Rest], Result], /, *arguments: *Rest) -> Iterator[Result]:
        """Apply a function to each block, and yield the results in order."""
        if self.sample is not None:
            self.report(self.stage, 0, 1)
            yield from in_order(function, self.sample, self.workers, *arguments)
            return
        picture = self.guide.picture
        height, rows = picture.size[0], picture.statistics_rows
        tiles = picture.tiles(self._radius + self.guide.margin, rows)
        self.report(self.stage, 0, height)
        results = in_order(self._applied, tiles, self.workers, function, *arguments)
        for number, result in enumerate(results, start=1):
            yield result
            self.report(self.stage, min(number * rows, height), height)

    def _applied(self, tile: Tile, function: Callable[[Block, *Rest], Result], *arguments: *Rest) -> Result:
        return function(self._block(tile), *arguments)

    @property
    def _radius(self) -> int:
        """Radius of a patch."""
        return self.kernel.recipe.patch_weights.shape[0] // 2

    def _block(self, tile: Tile) -> Block:
        image, first = tile.image.flatten(2), tile.first
        columns = self.cache.find(slice(first, first + image.shape[2]))
        if columns is None:
            guide = self.guide.seen(tile, self._radius)
            columns = self.kernel.columns(guide.pixels, origin=guide.origin, halo=guide.halo)
            self.cache.keep(first, columns)
        weights, ones = self.guide.weights(tile), torch.ones_like(columns[1])
        weights = ones if weights is None else weights.to(ones).view_as(ones)
        return Block(*columns, weights, image=image, start_row=tile.start)


@dataclass(frozen=True)
class Pilot:
    """The kernel of a picture, an even sample of its pixels, and the balancing of that sample.

    Attributes:
        kernel: landmarks, bandwidths and window.
        sample: pixels spread evenly over the picture.
        moment: the moment t (1, M, 1) of the balanced sample.
        seed: for further samples.
    """

    kernel: Kernel
    sample: Block
    moment: Tensor
    seed: int

    @property
    def completed(self) -> bool:
        """Whether the kernel has a unit diagonal."""
        return self.kernel.completion == "diagonal"


def take_pilot(picture: GuidePicture, report: Report, workers: int = 1) -> Pilot:
    """Compute bandwidth, landmarks and an initial balancing in one pass over the picture.

    Bandwidth and landmarks are those of :func:`nonlocal_operator`, to rounding.
    """
    options, counted = picture.guide.options, picture.counted
    check_options(options)
    check_bandwidths(options)
    recipe = GuideFeatures.of(options, options.bandwidth_or(lambda: 1.0), picture.picture.dtype)
    count = landmark_count(options, picture.picture.pixels)
    if counted is not None:
        count = min(count, counted.count)
    generator = torch.Generator().manual_seed(0) if options.generator is None else options.generator
    assert isinstance(options.landmarks, str)  # for mypy
    look = Look(picture, recipe, count, options.landmarks, generator, report, workers)
    return look.at_all() if counted is None else look.at_counted(counted)


@dataclass(frozen=True, eq=False)
class Look:
    """The first look at a picture, from which its pilot is computed.

    Attributes:
        guide: of the picture.
        recipe: of the features, with the photometric bandwidth unless that is automatic.
        count: number of landmarks.
        sampling: how they are chosen.
        generator: for this choice.
        report: called with the progress.
        workers: number of tiles looked at at once.
    """

    guide: GuidePicture
    recipe: GuideFeatures
    count: int
    sampling: Sampling
    generator: torch.Generator
    report: Report
    workers: int

    @property
    def picture(self) -> Picture:
        """The picture."""
        return self.guide.picture

    def at_all(self) -> Pilot:
        """The pilot of a picture all of whose pixels count, in one pass."""
        picture, count, generator = self.picture, self.count, self.generator
        drawn = candidate_pixels(picture.size, count, self.sampling, generator).cpu()
        rest = torch.Generator().manual_seed(int(drawn.sum()) % 2**32)  # ``generator`` is for the landmarks alone
        even = stratified(picture.pixels, min(PILOT, picture.pixels), rest)
        # The orientation of the picture, which decides which pixels are candidates, is known after the pass.
        turned = self.sampling == "kmeans" and len(drawn) > count
        candidates = source_pixels(torch.arange(ORIENTATIONS if turned else 1), picture.size, drawn)
        wanted = torch.cat([candidates.flatten(), even])
        patches, values, slope, total = self._read(wanted)
        recipe = self._with_bandwidth(slope / picture.pixels)
        orientation = orientation_of(total, patches.shape[1] // recipe.patch_weights.numel())
        if not turned:
            orientation = Orientation(torch.zeros(1, dtype=torch.long))
        first = int(orientation.numbers) * len(drawn)
        used = torch.cat([torch.arange(first, first + len(drawn)), torch.arange(candidates.numel(), len(wanted))])
        features = scaled_patches(patches[:, :, used], wanted[used], picture, recipe)
        weights = torch.full((1, len(even)), picture.pixels / len(even), dtype=picture.dtype)
        image, subset, rest_of = values[:, :, candidates.numel() :], *features.tensor_split([len(drawn)], dim=2)
        kernel = self._kernel(recipe, subset, orientation, drawn, picture.size)
        return self._pilot(kernel, rest_of, image, weights, rest)

    def at_counted(self, counted: CountedPixels) -> Pilot:
        """The pilot of the pixels of a picture that count, in two passes, of which the second reads candidates."""
        picture, count, generator = self.picture, self.count, self.generator
        rest = torch.Generator().manual_seed(generator.initial_seed() % 2**32)
        wanted = min(picture.pixels, math.ceil(PILOT * picture.pixels / counted.count))
        spread = stratified(picture.pixels, wanted, rest)
        even = spread[counted.at(spread) > 0]
        if len(even) == 0:
            even = counted.whole(counted.candidates(1, "random", rest, 0))
        patches, image, slope, total = self._read(even)
        recipe = self._with_bandwidth(slope / counted.total)
        orientation = Orientation(torch.zeros(1, dtype=torch.long))
        if self.sampling == "kmeans" and count < counted.count:
            orientation = orientation_of(total, patches.shape[1] // recipe.patch_weights.numel())
        drawn = counted.candidates(count, self.sampling, generator, int(orientation.numbers))
        candidates = counted.whole(source_pixels(orientation.numbers, counted.box, drawn)[0])
        subset = scaled_patches(self._read(candidates)[0], candidates, picture, recipe)
        kernel = self._kernel(recipe, subset, orientation, drawn, counted.box)
        weights = counted.at(even).to(picture.dtype) * (counted.count / len(even))
        return self._pilot(kernel, scaled_patches(patches, even, picture, recipe), image, weights.unsqueeze(0), rest)

    def _kernel(
        self, recipe: GuideFeatures, subset: Tensor, orientation: Orientation, drawn: Tensor, size: tuple[int, int]
    ) -> Kernel:
        """The kernel with landmarks from candidates.

        Args:
            recipe: of the features.
            subset: features (1, D, S) of the candidates.
            orientation: in which they are clustered, so that landmarks turn with the picture.
            drawn: numbers of the candidates in that orientation.
            size: (H, W) of the part of the picture in which they are numbered.
        """
        layout, coordinates = Layout(self.guide.guide.options.patch_size, recipe.spatial_bandwidth is not None), None
        if layout.coordinates:
            places = source_pixels(orientation.numbers, size, drawn, flipped=False)[0]
            located = torch.stack([places // size[1], places % size[1]]).to(recipe.patch_weights)
            coordinates = recipe.coordinates(located).to(subset)
        canonical = canonical_points(subset, orientation, layout, coordinates)
        with single_threaded(self.workers):  # so few pixels that a second thread would wait most of the time
            points = condense(subset, self.count, self.generator, canonical)
            completion = self.guide.guide.options.completion
            return Kernel(points, inverse_cholesky(points), completion, features=recipe)

    def _pilot(self, kernel: Kernel, features: Tensor, image: Tensor, weights: Tensor, rest: torch.Generator) -> Pilot:
        """Balance an even sample of the pixels.

        Args:
            kernel: of the filter.
            features: of the sample, (1, D, n).
            image: its colours, (1, C, n).
            weights: number of pixels that each represents, (1, n).
            rest: for further samples.
        """
        completed = kernel.completion == "diagonal"
        with single_threaded(self.workers):
            block = Block(*kernel.factor(features), weights, image=image)
            balancing = solve(block, PILOT_TOLERANCE, completed)
        warn_of_residual(balancing.worst, PILOT_TOLERANCE, self.picture.dtype, completed=completed)
        return Pilot(kernel, block, balancing.moment, rest.initial_seed())

    def _read(self, wanted: Tensor) -> tuple[Tensor, Tensor, float, Tensor]:
        """Patches (1, C p^2, n) and colours (1, C, n) of pixels, in their order, and two sums over the picture.

        These are the sum of the gradients, and those of :func:`orientation_sums`, (1, C, 6, 6).
        """
        ascending = wanted.sort()
        margin = self._margin + self.guide.margin
        parts = visit(self.picture, margin, ascending.values, self.report, "Looking")
        patches, values, slopes, sums, ends = zip(*in_order(self._read_tile, parts, self.workers), strict=True)
        order = torch.empty_like(wanted)
        order[ascending.indices] = torch.arange(len(wanted))  # position of each wanted pixel in reading order
        total, limits = torch.stack(sums).sum(0), torch.stack(ends)
        if self.guide.counted is not None:
            least, most = float(limits[:, 0].amin()), float(limits[:, 1].amax())
            total = stretched_sums(total[:, :-1], total[:, -1:], least, most)
        return torch.cat(patches, dim=2)[:, :, order], torch.cat(values, dim=2)[:, :, order], sum(slopes), total

    @property
    def _margin(self) -> int:
        """Number of rows of the guide around a tile that are read."""
        return max(self.guide.guide.options.patch_size // 2, 1)

    def _read_tile(self, part: tuple[Tile, Tensor]) -> tuple[Tensor, Tensor, float, Tensor, Tensor]:
        """What :meth:`_read` returns for chosen pixels of a tile, with the limits of its values.

        If pixels differ in how much they count, the sums are those of :func:`counted_sums`, to which the limits belong.
        """
        tile, chosen = part
        seen, options, counted = self.guide.seen(tile, self._margin), self.guide.guide.options, self.guide.counted
        guide = reduce_channels(seen.pixels, options.guide_channels)
        gradient = self._gradient(guide, seen) if isinstance(options.photometric_bandwidth, str) else 0.0
        rows = guide[:, :, seen.halo[0] : guide.shape[2] - seen.halo[1]]
        if counted is None:
            sums = orientation_sums(rows, tile.start, self.picture.size), rows.new_tensor([0.0, 1.0])
        else:
            sums = counted_sums(rows, tile.start, counted)
        return patches_at(guide, seen, chosen, options.patch_size), tile.image.flatten(2)[:, :, chosen], gradient, *sums

    def _gradient(self, guide: Tensor, seen: Tile) -> float:
        """Sum of the gradients of a tile's guide, times the weights of its pixels."""
        weights, counted, (above, below) = self.guide.weights(seen), self.guide.counted, seen.halo
        if counted is None or weights is None:
            return float(gradients(guide, seen.halo).double().mean((0, 1)).sum())
        counts = counted.rows(seen.start - above, seen.start + guide.shape[2] - above) > 0
        slopes = gradients_within(guide, counts)[:, :, above : guide.shape[2] - below]
        return float((slopes.double().mean((0, 1)) * weights[0, 0]).sum())

    def _with_bandwidth(self, slope: float) -> GuideFeatures:
        """The recipe, with the bandwidth for a mean slope if it is automatic."""
        if not isinstance(self.guide.guide.options.photometric_bandwidth, str):
            return self.recipe
        bandwidth = float(bandwidth_of_gradient(torch.tensor(slope, dtype=torch.float64)))
        return replace(self.recipe, photometric_bandwidth=bandwidth)


def counted_sums(rows: Tensor, first_row: int, counted: CountedPixels) -> tuple[Tensor, Tensor]:
    """:func:`orientation_sums` over rows of a guide from ``first_row`` on, of the pixels that count.

    Returns:
        The sums, (1, C + 1, 6, 6), the last ones those of values of 0, and the least and largest value, (2,).
    """
    (top, left), (height, width) = counted.corner, counted.box
    first, last = max(top - first_row, 0), max(min(top + height - first_row, rows.shape[2]), 0)
    part = rows[:, :, first : max(first, last), left : left + width]
    inside = torch.from_numpy(counted.in_box(slice(first_row + first, first_row + max(first, last))))[None]
    part = torch.cat([part, torch.zeros_like(part[:, :1])], dim=1)
    values = part[:, :-1, inside[0]]
    ends = torch.tensor([torch.inf, -torch.inf]) if values.numel() == 0 else torch.stack([values.amin(), values.amax()])
    return orientation_sums(part, first_row + first - top, counted.box, inside), ends


def visit(
    picture: Picture, margin: int, pixels: Tensor, report: Report, stage: str, *, every: bool = True
) -> Iterator[tuple[Tile, Tensor]]:
    """Yield the tiles of a pass, each with the chosen pixels that it contains.

    ``pixels`` are ascending indices in the picture; those that are yielded are indices in the tile. Tiles without any
    of the pixels are skipped unless ``every`` is True.
    """
    (height, width), rows = picture.size, picture.statistics_rows
    for start in range(0, height, rows):
        report(stage, start, height)
        stop = min(start + rows, height)
        first, last = torch.searchsorted(pixels, torch.tensor([start, stop]) * width).tolist()
        if every or first < last:
            yield picture.tile(start, stop, margin), pixels[first:last] - start * width


def patches_at(guide: Tensor, tile: Tile, chosen: Tensor, size: int) -> Tensor:
    """Unweighted patches (1, C p^2, n) around the chosen pixels of a tile with the guide (1, C, H, W)."""
    padded = pad_border(guide, size // 2)[..., tile.halo[0] :, :]
    columns, stride = guide.shape[-1], padded.shape[-1]
    corners = chosen // columns * stride + chosen % columns
    offsets = torch.arange(size)
    places = (offsets[:, None] * stride + offsets).reshape(-1, 1) + corners  # (p^2, n)
    return padded[0].flatten(1)[:, places].flatten(0, 1)[None]


def scaled_patches(patches: Tensor, pixels: Tensor, picture: Picture, recipe: GuideFeatures) -> Tensor:
    """Features (1, D, n), as of :class:`GuideFeatures`, from patches (1, C p^2, n) and indices of their pixels."""
    window = recipe.patch_weights
    channels = patches.shape[1] // window.numel()
    scale = (window / channels).sqrt() / torch.as_tensor(recipe.photometric_bandwidth, dtype=window.dtype)
    features = patches * scale.reshape(1, 1, -1, 1).expand(1, channels, -1, 1).reshape(1, -1, 1)
    if recipe.spatial_bandwidth is None:
        return features
    places = torch.stack([pixels // picture.size[1], pixels % picture.size[1]])
    return torch.cat([features, recipe.coordinates(places.to(recipe.patch_weights)).to(features)], dim=1)


EVEN_SHARE = 0.1  # share of a sample that is spread evenly over the picture


class Draws:
    """A random sample of about ``count`` pixels of a picture, in which rare pixels are more likely than common ones.

    Estimated sums have the largest errors where few pixels contribute: from an even sample of a million pixels, the
    rarest patches of a photograph are off by two grey levels and more. The leverage score of a pixel, ``d^2 |u|^2``, is
    its own weight in its filtered value, 1 over the number of similar pixels; sampling in proportion to it draws
    equally many pixels of every kind.
    """

    def __init__(self, pilot: Pilot, columns: Columns, count: int, pixels: int) -> None:
        """``columns`` are the columns of the pilot's sample."""
        self.completed, self.seed, self.even = pilot.completed, pilot.seed, EVEN_SHARE * count / pixels
        weight = float(pilot.sample.weights.max())
        self.rate = _rate(self.leverage(pilot.sample, columns), weight, self.even, count)

    def leverage(self, block: Block, columns: Columns) -> Tensor:
        """Leverage scores (n,) in float64 of the pixels of a block, given their columns."""
        length = 1 - block.diagonal if self.completed else columns.factor.square().sum(1)
        return (columns.scaling.square() * length)[0].double()

    def __call__(self, block: Block, columns: Columns) -> Block:
        """Draw pixels from a block."""
        likely = (self.even + self.rate * self.leverage(block, columns)).clamp(max=1.0) * (block.weights[0] > 0)
        chosen, counts = draw(likely, np.random.default_rng([self.seed, block.start_row]))
        weights = (counts / likely[chosen]).to(block.weights)[None] * block.weights[:, chosen]
        factor, diagonal, image = (planes[..., chosen] for planes in (block.factor, block.diagonal, block.image))
        return Block(factor, diagonal, weights, image=image)


def draw(rates: Tensor, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Draw pixels with given expected counts, one from every run of pixels whose rates sum to 1.

    Neighbouring pixels are similar, so that a sample without gaps and clusters gives sums several times as accurate as
    independent draws. The position within a run is random: a fixed one could coincide with the period of a texture.

    Args:
        rates: expected counts (n,) in (0, 1], float64. A pixel of rate 1 is drawn exactly once, others at most twice.
        generator: source of randomness for the positions.

    Returns:
        The indices (k,) of the drawn pixels, ascending, and how often each was drawn, (k,).

    Example:
        >>> draw(torch.tensor([1.0, 0.5, 0.5, 1.0], dtype=torch.float64), np.random.default_rng(0))
        (tensor([0, 2, 3]), tensor([1, 1, 1]))
    """
    certain = rates >= 1
    summed = (rates * ~certain).cumsum(0)
    ticks = np.arange(math.ceil(float(summed[-1])))
    places = torch.from_numpy(ticks + generator.random(len(ticks)))
    drawn = torch.searchsorted(summed, places[places < summed[-1]], right=True)
    counts = torch.bincount(drawn, minlength=len(rates)) + certain
    chosen = counts.nonzero().squeeze(1)
    return chosen, counts[chosen]


def _rate(leverage: Tensor, weight: float, even: float, count: int) -> float:
    """Find the factor at which about ``count`` pixels are drawn, given the leverage scores of an even sample."""
    low, high = 0.0, 1 / max(float(leverage.min()), 1e-12)
    for _ in range(60):
        middle = (low + high) / 2
        expected = weight * float((even + middle * leverage).clamp(max=1.0).sum())
        low, high = (middle, high) if expected < count else (low, middle)
    return low
