"""Photographs and scribbles for the figures, and drawing the scribbles on the photographs."""

from typing import Any

import torch
from torch import Tensor

from benchmarks.photographs import photograph
from nlfilter_torch.operator.features import reduce_channels

SIZE = 640  # longer side of a photograph, in pixels
SIDE = 384  # longer side of a panel
Numbers = dict[str, Any]  # values that JSON can represent
Box = tuple[int, int, int, int]  # column, row, width, height, in pixels of the full-size photograph
YELLOW = (1.0, 0.85, 0.1)
FADED = 0.55  # weight of the photograph under strokes


def scene(name: str, size: int) -> tuple[Tensor, float]:
    """A photograph (1, C, H, W) whose longer side is at most ``size``, and its scale relative to the original."""
    height, width = photograph(name).shape[-2:]
    scale = min(1.0, size / max(height, width))
    if scale == 1.0:
        return photograph(name), scale
    return photograph(name, round(height * scale), round(width * scale)), scale


def spots(image: Tensor, scale: float, *boxes: Box) -> Tensor:
    """Mask (1, 1, H, W) that is 1 inside rectangles, each at least one pixel in size."""
    mask = torch.zeros_like(image[:, :1])
    for x, y, width, height in boxes:
        left, top = round(x * scale), round(y * scale)
        mask[..., top : top + max(1, round(height * scale)), left : left + max(1, round(width * scale))] = 1
    return mask


def strokes(image: Tensor, scale: float, *painted: tuple[Box, tuple[float, float, float]]) -> tuple[Tensor, Tensor]:
    """Strokes (1, 3, H, W) and their mask (1, 1, H, W) from coloured rectangles."""
    colours, mask = torch.zeros_like(image).expand(-1, 3, -1, -1).clone(), torch.zeros_like(image[:, :1])
    for box, colour in painted:
        spot = spots(image, scale, box)
        colours = torch.where(spot > 0, torch.tensor(colour).view(1, 3, 1, 1), colours)
        mask = torch.maximum(mask, spot)
    return colours, mask


def painted_over(image: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """The faded photograph with strokes drawn on it, outlined in white."""
    faded = FADED * image.expand(-1, 3, -1, -1) + (1 - FADED) * reduce_channels(image, "luminance")
    return scribbled(faded, colours, mask)


def scribbled(image: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """An RGB image with strokes drawn on it, outlined in white."""
    rim = torch.nn.functional.max_pool2d(mask, 5, 1, 2)
    return torch.where(mask > 0, colours, torch.where(rim > 0, torch.ones_like(image), image))


def marked(image: Tensor, region: Tensor) -> Tensor:
    """The faded photograph with a region in yellow."""
    return painted_over(image, torch.tensor(YELLOW).view(1, 3, 1, 1).expand(-1, -1, *image.shape[-2:]), region)


def luminance(image: Tensor) -> Tensor:
    """Luminance of an image, (1, 1, H, W)."""
    return reduce_channels(image, "luminance")


def rounded(value: Tensor | float, digits: int = 4) -> float:
    """Round a number for JSON."""
    return round(float(value), digits)
