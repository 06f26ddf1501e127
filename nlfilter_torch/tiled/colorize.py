"""Colourisation from scribbles of a grey picture larger than memory."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_patch_size, check_positive, check_share
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.colorize import FAR, NEAR, Stage
from nlfilter_torch.edits.colour import merge_luminance, nearby, split_luminance
from nlfilter_torch.edits.parameters import COLORIZE
from nlfilter_torch.filtering.scribbles import FittedStrokes, fit_strokes
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.tiled.fitting import fit_spectrum
from nlfilter_torch.tiled.sampling import Report, Sample
from nlfilter_torch.tiled.scribbles import Guide, Painted, check_room, floats_of_painted, gather, read_strokes
from nlfilter_torch.tiled.sources import Picture, Rows, RowSource, RowTarget, Tile
from nlfilter_torch.tiled.tiles import (
    SAMPLE,
    Passes,
    Statistics,
    check_target,
    fill,
    in_silence,
    row_by_row,
    rows_that_fit,
)


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

    Given the sums over all pixels and over the scribbled ones, the colour of a pixel depends only on its own patch and
    position, so there are no seams, and the size of the tiles does not matter.

    Args:
        source: rows (H, W) or (H, W, S), as of :func:`stream_detail`; of colours the luminance is taken.
        target: receives the rows; (H, W, 3), or (H, W, 4) if the source has transparency.
        strokes: scribbles as rows (H, W, 3), RGB, read under ``stroke_mask`` only; or (H, W, 4), whose last channel is
            the mask. Integers are scaled to [0, 1].
        stroke_mask: rows (H, W) or (H, W, 1) in [0, 1] or of bool, above 0 on scribbles; None if ``strokes`` has four
            channels.
        method: ``"regression"``; k-means takes all pixels at once.
        strength: as of :func:`~nlfilter_torch.colorize`, and so are bandwidths, ``patch_size``, ``num_landmarks`` and
            ``generator``.
        photometric_bandwidth: in units of the image.
        spatial_bandwidth: in pixels; None is 0.5625 of the short side.
        patch_size: of the patches that are compared.
        num_landmarks: M of the operators.
        generator: source of randomness for the landmarks.
        statistics: as of :func:`stream_detail`, and so are ``sample``, ``tile_rows``, ``memory`` and ``report``.
        sample: number of pixels.
        tile_rows: rows that are computed at once.
        memory: in bytes, besides that of the sources and the target.
        report: called with the name of a stage and its progress.

    Raises:
        TypeError, ValueError: if an argument does not fit, nothing is painted, or a source changes its size.
        MemoryError: if the samples, the painted pixels or a single row take more than ``memory``.

    Example:
        >>> grey = np.full((60, 40), 60, np.uint8)
        >>> grey[:, 20:] = 200
        >>> strokes, coloured = np.zeros((60, 40, 4), np.uint8), np.empty((60, 40, 3), np.uint8)
        >>> strokes[4:8, 4:8], strokes[4:8, -8:-4] = (0, 0, 200, 255), (200, 0, 0, 255)  # dark is blue, bright is red
        >>> stream_colorize(grey, coloured, strokes, num_landmarks=20, tile_rows=16)
        >>> red, blue = coloured[..., 0].astype(int), coloured[..., 2].astype(int)
        >>> bool((blue > red)[:, :17].all()), bool((red > blue)[:, 23:].all())
        (True, True)
    """
    check_target(target, source, coloured=True)
    passes = Passes(np.dtype(target.dtype).name, statistics, sample, tile_rows, memory, report or in_silence)
    rows = colorize_rows(
        passes,
        source,
        strokes,
        stroke_mask,
        method=method,
        strength=strength,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        num_landmarks=num_landmarks,
        generator=generator,
    )
    fill(target, rows)


