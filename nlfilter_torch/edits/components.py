"""Spots that someone painted, and how much every pixel correlates with each.

Under ``g = W + s W^2 + s^2 W^3 + ...``, s the reach, two pixels correlate by ``g_ij / sqrt(g_ii g_jj)``. A spot, which
is paint without a gap, is compared by the mean of what it covers, so that few odd pixels under a brush do not count.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import CACHED, block_length
from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.filtering.scribbles import walk_basis
from nlfilter_torch.operator.spectrum import Spectrum

MAX_SPOTS = 64  # of one region; further ones are taken together
TINY = 1e-6  # variance below which a pixel correlates with nothing


@dataclass(frozen=True, eq=False)
class Pixels:
    """All pixels of an image as :func:`unit_vectors`, which take as much memory as the factor and are not kept.

    Attributes:
        basis: of :func:`walk_basis`, (M, M).
        factor: (M, N).
        scale: one over the lengths of ``basis @ factor``, (N,).
    """

    basis: Tensor
    factor: Tensor
    scale: Tensor

    @staticmethod
    def of(basis: Tensor, factor: Tensor) -> "Pixels":
        """From the columns (M, N) of the factor, block by block."""
        blocks = factor.split(block_length(1, factor.device, CACHED), dim=1)
        squares = torch.cat([(basis @ block).square().sum(0) for block in blocks])
        return Pixels(basis, factor, squares.clamp(min=TINY).rsqrt())

    def along(self, directions: Tensor) -> Tensor:
        """Products (L, N) of all unit vectors with others, (L, M)."""
        return spread((directions @ self.basis)[None], self.factor[None])[0] * self.scale


@dataclass(frozen=True, eq=False)
class Spots:
    """The J spots of one image.

    Attributes:
        means: of their pixels' unit vectors, of unit length themselves, (J, M).
        owners: the region that each spot belongs to, (J, K) of zeros and ones.
    """

    means: Tensor
    owners: Tensor

    @staticmethod
    def of_means(means: Tensor, owners: Tensor) -> "Spots":
        """From means (J, M) of any length."""
        return Spots(means * means.square().sum(1, keepdim=True).clamp(min=TINY).rsqrt(), owners)

    @property
    def between(self) -> Tensor:
        """Correlations of the spots with each other, (J, J), within [-1, 1]."""
        return self.means @ self.means.mT


def find_spots(spectrum: Spectrum, regions: Tensor, reach: float | Tensor) -> Iterator[tuple[Spots, Pixels]]:
    """The spots of every image, and its pixels.

    Args:
        spectrum: of the operator.
        regions: (B, K, H, W), weights above 0 where painted, in the spectrum's dtype; at least one spot in every image.
        reach: s in [0, 1), a number or a tensor of shape () or (B,).

    Yields:
        Those of an image after the other. Differentiable in operator, weights and reach.
    """
    basis = walk_basis(spectrum, reach).to(spectrum.factor)
    for b, region in enumerate(regions.flatten(2)):
        numbers, places = (region.detach() > 0).nonzero().unbind(1)
        spots, owners = label_spots(places, numbers, spectrum.size)
        few = unit_vectors(basis[b], spectrum.factor[b, :, places])
        sums, weight = spot_sums(few, region[numbers, places], spots, len(owners))
        found = Spots.of_means((sums / weight).to(basis), F.one_hot(owners, len(region)).to(region))
        yield found, Pixels.of(basis[b], spectrum.factor[b])


def unit_vectors(basis: Tensor, factor: Tensor) -> Tensor:
    """Columns (M, n) of the factor as unit vectors (M, n) whose products are correlations, by :func:`walk_basis`."""
    vectors = basis @ factor
    return vectors * vectors.square().sum(0, keepdim=True).clamp(min=TINY).rsqrt()


def spot_sums(values: Tensor, weights: Tensor, spots: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Sums (J, M) of weighted values (M, n) over J = ``count`` spots, and the weights (J, 1) of these, in float64.

    Numbers are added one after the other: in float32 a spot of thousands of pixels would lose the last two digits.
    """
    sums = values.new_zeros(count, values.shape[0], dtype=torch.float64)
    total = weights.new_zeros(count, 1, dtype=torch.float64)
    weighted = (values * weights).mT.double()
    return sums.index_add(0, spots, weighted), total.index_add(0, spots, weights.unsqueeze(1).double())


def label_spots(places: Tensor, regions: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Tell the spots of painted pixels apart: paint of one region without a gap, corners included.

    Args:
        places: numbers (n,) of the painted pixels, counted along the rows.
        regions: the region (n,) of each; by them the pixels are sorted first, and then by their places.
        size: (H, W) of the image.

    Returns:
        The number (n,) of the spot of each pixel, and the region (J,) of each spot.

    Example:
        >>> label_spots(torch.tensor([0, 1, 6, 3, 8]), torch.tensor([0, 0, 0, 1, 1]), (2, 5))
        (tensor([0, 0, 0, 1, 1]), tensor([0, 1]))
    """
    pixels, width = size[0] * size[1], size[1]
    keys, columns = regions * pixels + places, places % width
    begins = torch.cat([torch.ones_like(keys[:1]), ((keys.diff() != 1) | (columns[1:] == 0)).long()])
    runs = begins.cumsum(0) - 1  # paint without a gap within a row
    count, links = int(runs[-1]) + 1, []
    for step, allowed in ((width - 1, columns > 0), (width, columns >= 0), (width + 1, columns < width - 1)):
        above = (allowed & (places + step < pixels)).nonzero().squeeze(1)
        below = torch.searchsorted(keys, keys[above] + step).clamp(max=len(keys) - 1)
        meet = keys[below] == keys[above] + step
        links.append((runs[above[meet]] * count + runs[below[meet]]).unique_consecutive())
    both = torch.cat(links)
    first = _connect(count, torch.stack([both // count, both % count]))
    firsts, spots = first.unique(return_inverse=True)  # sorted, region after region
    owners = regions[begins.nonzero().squeeze(1)[firsts]]
    within = torch.arange(len(owners)).to(owners) - torch.searchsorted(owners, owners)  # number of a spot in its region
    kept = (within < MAX_SPOTS).cumsum(0) - 1
    return kept[spots[runs]], owners[within < MAX_SPOTS]


def _connect(count: int, links: Tensor) -> Tensor:
    """The smallest number (n,) that each of n = ``count`` things is connected to by links (2, L) between pairs."""
    first = torch.arange(count, device=links.device)
    while True:
        lower = first[links].amin(0).expand(2, -1).flatten()
        closer = first.scatter_reduce(0, first[links].flatten(), lower, "amin")
        closer = closer[closer]
        if torch.equal(closer, first):
            return first
        first = closer
