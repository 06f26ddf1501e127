"""The guide of a picture that is read by rows, and samples of it.

One pass over the picture yields the pilot: the kernel of its filter and an even sample of its pixels. A second sample,
for the sums that define the filter, favours rare pixels and has no gaps.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.blocks import stratified
from nlfilter_torch.core.checks import check_choice
from nlfilter_torch.core.workers import in_order, single_threaded
from nlfilter_torch.operator.assignment import Layout
from nlfilter_torch.operator.columns import Columns
from nlfilter_torch.operator.features import (
    GuideFeatures,
    bandwidth_of_gradient,
    gradients,
    pad_border,
    reduce_channels,
    unit_window,
)
from nlfilter_torch.operator.landmarks import candidate_pixels, condense
from nlfilter_torch.operator.nystrom import inverse_cholesky
from nlfilter_torch.operator.operator import Kernel
from nlfilter_torch.operator.option_checks import check_bandwidths, check_construction, landmark_count
from nlfilter_torch.operator.options import Completion, Construction, GuideChannels, Sampling, SpatialBandwidth
from nlfilter_torch.operator.orientation import (
    ORIENTATIONS,
    Orientation,
    canonical_points,
    orientation_of,
    orientation_sums,
    source_pixels,
)
from nlfilter_torch.operator.sinkhorn import sinkhorn_balance
from nlfilter_torch.photo.picture.source import Guide
from nlfilter_torch.photo.tiled.pictures import Picture, Tile
from nlfilter_torch.photo.tiled.statistics import Block, Result

PILOT = 1 << 15  # pixels of the first sample: their factor, 13 MB at m = 100, is balanced in memory
PILOT_TOLERANCE = 1e-3  # tolerance of its balancing, which is an initial guess
CHUNK = 1 << 16  # scribbled pixels whose factor is in memory at once

Report = Callable[[str, int, int], None]


def in_silence(stage: str, done: int, rows: int) -> None:
    """Report nothing."""


class GuidePicture(Picture):
    """The guide of a picture.

    Attributes:
        picture: whose guide this is.
        guide: computes the guide from the picture.
        stored: the whole guide (1, C, H, W), if kept in memory.
    """

    def __init__(self, picture: Picture, guide: Guide) -> None:
        super().__init__(picture.source, picture.name)
        self.checks_scale = picture.checks_scale
        self.picture, self.guide = picture, guide
        self.stored: Tensor | None = None

    def __getstate__(self) -> dict[str, object]:
        """The guide in another process, which computes it from the picture."""
        return self.__dict__ | {"stored": None}

    def store(self, rows: int, workers: int) -> None:
        """Compute the whole guide in tiles of ``rows``, and keep it in memory for further passes."""
        planes: Tensor | None = None
        tiles = self.picture.tiles(self.margin, rows)
        for start, part in in_order(self._start_and_guide, tiles, workers):
            if planes is None:
                planes = part.new_empty(*part.shape[:2], *self.size)
            planes[:, :, start : start + part.shape[2]] = part
        self.stored = planes

    def _start_and_guide(self, tile: Tile) -> tuple[int, Tensor]:
        """The first row of a tile of the picture, and its guide."""
        return tile.start, self.seen(tile, 0).pixels

    @property
    def margin(self) -> int:
        """Number of pixels around a pixel that are read to compute its guide."""
        return 0 if self.stored is not None else self.guide.margin

    def tile(self, start: int, stop: int, margin: int) -> Tile:
        """Read a tile of the guide, as :meth:`Picture.tile`."""
        return self.seen(super().tile(start, stop, margin + self.margin), margin)

    def seen(self, tile: Tile, margin: int) -> Tile:
        """The guide, with ``margin``, of a tile of the picture that has a margin large enough to compute it."""
        stop = tile.start + tile.stored.shape[0]
        halo = (min(tile.start, margin), min(self.size[0] - stop, margin))
        if self.stored is not None:
            stored = self.stored[:, :, tile.start - halo[0] : stop + halo[1]]
            return Tile(tile.start, partial(_unchanged, stored), halo, tile.stored)
        return Tile(tile.start, partial(self._computed, tile, halo), halo, tile.stored)

    def _computed(self, tile: Tile, halo: tuple[int, int]) -> Tensor:
        """The guide of a tile of the picture and of a halo of rows around it."""
        above, below = (min(have, want + self.guide.margin) for have, want in zip(tile.halo, halo, strict=True))
        image = tile.pixels[:, :, tile.halo[0] - above : tile.pixels.shape[2] - tile.halo[1] + below]
        return self.guide(image)[:, :, above - halo[0] : image.shape[2] - below + halo[1]]


def _unchanged(planes: Tensor) -> Tensor:
    return planes


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
    """A pass over every pixel of a picture.

    Attributes:
        picture: guide of the picture.
        kernel: computes the columns of the pixels.
        report: called with the progress of the ``stage``.
        stage: name for the progress.
        workers: number of tiles computed at once.
        cache: columns cached from earlier passes.
    """

    picture: GuidePicture
    kernel: Kernel
    report: Report
    stage: str
    workers: int
    cache: ColumnCache

    def __call__(self, function: Callable[[Block], Result]) -> Iterator[Result]:
        """Apply a function to each block, and yield the results in order."""
        picture = self.picture
        height, rows = picture.size[0], picture.statistics_rows
        tiles = picture.picture.tiles(self._radius + picture.margin, rows)
        self.report(self.stage, 0, height)
        for number, result in enumerate(in_order(partial(self._applied, function), tiles, self.workers), start=1):
            yield result
            self.report(self.stage, min(number * rows, height), height)

    def _applied(self, function: Callable[[Block], Result], tile: Tile) -> Result:
        return function(self._block(tile))

    @property
    def _radius(self) -> int:
        """Radius of a patch."""
        return self.kernel.recipe.patch_weights.shape[0] // 2

    def _block(self, tile: Tile) -> Block:
        image, first = tile.inner.flatten(2), tile.start * self.picture.size[1]
        columns = self.cache.find(slice(first, first + image.shape[2]))
        if columns is None:
            guide = self.picture.seen(tile, self._radius)
            columns = self.kernel.columns(guide.pixels, origin=guide.origin, halo=guide.halo)
            self.cache.keep(first, columns)
        return Block(*columns, image, torch.ones_like(columns[1]), tile.start)


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


@dataclass(frozen=True)
class PatchReader:
    """Reads the patches and colours of chosen pixels of a tile, and measures its gradient and orientation.

    Attributes:
        picture: guide of the picture.
        patch_size: width of a patch in pixels.
        guide_channels: channels of the guide that are compared.
        measures_gradient: whether the gradient is needed; it is 0 otherwise.
    """

    picture: GuidePicture
    patch_size: int
    guide_channels: GuideChannels
    measures_gradient: bool

    @property
    def margin(self) -> int:
        """Number of rows of the guide around a tile that are read."""
        return max(self.patch_size // 2, 1)

    def __call__(self, part: tuple[Tile, Tensor]) -> tuple[Tensor, Tensor, float, Tensor]:
        """Patches (1, C p^2, n) and colours (1, C, n) of the pixels, and two sums over all pixels of the tile.

        These are the sum of the gradients, and those of :func:`orientation_sums`, (1, C, 6, 6).
        """
        tile, chosen = part
        seen = self.picture.seen(tile, self.margin)
        guide = reduce_channels(seen.pixels, self.guide_channels)
        gradient = 0.0
        if self.measures_gradient:
            gradient = float(gradients(guide, seen.halo).double().mean((0, 1)).sum())
        rows = guide[:, :, seen.halo[0] : guide.shape[2] - seen.halo[1]]
        sums = orientation_sums(rows, tile.start, self.picture.size)
        return patches_at(guide, seen, chosen, self.patch_size), tile.inner.flatten(2)[:, :, chosen], gradient, sums


def take_pilot(
    picture: GuidePicture,
    report: Report,
    workers: int = 1,
    *,
    patch_size: int = 5,
    photometric_bandwidth: float | Literal["auto"] = "auto",
    spatial_bandwidth: SpatialBandwidth | None = None,
    num_landmarks: int = 100,
    landmarks: Sampling = "kmeans",
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "luminance",
    generator: torch.Generator | None = None,
) -> Pilot:
    """Compute bandwidth, landmarks and an initial balancing in one pass over the picture.

    Bandwidth and landmarks are those of :func:`nonlocal_operator`, to rounding.
    """
    check_choice(guide_channels, "guide_channels", ("luminance", "all"))
    method = Construction(num_landmarks=num_landmarks, landmarks=landmarks, completion=completion, generator=generator)
    check_construction(method)
    window = unit_window(patch_size, None).to(picture.dtype)
    check_bandwidths(photometric_bandwidth, spatial_bandwidth)
    num_landmarks = landmark_count(method, picture.pixels)

    generator = torch.Generator().manual_seed(0) if generator is None else generator
    drawn = candidate_pixels(picture.size, num_landmarks, landmarks, generator).cpu()
    rest = torch.Generator().manual_seed(int(drawn.sum()) % 2**32)  # ``generator`` is for the landmarks alone
    even = stratified(picture.pixels, min(PILOT, picture.pixels), rest)
    # The orientation of the picture, which decides which pixels are candidates, is known after the pass.
    turned = landmarks == "kmeans" and len(drawn) > num_landmarks
    candidates = source_pixels(torch.arange(ORIENTATIONS if turned else 1), picture.size, drawn)
    wanted = torch.cat([candidates.flatten(), even])
    reader = PatchReader(picture, patch_size, guide_channels, isinstance(photometric_bandwidth, str))
    parts = visit(picture.picture, reader.margin + picture.margin, wanted.sort().values, report, "Looking")
    patches, values, slopes, sums = zip(*in_order(reader, parts, workers), strict=True)
    if isinstance(photometric_bandwidth, str):
        photometric_bandwidth = float(
            bandwidth_of_gradient(torch.tensor(sum(slopes) / picture.pixels, dtype=torch.float64))
        )
    order = torch.empty_like(wanted)
    order[wanted.argsort()] = torch.arange(len(wanted))  # position of each wanted pixel in reading order
    recipe = GuideFeatures(window, photometric_bandwidth, spatial_bandwidth, guide_channels)
    total = torch.stack(sums).sum(0)
    orientation = orientation_of(total, patches[0].shape[1] // patch_size**2)
    if not turned:
        orientation = Orientation(torch.zeros(1, dtype=torch.long))
    first = int(orientation.numbers) * len(drawn)
    used = torch.cat([torch.arange(first, first + len(drawn)), torch.arange(candidates.numel(), len(wanted))])
    features = scaled_patches(torch.cat(patches, dim=2)[:, :, order[used]], wanted[used], picture, recipe)
    image = torch.cat(values, dim=2)[:, :, order[candidates.numel() :]]
    weights = torch.full((1, len(even)), picture.pixels / len(even), dtype=picture.dtype)
    with single_threaded(workers):  # so few pixels that a second thread would wait most of the time
        subset, coordinates = features[:, :, : len(drawn)], None
        if spatial_bandwidth is not None:
            coordinates = coordinates_of(
                source_pixels(orientation.numbers, picture.size, drawn, flipped=False)[0], picture, recipe
            )
        canonical = canonical_points(
            subset, orientation, Layout(patch_size, spatial_bandwidth is not None), coordinates
        )
        points = condense(subset, num_landmarks, generator, canonical)
        kernel = Kernel(points, inverse_cholesky(points), completion, features=recipe)
        columns = kernel.factor(features[:, :, len(drawn) :])
        balancing = sinkhorn_balance(
            *columns, tolerance=PILOT_TOLERANCE, completed=completion == "diagonal", weights=weights
        )
        return Pilot(kernel, Block(*columns, image, weights), balancing.moment, rest.initial_seed())


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
    return torch.cat([features, coordinates_of(pixels, picture, recipe).to(features)], dim=1)


def coordinates_of(pixels: Tensor, picture: Picture, recipe: GuideFeatures) -> Tensor:
    """Features (1, 2, n) of the rows and columns of pixels with the indices (n,)."""
    places = torch.stack([pixels // picture.size[1], pixels % picture.size[1]])
    return recipe.coordinates(places.to(recipe.patch_weights))


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
        weight = float(pilot.sample.weights[0, 0])
        self.rate = _rate(self.leverage(pilot.sample, columns), weight, self.even, count)

    def leverage(self, block: Block, columns: Columns) -> Tensor:
        """Leverage scores (n,) in float64 of the pixels of a block, given their columns."""
        length = 1 - block.diagonal if self.completed else columns.factor.square().sum(1)
        return (columns.scaling.square() * length)[0].double()

    def __call__(self, block: Block, columns: Columns) -> Block:
        """Draw pixels from a block."""
        likely = (self.even + self.rate * self.leverage(block, columns)).clamp(max=1.0)
        chosen, counts = draw(likely, np.random.default_rng([self.seed, block.start_row]))
        weights = (counts / likely[chosen]).to(block.weights)[None]
        factor, diagonal, image = (planes[..., chosen] for planes in (block.factor, block.diagonal, block.image))
        return Block(factor, diagonal, image, weights)


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
