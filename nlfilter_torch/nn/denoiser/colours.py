"""Luminance and colour differences, as the denoiser sees a picture, and the noise of each."""

import math

import torch
from torch import Tensor

from nlfilter_torch.core.precision import full_precision, working_dtype


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
