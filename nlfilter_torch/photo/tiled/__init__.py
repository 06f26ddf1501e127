"""Pictures larger than memory: the filter of the whole picture, applied in tiles of rows.

Its statistics come from passes over the picture or from a sample of its pixels.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_alpha
from nlfilter_torch.photo.declared.parameters import COLORIZE, DETAIL, RECOLOR
from nlfilter_torch.photo.edits.colorize import colorize
from nlfilter_torch.photo.edits.detail import enhance
from nlfilter_torch.photo.edits.recolor import recolor
from nlfilter_torch.photo.picture.source import Fitted
from nlfilter_torch.photo.tiled.pictures import Picture, RowSource, RowTarget
from nlfilter_torch.photo.tiled.sampling import Report, in_silence
from nlfilter_torch.photo.tiled.source import Tiled
from nlfilter_torch.photo.tiled.tiles import SAMPLE, Passes, Statistics, check_target, fill
from nlfilter_torch.photo.tiled.workers import single_threaded

__all__ = ["stream_colorize", "stream_detail", "stream_recolor"]


def stream_detail(
    source: RowSource,
    target: RowTarget,
    alpha: Tensor,
    regions: RowSource | None = None,
    *,
    negative: RowSource | None = None,
    residual: float | None = None,
    reach: float = DETAIL.defaults["reach"],
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
        alpha: sliders (k+1,), as in :func:`~nlfilter_torch.polynomial_filter`; with regions (K, k+1), a row for each,
            or (k+1,) for all.
        regions: rows (H, W, K) in [0, 1], above 0 on some or all pixels of each of K regions, as in
            :func:`~nlfilter_torch.enhance`. None edits the whole picture.
        negative: rows (H, W, 1 or K) in [0, 1], above 0 on some pixels outside all regions, or outside region k.
        residual: as in :func:`~nlfilter_torch.polynomial_filter`; if given, statistics are full, since the part that
            the eigenvectors capture depends on rare pixels that a sample lacks.
        reach: of the regions' masks, in [0, 1); a larger reach includes less similar pixels.
        channels: ``"luminance"`` edits brightness and keeps the colours, ``"all"`` edits every channel.
        statistics: ``"sample"`` balances the filter and computes its coefficients on a sample of the pixels that
            favours rare patches, and reads the source twice; ``"full"`` continues from there with all pixels, in three
            or four passes that each cost more than the output.
        sample: approximate number of pixels of that sample; with as many as the picture has, statistics are full.
        tile_rows: rows of a tile; None is as many as fit in ``memory``. With 256 MB or more, it is rounded to a
            multiple of the rows that make 16,384 pixels.
        memory: bytes that may be used, besides those of source and target.
        report: called with the name of a stage, the part done and the total.
        **options: ``threshold``, ``limits``, ``viewing_size`` and bandwidths of :func:`~nlfilter_torch.enhance`, and
            further ones of :func:`~nlfilter_torch.nonlocal_operator` except ``tolerance`` and ``patch_weights``;
            bandwidths, including ``mask_bandwidth``, are numbers.

    Raises:
        TypeError, ValueError: if an argument does not fit, or the source changes its size while it is read.
        MemoryError: if the samples or a single row take more than ``memory``.

    Example:
        >>> import numpy as np
        >>> picture = np.random.default_rng(0).integers(0, 256, (60, 40, 3), np.uint8)
        >>> edited = np.empty_like(picture)
        >>> stream_detail(picture, edited, torch.ones(4), num_landmarks=20, tile_rows=16)
        >>> np.array_equal(edited, picture)
        True
    """
    check_alpha(alpha, dimensions=(1,) if regions is None else (1, 2))
    options |= {"negative": negative, "residual": residual, "reach": reach, "channels": channels}
    fit = partial(enhance.fit, alpha=alpha, regions=regions, **options)
    _stream(source, target, fit, statistics, sample, tile_rows, memory, report)


