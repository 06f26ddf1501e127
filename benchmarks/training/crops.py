"""Clean crops: randomly augmented parts of pictures, and drawn patterns."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.training.patterns import pattern
from benchmarks.training.pictures import Draws, Pictures

REPEATED, REGIONS = 0.08, 0.06  # shares of crops with a drawn pattern: of repeated cells; of regions, lines or shades
BLENDED, TEXTURED = 0.15, 0.25  # shares of crops: of two crops; with an added texture
CONTRASTS = 2 / 255, 80 / 255  # range of the standard deviation of added textures


class Crops:
    """Random clean crops.

    Args:
        pictures: from which most crops are.
        side: of the crops, in pixels.
        draws: random numbers.
    """

    def __init__(self, pictures: Pictures, side: int, draws: Draws) -> None:
        self.pictures, self.side, self.draws = pictures, side, draws

    def crop(self, *, grey: bool) -> Tensor:
        """A crop (1 or 3, side, side), in [0, 1] up to rounding."""
        crop = self._drawn()
        if self.draws.chance(BLENDED):
            crop = self._blend(crop, self._cut())
        if self.draws.chance(TEXTURED):
            crop = self._add_texture(crop)
        crop = self._as_grey(crop) if grey else self._as_colour(crop)
        if self.draws.chance(0.4):
            crop = crop.clamp(0, 1) ** self.draws.number(0.6, 1.5)
        if self.draws.chance(0.4):
            contrast = self.draws.number(0.5, 1.0)
            crop = contrast * crop + (1 - contrast) * self.draws.number()
        return 1 - crop if self.draws.chance(0.1) else crop

    def _drawn(self) -> Tensor:
        """A picture or a pattern, (1 or 3, side, side)."""
        kind = self.draws.number()
        if kind < REPEATED:
            return pattern(self.side, self.draws.generator)
        return self._pattern() if kind < REPEATED + REGIONS else self._cut()

    def _cut(self) -> Tensor:
        return self.pictures.cut(self.draws, self.side)

    def _blend(self, first: Tensor, second: Tensor) -> Tensor:
        """Blend two crops, or put them side by side with a soft or sharp border."""
        if self.draws.chance(0.5):
            return torch.lerp(*torch.broadcast_tensors(first, second), self.draws.number())
        share = (self._smooth(1, 2 + self.draws.below(5)) * self.draws.number(5, 45) + 0.5).clamp(0, 1)
        return share * first + (1 - share) * second

    def _pattern(self) -> Tensor:
        """A random pattern (3, side, side) of regions, stripes, lines or shades."""
        smooth = self._smooth(3, 2 + self.draws.below(14))
        colours = self.draws.uniform(3, 3, 1, 1)
        kind = self.draws.below(4)
        if kind == 0:
            return colours[:, :, 0, 0].T[:, smooth.argmax(0)]
        if kind == 1:
            angle, frequency = self.draws.number(0, math.pi), self.draws.number(0.1, 1.3)
            places = torch.arange(self.side, dtype=torch.float32)
            along = places[:, None] * math.sin(angle) + places * math.cos(angle)
            wave = torch.sin(frequency * along + self.draws.number(0, 3) * smooth[:1])
            share = (wave > 0).float() if self.draws.chance(0.5) else (wave + 1) / 2
        elif kind == 2:
            share = ((2.5 * smooth[:1]).frac().abs() < 0.35).float()
        else:
            return (0.5 + 0.25 * smooth).clamp(0, 1)
        return torch.lerp(colours[0], colours[1], share)

    def _add_texture(self, crop: Tensor) -> Tensor:
        """Add a texture like grass, gravel or grain of wood, everywhere or in part of the crop."""
        texture = self._texture(1)
        if self.draws.chance(0.5):
            colours = self.draws.number() * self._texture(3) if self.draws.chance(0.3) else 0.0
            texture = (0.3 + self.draws.uniform(3, 1, 1)) * texture + colours
        if self.draws.chance(0.5):
            texture = texture * (self._smooth(1, 2 + self.draws.below(3)) * self.draws.number(2, 20) + 0.5).clamp(0, 1)
        contrast = self.draws.factor(*CONTRASTS)
        return (crop + contrast * texture).clamp(0, 1)

    def _texture(self, planes: int) -> Tensor:
        """Gaussian textures (planes, side, side) of unit variance, with one random spectrum.

        They may be coarse or fine, striped, and longer in one direction than in the other.
        """
        rows, columns = torch.fft.fftfreq(self.side)[:, None], torch.fft.rfftfreq(self.side)
        angle = self.draws.number(0, math.pi)
        along = columns * math.cos(angle) + rows * math.sin(angle)
        across = rows * math.cos(angle) - columns * math.sin(angle)
        middle = self.draws.number(0.05, 0.45) if self.draws.chance(0.4) else 0.0
        width = self.draws.factor(0.03, 0.7)
        longer = self.draws.factor(1.0, 10.0) if self.draws.chance(0.6) else 1.0
        distance = ((along.abs() - middle).square() + (longer * across).square()) / width**2
        spectrum = torch.fft.rfft2(self.draws.normal(planes, self.side, self.side))
        shape = (self.side, self.side)
        texture: Tensor = torch.fft.irfft2(spectrum * (1 + distance) ** -self.draws.number(0.5, 2), shape)
        return (texture - texture.mean((1, 2), keepdim=True)) / texture.std((1, 2), keepdim=True).clamp(min=1e-6)

    def _smooth(self, planes: int, count: int) -> Tensor:
        """Smooth random planes (planes, side, side), interpolated from ``count`` x ``count`` standard normal values."""
        values = self.draws.normal(1, planes, count, count)
        return F.interpolate(values, (self.side, self.side), mode="bicubic")[0]

    def _as_grey(self, crop: Tensor) -> Tensor:
        """A random mixture of the channels, as one channel."""
        mixture = self.draws.uniform(len(crop), 1, 1) + 0.1
        return (crop * (mixture / mixture.sum())).sum(0, keepdim=True)

    def _as_colour(self, crop: Tensor) -> Tensor:
        """Three channels: tint a grey crop between two colours, or change order, saturation and light of colours."""
        if len(crop) == 1:
            if self.draws.chance(0.5):
                return crop.expand(3, -1, -1)
            return torch.lerp(self.draws.uniform(3, 1, 1), self.draws.uniform(3, 1, 1), crop)
        if self.draws.chance(0.5):
            crop = crop[self.draws.permutation(3)]
        if self.draws.chance(0.6):
            mean = crop.mean(0, keepdim=True)
            crop = torch.lerp(mean.expand_as(crop), crop, self.draws.number(0, 1.5)).clamp(0, 1)
        if self.draws.chance(0.35):  # coloured light
            crop = crop.clamp(0, 1) ** (0.7 + 0.8 * self.draws.uniform(3, 1, 1)) * (
                0.15 + 0.85 * self.draws.uniform(3, 1, 1)
            )
        return crop
