"""Weights between the eight neighbours of each pixel."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

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
