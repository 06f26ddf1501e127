"""Tone curves of every part of a picture, which equalise the histogram around it as far as limits of contrast allow.

After Zuiderveld, "Contrast Limited Adaptive Histogram Equalization" (1994): histograms of blocks, clipped, give curves,
and a pixel takes its value from the curves of the four nearest blocks. Here histograms are of hat functions, so that
curves are continuous in the picture, and those of neighbouring blocks are blended.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

LIMITS = (1.5, 2.0, 3.0, 5.0)  # times as much of a shade as in an even histogram that counts at most: slopes of curves
SHADES = 17
BLOCKS = 16  # along the short side
FINE = 32  # pixels along a block that histograms are first taken of, at most


def shades(light: Tensor) -> Tensor:
    """How much of each of :data:`SHADES` equal steps from 0 to 1 there is in values (B, 1, H, W): (B, K, H, W)."""
    steps = torch.arange(SHADES).to(light).view(-1, 1, 1)
    return (1 - (light.clamp(0, 1) * (SHADES - 1) - steps).abs()).clamp(min=0)


@dataclass(frozen=True, eq=False)
class LocalCurves:
    """Changes of brightness by tone curves around the middles of blocks.

    Attributes:
        changes: of :data:`SHADES` shades, by S kinds of curves, (B, S, K, h, w).
        step: pixels along a block.
    """

    changes: Tensor
    step: int

    @staticmethod
    def of(size: tuple[int, int], reduced: Callable[[int], Tensor]) -> "LocalCurves":
        """The curves of a picture of a size (H, W), one kind for each of :data:`LIMITS`.

        Args:
            size: of the picture.
            reduced: means of :func:`shades` of its luminance over blocks of so many pixels, (B, K, h, w).
        """
        length = max(1, round(min(size) / BLOCKS))
        many = -(-length // FINE)
        fine = max(1, round(length / many))
        means = reduced(fine)
        counts = [torch.full((n,), float(fine)) for n in means.shape[-2:]]
        for count, whole in zip(counts, size, strict=True):
            count[-1] = whole - fine * (len(count) - 1)
        pixels = torch.outer(*counts).to(means)[None, None]
        sums = _blend(_pooled(means * pixels, many))
        histogram = sums / _blend(_pooled(pixels, many))
        straight = torch.linspace(0, 1, SHADES).to(means).view(-1, 1, 1)
        changes = []
        for limit in LIMITS:
            most = histogram.clamp(max=limit / SHADES)
            shared = most + (1 - most.sum(1, keepdim=True)) / SHADES
            changes.append(shared.cumsum(1) - shared / 2 - straight)
        return LocalCurves(torch.stack(changes, dim=1), fine * many)

    def weighed(self, strength: Tensor) -> "LocalCurves":
        """One kind of curves: the sum of all, each as strong as (S,) or (B, S) says."""
        weights = strength.to(self.changes).reshape(-1, len(LIMITS), 1, 1, 1)
        return LocalCurves((weights * self.changes).sum(1, keepdim=True), self.step)

    def rectangle(self, light: Tensor, corner: tuple[int, int]) -> Tensor:
        """Changes (B, S, h, w) of luminance (B, 1, h, w), whose first pixel is in that row and column."""
        height, width = light.shape[-2:]
        rows, columns = (
            torch.arange(start, start + length, device=light.device)
            for start, length in zip(corner, (height, width), strict=True)
        )
        found = self.at(light.flatten(1), rows.repeat_interleave(width), columns.repeat(height))
        return found.unflatten(2, (height, width))

    def at(self, light: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Changes (B, S, P) of the luminance (B, P) of some pixels, in rows and columns (P,)."""
        shape = self.changes.shape[-3:]
        places = [
            light.clamp(0, 1) * (SHADES - 1),
            ((rows + 0.5) / self.step - 0.5).to(light).expand_as(light),
            ((columns + 0.5) / self.step - 0.5).to(light).expand_as(light),
        ]
        places = [place.clamp(0, length - 1) for place, length in zip(places, shape, strict=True)]
        below = [
            place.detach().floor().clamp(max=max(length - 2, 0)) for place, length in zip(places, shape, strict=True)
        ]
        changes = self.changes.flatten(2).expand(len(light), -1, -1)
        found = torch.zeros_like(light).unsqueeze(1)
        for corner in product((0, 1), repeat=3):
            index, share = torch.zeros_like(light, dtype=torch.long), torch.ones_like(light)
            for place, low, one, length in zip(places, below, corner, shape, strict=True):
                index = index * length + (low.long() + one).clamp(max=length - 1)
                part = place - low
                share = share * (part if one else 1 - part)
            taken = changes.gather(2, index.unsqueeze(1).expand(-1, changes.shape[1], -1))
            found = found + share.unsqueeze(1) * taken
        return found


def _pooled(planes: Tensor, step: int) -> Tensor:
    """Sums over blocks."""
    return F.avg_pool2d(planes, step, ceil_mode=True, divisor_override=1)


def _blend(planes: Tensor) -> Tensor:
    """Sums over neighbouring blocks, with the weights 1, 2, 1 along both axes."""
    padded = F.pad(planes, (1, 1, 1, 1))
    rows = padded[..., :-2, :] + 2 * padded[..., 1:-1, :] + padded[..., 2:, :]
    return rows[..., :-2] + 2 * rows[..., 1:-1] + rows[..., 2:]
