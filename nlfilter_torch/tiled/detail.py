"""Detail sliders for pictures whose factor exceeds memory: statistics from passes or a sample, then tile by tile."""

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from torch import Tensor

from nlfilter_torch.core.checks import check_alpha, check_choice, check_count, check_positive
from nlfilter_torch.edits.colour import edit_luminance
from nlfilter_torch.edits.parameters import DETAIL
from nlfilter_torch.filtering.filters import blend_regions, blend_sliders
from nlfilter_torch.filtering.fitted import FittedFilter
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.tiled.fitting import FittedMasks, fit_masks, fit_picture, for_masks
from nlfilter_torch.tiled.sampling import Report
from nlfilter_torch.tiled.sources import Picture, Rows, RowSource, RowTarget, Tile
from nlfilter_torch.tiled.tiles import SAMPLE, Passes, Statistics, check_target, fill, in_silence, rows_that_fit


def stream_detail(
    source: RowSource,
    target: RowTarget,
    alpha: Tensor,
    regions: RowSource | None = None,
    *,
    negative: RowSource | None = None,
    residual: float | None = None,
    time: float = DETAIL.defaults["time"],
    width: float = 4.0,
    channels: Literal["luminance", "all"] = DETAIL.defaults["channels"],
    statistics: Statistics = "sample",
    sample: int = SAMPLE,
    tile_rows: int | None = None,
    memory: int = 1 << 30,
    report: Report | None = None,
    **options: Any,
) -> None:
    """Filter a picture of any size, with only some of its rows in memory at once.

    The whole picture shares landmarks, balancing and coefficients. Given these, the result at a pixel depends only on
    its own patch, so tiles are exact: there are no seams, and the size of the tiles does not matter.

    Args:
        source: rows (H, W) or (H, W, S) of 8 or 16 bits or floats: a numpy array or memory map, an array of zarr,
            anything that returns rows for a slice. One or three channels are colours; one more is transparency, which
            is copied. Integers are scaled to [0, 1].
        target: receives the rows in order, by assignment to a slice; of the source's shape and any dtype.
        alpha: sliders (k+1,), as of :func:`~nlfilter_torch.polynomial_filter`; with regions (K, k+1), a row for each,
            or (k+1,) for all.
        regions: rows (H, W, K), non-negative weights of the pixels of K regions; similar pixels are edited, as by
            :func:`~nlfilter_torch.enhance`. None edits the whole picture.
        negative: rows (H, W, 1 or K), weights of pixels whose similar pixels are left out, likewise.
        residual: as of :func:`~nlfilter_torch.polynomial_filter`; with it statistics are full, since the part that
            the eigenvectors capture depends on rare pixels that a sample lacks.
        time: diffusion time of the regions' masks; larger extends them further.
        width: squared diffusion distance at which a mask has fallen to 1/e.
        channels: ``"luminance"`` edits brightness and keeps the colours, ``"all"`` edits every channel.
        statistics: ``"sample"`` balances the filter and computes its coefficients on a sample of the pixels that
            favours rare patches, and reads the source twice; ``"full"`` continues from there with all pixels, in three
            or four passes that each cost more than the output.
        sample: approximate number of pixels of that sample; with as many as the picture has, statistics are full.
        tile_rows: rows that are computed at once; None is as many as fit in ``memory``.
        memory: bytes that may be used, besides those of source and target.
        report: called with the name of a stage, the part done and the total.
        **options: of :func:`~nlfilter_torch.nonlocal_operator` but ``tolerance`` and ``patch_weights``; bandwidths are
            numbers.

    Raises:
        TypeError, ValueError: if an argument does not fit, or the source changes its size during the work.
        MemoryError: if the samples or a single row take more than ``memory``.

    Example:
        >>> import torch
        >>> picture = np.random.default_rng(0).integers(0, 256, (60, 40, 3), np.uint8)
        >>> edited = np.empty_like(picture)
        >>> stream_detail(picture, edited, torch.ones(4), num_landmarks=20, tile_rows=16)
        >>> np.array_equal(edited, picture)
        True
    """
    check_target(target, source)
    passes = Passes(np.dtype(target.dtype).name, statistics, sample, tile_rows, memory, report or in_silence)
    rows = detail_rows(
        passes,
        source,
        alpha,
        regions,
        negative=negative,
        residual=residual,
        time=time,
        width=width,
        channels=channels,
        **options,
    )
    fill(target, rows)


