"""The orientation of an image that its content decides: what is drawn in it turns and flips with the image.

An image has eight orientations: either axis may be flipped, and both exchanged. Weighted sums over its pixels are
computed for all eight, in whole numbers, so that no order of summation matters. The one with the largest sums is the
canonical orientation. An image and its mirror image share it, and hence have k-means landmarks of the same patches.
Channels are ordered by their content, too, as some are exchanged with the axes: the strengths of gradients, say.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import cached_constants

LEVELS = 1 << 12  # steps to which values are rounded; sums along a row are then exact in float64
HASHED = 1 << 12  # number of different pseudo-random weights
ORIENTATIONS, EXCHANGED = 8, 4  # number 1 flips the rows, 2 the columns, 4 exchanges the axes afterwards
MOST_CHANNELS = 16  # of the guide that are looked at; more keep their order
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


@dataclass(frozen=True, eq=False)
class Orientation:
    """The canonical orientations of a batch of images.

    Attributes:
        numbers: (B,), from 0 to 7.
        channels: order (B, C) of the channels of the guide; None if they keep it.
    """

    numbers: Tensor
    channels: Tensor | None = None


@cached_constants
def canonical_order(layout: Layout, size: int, device: torch.device) -> Tensor:
    """Indices (8, D) of D = ``size`` features of a pixel in the order of each orientation of its patch."""
    area, numbers = layout.patch * layout.patch, torch.arange(ORIENTATIONS, device=device)
    patches = size - 2 * layout.coordinates
    places = source_pixels(numbers, (layout.patch, layout.patch), torch.arange(area, device=device))
    channels = torch.arange(0, patches, area, device=device).view(1, -1, 1)
    indices = (places.unsqueeze(1) + channels).flatten(1)
    if not layout.coordinates:
        return indices
    exchanged = (numbers // EXCHANGED).unsqueeze(1)
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


def canonical_points(subset: Tensor, orientation: Orientation, layout: Layout, coordinates: Tensor | None) -> Tensor:
    """Features (B, D, S) that pixels would have if their images had the canonical orientation; without a gradient.

    Equal for an image and its mirror image to the last bit.

    Args:
        subset: (B, D, S), features of the pixels with the indices of :func:`source_pixels`.
        orientation: of the images.
        layout: of the features.
        coordinates: (B, 2, S), the last two features of the pixels with the indices for ``flipped=False``, or None
            without coordinates. Mirrored coordinates themselves would differ by rounding.
    """
    subset = subset.detach()
    if coordinates is not None:
        subset = torch.cat([subset[:, :-2], coordinates.detach()], dim=1)
    order = canonical_order(layout, subset.shape[1], subset.device)[orientation.numbers]  # (B, D)
    if orientation.channels is not None:
        patches = subset.shape[1] - 2 * layout.coordinates
        by_channel = order[:, :patches].unflatten(1, (-1, layout.patch * layout.patch))
        moved = by_channel.gather(1, orientation.channels.unsqueeze(2).expand_as(by_channel)).flatten(1)
        order = torch.cat([moved, order[:, patches:]], dim=1)
    return subset.gather(1, order.unsqueeze(2).expand_as(subset))


def orientation_sums(rows: Tensor, first_row: int, size: Sequence[int], counted: Tensor | None = None) -> Tensor:
    """Sums (B, C, 6, 6) over rows of a guide (B, C, h, W) in [0, 1], to be added up for :func:`orientation_of`.

    The rows begin at ``first_row`` of an image of ``size`` (H, W). Where ``counted`` (B, h, W) is 0, no pixel counts.
    """
    channels = rows.unbind(1)[:MOST_CHANNELS]
    return torch.stack([whole_sums(channel, first_row, size, counted) for channel in channels], dim=1)


def stretched_sums(sums: Tensor, counted: Tensor, least: float, most: float) -> Tensor:
    """Sums (B, C, 6, 6) over pixels that count, as if their values had been stretched from [least, most] to [0, 1].

    ``counted`` (B, 1, 6, 6) are those of values of 0.
    """
    span = most - least if most > least else 1.0
    inside = (sums - counted).double() - LEVELS * least * counted.double()
    return (inside / span).round().long() + counted


def orientation_of(sums: Tensor, channels: int) -> Orientation:
    """The canonical orientations for sums (B, C, 6, 6) over images of whose ``channels`` the first C were looked at.

    The centres of gravity decide, so that small changes of an image do not change its orientation unless it is nearly
    symmetric; where they do not, sums with pseudo-random weights, which are equal only for equal images.
    """
    order = None
    if 1 < channels == sums.shape[1]:
        order = sums[:, :, ONES, ONES].argsort(dim=1, descending=True, stable=True)
        sums = sums.gather(1, order[..., None, None].expand_as(sums))
    mixed = sums[:, 0]
    for number in range(1, sums.shape[1]):
        mixed = mixed + (number + 1) * sums[:, number]
    flips, places = (constant.to(sums.device) for constant in _orientations())
    moments = torch.stack([mixed[:, MOMENT, ONES], mixed[:, ONES, MOMENT]], dim=1)
    heaviest, hashes = (moments.unsqueeze(1) * flips).sum(2), mixed[:, places[0], places[1]]  # (B, 8)
    tied = torch.where(heaviest == heaviest.amax(1, keepdim=True), hashes, torch.iinfo(torch.long).min)
    return Orientation(tied.argmax(1), order)


@cached_constants
def _orientations() -> tuple[Tensor, Tensor]:
    """For each orientation, weights (8, 2) of the moments down and across, and the place (2, 8) of its hash."""
    numbers = torch.arange(ORIENTATIONS)
    upset, turned, exchanged = numbers % 2, numbers // 2 % 2, numbers >= EXCHANGED
    first, second = torch.where(exchanged, SECOND, FIRST), torch.where(exchanged, FIRST, SECOND)
    heavier = torch.where(exchanged, 1, 2)  # the axis that counts first
    flips = torch.stack([(1 - 2 * upset) * heavier, (1 - 2 * turned) * (3 - heavier)], dim=1)
    return flips, torch.stack([first + upset, second + turned])


def whole_sums(shares: Tensor, first_row: int, size: Sequence[int], counted: Tensor | None = None) -> Tensor:
    """Weighted sums (B, 6, 6) of shares (B, h, W) of the largest value, in whole numbers.

    Pixels where ``counted`` (B, h, W) is 0 do not count.
    """
    down = _weights(first_row, shares.shape[1], size[0]).to(shares.device)
    across = _weights(0, shares.shape[2], size[1]).to(shares.device)
    levels = (shares * LEVELS).round().double() + 1  # positive: axes differ in length even where all values are equal
    levels = levels if counted is None else levels * counted
    by_row = (levels @ across.mT.double()).long()  # (B, h, 6)
    return (down.mT.unsqueeze(2) * by_row.unsqueeze(2)).sum(1)


@cached_constants
def _weights(first: int, count: int, length: int) -> Tensor:
    """Weights (6, n) of so many places along an axis, from the ``first`` on.

    Ones, distances from the middle, and two pairs of pseudo-random numbers, each pair counted from both ends.
    """
    places = torch.arange(first, first + count)
    back = length - 1 - places
    hashes = [hashed(ends) for hashed in (_hash_first, _hash_second) for ends in (places, back)]
    return torch.stack([torch.ones_like(places), places - back, *hashes])


def _hash_first(places: Tensor) -> Tensor:
    return _scattered((places * 40503 + 12345) % 65521)


def _hash_second(places: Tensor) -> Tensor:
    return _scattered((places * 60493 + 54321) % 65521)


def _scattered(numbers: Tensor) -> Tensor:
    """Pseudo-random numbers; a polynomial of a place would be tied wherever the centre of gravity is."""
    return numbers * numbers % 32749 % HASHED
