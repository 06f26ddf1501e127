"""Noise as cameras make it: a random camera takes a clean picture, and what a mean of many of its shots would be.

A clean picture in sRGB goes back to linear light and to the colours of a sensor (unprocessing, Brooks et al. 2019), is
measured with shot and read noise through a Bayer mosaic, and developed: demosaicing, white balance, colour matrix, tone
curve, noise reduction (colour more than luminance), sharpening, reduction, JPEG and 8 bits. The clean picture goes
through the same steps without noise; where a step depends on the picture it does what the noisy one needed, and where a
step bends values it takes the expected value. So the pair is one shot and the mean of many, as in public sets of pairs.
"""

import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.training.demosaicing import DEMOSAICERS, masks, mosaic
from benchmarks.training.development import (
    blurred,
    cored,
    expected,
    inverse_tone_curve,
    median_colour,
    sharpened,
    smoothed_colour,
    tone_curve,
)
from benchmarks.training.jpeg import SUBSAMPLINGS, compressed, from_luminance, to_luminance

PARTS = 8  # of every range
HELD_OUT_PARTS = (2, 5)  # parts that training never draws from
BLOCK = 16  # pixels that JPEG processes at once, with subsampled colour


@dataclass(frozen=True)
class Range:
    """Range of a parameter of cameras."""

    low: float
    high: float
    share: float  # probability that it is used at all; otherwise it has the value ``unused``
    logarithmic: bool  # whether its logarithm is uniform
    unused: float  # value that has no effect

    def drawn(self, generator: torch.Generator, *, held_out: bool) -> float:
        """A random value; those of cameras held out are in parts of the range that training never draws from."""
        parts = [part for part in range(PARTS) if (part in HELD_OUT_PARTS) == held_out]
        used, part, place = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        place = (parts[int(part * len(parts))] + place) / PARTS
        if used >= self.share:
            return self.unused
        if self.logarithmic:
            return math.exp(math.log(self.low) + place * math.log(self.high / self.low))
        return self.low + place * (self.high - self.low)


def parameter(unused: float, low: float, high: float, share: float = 1.0, logarithmic: bool = False) -> float:
    """A parameter of cameras: the value that has no effect, and the range that others are drawn from."""
    value: float = field(default=unused, metadata={"range": Range(low, high, share, logarithmic, unused)})
    return value


#: Demosaicers of training, and those of cameras held out.
TRAINED, APART = ("bilinear", "gradient corrected", "directional"), ("median of differences", "directional")


