"""Strokes of colour on a picture that is read by rows to what they make of any of its pixels, a few M-vectors."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.chroma import group_colours, split_luminance
from nlfilter_torch.edits.components import Pixels, Spots, label_spots, spot_sums, unit_vectors
from nlfilter_torch.edits.recolor import Dye, divide
from nlfilter_torch.filtering.scribbles import walk_basis
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.tiled.sampling import Report, Sample
from nlfilter_torch.tiled.scribbles import Guide, Painted, gather
from nlfilter_torch.tiled.sources import Picture, Tile
from nlfilter_torch.tiled.tiles import row_by_row


@dataclass(frozen=True)
class Marked:
    """Painted pixels, and those that are kept as they are, divided among regions of one colour.

    Attributes:
        places: numbers (n,) of the pixels, counted along the rows, ascending.
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
        """Tell the colours apart; strokes paint over what is kept."""
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
        guide: what is compared of the picture.
        kernel: of the operator.
        marked: what is painted.
        basis: of the unit vectors that pixels are compared by, (M, M).
        division: (K', M), of :func:`divide`.
        dye: what becomes of the colours.
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
        """How much pixels with features (1, D, n) resemble each region, (1, K', n)."""
        return Pixels.of(self.basis, self.kernel.factor(features)[0][0]).along(self.division)[None]


@torch.no_grad()
@full_precision
def fit_dye(
    picture: Picture, guide: Guide, kernel: Kernel, pairs: RitzPairs, marked: Marked, reach: float, report: Report
) -> FittedDye:
    """What :func:`recolor` makes of a picture, from the columns of the marked pixels."""
    found = gather(
        picture, guide, kernel, marked.places, marked.weights, lambda colours: split_luminance(colours)[1], report
    )
    basis = walk_basis(pairs, reach)[0].to(picture.dtype)
    spots = _find_spots(found, marked, kernel, basis, picture.size)
    sums, weights = spot_sums(found.image[0], marked.weights, marked.regions, marked.count)  # of the chroma, (K', 3)
    old = (sums / weights)[: len(marked.colours)].to(basis)
    return FittedDye(guide, kernel, marked, basis, divide(spots), Dye(marked.colours[None], old[None]))


def _find_spots(found: Sample, marked: Marked, kernel: Kernel, basis: Tensor, size: tuple[int, int]) -> Spots:
    """The spots of the marked pixels, compared with no pixel yet."""
    order = (marked.regions * (size[0] * size[1]) + marked.places).argsort()
    numbers, owners = label_spots(marked.places[order], marked.regions[order], size)
    numbers = torch.empty_like(numbers).scatter_(0, order, numbers)
    sums, weights, done = torch.zeros(()), torch.zeros(()), 0
    for block in found.blocks(kernel):
        part = numbers[done : done + block.weights.shape[1]]
        more = spot_sums(unit_vectors(basis, block.factor[0]), block.weights[0], part, len(owners))
        sums, weights, done = sums + more[0], weights + more[1], done + len(part)
    return Spots.of_means((sums / weights).to(basis), F.one_hot(owners, marked.count).to(basis))
