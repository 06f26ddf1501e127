"""Pictures in another size, a few rows at a time."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

Read = Callable[[int, int], Tensor]  # the rows (B, C, n, W) of a picture from one number to another
BLOCK = 64  # rows that are resized at once


def resized(read: Read, size: tuple[int, int], wanted: tuple[int, int], rows: range | None = None) -> Tensor:
    """Some rows of a picture in another size, by bicubic interpolation with antialiasing.

    Args:
        read: its rows.
        size: (H, W) of the picture.
        wanted: (H, W) it is to have.
        rows: of the result, all by default.
    """
    return torch.cat([part() for part in resized_parts(read, size, wanted, rows)], dim=2)


def resized_parts(
    read: Read, size: tuple[int, int], wanted: tuple[int, int], rows: range | None = None
) -> Iterator[Callable[[], Tensor]]:
    """The rows of :func:`resized`, a few at a time: they are read here, and resized when the part is called."""
    rows = range(wanted[0]) if rows is None else rows
    scale = size[0] / wanted[0]
    reach = 2 * max(scale, 1.0)  # of the kernel, in rows that are read
    for start in range(rows.start, rows.stop, BLOCK):
        stop = min(start + BLOCK, rows.stop)
        first = max(0, math.floor((start + 0.5) * scale - reach))
        last = min(size[0], math.ceil((stop - 0.5) * scale + reach))
        yield partial(_part, read(first, last), range(start, stop), first, scale, wanted[1])


def _part(planes: Tensor, rows: range, first: int, scale: float, width: int) -> Tensor:
    """Some rows, from those of the picture from number ``first`` on."""
    planes = F.interpolate(planes, (planes.shape[2], width), mode="bicubic", antialias=True)
    centres = (torch.arange(rows.start, rows.stop, dtype=torch.float64) + 0.5) * scale - 0.5
    weights = cubic((torch.arange(first, first + planes.shape[2]) - centres[:, None]) / max(scale, 1.0))
    weights = (weights / weights.sum(1, keepdim=True)).to(planes)
    return torch.einsum("rn,bcnw->bcrw", weights, planes)


def resize(planes: Tensor, size: tuple[int, int]) -> Tensor:
    """Planes (B, C, H, W) in another size, see :func:`resized`."""
    return resized(lambda start, stop: planes[:, :, start:stop], (planes.shape[-2], planes.shape[-1]), size)


def cubic(distance: Tensor) -> Tensor:
    """Keys' interpolation kernel with a = -1/2."""
    t = distance.abs()
    near, far = (1.5 * t - 2.5) * t * t + 1, ((-0.5 * t + 2.5) * t - 4) * t + 2
    return torch.where(t <= 1, near, torch.where(t < 2, far, torch.zeros_like(t)))


def enlarged(blocks: Tensor, step: int, first: int, size: tuple[int, int]) -> Tensor:
    """Rows (B, C, h, W) of a picture from values (B, C, n, m) of its blocks, between whose middles they are linear.

    Args:
        blocks: as of :func:`nlfilter_torch.edits.source.block_means`.
        step: rows and columns of a block.
        first: number of the first row.
        size: (h, W).
    """
    low, high = max(0, first // step - 1), (first + size[0] - 1) // step + 2
    rows = blocks[:, :, low:high]
    if step > 1:
        rows = F.interpolate(rows, scale_factor=step, mode="bilinear", align_corners=False)
    return rows[:, :, first - low * step :, :][:, :, : size[0], : size[1]]
