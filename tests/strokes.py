"""Strokes as masks and colours, strokes of single pixels, and groups of strokes."""

from collections.abc import Iterable

import torch
from torch import Tensor

from nlfilter_torch.photo.declared.strokes import Mark
from nlfilter_torch.photo.picture.painting import rasterised
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.selections.connected import StrokeGroups

SIZE = (20, 30)


def mask_of(
    marks: Iterable[Mark], size: tuple[int, int], rows: slice | None = None, *, above: Iterable[Mark] = ()
) -> Tensor:
    """The mask (1, 1, H, W) of marks, without what others cover of them."""
    plane = *((mark, True) for mark in marks), *((mark, False) for mark in above)
    return rasterised([plane], size, rows)


def paint(marks: Iterable[Mark], size: tuple[int, int], rows: slice | None = None) -> tuple[Tensor, Tensor]:
    """Colours (1, 3, H, W) of marks, and their mask."""
    planes = rasterised([tuple((mark, True) for mark in marks)], size, rows, coloured=True)
    return planes[:, :3], planes[:, 3:]


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
