"""Resizing of pictures: interpolation a few rows at a time, means over blocks, and enlarging of blocks."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.torch_internals import cached_constants

Read = Callable[[int, int], Tensor]  # returns the rows (B, C, n, W) of a picture from start to stop
BLOCK = 64  # rows resized at once


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
    parts = resized_parts(lambda start, stop: partial(read, start, stop), size, wanted, rows, columns)
    return torch.cat([part() for part in parts], dim=2)


def resized_parts(
    read: Callable[[int, int], Callable[[], Tensor]],
    size: tuple[int, int],
    wanted: tuple[int, int],
    rows: range | None = None,
    columns: range | None = None,
) -> Iterator[Callable[[], Tensor]]:
    """Yield parts of :func:`resized`, a few rows each.

    Rows are read here; the function that ``read`` returns for them is called when the part is.
    """
    rows = range(wanted[0]) if rows is None else rows
    across = None if columns is None else interpolation(columns, size[1], wanted[1])
    for start in range(rows.start, rows.stop, BLOCK):
        used, weights = interpolation(range(start, min(start + BLOCK, rows.stop)), size[0], wanted[0])
        yield partial(_part, read(used.start, used.stop), weights, across, wanted[1])


def _part(rows: Callable[[], Tensor], weights: Tensor, across: tuple[slice, Tensor] | None, width: int) -> Tensor:
    """Interpolate rows from the rows of the picture that they depend on, and weights."""
    planes = rows()
    if across is None:
        planes = F.interpolate(planes, (planes.shape[2], width), mode="bicubic", antialias=True)
    else:
        planes = planes[..., across[0]] @ across[1].to(planes).mT
    return torch.einsum("rn,bcnw->bcrw", weights.to(planes), planes)


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


def resize(planes: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize planes (B, C, H, W), see :func:`resized`."""
    return resized(partial(rows_of, planes), (planes.shape[-2], planes.shape[-1]), size)


def rows_of(planes: Tensor, start: int, stop: int) -> Tensor:
    """Rows of planes (B, C, H, W)."""
    return planes[:, :, start:stop]


def cubic(distance: Tensor) -> Tensor:
    """Evaluate Keys' interpolation kernel with a = -1/2."""
    t = distance.abs()
    near, far = (1.5 * t - 2.5) * t * t + 1, ((-0.5 * t + 2.5) * t - 4) * t + 2
    return torch.where(t <= 1, near, torch.where(t < 2, far, torch.zeros_like(t)))


def block_means(planes: Tensor, step: float) -> Tensor:
    """Means over blocks of ``step`` x ``step`` pixels; blocks at the lower and right borders may be smaller.

    With a fractional step, a pixel on the border of two blocks counts in both, weighted by the part in each.
    """
    if step == round(step):
        step = round(step)
        return planes if step == 1 else F.avg_pool2d(planes, step, ceil_mode=True, count_include_pad=False)
    rows, columns = (_shares(length, step).to(planes) for length in planes.shape[-2:])
    return rows @ planes @ columns.mT


def _shares(length: int, step: float) -> Tensor:
    """Weights (n, length) of the pixels along an axis in n blocks of a fractional step."""
    count = math.ceil(length / step - 0.01)  # avoids a very thin last block
    ends = torch.arange(count + 1, dtype=torch.float64) * step
    ends[-1] = length
    first = torch.arange(length, dtype=torch.float64)
    inside = torch.minimum(ends[1:, None], first + 1) - torch.maximum(ends[:-1, None], first)
    inside = inside.clamp(min=0.0)
    return inside / inside.sum(1, keepdim=True)


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
