"""A picture that is read by rows to the filter and the masks of the whole, a few M-vectors each."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.detail import MASK_BANDWIDTH, SHARED
from nlfilter_torch.filtering.fitted import FittedFilter
from nlfilter_torch.filtering.masks import check_negative, mask_of_exponents, squared_distances
from nlfilter_torch.operator.eigenvalue_bound import is_bounded
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.scaling import PixelScaling
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.tiled.sampling import Image, Report, all_blocks, sample_by_influence, take_pilot
from nlfilter_torch.tiled.sources import Picture, RowSource, Tile
from nlfilter_torch.tiled.statistics import CONVERGED, Block, Sums, balance_by_passes, limiter_by_passes, sum_up
from nlfilter_torch.tiled.tiles import Passes, row_by_row


def for_masks(passes: Passes) -> Passes:
    """With half the sample: patches in colour are three times as large."""
    return replace(passes, sample=max(1, passes.sample // 2))


@torch.no_grad()
@full_precision
def fit_picture(
    picture: Picture,
    order: int,
    passes: Passes,
    *,
    channels: Literal["luminance", "all"],
    **options: Any,
) -> FittedFilter:
    """The filter of a picture, as :func:`fit_filter` makes it of an image in memory."""

    def image(colours: Tensor) -> Tensor:
        return reduce_channels(colours, "luminance") if channels == "luminance" else colours

    kernel, balancing, sums = _gather(picture, image, order, passes, spectral=False, **options)
    return FittedFilter(kernel, balancing, sums.coefficients(), sums.explained())


@torch.no_grad()
@full_precision
def fit_spectrum(picture: Picture, passes: Passes, **options: Any) -> tuple[Kernel, RitzPairs]:
    """Kernel and eigenvalues of a picture, with the options of :func:`nonlocal_operator`."""
    kernel, _, sums = _gather(picture, lambda c: c[:, :1], 1, passes, spectral=True, **options)
    return kernel, RitzPairs.of_sums(sums.grams, sums.dtype)


@dataclass(frozen=True, eq=False)
class FittedMasks:
    """Diffusion masks of regions of a picture, at any of its tiles. Paper: eq. (15) to (17).

    Attributes:
        kernel: of the operator that compares colours.
        balancing: what the scaling of a pixel is a function of.
        core: (1, M, M), from a column of F to coordinates of the diffusion map.
        centres: of the regions in these coordinates, (1, K, M).
        others: of pixels that the masks stay away from, (1, 1 or K, M), or None.
        scale: of squared distances: the number of pixels over the width.
    """

    kernel: Kernel
    balancing: PixelScaling
    core: Tensor
    centres: Tensor
    others: Tensor | None
    scale: float

    def __call__(self, tile: Tile) -> Tensor:
        """Masks (1, K, h, W) in (0, 1]."""
        return row_by_row(self.kernel, tile, self.masks)

    def masks(self, features: Tensor) -> Tensor:
        """Of pixels with features (1, D, n): (1, K, n)."""
        coordinates = self.core.to(features) @ _columns(self.kernel, features, self.balancing)

        def exponents(centres: Tensor) -> Tensor:
            return self.scale * squared_distances(coordinates, centres.to(coordinates))

        return mask_of_exponents(exponents(self.centres), None if self.others is None else exponents(self.others))


@torch.no_grad()
@full_precision
def fit_masks(
    picture: Picture,
    regions: RowSource,
    negative: RowSource | None,
    passes: Passes,
    *,
    time: float,
    width: float,
    **options: Any,
) -> FittedMasks:
    """The masks of regions, rows (H, W, K) of weights, as :func:`enhance` has them.

    Raises:
        ValueError: if a region does not fit, is negative or empty.
    """
    for rows, name in ((regions, "regions"), (negative, "negative")):
        if rows is not None and (tuple(rows.shape[:2]) != picture.size or len(rows.shape) != 3):
            raise ValueError(
                f"{name} must have the shape {(*picture.size, 'K')}, the picture's and the number of regions, got "
                f"{tuple(rows.shape)}; resize them"
            )
    check_negative(1 if negative is None else negative.shape[2], regions.shape[2])
    shared = {name: value for name, value in options.items() if name in SHARED}
    shared |= {"photometric_bandwidth": MASK_BANDWIDTH, "guide_channels": "all"}
    kernel, balancing, sums = _gather(picture, lambda c: c, 1, for_masks(passes), spectral=True, **shared)
    core = RitzPairs.of_sums(sums.grams, sums.dtype).basis(lambda eigenvalues: eigenvalues.pow(time))

    def centres(rows: RowSource, name: str) -> Tensor:
        return (core @ _region_means(picture, rows, name, kernel, balancing, passes.report)).mT

    others = None if negative is None else centres(negative, "negative")
    return FittedMasks(kernel, balancing, core, centres(regions, "regions"), others, picture.pixels / width)


def _region_means(
    picture: Picture, regions: RowSource, name: str, kernel: Kernel, balancing: PixelScaling, report: Report
) -> Tensor:
    """The mean column of F over each region, (1, M, K) in float64."""
    margin, rows = kernel.recipe.patch_weights.shape[0] // 2, picture.statistics_rows
    total = torch.zeros(1, balancing.moment.shape[1], regions.shape[2], dtype=torch.float64)
    weight = torch.zeros(regions.shape[2], dtype=torch.float64)
    for start in range(0, picture.size[0], rows):
        report("Finding regions", start, picture.size[0])
        stop = min(start + rows, picture.size[0])
        weights = torch.from_numpy(np.array(regions[start:stop], np.float32)).flatten(0, 1)  # (n, K)
        if bool((weights < 0).any()) or not bool(torch.isfinite(weights).all()):
            raise ValueError(f"{name} must be non-negative and finite, got others; clamp them at 0")
        if not bool((weights > 0).any()):
            continue
        tile = picture.tile(start, stop, margin)
        columns = _columns(kernel, kernel.recipe(tile.pixels, origin=tile.origin, halo=tile.halo), balancing)
        total += (columns @ weights.to(columns)).double()
        weight += weights.double().sum(0)
    if not bool((weight > 0).all()):
        raise ValueError(f"{name} must each hold a pixel of positive weight, got an empty one; select some pixels")
    return total / weight


def _columns(kernel: Kernel, features: Tensor, balancing: PixelScaling) -> Tensor:
    """F (1, M, n) of pixels with features (1, D, n)."""
    factor, diagonal = kernel.factor(features)
    return factor * balancing(factor, diagonal)[0].unsqueeze(1)


def _gather(
    picture: Picture,
    image: Image,
    order: int,
    passes: Passes,
    *,
    spectral: bool,
    **options: Any,
) -> tuple[Kernel, PixelScaling, Sums]:
    """Kernel, scaling, and the sums for the first ``order`` powers of W."""
    report = passes.report
    pilot = take_pilot(picture, image, report, **options)
    kernel, total = pilot.kernel, pilot.balancing
    completed = kernel.completion == "diagonal"

    def every(stage: str) -> Iterator[Block]:
        return all_blocks(picture, kernel, image, report, stage)  # the kernel as it is by then

    def some(stage: str) -> Iterator[Block]:
        report(stage, 0, 1)
        return (block for part in chosen for block in part.blocks(kernel))

    drawn = passes.sample < picture.pixels
    if drawn:
        chosen = sample_by_influence(picture, pilot, image, passes.sample, report, spectral=spectral)
        total = balance_by_passes(lambda: some("Balancing"), total, completed=completed)
    part = some if drawn and passes.statistics == "sample" else every
    if part is every:
        total = balance_by_passes(lambda: every("Balancing"), total, completed=completed)
    balancing = PixelScaling(total, completed, CONVERGED[kernel.landmarks.dtype])
    if is_bounded(options.get("landmarks", "kmeans"), picture.pixels, total.shape[1]):
        kernel = replace(kernel, limiter=limiter_by_passes(lambda: part("Bounding"), balancing))
    return kernel, balancing, sum_up(lambda: part("Summing up"), balancing, order)
