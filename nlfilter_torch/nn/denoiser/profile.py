"""The noise of a photograph by scale, plane and brightness, which tells noise of cameras from white noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from scipy.optimize import nnls
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_same_size
from nlfilter_torch.core.precision import full_precision, per_image, squarable, working_dtype
from nlfilter_torch.filtering.noise import random_normal

KNOTS = 6  # brightnesses at which levels are known: 0, 0.2, ... 1
STIFFNESS = 4  # number of blocks that outweigh the assumption that variances at neighbouring knots are the same
STIFFEST = 1e-4  # the same as a share of all blocks, which keeps the fit well-conditioned
NEGLIGIBLE = 1e-3  # squared level, over the largest of all scales, below which errors count no more


@dataclass(frozen=True)
class NoiseProfile:
    """Noise by scale, plane and brightness.

    Cameras smooth and compress the noise of their sensors, so that it is coarser than white noise, most of all in
    colour. The level at scale s is the standard deviation of the noise's means over blocks of s x s pixels, times s:
    white noise has the same level at every scale.

    Attributes:
        levels: (B, S, 2, K), not negative, in units of the image: at S scales (``SCALES``), of the luminance (mean
            of the channels) and of the colour differences (of unit norm, root mean square of both), at K brightnesses
            from 0 to 1, their squares linear in between. Grey images have no colour differences: levels of 0.
        light: mean brightness (B,) of the photograph.

    Example:
        >>> profile = NoiseProfile.white(torch.tensor([0.1]))
        >>> profile.levels.shape, profile.level, profile.coarseness
        (torch.Size([1, 5, 2, 6]), tensor([0.1000]), tensor([1.]))
    """

    SCALES: ClassVar[tuple[int, ...]] = (1, 2, 4, 8, 16)
    levels: Tensor
    light: Tensor

    @classmethod
    def white(cls, level: Tensor, *, channels: int = 3) -> "NoiseProfile":
        """Return white noise with standard deviation ``level`` (B,), or (B, K) by brightness, in every channel."""
        if level.ndim == 1:
            level = level[:, None].expand(-1, KNOTS)
        planes = [level / 3**0.5, level] if channels == 3 else [level, torch.zeros_like(level)]
        levels = torch.stack(planes, dim=1)[:, None].expand(-1, len(cls.SCALES), -1, -1)
        return cls(levels, torch.full_like(level[:, 0], 0.5))

    @property
    def level(self) -> Tensor:
        """Standard deviation of a pixel's channels (B,), at the mean brightness."""
        return self._deviation(0)

    @property
    def coarseness(self) -> Tensor:
        """How coarse the noise is (B,), from 1 for white noise to 4 for blotches; 1 where there is no noise.

        It is the level at scale 4 over that at scale 1, at the mean brightness.
        """
        fine, coarse = self._deviation(0), self._deviation(2)
        return torch.where(fine > 0, coarse / torch.where(fine > 0, fine, 1.0), 1.0)

    def scaled(self, factor: float | Tensor) -> "NoiseProfile":
        """Return noise that is stronger by a factor, a number or a tensor of shape () or (B,)."""
        return replace(self, levels=self.levels * per_image(factor, self.levels, 4))

    def in_range(self, black: Tensor, span: Tensor) -> "NoiseProfile":
        """Return the noise of the pictures less ``black`` (B,) and divided by ``span`` (B,)."""
        knots = torch.linspace(0, 1, KNOTS).to(self.levels)
        positions = ((black[:, None] + span[:, None] * knots).clamp(0, 1) * (KNOTS - 1)).to(self.levels)
        below = positions.floor().clamp(max=KNOTS - 2)
        squares = self.levels.square().expand(len(positions), -1, -1, -1)
        places = below.long()[:, None, None].expand(-1, *squares.shape[1:3], -1)
        share = (positions - below)[:, None, None]
        levels = torch.lerp(squares.gather(3, places), squares.gather(3, places + 1), share).sqrt()
        return NoiseProfile(levels / per_image(span, levels, 4), ((self.light - black) / span).to(self.light))

    @full_precision
    def at(self, image: Tensor, scales: Sequence[int] = SCALES) -> Tensor:
        """Levels at the pixels of an image (B, C, H, W), by the mean brightness of 5x5 pixels.

        Returns:
            Planes (B, 2 S, H, W), of luminance and colour differences at the first of the scales, then at the next.
        """
        light = F.avg_pool2d(image.detach(), 5, 1, padding=2, count_include_pad=False).mean(1, keepdim=True)
        positions = light.clamp(0, 1) * (KNOTS - 1)
        chosen = self.levels[:, [self.SCALES.index(scale) for scale in scales]].to(image)
        first, *others = chosen.flatten(1, 2).square().unbind(2)
        # Linear interpolation, as a sum of ramps between the knots: their slopes are constant.
        squares, previous = first[..., None, None].expand(-1, -1, *image.shape[-2:]), first
        for knot, values in enumerate(others):
            squares = squares + (values - previous)[..., None, None] * (positions - knot).clamp(0, 1)
            previous = values
        return squares.clamp(min=0).sqrt()

    def variance(self, image: Tensor) -> Tensor:
        """Variance (B, 1, H, W) of the noise of each channel of an image (B, C, H, W)."""
        luminance, colour = self.at(image, self.SCALES[:1]).square().split(1, dim=1)
        return luminance + 2 / 3 * colour if image.shape[1] == 3 else luminance

    @full_precision
    def draw(self, image: Tensor, generator: torch.Generator) -> Tensor:
        """A random field (B, C, H, W) with the levels of the noise of an image (B, C, H, W) at every scale.

        It is a sum of weighted means of white noise, with smooth weights for each scale. Their variances are fitted to
        the squared levels at each brightness, and add up to that of a pixel.
        """
        channels, (height, width) = image.shape[1], image.shape[2:]
        deviations = replace(self, levels=self._parts().to(image)).at(image).unflatten(1, (-1, 2))  # (B, S, 2, H, W)
        total = torch.zeros_like(image)
        for scale, part in zip(self.SCALES, deviations.unbind(1), strict=True):
            tent = torch.from_numpy(_tent(scale)).to(image).view(1, 1, -1, 1)
            size = height + 2 * scale - 2, width + 2 * scale - 2
            field = random_normal((len(image), channels, *size), image, generator).flatten(0, 1).unsqueeze(1)
            field = F.conv2d(F.conv2d(field, tent), tent.mT).view_as(image)
            total = total + (part[:, (0, 1, 1)] if channels == 3 else part[:, :1]) * field
        return join_colours(total, 3) if channels == 3 else total

    def _parts(self) -> Tensor:
        """Deviations (B, S, 2, K) of weighted means of each scale, which together have the levels."""
        gains = np.empty((len(self.SCALES), len(self.SCALES)))  # squared level at a scale for a unit of each variance
        for row, scale in enumerate(self.SCALES):
            distances = np.abs(np.subtract.outer(np.arange(scale), np.arange(scale)))
            for column, side in enumerate(self.SCALES):
                products = np.correlate(_tent(side), _tent(side), "full")[2 * side - 2 :]
                products = np.pad(products, (0, max(self.SCALES)))
                gains[row, column] = (products[distances].sum() / scale) ** 2
        squares = self.levels.detach().double().square().transpose(1, 3)  # (B, K, 2, S)
        rows = []
        for levels in squares.flatten(0, 2).cpu().numpy():
            # Coarse levels are often the largest: errors count as shares of each. The first is the power and holds.
            relative = levels / max(levels.max(), np.finfo(float).tiny)
            shares = 1 / np.maximum(relative, NEGLIGIBLE)
            parts, _ = nnls(gains * shares[:, None], relative * shares)
            rows.append(parts * levels[0] / max(parts.sum(), np.finfo(float).tiny))
        return torch.from_numpy(np.stack(rows)).sqrt().to(self.levels).view_as(squares).transpose(1, 3)

    def _deviation(self, scale: int) -> Tensor:
        """Root mean square (B,) of a pixel's channels at the scale of that index, at the mean brightness."""
        position = self.light.clamp(0, 1) * (KNOTS - 1)
        below = position.floor().clamp(max=KNOTS - 2)
        share = (position - below)[:, None]
        places = below.long()[:, None, None].expand(-1, 2, 1)
        squares = self.levels[:, scale].square()
        ends = squares.gather(2, places).squeeze(2), squares.gather(2, places + 1).squeeze(2)
        luminance, colour = torch.lerp(ends[0], ends[1], share).unbind(1)
        # The differences have coefficients of unit norm: their variances are shared by the three channels.
        return (luminance + 2 / 3 * colour).sqrt()


