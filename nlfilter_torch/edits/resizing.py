"""Pictures in another size, a few rows at a time."""

import math
from collections.abc import Callable

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
    rows = range(wanted[0]) if rows is None else rows
    scale = size[0] / wanted[0]
    reach = 2 * max(scale, 1.0)  # of the kernel, in rows that are read
    parts = []
    for start in range(rows.start, rows.stop, BLOCK):
        stop = min(start + BLOCK, rows.stop)
        first = max(0, math.floor((start + 0.5) * scale - reach))
        last = min(size[0], math.ceil((stop - 0.5) * scale + reach))
        planes = read(first, last)
        planes = F.interpolate(planes, (planes.shape[2], wanted[1]), mode="bicubic", antialias=True)
        centres = (torch.arange(start, stop, dtype=torch.float64) + 0.5) * scale - 0.5
        weights = cubic((torch.arange(first, last) - centres[:, None]) / max(scale, 1.0))
        weights = (weights / weights.sum(1, keepdim=True)).to(planes)
        parts.append(torch.einsum("rn,bcnw->bcrw", weights, planes))
    return torch.cat(parts, dim=2)


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