def detail_rows(
    passes: Passes,
    source: RowSource,
    alpha: Tensor,
    regions: RowSource | None = None,
    *,
    negative: RowSource | None = None,
    outside: Tensor | None = None,
    residual: float | None = None,
    time: float = DETAIL.defaults["time"],
    width: float = 4.0,
    channels: Literal["luminance", "all"] = DETAIL.defaults["channels"],
    name: str = "source",
    **options: Any,
) -> Rows:
    """The rows (h, W, S) of :func:`stream_detail`, computed in order as they are requested.

    The sliders ``outside`` (k+1,) apply to pixels similar to no region. ``name`` is the source's in error messages.
    """
    picture = Picture(source, name)
    check_alpha(alpha, dimensions=(1,) if regions is None else (1, 2))
    check_positive(time, "time")
    check_positive(width, "width")
    check_choice(channels, "channels", ("luminance", "all"))
    if residual is not None and not math.isfinite(residual):
        raise ValueError(f"residual must be finite, got {residual}; pass a number or None")
    rows = rows_in_memory(picture, passes, alpha.shape[-1], regions is not None, **options)
    generator, masks = options.get("generator"), None
    if regions is not None:
        if alpha.ndim == 2 and len(alpha) != regions.shape[-1]:
            raise ValueError(
                f"alpha must have a row for each of the {regions.shape[-1]} regions, got {len(alpha)}; add or drop some"
            )
        alpha = alpha.expand(regions.shape[-1], -1)
        own = {} if generator is None else {"generator": generator.clone_state()}  # as if each were computed alone
        masks = fit_masks(picture, regions, negative, passes, time=time, width=width, **options | own)
    elif negative is not None:
        raise ValueError("negative must come with regions, got it alone; select what is to be edited, too")
    exact = passes if residual is None else replace(passes, statistics="full")
    fitted = fit_picture(picture, alpha.shape[-1] - 1, exact, channels=channels, **options)

    def edit(tile: Tile) -> Tensor:
        return _edit(tile, fitted, masks, alpha, outside, residual, channels)

    yield from passes.work_out(picture, edit, fitted.kernel.recipe.patch_weights.shape[0] // 2, rows)


def _edit(
    tile: Tile,
    fitted: FittedFilter,
    masks: FittedMasks | None,
    alpha: Tensor,
    outside: Tensor | None,
    residual: float | None,
    channels: Literal["luminance", "all"],
) -> Tensor:
    """The colours (1, C, h, W) of a tile's rows under the sliders."""
    image = tile.pixels if channels == "all" else reduce_channels(tile.pixels, "luminance")

    def filtered(sliders: Tensor) -> Tensor:
        return fitted(image, sliders, tile.pixels, residual=residual, origin=tile.origin, halo=tile.halo, by_rows=True)

    def edit(inner: Tensor) -> Tensor:
        if masks is None:
            return filtered(alpha)
        if outside is not None:
            return filtered(blend_sliders(masks(tile), alpha, outside))
        return blend_regions(inner, masks(tile), alpha, filtered)

    return edit(tile.inner) if channels == "all" else edit_luminance(tile.inner, edit)


def rows_in_memory(
    picture: Picture,
    passes: Passes,
    sliders: int,
    masked: bool,
    *,
    num_landmarks: int = 100,
    patch_size: int = 5,
    guide_channels: str = DETAIL.defaults["channels"],
    **_: Any,
) -> int:
    """Rows of a tile that fit in the memory of the passes.

    Raises:
        MemoryError: if there is not one, or no room for the samples.
    """
    check_count(num_landmarks, "num_landmarks")
    check_count(patch_size, "patch_size")
    in_colour = masked or guide_channels == "all"
    planes = patch_size**2 * (picture.colours if in_colour else 1)
    floats = planes + (3 * sliders + 8) * picture.colours  # features, and some images
    passes = for_masks(passes) if masked else passes
    return rows_that_fit(picture, passes, floats=floats, planes=planes, num_landmarks=num_landmarks)
