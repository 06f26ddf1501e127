"""The orientation of an image that its content decides: what is drawn in it turns and flips with the image.

An image has eight orientations: either axis may be flipped, and both exchanged. Weighted sums over its pixels are
computed for all eight, in whole numbers, so that no order of summation matters. The one with the largest sums is the
canonical orientation. An image and its mirror image share it, and hence have k-means landmarks of the same patches.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.communicator import ALONE, Communicator

LEVELS = 1 << 12  # steps to which values are rounded; sums along a row are then exact in float64
HASHED = 1 << 12  # number of different pseudo-random weights
ORIENTATIONS, EXCHANGED = 8, 4  # number 1 flips the rows, 2 the columns, 4 exchanges the axes afterwards
MOST_CHANNELS = 16  # of the guide that are looked at
ONES, MOMENT, FIRST, SECOND = 0, 1, 2, 4  # rows of the weights along an axis


@dataclass(frozen=True)
class Layout:
    """Which features of a pixel belong to which place of its patch.

    Attributes:
        patch: width p of a patch; the features are C patches, row by row.
        coordinates: whether row and column of the pixel follow.
    """

    patch: int
    coordinates: bool

    def to_canonical(self, size: int, device: torch.device) -> Tensor:
        """Indices (8, D) of D = ``size`` features of a pixel in the order of each orientation of its patch."""
        area = self.patch * self.patch
        patches = size - 2 * self.coordinates
        places = source_pixels(
            torch.arange(ORIENTATIONS, device=device), (self.patch, self.patch), torch.arange(area, device=device)
        )
        channels = torch.arange(0, patches, area, device=device).view(1, -1, 1)
        indices = (places.unsqueeze(1) + channels).flatten(1)
        if not self.coordinates:
            return indices
        exchanged = (torch.arange(ORIENTATIONS, device=device) // EXCHANGED).unsqueeze(1)
        return torch.cat([indices, patches + exchanged, patches + 1 - exchanged], dim=1)


def source_pixels(orientation: Tensor, size: Sequence[int], pixels: Tensor, *, flipped: bool = True) -> Tensor:
    """Indices (B, S) in an image of ``size`` (H, W) of pixels (S,) numbered in orientations (B,) of it.

    With ``flipped=False`` axes are exchanged only.
    """
    height, width = size
    exchanged = (orientation >= EXCHANGED).unsqueeze(1)
    across = torch.where(exchanged, height, width)
    first, second = pixels // across, pixels % across
    row, column = torch.where(exchanged, second, first), torch.where(exchanged, first, second)
    if flipped:
        row = torch.where((orientation % 2 == 1).unsqueeze(1), height - 1 - row, row)
        column = torch.where((orientation // 2 % 2 == 1).unsqueeze(1), width - 1 - column, column)
    return row * width + column


def canonical_points(subset: Tensor, orientation: Tensor, layout: Layout, coordinates: Tensor | None) -> Tensor:
    """Features (B, D, S) that pixels would have if their images had the canonical orientation; without a gradient.

    Equal for an image and its mirror image to the last bit.

    Args:
        subset: (B, D, S), features of the pixels with the indices of :func:`source_pixels`.
        orientation: (B,).
        layout: of the features.
        coordinates: (B, 2, S), the last two features of the pixels with the indices for ``flipped=False``, or None
            without coordinates. Mirrored coordinates themselves would differ by rounding.
    """
    subset = subset.detach()
    if coordinates is not None:
        subset = torch.cat([subset[:, :-2], coordinates.detach()], dim=1)
    order = layout.to_canonical(subset.shape[1], subset.device)[orientation]  # (B, D)
    return subset.gather(1, order.unsqueeze(2).expand_as(subset))


def orientations(features: Tensor, size: Sequence[int], layout: Layout, communicator: Communicator = ALONE) -> Tensor:
    """The canonical orientations (B,) of images with features (B, D, N), whose rows here have ``size`` (h, W)."""
    area = layout.patch * layout.patch
    patches = features.shape[1] - 2 * layout.coordinates
    values = _mixture([features[:, plane].detach() for plane in range(area // 2, patches, area)])
    ends = communicator.max(torch.stack([-values.amin(1), values.amax(1)], dim=1))  # (B, 2)
    span = ends.sum(1, keepdim=True)
    shares = (values + ends[:, :1]) / torch.where(span > 0, span, 1.0)
    sums = _sums(
        shares.unflatten(1, (size[0], size[1])), communicator.first_row, communicator.whole((size[0], size[1]))
    )
    return orientation_of(communicator.sum(sums))


def orientation_sums(rows: Tensor, first_row: int, size: Sequence[int]) -> Tensor:
    """Sums (B, 6, 6) over rows of a guide (B, C, h, W) in [0, 1], to be added up for :func:`orientation_of`.

    The rows begin at ``first_row`` of an image of ``size`` (H, W).
    """
    return _sums(_mixture(list(rows.unbind(1))), first_row, size)


def orientation_of(sums: Tensor) -> Tensor:
    """The canonical orientations (B,) for sums (B, 6, 6) over an image.

    The centres of gravity decide, so that small changes of an image do not change its orientation unless it is nearly
    symmetric; where they do not, sums with pseudo-random weights, which are equal only for equal images.
    """
    gravity, hashes = [], []
    for number in range(ORIENTATIONS):
        row, column = number % 2, number // 2 % 2
        down, across = (1 - 2 * row) * sums[:, MOMENT, ONES], (1 - 2 * column) * sums[:, ONES, MOMENT]
        gravity.append(2 * down + across if number < EXCHANGED else 2 * across + down)
        first, second = (FIRST, SECOND) if number < EXCHANGED else (SECOND, FIRST)
        hashes.append(sums[:, first + row, second + column])
    heaviest, tied = torch.stack(gravity, dim=1), torch.stack(hashes, dim=1)
    tied = torch.where(heaviest == heaviest.amax(1, keepdim=True), tied, torch.iinfo(torch.long).min)
    return tied.argmax(1)


def _mixture(channels: Sequence[Tensor]) -> Tensor:
    """Sum of up to :data:`MOST_CHANNELS` channels with different weights, in float64."""
    values = channels[0].double()
    for number, channel in enumerate(channels[1:MOST_CHANNELS], 2):
        values = values + number * channel
    return values


def _sums(shares: Tensor, first_row: int, size: Sequence[int]) -> Tensor:
    """Weighted sums (B, 6, 6) of shares (B, h, W) of the largest value, in whole numbers."""
    rows = torch.arange(shares.shape[1], device=shares.device) + first_row
    down, across = _weights(rows, size[0]), _weights(torch.arange(shares.shape[2], device=shares.device), size[1])
    levels = (shares * LEVELS).round() + 1  # positive: axes differ in length even where all values are equal
    by_row = (levels @ across.mT.double()).long()  # (B, h, 6)
    return (down.mT.unsqueeze(2) * by_row.unsqueeze(2)).sum(1)


def _weights(places: Tensor, length: int) -> Tensor:
    """Weights (6, n) of places (n,) along an axis.

    Ones, distances from the middle, and two pairs of pseudo-random numbers, each pair counted from both ends.
    """
    back = length - 1 - places
    hashes = [hashed(ends) for hashed in (_hash_first, _hash_second) for ends in (places, back)]
    return torch.stack([torch.ones_like(places), places - back, *hashes])


def _hash_first(places: Tensor) -> Tensor:
    return (places * 40503 + places * places * 9973 + 12345) // 16 % HASHED


def _hash_second(places: Tensor) -> Tensor:
    return (places * 60493 + places * places * 7919 + 54321) // 16 % HASHED
