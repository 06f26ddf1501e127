"""Training data of the denoiser: randomly augmented crops of scikit-image's pictures, synthetic patterns, and noise.

The test pictures of :mod:`benchmarks.denoising` are not among them; the left halves of ``retina`` and ``page`` are for
testing, and their right halves for training.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.photographs import photograph

#: How often each picture is drawn; photographs more often than textures and drawings.
PICTURES = {
    "astronaut": 4.0,
    "motorcycle": 6.0,
    "rocket": 4.0,
    "retina": 1.0,
    "page": 1.0,
    "hubble_deep_field": 1.0,
    "immunohistochemistry": 1.0,
    "coins": 1.0,
    "brick": 1.0,
    "grass": 1.0,
    "gravel": 1.0,
    "text": 1.0,
    "clock": 1.0,
    "moon": 0.5,
    "cell": 0.5,
}
RIGHT_HALVES = ("retina", "page")
SCALES = (1.0, 0.8, 0.6, 0.4, 0.28)
LARGEST = 60 / 255  # standard deviation of noise
MISSTATED = 0.5  # share of crops whose given noise level is not the actual one
RATIOS = 0.75, 1.35  # range of given over actual noise level, in these crops
CONTRASTS = 2 / 255, 40 / 255  # range of the standard deviation of added textures


class Crops:
    """Random crops with noise, reproducible from a seed.

    Args:
        side: of the crops, in pixels.
        seed: of all random numbers.
        textured: share of crops with an added texture.
        contrast: largest standard deviation of a texture.
        misstated: share of crops whose given noise level is not the actual one.
    """

    def __init__(
        self,
        side: int,
        seed: int,
        *,
        textured: float = 0.0,
        contrast: float = CONTRASTS[1],
        misstated: float = MISSTATED,
    ) -> None:
        self.side, self.generator = side, torch.Generator().manual_seed(seed)
        self.textured, self.contrast, self.misstated = textured, contrast, misstated
        self.pictures: list[Tensor] = []
        weights = []
        for name, weight in PICTURES.items():
            picture = photograph(name)
            if name in RIGHT_HALVES:
                picture = picture[..., picture.shape[-1] // 2 :]
            for scale in SCALES:
                size = [round(length * scale) for length in picture.shape[-2:]]
                if min(size) > side:
                    reduced = picture if scale == 1 else F.interpolate(picture, size, mode="bicubic", antialias=True)
                    self.pictures.append(reduced.clamp(0, 1)[0])
                    weights.append(weight)
        self.weights = torch.tensor(weights)

    def batch(self, count: int, *, grey: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Clean and noisy crops (B, 1 or 3, side, side), and the noise level that the denoiser is given."""
        clean = torch.stack([self._clean(grey) for _ in range(count)])
        return (clean, *self._noise(clean))

    def _random(self, *size: int) -> Tensor:
        return torch.rand(size, generator=self.generator)

    def _number(self, low: float = 0.0, high: float = 1.0) -> float:
        return low + (high - low) * float(self._random())

    def _chance(self, probability: float) -> bool:
        return self._number() < probability

    def _below(self, count: int) -> int:
        return int(torch.randint(count, (), generator=self.generator))

    def _clean(self, grey: bool) -> Tensor:
        crop = self._pattern() if self._chance(0.08) else self._cut()
        if self._chance(0.15):
            crop = self._blend(crop, self._cut())
        if self.textured and self._chance(self.textured):
            crop = self._add_texture(crop)
        crop = self._as_grey(crop) if grey else self._as_colour(crop)
        if self._chance(0.4):
            crop = crop.clamp(0, 1) ** self._number(0.6, 1.5)
        if self._chance(0.4):
            contrast = self._number(0.5, 1.0)
            crop = contrast * crop + (1 - contrast) * self._number()
        return 1 - crop if self._chance(0.1) else crop

    def _cut(self) -> Tensor:
        """A crop (C, side, side), rotated and mirrored at random."""
        picture = self.pictures[int(torch.multinomial(self.weights, 1, generator=self.generator))]
        row, column = (self._below(length - self.side + 1) for length in picture.shape[-2:])
        crop = torch.rot90(picture[:, row : row + self.side, column : column + self.side], self._below(4), (1, 2))
        return crop.flip(2) if self._chance(0.5) else crop

    def _blend(self, first: Tensor, second: Tensor) -> Tensor:
        """Blend two crops, or put them side by side with a soft or sharp border."""
        if self._chance(0.5):
            return torch.lerp(*torch.broadcast_tensors(first, second), self._number())
        share = (self._smooth(1, 2 + self._below(5)) * self._number(5, 45) + 0.5).clamp(0, 1)
        return share * first + (1 - share) * second

    def _pattern(self) -> Tensor:
        """A random pattern (3, side, side) of regions, stripes, lines or shades."""
        smooth = self._smooth(3, 2 + self._below(14))
        colours = self._random(3, 3, 1, 1)
        kind = self._below(4)
        if kind == 0:
            return colours[:, :, 0, 0].T[:, smooth.argmax(0)]
        if kind == 1:
            angle, frequency = self._number(0, math.pi), self._number(0.1, 1.3)
            places = torch.arange(self.side, dtype=torch.float32)
            along = places[:, None] * math.sin(angle) + places * math.cos(angle)
            wave = torch.sin(frequency * along + self._number(0, 3) * smooth[:1])
            share = (wave > 0).float() if self._chance(0.5) else (wave + 1) / 2
        elif kind == 2:
            share = ((2.5 * smooth[:1]).frac().abs() < 0.35).float()
        else:
            return (0.5 + 0.25 * smooth).clamp(0, 1)
        return torch.lerp(colours[0], colours[1], share)

    def _add_texture(self, crop: Tensor) -> Tensor:
        """Add a texture like grass, gravel or grain of wood, everywhere or in part of the crop."""
        texture = self._texture(1)
        if self._chance(0.5):
            colours = self._number() * self._texture(3) if self._chance(0.3) else 0.0
            texture = (0.3 + self._random(3, 1, 1)) * texture + colours
        if self._chance(0.5):
            texture = texture * (self._smooth(1, 2 + self._below(3)) * self._number(2, 20) + 0.5).clamp(0, 1)
        contrast = math.exp(self._number(math.log(CONTRASTS[0]), math.log(self.contrast)))
        return (crop + contrast * texture).clamp(0, 1)

    def _texture(self, planes: int) -> Tensor:
        """Gaussian textures (planes, side, side) of unit variance, with one random spectrum.

        They may be coarse or fine, striped, and longer in one direction than in the other.
        """
        rows, columns = torch.fft.fftfreq(self.side)[:, None], torch.fft.rfftfreq(self.side)
        angle = self._number(0, math.pi)
        along = columns * math.cos(angle) + rows * math.sin(angle)
        across = rows * math.cos(angle) - columns * math.sin(angle)
        middle = self._number(0.05, 0.45) if self._chance(0.4) else 0.0
        width = math.exp(self._number(math.log(0.03), math.log(0.7)))
        longer = math.exp(self._number(0, math.log(10))) if self._chance(0.6) else 1.0
        distance = ((along.abs() - middle).square() + (longer * across).square()) / width**2
        spectrum = torch.fft.rfft2(torch.randn(planes, self.side, self.side, generator=self.generator))
        shape = (self.side, self.side)
        texture: Tensor = torch.fft.irfft2(spectrum * (1 + distance) ** -self._number(0.5, 2), shape)
        return (texture - texture.mean((1, 2), keepdim=True)) / texture.std((1, 2), keepdim=True).clamp(min=1e-6)

    def _smooth(self, planes: int, count: int) -> Tensor:
        """Smooth random planes (planes, side, side), interpolated from ``count`` x ``count`` standard normal values."""
        values = torch.randn(1, planes, count, count, generator=self.generator)
        return F.interpolate(values, (self.side, self.side), mode="bicubic")[0]

    def _as_grey(self, crop: Tensor) -> Tensor:
        """A random mixture of the channels, as one channel."""
        mixture = self._random(len(crop), 1, 1) + 0.1
        return (crop * (mixture / mixture.sum())).sum(0, keepdim=True)

    def _as_colour(self, crop: Tensor) -> Tensor:
        """Three channels: tint a grey crop between two colours, or change order, saturation and light of colours."""
        if len(crop) == 1:
            if self._chance(0.5):
                return crop.expand(3, -1, -1)
            return torch.lerp(self._random(3, 1, 1), self._random(3, 1, 1), crop)
        if self._chance(0.5):
            crop = crop[torch.randperm(3, generator=self.generator)]
        if self._chance(0.6):
            mean = crop.mean(0, keepdim=True)
            crop = torch.lerp(mean.expand_as(crop), crop, self._number(0, 1.5)).clamp(0, 1)
        if self._chance(0.35):  # coloured light
            crop = crop.clamp(0, 1) ** (0.7 + 0.8 * self._random(3, 1, 1)) * (0.15 + 0.85 * self._random(3, 1, 1))
        return crop

    def _noise(self, clean: Tensor) -> tuple[Tensor, Tensor]:
        """Noisy crops and the given noise level: uniform, varying over the crop, or dependent on brightness."""
        shape = (len(clean), 1, 1, 1)
        level = LARGEST * self._random(*shape) ** 1.4
        shades = F.interpolate(self._random(len(clean), 1, 3, 3), clean.shape[-2:], mode="bilinear", align_corners=True)
        gain = level.square() * (0.5 + 1.5 * self._random(*shape))  # variance at white
        dark = (0.3 * level * self._random(*shape)).square()
        kind = self._random(*shape)
        even = level.expand_as(clean)
        uneven = torch.where(kind < 0.7, even, level * (0.3 + 1.4 * shades))
        deviation = torch.where(kind < 0.82, uneven, (gain * clean.clamp(min=0) + dark).sqrt())
        noisy = clean + deviation * torch.randn(clean.shape, generator=self.generator)
        seen = F.avg_pool2d(F.pad(noisy, (2, 2, 2, 2), mode="reflect"), 5, 1)  # estimated brightness
        told = torch.where(kind < 0.82, uneven, (gain * seen.clamp(min=0) + dark).sqrt())
        low, high = (math.log(factor) for factor in RATIOS)
        factor = (low + (high - low) * self._random(*shape)).exp()
        wrong = torch.where(self._random(*shape) < self.misstated, factor, 1.0)
        clipped = torch.where(self._random(*shape) < 0.15, noisy.clamp(0, 1), noisy)
        return clipped, told * wrong