def colorize_rows(
    passes: Passes,
    source: RowSource,
    strokes: RowSource,
    stroke_mask: RowSource | None = None,
    *,
    method: str = COLORIZE.defaults["method"],
    strength: float = COLORIZE.defaults["strength"],
    photometric_bandwidth: float = COLORIZE.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | None = None,
    patch_size: int = COLORIZE.defaults["patch_size"],
    num_landmarks: int = COLORIZE.defaults["num_landmarks"],
    generator: torch.Generator | None = None,
    names: tuple[str, str] = ("source", "strokes"),
) -> Rows:
    """The rows (h, W, S) of :func:`stream_colorize`, computed as they are requested.

    ``names`` are those of source and strokes in error messages.
    """
    COLORIZE["method"].check_argument(method)
    if method == "kmeans":
        raise ValueError(
            "method must be regression where a picture is worked out by rows, got kmeans, which takes all pixels at "
            "once; choose regression, or allow more memory"
        )
    check_share(strength, "strength")
    check_positive(photometric_bandwidth, "photometric_bandwidth")
    check_patch_size(patch_size)
    check_count(num_landmarks, "num_landmarks")
    picture = Picture(source, names[0])
    guide = Guide(source, names[0], lambda colours: reduce_channels(colours, "luminance"))
    bandwidth = nearby(spatial_bandwidth, COLORIZE["spatial_bandwidth"].share, guide.size)
    check_positive(bandwidth, "spatial_bandwidth")
    painted = read_strokes(guide, strokes, stroke_mask, passes, name=names[1])

    planes = patch_size**2 + 2
    check_room(guide, len(painted.places), planes, passes.memory)
    rows = rows_that_fit(
        guide,
        passes,
        floats=planes + 40,
        planes=planes,
        num_landmarks=num_landmarks,
        held=len(painted.places) * floats_of_painted(planes),
    )
    values = split_luminance(painted.colours[None, :, None])[1][:, :, 0]  # (1, 3, n)
    fitted: list[FittedChroma] = []
    for stage in (FAR, NEAR):
        kernel, pairs = fit_spectrum(
            guide,
            passes,
            patch_size=int(min(patch_size, stage.patch_size)),
            photometric_bandwidth=stage.photometric * photometric_bandwidth,
            spatial_bandwidth=stage.spatial * bandwidth,
            num_landmarks=min(num_landmarks, guide.pixels),
            generator=generator,
        )
        part = strength if stage is FAR else 0.0
        chroma, values = fit_chroma(picture, guide, kernel, pairs, painted, values, stage, part, passes.report)
        fitted.append(chroma)

    def edit(tile: Tile) -> Tensor:
        return merge_luminance(tile.inner, fitted[0](tile) + fitted[1](tile))

    yield from passes.work_out(guide, edit, patch_size // 2, rows)


@dataclass(frozen=True, eq=False)
class FittedChroma:
    """The chroma of a picture's tiles by regression on scribbles.

    Attributes:
        kernel: of the operator.
        strokes: fitted to it.
    """

    kernel: Kernel
    strokes: FittedStrokes

    @full_precision
    def __call__(self, tile: Tile) -> Tensor:
        """(1, 3, h, W), for the rows of a tile of the guide."""
        return row_by_row(self.kernel, tile, lambda features: self.strokes(self.kernel.factor(features)[0]))


@torch.no_grad()
@full_precision
def fit_chroma(
    picture: Picture,
    guide: Guide,
    kernel: Kernel,
    pairs: RitzPairs,
    painted: Painted,
    values: Tensor,
    stage: Stage,
    strength: float,
    report: Report,
) -> tuple[FittedChroma, Tensor]:
    """A stage of :func:`colorize` for values (1, 3, n) of the scribbled pixels, and the residuals it leaves."""
    found = gather(picture, guide, kernel, painted.places, painted.weights, lambda colours: colours, report)
    found = Sample(found.features, values, found.weights)

    def blocks() -> Any:
        return ((block.factor, block.weights.unsqueeze(1), block.image) for block in found.blocks(kernel))

    fitted = fit_strokes(blocks, pairs, guide.pixels, strength=strength, reach=stage.reach, smoothness=stage.smoothness)
    said = torch.cat([fitted(factor) for factor, _, _ in blocks()], dim=2)
    return FittedChroma(kernel, fitted), values - said
