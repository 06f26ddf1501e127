"""New colours for what looks like the strokes on a picture that fits no memory."""

from typing import Any

import numpy as np

from nlfilter_torch.core.checks import check_count, check_patch_size, check_share
from nlfilter_torch.edits.recolor import colour_guide
from nlfilter_torch.tiled.fitting import fit_spectrum
from nlfilter_torch.tiled.recoloring import Marked, fit_dye
from nlfilter_torch.tiled.sampling import Report
from nlfilter_torch.tiled.scribbles import Guide, check_room, floats_of_painted, read_mask, read_strokes
from nlfilter_torch.tiled.sources import Picture, Rows, RowSource, RowTarget
from nlfilter_torch.tiled.tiles import SAMPLE, Passes, Statistics, check_target, fill, in_silence, rows_that_fit


def stream_recolor(
    source: RowSource,
    target: RowTarget,
    strokes: RowSource,
    stroke_mask: RowSource | None = None,
    *,
    keep: RowSource | None = None,
    reach: float = 0.8,
    photometric_bandwidth: float = 0.12,
    patch_size: int = 3,
    statistics: Statistics = "sample",
    sample: int = SAMPLE,
    tile_rows: int | None = None,
    memory: int = 1 << 30,
    report: Report | None = None,
    **options: Any,
) -> None:
    """Recolour a picture of any size, as :func:`~nlfilter_torch.recolor` does one in memory.

    What the strokes make of a pixel depends on the pixel's own patch only, once the sums over all pixels and over the
    painted ones are known: tiles have no seams, and their size makes no difference.

    Args:
        source: rows (H, W, 3) in RGB or (H, W, 4) with transparency, as of :func:`stream_detail`.
        target: what takes the rows; of the source's shape.
        strokes: rows (H, W, 3), RGB, read where painted only; or (H, W, 4), painted where not transparent. Integers
            count from 0 to 1, whatever their range.
        stroke_mask: rows (H, W) or (H, W, 1) in [0, 1] or of bool, above 0 where painted; None where the strokes have
            four channels.
        keep: likewise, above 0 on spots whose likes are to stay as they are; None is none.
        reach: as of :func:`~nlfilter_torch.recolor`, and so are ``photometric_bandwidth`` and ``patch_size``.
        photometric_bandwidth: in hundredths of Lab.
        patch_size: of the patches that are compared.
        statistics: as of :func:`stream_detail`, and so are ``sample``, ``tile_rows``, ``memory`` and ``report``.
        sample: number of pixels.
        tile_rows: rows that are worked out at once.
        memory: in bytes, beside those of the sources and the target.
        report: called with a stage and how much of it is done.
        **options: of :func:`~nlfilter_torch.nonlocal_operator` but ``guide_channels``, ``tolerance`` and
            ``patch_weights``.

    Raises:
        TypeError, ValueError: if an argument does not fit, nothing is painted, or a source changes its size meanwhile.
        MemoryError: if the samples, the painted pixels or a single row take more than ``memory``.

    Example:
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
    check_target(target, source)
    passes = Passes(np.dtype(target.dtype).name, statistics, sample, tile_rows, memory, report or in_silence)
    rows = recolor_rows(
        passes,
        source,
        strokes,
        stroke_mask,
        keep=keep,
        reach=reach,
        photometric_bandwidth=photometric_bandwidth,
        patch_size=patch_size,
        **options,
    )
    fill(target, rows)


def recolor_rows(
    passes: Passes,
    source: RowSource,
    strokes: RowSource,
    stroke_mask: RowSource | None = None,
    *,
    keep: RowSource | None = None,
    reach: float = 0.8,
    photometric_bandwidth: float = 0.12,
    patch_size: int = 3,
    names: tuple[str, str] = ("source", "strokes"),
    **options: Any,
) -> Rows:
    """The rows (h, W, S) of :func:`stream_recolor`, as they are asked for.

    Errors call source and strokes by ``names``.
    """
    picture, guide = Picture(source, names[0]), Guide(source, names[0], colour_guide)
    if picture.colours != 3:
        raise ValueError(
            f"{names[0]} must have 3 or 4 channels to be recoloured, got {picture.samples}; colourise it instead"
        )
    check_share(reach, "reach", below=True)
    check_patch_size(patch_size)
    landmarks = options.get("num_landmarks", 100)
    check_count(landmarks, "num_landmarks")
    painted = read_strokes(picture, strokes, stroke_mask, passes, name=names[1])
    held = None if keep is None else read_mask(picture, keep, "keep", passes)
    marked = Marked.of(painted, held)

    planes = 3 * patch_size**2 + 2
    check_room(picture, len(marked.places), planes, passes.memory)
    rows = rows_that_fit(
        picture,
        passes,
        floats=planes + 6 * marked.count + 40,  # features, shares of the colours, and some images
        planes=planes,
        num_landmarks=landmarks,
        held=len(marked.places) * floats_of_painted(planes),
    )
    kernel, pairs = fit_spectrum(
        guide,
        passes,
        photometric_bandwidth=photometric_bandwidth,
        patch_size=patch_size,
        guide_channels="all",
        **options,
    )
    fitted = fit_dye(picture, guide, kernel, pairs, marked, reach, passes.report)
    yield from passes.work_out(picture, fitted, patch_size // 2, rows)
