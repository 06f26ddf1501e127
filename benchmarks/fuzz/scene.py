"""Random arguments of matching shapes."""

import random
from functools import cached_property

import torch
from torch import Tensor

import nlfilter_torch as nlf
from benchmarks.fuzz.cases import log_uniform

SIDES = (4, 24)


class Scene:
    """An image, its operator, and other arguments of matching shapes."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.batch = rng.choice((1, 1, 2))
        self.size = (rng.randint(*SIDES), rng.randint(*SIDES))
        self.dtype = rng.choice((torch.float32, torch.float32, torch.float64))
        self.order = rng.randint(1, 4)
        self.regions = rng.randint(1, 3)
        self.generator = torch.Generator().manual_seed(rng.randint(0, 1 << 20))

    def noise(self, *shape: int) -> Tensor:
        """Draw values in [0, 1], sometimes with few levels."""
        levels = self.rng.choice((2, 4, 255, 1 << 20))
        values = torch.rand(shape, generator=self.generator, dtype=torch.float64)
        return ((values * levels).round() / levels).to(self.dtype)

    def image(self, channels: int) -> Tensor:
        """Draw an image (B, C, H, W), sometimes flat in one half."""
        image = self.noise(self.batch, channels, *self.size)
        if self.rng.random() < 0.3:
            image[..., self.size[1] // 2 :] = self.rng.random()
        return image

    def mask(self, channels: int) -> Tensor:
        """Draw a mask (B, C, H, W) in [0, 1] with a rectangle in every channel, which leaves the last row free."""
        mask = torch.zeros(self.batch, channels, *self.size, dtype=self.dtype)
        for plane in mask.flatten(0, 1):
            top, left = (self.rng.randint(0, side - 2) for side in self.size)
            bottom = min(top + self.rng.randint(1, 8), self.size[0] - 1)
            plane[top:bottom, left : left + self.rng.randint(1, 8)] = self.rng.choice((1, 0.5))
        return mask

    def background(self) -> Tensor:
        """Draw a mask (B, 1, H, W) in [0, 1] with a rectangle and the last row, so that no other mask covers it."""
        mask = self.mask(1)
        mask[..., -1, :] = 1
        return mask

    @cached_property
    def guide(self) -> Tensor:
        """Guide of the operator."""
        return self.image(self.rng.choice((1, 3, 2)))

    @cached_property
    def operator(self) -> nlf.NonlocalOperator:
        """Operator with a bandwidth suitable for noise."""
        bandwidth = log_uniform(self.rng, 0.03, 1.0)
        return nlf.nonlocal_operator(self.guide, photometric_bandwidth=bandwidth, num_landmarks=self.rng.randint(1, 16))

    @cached_property
    def spectrum(self) -> nlf.Spectrum:
        """Spectrum of the operator."""
        return self.operator.spectrum()
