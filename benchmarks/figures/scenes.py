"""Photographs for the figures, spots on them, and how strokes are shown."""

from typing import Any

import torch
from torch import Tensor

from benchmarks.photographs import photograph
from nlfilter_torch.operator.features import reduce_channels

SIZE = 640  # of the longer side of a photograph, in pixels
SIDE = 384  # of a panel
Numbers = dict[str, Any]  # what JSON holds
Box = tuple[int, int, int, int]  # column, row, width, height, in pixels of the photograph as it ships
YELLOW = (1.0, 0.85, 0.1)
FADED = 0.55  # weight of the photograph under strokes


def scene(name: str, size: int) -> tuple[Tensor, float]:
    """A photograph (1, C, H, W) whose longer side is at most ``size``, and by how much it was reduced."""
    height, width = photograph(name).shape[-2:]
    scale = min(1.0, size / max(height, width))
    if scale == 1.0:
        return photograph(name), scale
    return photograph(name, round(height * scale), round(width * scale)), scale


def spots(image: Tensor, scale: float, *boxes: Box) -> Tensor:
    """A mask (1, 1, H, W), 1 within rectangles, each at least a pixel."""
    mask = torch.zeros_like(image[:, :1])
    for x, y, width, height in boxes:
        left, top = round(x * scale), round(y * scale)
        mask[..., top : top + max(1, round(height * scale)), left : left + max(1, round(width * scale))] = 1
    return mask


def strokes(image: Tensor, scale: float, *painted: tuple[Box, tuple[float, float, float]]) -> tuple[Tensor, Tensor]:
    """Strokes (1, 3, H, W) and their mask (1, 1, H, W) from rectangles of colour."""
    colours, mask = torch.zeros_like(image).expand(-1, 3, -1, -1).clone(), torch.zeros_like(image[:, :1])
    for box, colour in painted:
        spot = spots(image, scale, box)
        colours = torch.where(spot > 0, torch.tensor(colour).view(1, 3, 1, 1), colours)
        mask = torch.maximum(mask, spot)
    return colours, mask


def painted_over(image: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """The photograph, faded, with the strokes on it and a white rim around them."""
    faded = FADED * image.expand(-1, 3, -1, -1) + (1 - FADED) * reduce_channels(image, "luminance")
    return scribbled(faded, colours, mask)


def scribbled(image: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """An RGB image with strokes on it and a white rim around them."""
    rim = torch.nn.functional.max_pool2d(mask, 5, 1, 2)
    return torch.where(mask > 0, colours, torch.where(rim > 0, torch.ones_like(image), image))


def marked(image: Tensor, region: Tensor) -> Tensor:
    """The photograph, faded, with a region in yellow."""
    return painted_over(image, torch.tensor(YELLOW).view(1, 3, 1, 1).expand(-1, -1, *image.shape[-2:]), region)


def luminance(image: Tensor) -> Tensor:
    """(1, 1, H, W)."""
    return reduce_channels(image, "luminance")


def rounded(value: Tensor | float, digits: int = 4) -> float:
    """A number for JSON."""
    return round(float(value), digits)
