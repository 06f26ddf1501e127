"""Connected areas: the part of a mask that is connected with a scribble, and the strokes of a picture in groups.

The groups are for cross-validation: methods are compared by how well they predict a group from the others.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.blocks import order_by
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, blocks_at

Extent = Literal["near", "object", "everywhere"]
INSIDE_MASK = 0.5  # mask from which on a pixel is inside an object, in which pixels are connected
SOFT_BORDER = 8  # width in pixels of a soft border, which belongs to the nearest object
VISIBLE = 0.05  # masks up to this are hardly visible, and from twice this on they are
SMALL_PIECE = 0.03  # of the pixels of the object; smaller pieces within its border, such as hair, belong to it


@torch.no_grad()
def connected(masks: Tensor, scribbles: Tensor) -> Tensor:
    """Which pixels belong to what is connected with a scribble, (B, K, H, W) of bool.

    Pixels are connected by their sides through those with a mask of at least :data:`INSIDE_MASK`.

    Args:
        masks: of K regions, (B, K, H, W).
        scribbles: weights of those on the regions, (B, K, H, W), above 0 where painted.
    """
    own, others = _parts(masks, scribbles)
    for _ in range(SOFT_BORDER):
        wider = torch.where(others > 0, 0.0, _widened(own))
        others, own = torch.where(wider > 0, 0.0, _widened(others)), wider
    return own > 0


@torch.no_grad()
def without_haze(masks: Tensor, scribbles: Tensor, least: Tensor) -> Tensor:
    """Shares (B, K, H, W) of masks that stay: 0 in haze, which is hardly visible, and in specks; 1 elsewhere.

    Specks are smaller than ``least``, (B, K) in pixels, neither connected with a scribble nor within a soft border of
    what is. Half of that border lies outside of what is selected by half; there, all stays. The other arguments are
    those of :func:`connected`.
    """
    selected = torch.maximum(*_parts(masks, scribbles, least))
    border = F.max_pool2d(selected, 2 * SOFT_BORDER + 1, 1, SOFT_BORDER)
    specks = F.max_pool2d((masks >= INSIDE_MASK).to(masks) * (1 - border), 2 * SOFT_BORDER + 1, 1, SOFT_BORDER)
    visible = (masks / VISIBLE - 1).clamp(0.0, 1.0)
    stays = F.max_pool2d(selected, SOFT_BORDER + 1, 1, SOFT_BORDER // 2)
    return stays.maximum(visible * (1 - specks * (1 - border)))


@torch.no_grad()
def unconnected(mask: Tensor, painted: Tensor) -> Tensor:
    """Parts (H, W) of a mask (H, W), as bool, that are not connected with what is painted, (H, W)."""
    inside = (mask >= INSIDE_MASK) | (painted > 0)
    numbers = _numbered(inside)
    return inside & ~torch.isin(numbers, numbers[painted > 0].unique())


def _numbered(inside: Tensor) -> Tensor:
    """Number of the connected component of each pixel (H, W)."""
    from skimage.measure import label

    return torch.from_numpy(label(inside.cpu().numpy(), connectivity=1)).to(inside.device)


def connected_pieces(places: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """Number of the connected piece of each place, (m,), from 0 on, also by corners.

    Places are row-major indices, ascending, of a picture so many pixels wide, of whose size the cost is independent.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = []
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        start = np.flatnonzero((places % width + right >= 0) & (places % width + right < width))
        wanted = places[start] + down * width + right
        found = np.searchsorted(places, wanted).clip(max=len(places) - 1)
        same = places[found] == wanted
        pairs.append((start[same], found[same]))
    start, end = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    links = coo_array((np.ones(len(start)), (start, end)), shape=(len(places), len(places)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def _parts(masks: Tensor, scribbles: Tensor, least: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The components of masks that hold a scribble, and other large ones, (B, K, H, W) of 0 and 1 each.

    Large ones have at least so many pixels, (B, K), or :data:`SMALL_PIECE` of those that hold a scribble.
    """
    inside = (masks >= INSIDE_MASK) | (scribbles > 0)
    parts = []
    for number, planes in enumerate(zip(inside.flatten(0, 1), scribbles.flatten(0, 1) > 0, strict=True)):
        numbers = _numbered(planes[0])
        own = torch.isin(numbers, numbers[planes[1]].unique()) & planes[0]
        enough = SMALL_PIECE * own.sum() if least is None else least.flatten()[number]
        parts.append((own, planes[0] & ~own & (numbers.flatten().bincount() >= enough)[numbers]))
    own, large = (torch.stack(planes).view_as(masks).to(masks) for planes in zip(*parts, strict=True))
    return own, large


def _widened(planes: Tensor) -> Tensor:
    """Planes (B, K, H, W) of 0 and 1 with another pixel around the ones."""
    return F.max_pool2d(planes, 3, 1, 1)


GROUPS = 5
CELLS_ACROSS = 64  # number of cells along the short side; painted areas in the same or in adjacent cells are connected


def _cells(length: int, side: float) -> int:
    """Number of cells along an axis, such that no border of two cells runs through the middle of a pixel."""
    count = math.ceil(length / side)
    return count if length % count == 0 or count % 2 == 1 else count + 1


@dataclass(frozen=True, eq=False)
class StrokeGroups:
    """The strokes of each image of a batch: its connected painted areas.

    Attributes:
        strokes: number of the stroke at each scribbled pixel, (B, n); any number where nothing is painted. Strokes with
            the same remainder after division by :data:`GROUPS` are a group.
        count: number S of strokes, the largest of all images.
    """

    strokes: Tensor
    count: int

    @staticmethod
    def of(scribbles: Scribbles, size: tuple[int, int]) -> "StrokeGroups":
        """Number the strokes of a picture (H, W). Areas closer together than 1/64 of the short side are connected."""
        from skimage.measure import label

        side = max(1.0, min(size) / CELLS_ACROSS)
        cells = (_cells(size[0], side), _cells(size[1], side))
        at = blocks_at(scribbles.places, size, cells)
        weights = scribbles.weights.detach().amax(1)
        painted = weights.new_zeros(len(weights), cells[0] * cells[1]).index_add(1, at, weights).unflatten(1, cells) > 0
        numbers = torch.from_numpy(np.stack([label(image, connectivity=2) for image in painted.cpu().numpy()]))
        strokes = (numbers.to(at).flatten(1)[:, at] - 1).clamp(min=0)
        groups = StrokeGroups(strokes, int(numbers.max()))
        return groups if groups.count <= GROUPS else groups._outwards(scribbles, size)

    def _outwards(self, scribbles: Scribbles, size: tuple[int, int]) -> "StrokeGroups":
        """The strokes, numbered from the middle of the picture outwards, so that the numbers turn with it.

        Strokes at the same distance are ordered by brightness.
        """
        places = scribbles.places
        distances = (2 * (places // size[1]) + 1 - size[0]).square() + (2 * (places % size[1]) + 1 - size[1]).square()
        painted = (scribbles.weights.detach() > 0).any(1)
        distances = torch.where(painted, distances, distances.max() + 1)
        nearest = distances.new_full((len(self.strokes), self.count), torch.iinfo(torch.long).max)
        nearest = nearest.scatter_reduce(1, self.strokes, distances, "amin")
        light = self.sums(scribbles.image.detach().mean(1, keepdim=True) * painted.unsqueeze(1)).squeeze(1)
        return StrokeGroups(order_by(nearest, light).argsort(1).gather(1, self.strokes), self.count)

    @property
    def groups(self) -> Tensor:
        """Number of the group at each scribbled pixel, (B, 1, n)."""
        return (self.strokes % GROUPS).unsqueeze(1)

    def without_each(self, weighted: Tensor) -> list[Tensor]:
        """Values (B, C, n) with those of one group replaced by 0, for each group; an empty list for single strokes."""
        if self.count < 2:
            return []
        return [weighted * (self.groups != number) for number in range(min(GROUPS, self.count))]

    def weights_without_each(self, weights: Tensor) -> list[Tensor]:
        """:meth:`without_each` of weights (B, 1, n), but images that would be left without any keep all of them."""
        sets = self.without_each(weights)
        return [torch.where(left.sum(2, keepdim=True) > 0, left, weights) for left in sets]

    def of_own(self, values: Sequence[Tensor]) -> Tensor:
        """Select, at each pixel, the values (B, C, n) that belong to its own group from those for every group."""
        return torch.stack(list(values)).gather(0, self.groups.expand(1, *values[0].shape)).squeeze(0)

    def sums(self, values: Tensor) -> Tensor:
        """Sums (B, C, S) of values (B, C, n) over each stroke, in float64."""
        sums = values.new_zeros(*values.shape[:2], self.count, dtype=torch.float64)
        return sums.scatter_add(2, self.strokes.unsqueeze(1).expand(values.shape), values.double())
