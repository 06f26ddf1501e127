"""Connected components of scribbles, and how much every pixel correlates with each.

Under ``g = W + s W^2 + s^2 W^3 + ...``, s the reach, two pixels correlate by ``g_ij / sqrt(g_ii g_jj)``. A connected
component is compared by the mean of the pixels it covers, so that a few odd pixels under the brush do not count.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import CACHED, block_length
from nlfilter_torch.core.kernels.tall_skinny import spread

MAX_COMPONENTS = 64  # of one region; further ones count as one with the last
TINY = 1e-6  # variance below which a pixel correlates with nothing


@dataclass(frozen=True, eq=False)
class Scribbles:
    """Scribbled pixels of a picture, or of a batch of them.

    Attributes:
        places: numbers (n,) of the pixels along the rows, ascending; of all that are scribbled on in any image.
        weights: (B, K, n) in [0, 1], of K regions.
        image: what they cover, (B, C, n).
        colours: of the scribbles, (B, 3, n), or None.
    """

    places: Tensor
    weights: Tensor
    image: Tensor
    colours: Tensor | None = None

    def joined(self, other: "Scribbles") -> "Scribbles":
        """With the regions of other scribbles after these; where both lie, these count."""
        places, back = torch.cat([self.places, other.places]).unique(return_inverse=True)
        own, others = back.split([len(self.places), len(other.places)])
        shape = (len(self.weights), self.weights.shape[1] + other.weights.shape[1], len(places))
        count = self.weights.shape[1]
        weights = self.weights.new_zeros(shape)
        weights[:, count:, others] = other.weights.to(weights)
        free = torch.ones_like(weights[:, :1])
        free[:, :, own] = (self.weights.sum(1, keepdim=True) == 0).to(free)
        weights = weights * free
        weights[:, :count, own] = self.weights
        image = self.image.new_zeros(*self.image.shape[:2], len(places))
        image[:, :, others], image[:, :, own] = other.image, self.image
        return Scribbles(places, weights, image)

    def weighted(self, weights: Tensor) -> "Scribbles":
        """With other regions, (B, K, n)."""
        return replace(self, weights=weights)

    def planes(self, pixels: Any) -> Tensor:
        """The weights (B, K, h, W) of some rows."""
        height, width = pixels.image.shape[-2:]
        ends = torch.tensor([pixels.first, pixels.first + height * width]).to(self.places)
        first, last = torch.searchsorted(self.places, ends).tolist()
        planes = self.weights.new_zeros(*self.weights.shape[:2], height * width)
        planes[:, :, self.places[first:last] - pixels.first] = self.weights[:, :, first:last]
        return planes.unflatten(2, (height, width))


@dataclass(frozen=True, eq=False)
class Components:
    """The J connected components of the scribbles on one image.

    Attributes:
        means: of their pixels' unit vectors, of unit length themselves, (J, M).
        owners: the region that each belongs to, (J, K) of zeros and ones.
    """

    means: Tensor
    owners: Tensor

    @property
    def between(self) -> Tensor:
        """Correlations of the components with each other, (J, J), within [-1, 1]."""
        return self.means @ self.means.mT


def scribbled_blocks(
    known: Sequence[tuple[Callable[[], Iterable[Tensor]], Tensor, Tensor]],
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Columns (B, M, n), weights (B, 1, n) and values (B, C, n) of pixels, block by block, as a regression takes them.

    Args:
        known: some pixels and others: their columns, block by block; weights and values of all of them.
    """
    for columns, weights, values in known:
        first = 0
        for block in columns():
            part = slice(first, first + block.shape[2])
            yield block, weights[:, :, part], values[:, :, part]
            first = part.stop


