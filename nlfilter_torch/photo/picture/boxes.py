"""Rectangles around objects, as hints for their masks: an object lies within its rectangle, but does not fill it."""

from collections.abc import Sequence
from numbers import Real

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_finite
from nlfilter_torch.core.torch_internals import is_hidden
from nlfilter_torch.photo.picture.pixels import Box, Pixels, corner
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, Size

ORDER = "give left, top, right and bottom in this order"
AROUND = 0.1  # width of what tells the background around a box, as a share of the side of a square of its area
ROUNDING = 1e-3  # pixels that a box may lie outside a picture: float32 coordinates of large pictures are this exact


def boxes_of(box: Box, size: Size, batch: int, count: int | None) -> Tensor:
    """Boxes (B, K, 4) in pixels of a picture (H, W), one for each of ``count`` regions; None is as many as there are.

    Raises:
        TypeError, ValueError: if they are none, do not lie in the picture, or are another number.
    """
    boxes = _tensor_of(box)
    shape = tuple(boxes.shape)
    if boxes.ndim != 3 or shape[2] != 4 or shape[1] == 0 or shape[0] not in (1, batch):
        raise ValueError(
            f"box must be four numbers (left, top, right, bottom) in pixels, or have shape ({batch}, K, 4) with four "
            f"for each of K regions, got {shape if isinstance(box, Tensor) else tuple(box)}; reshape it"
        )
    count = shape[1] if count is None else count
    if shape[1] not in (1, count):
        raise ValueError(
            f"box must be one for all regions or one for each of the {count} regions, got {shape[1]}; add or drop some"
        )
    check_finite(boxes, "box")
    boxes = boxes.float()
    if not is_hidden(boxes):
        _check_places(boxes, size)
    return boxes.expand(batch, count, 4)


def _tensor_of(box: Box) -> Tensor:
    """The boxes of an argument, with three dimensions if it is a single one."""
    if isinstance(box, Tensor):
        if box.dtype == torch.bool or box.is_complex():
            raise TypeError(f"box must hold numbers of pixels, got {box.dtype}; convert it with .float()")
        return box.view(1, 1, 4) if tuple(box.shape) == (4,) else box
    if not isinstance(box, Sequence) or not all(isinstance(v, Real) and not isinstance(v, bool) for v in box):
        raise TypeError(
            f"box must be four numbers (left, top, right, bottom) in pixels, or a tensor (B, K, 4), got {box!r}; "
            f"{ORDER}"
        )
    return torch.tensor([[[float(number) for number in box]]], dtype=torch.float64)


def _check_places(boxes: Tensor, size: Size) -> None:
    """Raise ValueError if a box is inverted, is narrower than a pixel, or leaves a picture (H, W)."""
    for box in boxes.flatten(0, 1).tolist():
        left, top, right, bottom = box
        shown = "({:g}, {:g}, {:g}, {:g})".format(*box)
        if right - left < 1 - ROUNDING or bottom - top < 1 - ROUNDING:
            raise ValueError(f"box must be at least 1 pixel wide and high, got {shown}; {ORDER}")
        if min(left, top) < -ROUNDING or right > size[1] + ROUNDING or bottom > size[0] + ROUNDING:
            raise ValueError(
                f"box must lie within the picture, which is {size[1]} pixels wide and {size[0]} high, got {shown}; "
                "move or shrink it"
            )


def scaled(boxes: Tensor, size: Size, other: Size) -> Tensor:
    """Boxes (B, K, 4) of a picture (H, W) in another size of it, where they are at least a pixel wide and high."""
    (height, width), lengths = size, boxes.new_tensor([other[1], other[0]])
    starts, ends = (boxes * (lengths / boxes.new_tensor([width, height])).repeat(2)).split(2, dim=2)
    wider = (1 - (ends - starts)).clamp(min=0.0) / 2
    starts = torch.minimum((starts - wider).clamp(min=0.0), lengths - 1)
    return torch.cat([starts, torch.minimum(torch.maximum(ends + wider, starts + 1), lengths)], dim=2)


def in_boxes(boxes: Tensor, pixels: Pixels) -> Tensor:
    """Which pixels have their centre in each box, (B, K, h, w) of bool."""
    return held(boxes.to(pixels.image.device), pixels.image.shape[-2:], corner(pixels))


def held(boxes: Tensor, size: Sequence[int], first: tuple[int, int] = (0, 0)) -> Tensor:
    """Which of (h, w) pixels, the first of which is in that row and column, have their centre in boxes."""
    rows, columns = (torch.arange(start, start + count) for start, count in zip(first, size, strict=True))
    return _within(boxes, 1, rows).unsqueeze(3) & _within(boxes, 0, columns).unsqueeze(2)


def _within(boxes: Tensor, axis: int, places: Tensor) -> Tensor:
    """Which pixels at places (n,) along an axis have their centre between the sides of boxes (..., 4), (..., n)."""
    centres = places.to(boxes.device) + 0.5
    return (boxes[..., axis, None] <= centres) & (centres < boxes[..., axis + 2, None])


def just_outside(boxes: Tensor, size: Size) -> Tensor:
    """Which pixels of a picture (H, W) lie just outside each box, (B, K, H, W) of bool: they tell its background."""
    sides = boxes[..., 2:] - boxes[..., :2]
    margin = (AROUND * sides.prod(-1, keepdim=True).sqrt()).clamp(min=1.0)
    return held(torch.cat([boxes[..., :2] - margin, boxes[..., 2:] + margin], dim=-1), size) & ~held(boxes, size)


def check_scribbles_in(boxes: Tensor, inside: Sequence[Scribbles], size: Size, name: str) -> None:
    """Raise ValueError if most of the scribbles on a region, which errors call ``name``, lie outside its box.

    A stroke may cross the edge, as one that strays may leave its object; what lies outside does not count.

    Args:
        boxes: (B, K, 4), in pixels of the picture.
        inside: the scribbles on each of K regions, one of them on every region in each.
        size: (H, W) of the picture.
        name: of the scribbles.
    """
    for number, scribbles in enumerate(inside):
        weights = scribbles.weights.detach()[:, 0]
        own, places = boxes[:, number].to(weights.device), scribbles.places
        inner = _within(own, 1, places // size[1]) & _within(own, 0, places % size[1])
        if not is_hidden(weights) and bool(((weights * inner).sum(1) < weights.sum(1) / 2).any()):
            raise ValueError(
                f"box must hold most of the {name} on its object in every image, got some that lie mostly outside; "
                "enlarge it, or move them"
            )
