"""Automatic levels: brightness stretched to the whole range, from the darkest to the lightest pixel of a picture.

There are three kinds: of luminance, which changes all channels alike; of the largest channel (value in HSV), which
scales colours; and of each channel for itself. As in other programs, single outliers set the range.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels

KINDS = 3
DARKEST = 1 / 255  # largest channel that colours are divided by
FLAT = 1 / 255  # range of a picture that is not stretched


def brightness(image: Tensor) -> Tensor:
    """Luminance and largest channel (B, 2, H, W) of an image (B, C, H, W)."""
    return torch.cat([reduce_channels(image, "luminance").mean(1, keepdim=True), image.amax(1, keepdim=True)], dim=1)


def tones(image: Tensor) -> Tensor:
    """What is stretched: both kinds of :func:`brightness` and the channels, (B, 2 + C, H, W)."""
    return torch.cat([brightness(image), image], dim=1)


def ends_of(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest values (B, C, 1, 1) of planes (B, C, H, W)."""
    return planes.amin((2, 3), keepdim=True), planes.amax((2, 3), keepdim=True)


@dataclass(frozen=True, eq=False)
class Stretch:
    """The range of a picture's :func:`tones`.

    Attributes:
        darkest: (B, 2 + C, 1, 1).
        width: distance to the lightest; 1 where it is so small that nothing is stretched, and ``darkest`` is 0 there.
    """

    darkest: Tensor
    width: Tensor

    @staticmethod
    def of(ends: tuple[Tensor, Tensor]) -> "Stretch":
        """The range between the least and the largest :func:`tones` of a picture, (B, 2 + C, 1, 1) each."""
        width = ends[1] - ends[0]
        flat = width < FLAT
        return Stretch(ends[0].masked_fill(flat, 0.0), width.masked_fill(flat, 1.0))

    def largest(self, values: Tensor) -> Tensor:
        """Stretch the largest channels (B, 1, H, W) of pixels."""
        return (values - self.darkest[:, 1:2]) / self.width[:, 1:2]

    def changes(self, image: Tensor) -> Tensor:
        """What each kind changes of an image (B, C, H, W): (B, KINDS, C, H, W)."""
        found = tones(image)
        moved = (found - self.darkest) / self.width - found
        scaled = moved[:, 1:2] * image / found[:, 1:2].clamp(min=DARKEST)
        return torch.stack([moved[:, :1].expand_as(image), scaled, moved[:, 2:]], dim=1)

    def change(self, image: Tensor, strengths: Tensor) -> Tensor:
        """The sum (B, C, H, W) of all kinds, weighted by strengths (KINDS,) or (B, KINDS)."""
        return (strengths.to(image).reshape(-1, KINDS, 1, 1, 1) * self.changes(image)).sum(1)
