"""Resizing of pictures: interpolation a few rows at a time, means over blocks, and enlarging of blocks."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.torch_internals import cached_constants

Read = Callable[[int, int], Tensor]  # returns the rows (B, C, n, W) of a picture from start to stop
BLOCK = 64  # rows resized at once
PIECE = 1 << 21  # pixels, at most, that are reduced along rows at once
SMALL_SHARE = 1e-3  # share of a block that must count


def resized(
    read: Read,
    size: tuple[int, int],
    wanted: tuple[int, int],
    rows: range | None = None,
    columns: range | None = None,
) -> Tensor:
    """Resize a picture, or compute some rows and columns of the result, by bicubic interpolation with antialiasing.

    ``read`` returns rows of the picture (H, W); ``wanted`` is its new size.
    """
    parts = resized_parts(size, wanted, rows, columns)
    return torch.cat([part.of(read(piece.start, piece.stop) for piece in part.pieces) for part in parts], dim=2)


def resized_parts(
    size: tuple[int, int], wanted: tuple[int, int], rows: range | None = None, columns: range | None = None
) -> Iterator["ResizedPart"]:
    """Yield the parts of which :func:`resized` joins a picture, a few rows each."""
    rows = range(wanted[0]) if rows is None else rows
    across = None if columns is None else interpolation(columns, size[1], wanted[1])
    for start in range(rows.start, rows.stop, BLOCK):
        used, weights = interpolation(range(start, min(start + BLOCK, rows.stop)), size[0], wanted[0])
        step = max(1, PIECE // size[1])
        pieces = [slice(first, min(first + step, used.stop)) for first in range(used.start, used.stop, step)]
        yield ResizedPart(pieces, weights, across, wanted[1])


@dataclass(frozen=True, eq=False)
class ResizedPart:
    """Some rows of a resized picture.

    Attributes:
        pieces: the rows of the picture that they depend on, a few at a time.
        weights: of these rows, (h, n).
        across: the columns of the picture that they depend on, and their weights; None if all columns are wanted.
        width: of the resized picture.
    """

    pieces: list[slice]
    weights: Tensor
    across: tuple[slice, Tensor] | None
    width: int

    def of(self, pieces: Iterable[Tensor]) -> Tensor:
        """Interpolate the rows from the pieces (B, C, n, W), each of which is used before the next is read."""
        planes = torch.cat([_along_rows(piece, self.across, self.width) for piece in pieces], dim=2)
        return torch.einsum("rn,bcnw->bcrw", self.weights.to(planes), planes)


def _along_rows(planes: Tensor, across: tuple[slice, Tensor] | None, width: int) -> Tensor:
    """Interpolate each row."""
    if across is None:
        return F.interpolate(planes, (planes.shape[2], width), mode="bicubic", antialias=True)
    return planes[..., across[0]] @ across[1].to(planes).mT


@cached_constants  # strips of one picture have the same columns
def interpolation(places: range, length: int, wanted: int) -> tuple[slice, Tensor]:
    """Part of an axis that interpolation at places of the resized axis reads, and weights (places, part) in float64."""
    scale = length / wanted
    kernel_radius = 2 * max(scale, 1.0)
    first = max(0, math.floor((places.start + 0.5) * scale - kernel_radius))
    last = min(length, math.ceil((places.stop - 0.5) * scale + kernel_radius))
    centres = (torch.arange(places.start, places.stop, dtype=torch.float64) + 0.5) * scale - 0.5
    weights = cubic((torch.arange(first, last) - centres[:, None]) / max(scale, 1.0))
    return slice(first, last), weights / weights.sum(1, keepdim=True)


def resized_part(rows: Tensor, start: int, size: tuple[int, int], wanted: tuple[int, int]) -> tuple[int, Tensor]:
    """What rows (B, C, h, W) of a picture (H, W), from ``start`` on, contribute to its resized rows, and the first one.

    Parts of all rows are to be added up.
    """
    stop, scale = start + rows.shape[2], size[0] / wanted[0]
    reach = 2 * max(scale, 1.0)
    first = max(0, math.floor((start - reach) / scale - 0.5))
    last = min(wanted[0], math.ceil((stop + reach) / scale + 0.5))
    parts = []
    for place in range(first, last, BLOCK):
        used, weights = interpolation(range(place, min(place + BLOCK, last)), size[0], wanted[0])
        inside = slice(max(used.start, start), min(used.stop, stop))
        if inside.start >= inside.stop:
            parts.append(rows.new_zeros(*rows.shape[:2], len(weights), wanted[1]))
            continue
        weights = weights[:, inside.start - used.start : inside.stop - used.start]
        along = _along_rows(rows[:, :, inside.start - start : inside.stop - start], None, wanted[1])
        parts.append(torch.einsum("rn,bcnw->bcrw", weights.to(along), along))
    return first, torch.cat(parts, dim=2)


def resize(planes: Tensor, wanted: tuple[int, int], rows: range | None = None, columns: range | None = None) -> Tensor:
    """Resize planes (B, C, H, W), see :func:`resized`."""
    parts = resized_parts((planes.shape[-2], planes.shape[-1]), wanted, rows, columns)
    return torch.cat([part.of(planes[:, :, piece] for piece in part.pieces) for part in parts], dim=2)


def cubic(distance: Tensor) -> Tensor:
    """Evaluate Keys' interpolation kernel with a = -1/2."""
    t = distance.abs()
    near, far = (1.5 * t - 2.5) * t * t + 1, ((-0.5 * t + 2.5) * t - 4) * t + 2
    return torch.where(t <= 1, near, torch.where(t < 2, far, torch.zeros_like(t)))


