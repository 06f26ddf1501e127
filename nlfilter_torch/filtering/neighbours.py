"""Weights between the eight neighbours of each pixel, and linear systems of pixels and their neighbours."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.precision import full_precision

OFFSETS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (row, column) offsets to half of the neighbours, so each pair occurs once

Slices = tuple[slice, slice]


def _sides(offset: tuple[int, int]) -> tuple[Slices, Slices]:
    """Slices of the pixels that have a neighbour at ``offset``, and of these neighbours."""
    down, right = offset
    here = (slice(None, -down or None), slice(1, None) if right < 0 else slice(None, -right or None))
    there = (slice(down, None), slice(None, -1) if right < 0 else slice(right, None))
    return here, there


SIDES = tuple(_sides(offset) for offset in OFFSETS)
PADDING = ((0, 1, 0, 0), (0, 0, 0, 1), (0, 1, 0, 1), (1, 0, 0, 1))  # from pixels with such a neighbour to all pixels


def neighbour_weights(guide: Tensor, weight: Callable[[Tensor], Tensor]) -> Tensor:
    """Weights (B, 4, H, W) of each pixel of a guide with its neighbours at :data:`OFFSETS`, 0 where there is none.

    ``weight`` is a function of squared distances (B, h, w), summed over the channels.
    """
    weights = []
    for (here, there), padding in zip(SIDES, PADDING, strict=True):
        distance = (guide[..., *here] - guide[..., *there]).square().sum(1)
        weights.append(F.pad(weight(distance), padding))
    return torch.stack(weights, dim=1)


@full_precision
def solve_stencil(stencil: Tensor, right: Tensor) -> Tensor:
    """Solve a linear system in which the equation of each pixel contains the pixel and its eight neighbours.

    The matrix need not be symmetric. It is block tridiagonal, with a block for each row of pixels (or each column, if
    these are shorter), and is eliminated block by block in float64: an image of h x w pixels, h <= w, takes about
    3 h^3 w operations. The blocks are not exchanged, so each equation's own coefficient should be the largest.

    Args:
        stencil: (B, 3, 3, H, W); coefficient of the neighbour in the previous, same or next row and column. Those of
            neighbours outside the image are ignored.
        right: right sides, (B, C, H, W).

    Returns:
        The solution (B, C, H, W). Differentiable any number of times.

    Example:
        >>> stencil = torch.zeros(1, 3, 3, 1, 5)  # every pixel is the mean of its neighbours in the row
        >>> stencil[:, 1, 0] = stencil[:, 1, 2] = -1
        >>> stencil[:, 1, 1] = 2
        >>> right = torch.tensor([0.0, 0, 0, 0, 6]).view(1, 1, 1, 5)  # 0 before the row, 6 after it
        >>> solve_stencil(stencil, right).flatten()
        tensor([1., 2., 3., 4., 5.])
    """
    if right.shape[3] > right.shape[2]:
        return solve_stencil(stencil.transpose(1, 2).mT, right.mT).mT
    width = right.shape[3]
    # Matrices are stored transposed, since LAPACK expects columns to be contiguous.
    rows: list[Tensor] = []  # of each row of pixels: matrix for the next row and constant, (B, W+C, W)
    stencils = stencil.double().permute(3, 1, 0, 2, 4)  # (H, 3, B, 3, W)
    padded = F.pad(stencils, (1, 1))
    turned = torch.stack([padded[..., 2, :-2], stencils[..., 1, :], padded[..., 0, 2:]], dim=-1)  # (H, 3, B, W, 3)
    for bands, columns, constant in zip(stencils, turned, right.double().permute(2, 0, 1, 3), strict=True):
        own, after = _tridiagonal(columns[1]), _tridiagonal(columns[2])
        if rows:
            eliminated = _tridiagonal_product(bands[0], rows[-1])
            own, constant = own + eliminated[:, :width], constant - eliminated[:, width:]
        rows.append(torch.linalg.solve(own.mT, torch.cat([-after, constant], dim=1).mT).mT)
    found = [rows.pop()[:, width:]]
    for row in reversed(rows):
        found.append(torch.baddbmm(row[:, width:], found[-1], row[:, :width]))
    return torch.stack(found[::-1], dim=2).to(right.dtype)


def _tridiagonal(bands: Tensor) -> Tensor:
    """Matrices (B, N, N) with the rows' entries (B, N, 3) on and beside the diagonal."""
    count = bands.shape[1]
    # Rows of N + 3 entries, read as rows of N + 2, move to the right by one from row to row.
    entries = F.pad(bands, (0, count)).flatten(1)[:, : count * (count + 2)]
    return entries.unflatten(1, (count, count + 2))[..., 1:-1]


def _tridiagonal_product(bands: Tensor, transposed: Tensor) -> Tensor:
    """Transposed product of tridiagonal matrices and matrices, of which the second are given transposed, (B, K, N).

    ``bands`` (B, 3, N) has the entries before, on and after the diagonal in each row.
    """
    before, own, after = bands.split(1, dim=1)  # (B, 1, N)
    padded = F.pad(transposed, (1, 1))
    return torch.addcmul(torch.addcmul(own * transposed, before, padded[..., :-2]), after, padded[..., 2:])
