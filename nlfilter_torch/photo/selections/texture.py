"""Surroundings and texture of pixels, as channels of a guide: they tell apart areas of the same brightness."""

import torch
from torch import Tensor

from nlfilter_torch.operator.features import blur, blur_margin, pad_border

# Gaussians, in pixels: surroundings, grain, average of its strength.
SURROUND_SIGMA, GRAIN_SIGMA, TEXTURE_SIGMA = 2.0, 1.5, 3.0
TEXTURE_MARGIN = max(blur_margin(SURROUND_SIGMA), blur_margin(GRAIN_SIGMA) + blur_margin(TEXTURE_SIGMA))


def with_texture(planes: Tensor, brightness: Tensor, weight: float) -> Tensor:
    """Append the means of planes around each pixel and the strength of the texture there.

    Args:
        planes: (B, C, H, W).
        brightness: (B, 1, H, W), of which the texture is measured.
        weight: of the texture.

    Returns:
        (B, 2 C + 3, H, W): the planes, their means, and ``weight`` times the strength of grain and of both gradients.
    """
    # In float32, blurred planes of a mirrored picture would differ by rounding, and with them its landmarks.
    planes, brightness, dtype = planes.double(), brightness.double(), planes.dtype
    padded = pad_border(brightness, 1)
    rows, columns = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    grain = torch.cat([brightness - blur(brightness, GRAIN_SIGMA), rows / 2, columns / 2], dim=1)
    strength = (blur(grain.square(), TEXTURE_SIGMA) + 1e-8).sqrt()  # the derivative of the root is finite
    return torch.cat([planes, blur(planes, SURROUND_SIGMA), weight * strength], dim=1).to(dtype)