def stream_recolor(
    source: RowSource,
    target: RowTarget,
    strokes: RowSource,
    stroke_mask: RowSource | None = None,
    *,
    keep: RowSource | None = None,
    reach: float = RECOLOR.defaults["reach"],
    photometric_bandwidth: float = RECOLOR.defaults["photometric_bandwidth"],
    patch_size: int = RECOLOR.defaults["patch_size"],
    statistics: Statistics = "sample",
    sample: int = SAMPLE,
    tile_rows: int | None = None,
    memory: int = 1 << 30,
    report: Report | None = None,
    **options: Any,
) -> None:
    """Recolour a picture of any size, as :func:`~nlfilter_torch.recolor` does in memory.

    Given the sums over all pixels and over the scribbled ones, the colour of a pixel depends only on its own patch, so
    there are no seams, and the size of the tiles does not matter.

    Args:
        source: rows (H, W, 3) in RGB or (H, W, 4) with transparency, as in :func:`stream_detail`.
        target: receives the rows; of the source's shape.
        strokes: scribbles as rows (H, W, 3), RGB, read under ``stroke_mask`` only; or (H, W, 4), whose last channel is
            the mask. Integers are scaled to [0, 1].
        stroke_mask: rows (H, W) or (H, W, 1) in [0, 1] or of bool, above 0 on scribbles; None if ``strokes`` has four
            channels.
        keep: rows like those of ``stroke_mask``, or None, above 0 on background scribbles; pixels similar to these
            keep their colours.
        reach: as in :func:`~nlfilter_torch.recolor`, like ``photometric_bandwidth`` and ``patch_size``.
        photometric_bandwidth: in Lab units divided by 100.
        patch_size: of the patches that are compared.
        statistics: as in :func:`stream_detail`, like ``sample``, ``tile_rows``, ``memory`` and ``report``.
        sample: number of pixels.
        tile_rows: rows of a tile.
        memory: in bytes, besides that of the sources and the target.
        report: called with the name of a stage and its progress.
        **options: of :func:`~nlfilter_torch.nonlocal_operator` except ``guide_channels``, ``tolerance`` and
            ``patch_weights``.

    Raises:
        TypeError, ValueError: if an argument does not fit, there is no scribble, or a source changes its size.
        MemoryError: if the samples, the scribbled pixels or a single row take more than ``memory``.

    Example:
        >>> import numpy as np
        >>> picture = np.full((60, 40, 3), 100, np.uint8)
        >>> picture[:, 20:, 0] = 220  # the right half is reddish
        >>> strokes, recoloured = np.zeros((60, 40, 4), np.uint8), np.empty_like(picture)
        >>> strokes[20:26, 28:34] = 0, 0, 255, 255  # blue, in its midst
        >>> stream_recolor(picture, recoloured, strokes, num_landmarks=20, tile_rows=16)
        >>> bool((recoloured[:, 22:, 2] > recoloured[:, 22:, 0]).all())
        True
        >>> np.array_equal(recoloured[:, :18], picture[:, :18])
        True
    """
    picture = Picture(source)
    if picture.colours != 3:
        raise ValueError(
            f"source must have 3 or 4 channels to be recoloured, got {picture.samples}; use colorize instead"
        )
    options |= {"keep": keep, "reach": reach, "photometric_bandwidth": photometric_bandwidth, "patch_size": patch_size}
    fit = partial(recolor.fit, strokes=strokes, stroke_mask=stroke_mask, **options)
    _stream(source, target, fit, statistics, sample, tile_rows, memory, report)