@dataclass(frozen=True)
class Camera:
    """Parameters of a camera and of its settings, each with its range."""

    # Factor of linear light.
    exposure: float = parameter(1.0, 0.4, 1.6, share=0.5, logarithmic=True)
    # Variance of shot noise at white, as a share of white (Brooks et al.).
    shot: float = parameter(0.0, 5e-5, 1.2e-2, logarithmic=True)
    # Logarithm of the variance of read noise, over the line of Brooks et al.
    read_offset: float = parameter(0.0, -0.8, 0.8)
    # Deviation of the noise that a row has in common, over that of read noise.
    row: float = parameter(0.0, 0.02, 0.3, share=0.3)
    # How far below black a measured value may fall, as a share of white.
    black: float = parameter(0.0, 0.0, 0.06)
    # White balance.
    red_gain: float = parameter(1.0, 1.2, 2.8, logarithmic=True)
    blue_gain: float = parameter(1.0, 1.2, 2.8, logarithmic=True)
    # Entries of the colour matrix beside its diagonal: those of DSLR cameras (dcraw).
    red_from_green: float = parameter(0.0, -0.9, -0.2)
    red_from_blue: float = parameter(0.0, -0.3, 0.1)
    green_from_red: float = parameter(0.0, -0.35, -0.05)
    green_from_blue: float = parameter(0.0, -0.6, -0.1)
    blue_from_red: float = parameter(0.0, -0.15, 0.1)
    blue_from_green: float = parameter(0.0, -0.9, -0.2)
    # Of the tone curve.
    contrast: float = parameter(0.0, 0.1, 0.9, share=0.8)
    shoulder: float = parameter(1.0, 0.6, 1.1, share=0.7)
    # Radius of the blur of the lens, in pixels.
    lens: float = parameter(0.0, 0.3, 0.9, share=0.5)
    # Reduction of noise in colour.
    colour_radius: float = parameter(0.0, 1.5, 16.0, share=0.9, logarithmic=True)
    colour_share: float = parameter(0.0, 0.6, 1.0)
    colour_edges: float = parameter(1.0, 1.0, 6.0)
    median_share: float = parameter(0.0, 0.3, 1.0, share=0.3)
    # Reduction of noise in luminance.
    coring: float = parameter(0.0, 0.5, 3.0, share=0.8)
    coring_fall: float = parameter(1.0, 0.3, 0.9)
    floor: float = parameter(0.0, 0.0, 0.5)
    # Radius of a blur after noise reduction, in pixels, as from corrections of the lens and enlargements.
    softening: float = parameter(0.0, 0.4, 1.3, share=0.7)
    # Unsharp masking of luminance.
    sharpening: float = parameter(0.0, 0.1, 1.2, share=0.6)
    sharpening_radius: float = parameter(1.0, 0.7, 2.0)
    # Of the reduction after all that.
    scale: float = parameter(1.0, 0.4, 1.0, share=0.5)
    # Of JPEG; at 100 the picture is not compressed at all.
    quality: float = parameter(100.0, 60.0, 98.0, share=0.9)
    # Of JPEG with 4:2:0 of a part of the picture, as when it is cut out and written again.
    second_quality: float = parameter(100.0, 60.0, 98.0, share=0.3)
    demosaicer: str = "gradient corrected"
    subsampling: str = "4:4:4"
    phase: int = 0  # of the mosaic, 0 to 3

    @classmethod
    def drawn(cls, generator: torch.Generator, *, held_out: bool = False) -> "Camera":
        """A random camera; those held out have parameters and a demosaicer that no other camera has."""
        values = {name: limits.drawn(generator, held_out=held_out) for name, limits in RANGES.items()}
        names = APART if held_out else TRAINED
        which, subsampled, phase = torch.rand(3, generator=generator).tolist()
        return cls(
            **values,
            demosaicer=names[int(which * len(names))],
            subsampling=list(SUBSAMPLINGS)[int(subsampled * len(SUBSAMPLINGS))],
            phase=int(4 * phase),
        )

    @property
    def read(self) -> float:
        """Variance of read noise as a share of white squared: log-linear in shot noise, as Brooks et al. measured."""
        return math.exp(2.18 * math.log(self.shot) + 1.2 + self.read_offset) if self.shot else 0.0

    @cached_property
    def matrix(self) -> Tensor:
        """The colour matrix (3, 3) from the sensor's colours to sRGB; its rows add up to 1."""
        entries = [
            [0.0, self.red_from_green, self.red_from_blue],
            [self.green_from_red, 0.0, self.green_from_blue],
            [self.blue_from_red, self.blue_from_green, 0.0],
        ]
        beside = torch.tensor(entries)
        return beside + torch.diag(1 - beside.sum(1))

    def without_noise(self) -> "Camera":
        """The same camera, whose sensor has no noise."""
        return replace(self, shot=0.0)

    def side_before(self, side: int) -> int:
        """Side of the crop that the camera needs for a photograph of a side, before it reduces the picture."""
        return 2 * math.ceil(self._area(side) / self.scale / 2)

    def photograph(self, crop: Tensor, side: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Take a clean crop: return the mean of many shots and one shot, (3, side, side) each in [0, 1].

        Args:
            crop: (3, N, N) in sRGB from 0 to 1, with N = :meth:`side_before` of ``side``.
            side: of the photograph in pixels.
            generator: of the noise and of the place within JPEG's blocks.
        """
        before = self.side_before(side)
        if crop.shape != (3, before, before):
            raise ValueError(f"crop must be (3, {before}, {before}) for a side of {side}, got {tuple(crop.shape)}")
        planes = self.developed(self.measured(self.seen(crop), generator))
        area = self._area(side)
        if before != area:
            planes = F.interpolate(planes, (area, area), mode="bicubic", antialias=True, align_corners=False)
        shots = self._written(planes, self.quality, self.subsampling)
        if self.second_quality < 100:
            shots = self._cut(shots, _blocks(side), generator)
            shots = self._written(to_luminance(shots), self.second_quality, "4:2:0")
        mean, shot = self._cut(shots, side, generator)
        return mean, shot

    @staticmethod
    def _written(planes: Tensor, quality: float, subsampling: str) -> Tensor:
        """Red, green and blue (2, 3, N, N) as a file has them; only the noisy shot is rounded to 8 bits."""
        if quality < 100:
            planes = compressed(planes, round(quality), subsampling)
        mean, shot = expected(partial(torch.clamp, min=0, max=1), from_luminance(planes))
        return torch.stack([mean, (255 * shot).round() / 255])

    @staticmethod
    def _cut(shots: Tensor, side: int, generator: torch.Generator) -> Tensor:
        """Both shots, cut to a side at a random place."""
        top, left = torch.randint(shots.shape[-1] - side + 1, (2,), generator=generator).tolist()
        return shots[..., top : top + side, left : left + side]

    def _area(self, side: int) -> int:
        """Side of the area of whole blocks of JPEG in which a photograph has a random place."""
        return _blocks(_blocks(side) if self.second_quality < 100 else side)

    def seen(self, crop: Tensor) -> Tensor:
        """Linear light (3, N, N) that arrives at the sensor, in the sensor's colours."""
        light = self.exposure * inverse_tone_curve(crop, self.contrast, self.shoulder)
        if self.lens:
            light = blurred(light[None], self.lens)[0]
        return torch.einsum("sc,chw->shw", torch.linalg.inv(self.matrix), light).clamp(min=0) / self._gains()

    def measured(self, light: Tensor, generator: torch.Generator) -> Tensor:
        """The mosaic (2, 1, N, N) that the sensor measures: the mean of many shots and one shot."""
        raw = mosaic(light[None], masks(*light.shape[-2:], self.phase))
        deviation = (self.shot * raw + self.read).sqrt()
        noise = deviation * torch.randn(raw.shape, generator=generator)
        if self.row:
            noise = noise + self.row * math.sqrt(self.read) * torch.randn(raw.shape[-2], 1, generator=generator)
        limit = partial(torch.clamp, min=-self.black, max=1)
        return expected(limit, torch.cat([raw, raw + noise]), deviation)

    def developed(self, raw: Tensor) -> Tensor:
        """Planes Y, Cb, Cr (2, 3, N, N) of the developed picture, before reduction and JPEG."""
        filters = masks(*raw.shape[-2:], self.phase)
        balanced = raw * (filters * self._gains()).sum(0)
        light = DEMOSAICERS[self.demosaicer](balanced, filters)
        light = expected(partial(torch.clamp, max=1), light)
        light = torch.einsum("cs,bshw->bchw", self.matrix, light)
        picture = expected(partial(tone_curve, contrast=self.contrast, shoulder=self.shoulder), light)
        planes = to_luminance(picture)
        if self.median_share:
            planes = median_colour(planes, self.median_share)
        if self.colour_radius:
            planes = smoothed_colour(planes, round(self.colour_radius), self.colour_share, self.colour_edges)
        if self.coring:
            light = cored(planes[:, :1], self.coring, self.coring_fall, self.floor)
            planes = torch.cat([light, planes[:, 1:]], dim=1)
        if self.softening:
            planes = blurred(planes, self.softening)
        return sharpened(planes, self.sharpening, self.sharpening_radius) if self.sharpening else planes

    def _gains(self) -> Tensor:
        return torch.tensor([self.red_gain, 1.0, self.blue_gain])[:, None, None]


def _blocks(side: int) -> int:
    """Side of whole blocks of JPEG in which a square of a side can begin at any pixel of a block."""
    return BLOCK * math.ceil((side + BLOCK - 1) / BLOCK)


#: Ranges of all parameters of cameras.
RANGES: dict[str, Range] = {each.name: each.metadata["range"] for each in fields(Camera) if each.metadata}