def _tent(side: int) -> npt.NDArray[np.float64]:
    """Weights (2 side - 1,) of a mean of means over ``side`` values, whose squares add up to 1."""
    weights = np.convolve(np.ones(side), np.ones(side))
    return weights / np.linalg.norm(weights)


@torch.no_grad()
@full_precision
def profile_of_difference(noisy: Tensor, clean: Tensor) -> NoiseProfile:
    """Measure the noise of a photograph as its difference from a clean one.

    Args:
        noisy: (B, C, H, W), in [0, 1] apart from the noise.
        clean: the same photograph without noise.

    Returns:
        The noise. At brightnesses that do not occur, levels are those of the nearest ones that do. Levels at scale s
        are uncertain by 1 / sqrt(2 n) of their value, with n the number of blocks of s x s pixels.

    Raises:
        TypeError, ValueError: if an image is not a finite floating-point (B, C, H, W) tensor, or sizes differ.

    Example:
        >>> clean = torch.full((1, 3, 64, 64), 0.4)
        >>> noise = torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> profile_of_difference(clean + 0.1 * noise, clean).level.round(decimals=2)
        tensor([0.1000])
    """
    check_image(noisy, "noisy")
    check_image(clean, "clean", batch=noisy.shape[0], channels=noisy.shape[1])
    check_same_size(clean, (noisy.shape[-2], noisy.shape[-1]), "clean", "noisy")
    dtype = working_dtype(noisy)
    picture = clean.to(dtype)
    planes = _planes_of(squarable(noisy.to(dtype) - picture))
    light = picture.mean(1, keepdim=True).clamp(0, 1)
    levels = [_levels(planes, light, scale) for scale in NoiseProfile.SCALES]
    return NoiseProfile(torch.stack(levels, dim=1), light.mean((1, 2, 3)))


