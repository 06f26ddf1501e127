"""Sizes of panels, and scribbles on faded photographs, for the pictures of the documentation."""

from typing import Any

import torch
from torch import Tensor

from benchmarks.photographs import luminance, scribbled

SIDE = 384  # longer side of a panel
LETTERS = 27  # height of captions in pixels: phones show pictures of three columns at less than half their size
Numbers = dict[str, Any]  # values that JSON can represent
YELLOW = (1.0, 0.85, 0.1)
FADED = 0.55  # weight of the photograph under strokes


def painted_over(image: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """The faded photograph with strokes drawn on it, outlined in white."""
    faded = FADED * image.expand(-1, 3, -1, -1) + (1 - FADED) * luminance(image)
    return scribbled(faded, colours, mask)


def marked(image: Tensor, region: Tensor) -> Tensor:
    """The faded photograph with a region in yellow."""
    return painted_over(image, torch.tensor(YELLOW).view(1, 3, 1, 1).expand(-1, -1, *image.shape[-2:]), region)


def rounded(value: Tensor | float, digits: int = 4) -> float:
    """Round a number for JSON."""
    return round(float(value), digits)
