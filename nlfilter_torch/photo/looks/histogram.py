"""Changes by the histogram of a picture: automatic levels of the whole, and tone curves of its parts.

Automatic levels stretch brightness to the whole range, from the darkest to the lightest pixel. There are three kinds:
of luminance, which changes all channels alike; of the largest channel (value in HSV), which scales colours; and of each
channel for itself. As in other programs, single outliers set the range.

Tone curves equalise the histogram around a pixel as far as limits of contrast allow. After Zuiderveld, "Contrast
Limited Adaptive Histogram Equalization" (1994): clipped histograms of 8 x 8 tiles give curves, and a pixel takes its
value from the curves of the four nearest tiles. Here histograms are of hat functions, so that curves are continuous in
the picture. What curves of luminance change is added to every channel; curves of the largest channel, which is
stretched to the whole range first, scale colours.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.picture.resizing import block_counts, block_means

GREY_LEVEL = 1 / 255  # pictures of a smaller range are not stretched, and colours are divided by no smaller value
KINDS_OF_LEVELS = 3  # of automatic levels
CONTRAST_LIMITS = (1.5, 2.0, 3.0, 5.0)  # clip limits relative to an even histogram; also the steepest slopes of curves
STRENGTHS = 2 * len(CONTRAST_LIMITS)  # of tone curves of luminance, and of the largest channel
SHADES = 33  # between which curves are straight: 32 steps of 8 levels of 255
TILES = 8  # along both sides
FINE = 16  # blocks along the short side of a tile that histograms are first taken of


def brightness(image: Tensor) -> Tensor:
    """Luminance and largest channel (B, 2, H, W) of an image (B, C, H, W)."""
    return torch.cat([reduce_channels(image, "luminance").mean(1, keepdim=True), image.amax(1, keepdim=True)], dim=1)


def tones(image: Tensor) -> Tensor:
    """The planes that levels stretch: both kinds of :func:`brightness` and the channels, (B, 2 + C, H, W)."""
    return torch.cat([brightness(image), image], dim=1)


@dataclass(frozen=True, eq=False)
class Stretch:
    """The range of a picture's :func:`tones`.

    Attributes:
        darkest: (B, 2 + C, 1, 1).
        width: distance to the lightest tone, (B, 2 + C, 1, 1). Where it is so small that nothing is stretched, it is 1,
            and ``darkest`` is 0.
    """

    darkest: Tensor
    width: Tensor

    @staticmethod
    def of(ends: tuple[Tensor, Tensor]) -> "Stretch":
        """The range between the least and the largest :func:`tones` of a picture, (B, 2 + C, 1, 1) each."""
        width = ends[1] - ends[0]
        flat = width < GREY_LEVEL
        return Stretch(ends[0].masked_fill(flat, 0.0), width.masked_fill(flat, 1.0))

    def largest(self, values: Tensor) -> Tensor:
        """Stretch the largest channels (B, 1, H, W) of pixels."""
        return (values - self.darkest[:, 1:2]) / self.width[:, 1:2]

    def changes(self, image: Tensor) -> Tensor:
        """Changes (B, KINDS_OF_LEVELS, C, H, W) of an image (B, C, H, W) by each kind of levels."""
        before = tones(image)
        moved = (before - self.darkest) / self.width - before
        scaled = moved[:, 1:2] * image / before[:, 1:2].clamp(min=GREY_LEVEL)
        return torch.stack([moved[:, :1].expand_as(image), scaled, moved[:, 2:]], dim=1)

    def change(self, image: Tensor, strengths: Tensor) -> Tensor:
        """The sum (B, C, H, W) of all kinds, weighted by strengths (KINDS_OF_LEVELS,) or (B, KINDS_OF_LEVELS)."""
        return (strengths.to(image).reshape(-1, KINDS_OF_LEVELS, 1, 1, 1) * self.changes(image)).sum(1)


def ramps(image: Tensor, stretch: Stretch) -> Tensor:
    """Position of luminance and of the stretched largest channel between each shade and the next, in [0, 1].

    Returns:
        (B, 2 (K - 1), H, W).
    """
    light = _stretched(brightness(image), stretch) * (SHADES - 1)
    return torch.stack([light.clamp(k, k + 1) - k for k in range(SHADES - 1)], dim=2).flatten(1, 2)


def mean_ramps(image: Tensor, stretch: Stretch, step: int) -> Tensor:
    """:func:`block_means` of :func:`ramps`, with one shade in memory at a time."""
    light = _stretched(brightness(image), stretch) * (SHADES - 1)
    means = [block_means(light.clamp(k, k + 1), step) - k for k in range(SHADES - 1)]
    return torch.stack(means, dim=2).flatten(1, 2)


def _stretched(light: Tensor, stretch: Stretch) -> Tensor:
    """Both kinds of :func:`brightness`, (B, 2, H, W), of which the largest channel is stretched."""
    return torch.cat([light[:, :1], stretch.largest(light[:, 1:])], dim=1)


@dataclass(frozen=True, eq=False)
class LocalCurves:
    """Changes of brightness by tone curves around the middles of tiles.

    Attributes:
        changes: of K shades of luminance and of the largest channel, by S curves, (B, 2, S, K, TILES, TILES).
        size: (H, W) of the picture.
        stretch: range of its brightness.
    """

    changes: Tensor
    size: tuple[int, int]
    stretch: Stretch

    @staticmethod
    def of(size: tuple[int, int], stretch: Stretch, reduced: Callable[[int], Tensor]) -> "LocalCurves":
        """The curves of a picture of size (H, W), one for each of :data:`CONTRAST_LIMITS`.

        ``reduced`` returns :func:`block_means` of its :func:`ramps` for blocks of so many pixels, (B, 2 (K - 1), h, w).
        """
        step = max(1, min(size) // (TILES * FINE))
        means = reduced(step).unflatten(1, (2, SHADES - 1))
        rows, columns = (_shares(count).to(means) for count in block_counts(size, step))
        # A hat function rises with one ramp and falls with the next.
        passed = F.pad(rows @ means @ columns.mT, (0, 0, 0, 0, 1, 0), value=1.0)
        histogram = passed - F.pad(passed[:, :, 1:], (0, 0, 0, 0, 0, 1))
        straight = torch.linspace(0, 1, SHADES).to(means).view(-1, 1, 1)
        changes = []
        for limit in CONTRAST_LIMITS:
            most = histogram.clamp(max=limit / SHADES)
            shared = most + (1 - most.sum(2, keepdim=True)) / SHADES
            changes.append(shared.cumsum(2) - shared / 2 - straight)
        return LocalCurves(torch.stack(changes, dim=2), size, stretch)

    def weighed(self, strength: Tensor) -> "LocalCurves":
        """The sum of all curves as one, weighted by strengths (2 S,) or (B, 2 S)."""
        weights = strength.to(self.changes).reshape(-1, 2, len(CONTRAST_LIMITS), 1, 1, 1)
        return LocalCurves((weights * self.changes).sum(2, keepdim=True), self.size, self.stretch)

    def rectangle(self, image: Tensor, corner: tuple[int, int]) -> Tensor:
        """Changes (B, 2 S, C, h, w) of an image (B, C, h, w), whose first pixel is in that row and column."""
        height, width = image.shape[-2:]
        rows, columns = (
            torch.arange(start, start + length, device=image.device)
            for start, length in zip(corner, (height, width), strict=True)
        )
        changes = self.at(image.flatten(2), rows.repeat_interleave(width), columns.repeat(height))
        return changes.unflatten(3, (height, width))

    def at(self, image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Changes (B, 2 S, C, P) of pixels (B, C, P) in rows and columns (P,)."""
        light = brightness(image.unsqueeze(2))
        places = _stretched(light, self.stretch).squeeze(2)
        added, scaled = self._changes_of(places, rows, columns).unbind(1)
        colours = (image / light[:, 1:, 0].clamp(min=GREY_LEVEL)).unsqueeze(1)
        added = added.unsqueeze(2).expand(-1, -1, image.shape[1], -1)
        return torch.cat([added, scaled.unsqueeze(2) * colours], dim=1)

    def _changes_of(self, light: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Changes (B, 2, S, P) of both kinds of brightness (B, 2, P)."""
        shape = (SHADES, TILES, TILES)
        places = [light.clamp(0, 1) * (SHADES - 1)]
        for numbers, length in zip((rows, columns), self.size, strict=True):
            places.append(((numbers + 0.5) * (TILES / length) - 0.5).to(light))
        places = [place.clamp(0, length - 1) for place, length in zip(places, shape, strict=True)]
        below = [place.detach().floor().clamp(max=length - 2) for place, length in zip(places, shape, strict=True)]
        changes = self.changes.flatten(3).expand(len(light), -1, -1, -1)
        total = torch.zeros_like(light).unsqueeze(2)
        for corner in product((0, 1), repeat=3):  # trilinear interpolation
            index, share = torch.zeros_like(light, dtype=torch.long), torch.ones_like(light)
            for place, low, step, length in zip(places, below, corner, shape, strict=True):
                index = index * length + low.long() + step
                part = place - low
                share = share * (part if step else 1 - part)
            nearest = changes.gather(3, index.unsqueeze(2).expand(-1, -1, changes.shape[2], -1))
            total = total + share.unsqueeze(2) * nearest
        return total


def _shares(count: int) -> Tensor:
    """Weights (TILES, n) of n blocks that divide a side of a picture evenly, in the means over tiles."""
    starts, edges = torch.arange(count) * TILES, torch.arange(TILES + 1).view(-1, 1) * count  # of 1 / (TILES n)
    shared = torch.minimum(starts + TILES, edges[1:]) - torch.maximum(starts, edges[:-1])
    return shared.clamp(min=0).double() / count