def find_components(
    scribbles: Scribbles, columns: Callable[[], Iterable[Tensor]], basis: Tensor, size: tuple[int, int]
) -> list[Components]:
    """The connected components on every image.

    Args:
        scribbles: at least one pixel in every image.
        columns: of the scribbled pixels, (B, M, n), block by block.
        basis: of :func:`walk_basis`, (B, M, M).
        size: (H, W).

    Returns:
        Differentiable in columns, weights and basis.
    """
    found = []
    for b, weights in enumerate(scribbles.weights):
        numbers, places = (weights.detach() > 0).nonzero().unbind(1)
        labels, owners = label_components(scribbles.places[places], numbers, size)
        sums, total, first = torch.zeros(()), torch.zeros(()), 0
        for block in columns():
            inside = (places >= first) & (places < first + block.shape[2])
            some = places[inside]
            vectors = unit_vectors(basis[b], block[b, :, some - first])
            more = component_sums(vectors, weights[numbers[inside], some], labels[inside], len(owners))
            sums, total, first = sums + more[0], total + more[1], first + block.shape[2]
        means = (sums / total).to(basis)
        means = means * means.square().sum(1, keepdim=True).clamp(min=TINY).rsqrt()
        found.append(Components(means, F.one_hot(owners, len(weights)).to(means)))
    return found


def correlations(basis: Tensor, directions: Tensor, factor: Tensor) -> Tensor:
    """Products (L, n) of directions (L, M) with the unit vectors of all columns (M, n) of one image.

    The unit vectors take as much memory as the factor and are not kept.
    """
    blocks = factor.split(block_length(1, factor.device, CACHED), dim=1)
    squares = torch.cat([(basis @ block).square().sum(0) for block in blocks])
    return spread((directions @ basis)[None], factor[None])[0] * squares.clamp(min=TINY).rsqrt()


def unit_vectors(basis: Tensor, factor: Tensor) -> Tensor:
    """Columns (M, n) of the factor as unit vectors (M, n) whose products are correlations, by :func:`walk_basis`."""
    vectors = basis @ factor
    return vectors * vectors.square().sum(0, keepdim=True).clamp(min=TINY).rsqrt()


def component_sums(values: Tensor, weights: Tensor, labels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Sums (J, M) of weighted values (M, n) over J = ``count`` components, and their weights (J, 1), in float64.

    Numbers are added one after the other: in float32 a component of thousands of pixels would lose the last two digits.
    """
    sums = values.new_zeros(count, values.shape[0], dtype=torch.float64)
    total = weights.new_zeros(count, 1, dtype=torch.float64)
    weighted = (values * weights).mT.double()
    return sums.index_add(0, labels, weighted), total.index_add(0, labels, weights.unsqueeze(1).double())


def label_components(places: Tensor, regions: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Label the connected components of each region; pixels that touch at a corner are connected.

    Args:
        places: numbers (n,) of the scribbled pixels, counted along the rows.
        regions: the region (n,) of each; by them the pixels are sorted first, and then by their places.
        size: (H, W) of the image.

    Returns:
        The number (n,) of the component of each pixel, and the region (J,) of each component.

    Example:
        >>> label_components(torch.tensor([0, 1, 6, 3, 8]), torch.tensor([0, 0, 0, 1, 1]), (2, 5))
        (tensor([0, 0, 0, 1, 1]), tensor([0, 1]))
    """
    pixels, width = size[0] * size[1], size[1]
    keys, columns = regions * pixels + places, places % width
    begins = torch.cat([torch.ones_like(keys[:1]), ((keys.diff() != 1) | (columns[1:] == 0)).long()])
    runs = begins.cumsum(0) - 1  # without a gap within a row
    count, links = int(runs[-1]) + 1, []
    for step, allowed in ((width - 1, columns > 0), (width, columns >= 0), (width + 1, columns < width - 1)):
        above = (allowed & (places + step < pixels)).nonzero().squeeze(1)
        below = torch.searchsorted(keys, keys[above] + step).clamp(max=len(keys) - 1)
        touching = keys[below] == keys[above] + step
        links.append((runs[above[touching]] * count + runs[below[touching]]).unique_consecutive())
    both = torch.cat(links)
    first = _connect(count, torch.stack([both // count, both % count]))
    firsts, labels = first.unique(return_inverse=True)  # sorted, region after region
    owners = regions[begins.nonzero().squeeze(1)[firsts]]
    within = torch.arange(len(owners)).to(owners) - torch.searchsorted(owners, owners)  # number within its region
    kept = (within < MAX_COMPONENTS).cumsum(0) - 1
    return kept[labels[runs]], owners[within < MAX_COMPONENTS]


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
