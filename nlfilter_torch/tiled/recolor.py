"""Recolouring from scribbles of a picture larger than memory.

A few M-vectors, computed from the scribbled pixels, determine the new colour of any pixel.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_patch_size, check_share
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.colour import group_colours, split_luminance
from nlfilter_torch.edits.components import Pixels, Spots, label_spots, spot_sums, unit_vectors
from nlfilter_torch.edits.parameters import RECOLOR
from nlfilter_torch.edits.recolor import Dye, colour_guide, divide
from nlfilter_torch.filtering.scribbles import walk_basis
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.tiled.fitting import fit_spectrum
from nlfilter_torch.tiled.sampling import Report, Sample
from nlfilter_torch.tiled.scribbles import (
    Guide,
    Painted,
    check_room,
    floats_of_painted,
    gather,
    read_mask,
    read_strokes,
)
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
        source: rows (H, W, 3) in RGB or (H, W, 4) with transparency, as of :func:`stream_detail`.
        target: receives the rows; of the source's shape.
        strokes: scribbles as rows (H, W, 3), RGB, read under ``stroke_mask`` only; or (H, W, 4), whose last channel is
            the mask. Integers are scaled to [0, 1].
        stroke_mask: rows (H, W) or (H, W, 1) in [0, 1] or of bool, above 0 on scribbles; None if ``strokes`` has four
            channels.
        keep: likewise, above 0 on background scribbles, whose similar pixels keep their colours; None is none.
        reach: as of :func:`~nlfilter_torch.recolor`, and so are ``photometric_bandwidth`` and ``patch_size``.
        photometric_bandwidth: in hundredths of Lab.
        patch_size: of the patches that are compared.
        statistics: as of :func:`stream_detail`, and so are ``sample``, ``tile_rows``, ``memory`` and ``report``.
        sample: number of pixels.
        tile_rows: rows that are computed at once.
        memory: in bytes, besides that of the sources and the target.
        report: called with the name of a stage and its progress.
        **options: of :func:`~nlfilter_torch.nonlocal_operator` but ``guide_channels``, ``tolerance`` and
            ``patch_weights``.

    Raises:
        TypeError, ValueError: if an argument does not fit, nothing is painted, or a source changes its size.
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
    reach: float = RECOLOR.defaults["reach"],
    photometric_bandwidth: float = RECOLOR.defaults["photometric_bandwidth"],
    patch_size: int = RECOLOR.defaults["patch_size"],
    names: tuple[str, str] = ("source", "strokes"),
    **options: Any,
) -> Rows:
    """The rows (h, W, S) of :func:`stream_recolor`, computed as they are requested.

    ``names`` are those of source and strokes in error messages.
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


@dataclass(frozen=True)
class Marked:
    """Scribbled pixels, grouped into regions of one colour; background scribbles are a region of their own.

    Attributes:
        places: indices (n,) of the pixels in row-major order, ascending.
        weights: (n,) in (0, 1].
        regions: the region (n,) of each; those of the K colours come first.
        colours: their chroma, (K, 3).
        count: of the regions, K or K + 1.
    """

    places: Tensor
    weights: Tensor
    regions: Tensor
    colours: Tensor
    count: int

    @staticmethod
    def of(painted: Painted, held: Painted | None) -> "Marked":
        """Group the pixels by colour; coloured scribbles take precedence over background scribbles."""
        wanted = split_luminance(painted.colours[None, :, None])[1]
        regions, colours, _ = group_colours(wanted, painted.weights[None, None, None])  # (1, K, 1, n)
        labels, count = regions[0, :, 0].argmax(0), len(colours[0])
        if held is None:
            return Marked(painted.places, painted.weights, labels, colours[0], count)
        free = ~torch.isin(held.places, painted.places)
        places = torch.cat([painted.places, held.places[free]])
        weights = torch.cat([painted.weights, held.weights[free]])
        labels = torch.cat([labels, torch.full_like(held.places[free], count)])
        order = places.argsort()
        return Marked(places[order], weights[order], labels[order], colours[0], count + 1)

    def planes(self, tile: Tile) -> Tensor:
        """The weights (1, count, h, W) in the rows of a tile."""
        height, width = tile.inner.shape[-2:]
        pixels = torch.tensor([tile.start, tile.start + height]) * width
        first, last = torch.searchsorted(self.places, pixels).tolist()
        planes = self.weights.new_zeros(self.count, height * width)
        planes[self.regions[first:last], self.places[first:last] - tile.start * width] = self.weights[first:last]
        return planes[None].unflatten(2, (height, width))


@dataclass(frozen=True, eq=False)
class FittedDye:
    """A picture's tiles in new colours.

    Attributes:
        guide: by which pixels are compared.
        kernel: of the operator.
        marked: the scribbled pixels.
        basis: of the unit vectors that pixels are compared by, (M, M).
        division: (K', M), of :func:`divide`.
        dye: the change of the colours.
    """

    guide: Guide
    kernel: Kernel
    marked: Marked
    basis: Tensor
    division: Tensor
    dye: Dye

    @full_precision
    def __call__(self, tile: Tile) -> Tensor:
        """The colours (1, 3, h, W) of the rows of a tile of the picture."""
        likeness = row_by_row(self.kernel, self.guide.seen(tile), self.likeness)
        return self.dye(tile.inner, likeness, self.marked.planes(tile))

    def likeness(self, features: Tensor) -> Tensor:
        """Similarity (1, K', n) of pixels with features (1, D, n) to each region."""
        return Pixels.of(self.basis, self.kernel.factor(features)[0][0]).along(self.division)[None]


@torch.no_grad()
@full_precision
def fit_dye(
    picture: Picture, guide: Guide, kernel: Kernel, pairs: RitzPairs, marked: Marked, reach: float, report: Report
) -> FittedDye:
    """Fit the recolouring of a picture to the columns of the scribbled pixels."""
    found = gather(
        picture, guide, kernel, marked.places, marked.weights, lambda colours: split_luminance(colours)[1], report
    )
    basis = walk_basis(pairs, reach)[0].to(picture.dtype)
    spots = _find_spots(found, marked, kernel, basis, picture.size)
    sums, weights = spot_sums(found.image[0], marked.weights, marked.regions, marked.count)  # of the chroma, (K', 3)
    old = (sums / weights)[: len(marked.colours)].to(basis)
    return FittedDye(guide, kernel, marked, basis, divide(spots), Dye(marked.colours[None], old[None]))


def _find_spots(found: Sample, marked: Marked, kernel: Kernel, basis: Tensor, size: tuple[int, int]) -> Spots:
    """The scribbled regions, before any pixel is compared with them."""
    order = (marked.regions * (size[0] * size[1]) + marked.places).argsort()
    numbers, owners = label_spots(marked.places[order], marked.regions[order], size)
    numbers = torch.empty_like(numbers).scatter_(0, order, numbers)
    sums, weights, done = torch.zeros(()), torch.zeros(()), 0
    for block in found.blocks(kernel):
        part = numbers[done : done + block.weights.shape[1]]
        more = spot_sums(unit_vectors(basis, block.factor[0]), block.weights[0], part, len(owners))
        sums, weights, done = sums + more[0], weights + more[1], done + len(part)
    return Spots.of_means((sums / weights).to(basis), F.one_hot(owners, marked.count).to(basis))