def stream_colorize(
    source: RowSource,
    target: RowTarget,
    strokes: RowSource,
    stroke_mask: RowSource | None = None,
    *,
    method: Literal["regression"] = COLORIZE.defaults["method"],
    strength: float = COLORIZE.defaults["strength"],
    photometric_bandwidth: float = COLORIZE.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | None = None,
    patch_size: int = COLORIZE.defaults["patch_size"],
    num_landmarks: int = COLORIZE.defaults["num_landmarks"],
    generator: torch.Generator | None = None,
    statistics: Statistics = "sample",
    sample: int = SAMPLE,
    tile_rows: int | None = None,
    memory: int = 1 << 30,
    report: Report | None = None,
) -> None:
    """Colourise a picture of any size, as :func:`~nlfilter_torch.colorize` does in memory.

    Given the sums over all pixels and over the scribbled ones, and a reduced picture, the colour of a pixel depends
    only on its own patch and position, so there are no seams, and the size of the tiles does not matter.

    Args:
        source: rows (H, W) or (H, W, S), as in :func:`stream_detail`; colours are reduced to their luminance.
        target: receives the rows; (H, W, 3), or (H, W, 4) if the source has transparency.
        strokes: scribbles as rows (H, W, 3), RGB, read under ``stroke_mask`` only; or (H, W, 4), whose last channel is
            the mask. Integers are scaled to [0, 1].
        stroke_mask: rows (H, W) or (H, W, 1) in [0, 1] or of bool, above 0 on scribbles; None if ``strokes`` has four
            channels.
        method: ``"regression"``; k-means would need all pixels at once.
        strength: as in :func:`~nlfilter_torch.colorize`, like bandwidths, ``patch_size``, ``num_landmarks`` and
            ``generator``.
        photometric_bandwidth: in units of the image.
        spatial_bandwidth: in pixels, as in :func:`~nlfilter_torch.colorize`; None is 0.7 of the short side.
        patch_size: of the patches that are compared.
        num_landmarks: M of the operators.
        generator: source of randomness for the landmarks.
        statistics: as in :func:`stream_detail`, like ``sample``, ``tile_rows``, ``memory`` and ``report``.
        sample: number of pixels.
        tile_rows: rows of a tile.
        memory: in bytes, besides that of the sources and the target.
        report: called with the name of a stage and its progress.

    Raises:
        TypeError, ValueError: if an argument does not fit, there is no scribble, or a source changes its size.
        MemoryError: if the samples, the scribbled pixels or a single row take more than ``memory``.

    Example:
        >>> import numpy as np
        >>> grey = np.full((60, 40), 60, np.uint8)
        >>> grey[:, 20:] = 200
        >>> strokes, coloured = np.zeros((60, 40, 4), np.uint8), np.empty((60, 40, 3), np.uint8)
        >>> strokes[4:8, 4:8], strokes[4:8, -8:-4] = (0, 0, 200, 255), (200, 0, 0, 255)  # dark is blue, bright is red
        >>> stream_colorize(grey, coloured, strokes, num_landmarks=20, tile_rows=16)
        >>> red, blue = coloured[..., 0].astype(int), coloured[..., 2].astype(int)
        >>> bool((blue > red)[:, :17].all()), bool((red > blue)[:, 23:].all())
        (True, True)
    """
    fit = partial(
        colorize.fit,
        strokes=strokes,
        stroke_mask=stroke_mask,
        method=method,
        strength=strength,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        num_landmarks=num_landmarks,
        generator=generator,
    )
    _stream(source, target, fit, statistics, sample, tile_rows, memory, report, coloured=True)


def _stream(
    source: RowSource,
    target: RowTarget,
    fit: Callable[[Tiled], Fitted],
    statistics: Statistics,
    sample: int,
    tile_rows: int | None,
    memory: int,
    report: Report | None,
    *,
    coloured: bool = False,
) -> None:
    """Fit an edit to a picture and write the result; ``coloured`` edits turn grey into colour."""
    check_target(target, source, coloured=coloured)
    kind = np.dtype(target.dtype).name
    tiled = Tiled(Picture(source), Passes(kind, statistics, sample, tile_rows, memory, report or in_silence))
    with single_threaded(tiled.passes.workers(1)):
        fitted = fit(tiled)
    fill(target, tiled.rows(fitted))