def block_counts(size: tuple[int, int], step: float) -> tuple[int, int]:
    """Numbers of rows and columns of blocks of about ``step`` x ``step`` pixels of a picture (H, W)."""
    height, width = (max(1, math.ceil(length / step - 0.01)) for length in size)  # no very thin last block
    return height, width


def weights_of(planes: Tensor) -> Tensor:
    """Weights from reduced weights (B, 1, H, W): from 0 to 1, without what interpolation leaves far from any."""
    return torch.where(planes < SMALL_SHARE, 0.0, planes).clamp(max=1.0)


def block_means(planes: Tensor, step: float) -> Tensor:
    """Means over blocks of about ``step`` x ``step`` pixels, a whole number of which fill the picture evenly."""
    size = (planes.shape[-2], planes.shape[-1])
    return planes if block_counts(size, step) == size else block_parts(planes, 0, size, step)[1].to(planes)


def block_parts(rows: Tensor, start: int, size: tuple[int, int], step: float) -> tuple[int, Tensor]:
    """What rows (B, C, h, W) of a picture (H, W) contribute to its means over blocks, (B, C, n, m) in float64.

    Blocks are about ``step`` x ``step`` pixels, a whole number of which fill the picture evenly. A pixel on the border
    of two blocks counts in both, weighted by the part in each. In float32, the means of a mirrored picture would differ
    by rounding, and with them its landmarks. ``start`` is the first of the rows; the number of the first row of blocks
    comes with the result. Parts of all rows are to be added up.
    """
    counts, stop = block_counts(size, step), start + rows.shape[2]
    whole = round(step)
    if all(count * whole == length for count, length in zip(counts, size, strict=True)) and start % whole == 0:
        strips = rows.split(whole * BLOCK, dim=2)  # float64 of a few rows at a time
        return start // whole, torch.cat([F.avg_pool2d(strip.double(), whole) for strip in strips], dim=2)
    first, last = start * counts[0] // size[0], (stop * counts[0] - 1) // size[0]
    down = _parts(rows.double(), 2, (first, last + 1), size[0], counts[0], start)
    return first, _parts(down, 3, (0, counts[1]), size[1], counts[1], 0)


def _parts(planes: Tensor, axis: int, wanted: tuple[int, int], length: int, count: int, start: int) -> Tensor:
    """Weighted sums of planes over the blocks ``wanted`` of an axis that ``count`` blocks divide evenly.

    Args:
        planes: part of a picture, from its row or column ``start`` on.
        axis: that is divided.
        wanted: numbers of the first block and of that after the last.
        length: of the axis in the whole picture.
        count: of the blocks of the whole picture.
        start: where the planes begin.
    """
    blocks, here = torch.arange(*wanted), planes.shape[axis]
    total = torch.zeros((), dtype=planes.dtype, device=planes.device)
    for step in range(length // count + 2):
        pixels = blocks * length // count + step
        inside = torch.minimum((blocks + 1) * length, (pixels + 1) * count) - torch.maximum(
            blocks * length, pixels * count
        )  # in units of a pixel over the number of blocks
        inside = torch.where((pixels >= start) & (pixels < start + here), inside, 0).clamp(min=0)
        places = (pixels - start).clamp(0, here - 1).to(planes.device)
        share = (inside.double() / length).to(planes)
        total = total + planes.index_select(axis, places) * (share.unsqueeze(1) if axis == 2 else share)
    return total


def enlarged(blocks: Tensor, steps: tuple[float, float], corner: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Interpolate a part (B, C, h, w) of a picture bilinearly between the centres of blocks (B, C, n, m).

    ``steps`` are height and width of a block, ``corner`` row and column of the first pixel of the part.
    """
    above, below, share_below = _nearest_blocks(corner[0], size[0], steps[0], blocks.shape[2])
    left, right, share_right = _nearest_blocks(corner[1], size[1], steps[1], blocks.shape[3])
    first, last = int(above[0]), int(below[-1])
    used = blocks[:, :, first : last + 1]
    columns = _interpolated(used, 3, left, right, share_right)
    return _interpolated(columns, 2, above - first, below - first, share_below.unsqueeze(1))


def _nearest_blocks(first: int, count: int, step: float, blocks: int) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the two blocks nearest to each of ``count`` pixels from ``first`` on, and weights of the second ones.

    Pixels beyond the centre of the first or the last block take its value.
    """
    position = ((torch.arange(first, first + count, dtype=torch.float64) + 0.5) / step - 0.5).clamp(0, blocks - 1)
    before = position.long()
    return before, (before + 1).clamp(max=blocks - 1), position - before


def _interpolated(values: Tensor, axis: int, before: Tensor, after: Tensor, share: Tensor) -> Tensor:
    device = values.device
    start, end = (values.index_select(axis, indices.to(device)) for indices in (before, after))
    return start.lerp_(end, share.to(values))