def _planes_of(difference: Tensor) -> tuple[Tensor, Tensor]:
    """Luminance and colour differences of a difference of images; channels of other than 3 count as luminances."""
    if difference.shape[1] != 3:
        return difference, torch.zeros_like(difference[:, :1])
    planes = split_colours(difference)
    return planes[:, :1], planes[:, 1:]


def _levels(planes: tuple[Tensor, Tensor], light: Tensor, scale: int) -> Tensor:
    """Levels (B, 2, K) of block means at a scale, from planes (B, n, H, W) and the brightness (B, 1, H, W).

    Variances that are linear between the knots are fitted by least squares.
    """
    size = [min(scale, length) for length in light.shape[-2:]]
    stride = [max(1, length // 2) for length in size]
    knots = torch.arange(KNOTS, dtype=light.dtype, device=light.device)
    positions = F.avg_pool2d(light, size, stride) * (KNOTS - 1)
    weights = (1 - (positions - knots.view(1, -1, 1, 1)).abs()).clamp(min=0)  # (B, K, h, w)
    energies = [F.avg_pool2d(plane, size, stride).square().mean(1, keepdim=True) for plane in planes]
    squares = torch.einsum("bkhw,blhw->bkl", weights, weights)
    slopes = torch.eye(KNOTS).to(light).diff(dim=0)
    sums = torch.stack([(weights * energy).sum((2, 3)) for energy in energies], dim=2)
    stiffness = (STIFFEST * squares.sum((1, 2), keepdim=True)).clamp(min=STIFFNESS)
    variances = torch.linalg.solve(squares + stiffness * (slopes.mT @ slopes), sums).mT
    return (variances.clamp(min=0) * (size[0] * size[1])).sqrt()


@full_precision
def split_colours(image: Tensor) -> Tensor:
    """Split an image (B, 1 or 3, H, W) into luminance and two colour differences (B, 3, H, W).

    The luminance is the mean of the channels. The differences have coefficients of unit norm; for a grey image they are
    0.
    """
    if image.shape[1] == 1:
        nothing = torch.zeros_like(image)
        return torch.cat([image, nothing, nothing], dim=1)
    return torch.einsum("pc,bchw->bphw", _mixture(image), image)


@full_precision
def split_noise(noise: Tensor, channels: int) -> Tensor:
    """Levels (B, 2, H, W) of luminance and colour differences, from those of white noise (B, 1 or C, H, W)."""
    if channels == 1:
        return torch.cat([noise, torch.zeros_like(noise)], dim=1)
    if noise.shape[1] == 1:
        return torch.cat([noise / math.sqrt(3), noise], dim=1)
    variance = noise.to(working_dtype(noise)).square()
    deviation = torch.cat([variance.sum(1, keepdim=True) / 9, variance.mean(1, keepdim=True)], dim=1)
    return deviation.clamp(min=1e-30).sqrt().to(noise)


@full_precision
def join_colours(planes: Tensor, channels: int) -> Tensor:
    """Invert :func:`split_colours`."""
    if channels == 1:
        return planes[:, :1]
    # Coefficients of differences are orthonormal and add up to 0: the inverse is the transpose but for the luminance.
    inverse = torch.cat([torch.ones_like(_mixture(planes)[:1]), _mixture(planes)[1:]]).mT
    return torch.einsum("cp,bphw->bchw", inverse, planes)


def _mixture(like: Tensor) -> Tensor:
    """Matrix (3, 3) from red, green and blue to luminance and differences."""
    rows = [[1 / 3, 1 / 3, 1 / 3], [0.5**0.5, 0.0, -(0.5**0.5)], [6**-0.5, -2 * 6**-0.5, 6**-0.5]]
    return like.new_tensor(rows)
