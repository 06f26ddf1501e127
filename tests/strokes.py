"""Strokes of single pixels, and groups of strokes."""

import torch
from torch import Tensor

from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.selections.connected import StrokeGroups

SIZE = (20, 30)


def groups_of(mask: Tensor) -> tuple[StrokeGroups, Tensor]:
    """Groups of the strokes of a mask (B, 1, H, W), and their places."""
    places = mask.amax((0, 1)).flatten().nonzero().squeeze(1)
    scribbles = Scribbles(places, mask.flatten(2)[:, :, places], torch.zeros(1, 1, len(places)))
    return StrokeGroups.of(scribbles, (mask.shape[2], mask.shape[3])), places


def dots(*positions: tuple[int, int], size: tuple[int, int] = SIZE) -> Tensor:
    mask = torch.zeros(1, 1, *size)
    for row, column in positions:
        mask[..., row, column] = 1
    return mask
