"""Other sharpening methods: detail images whose multiples are added to the photograph.

Adaptive unsharp masking after Polesel, Ramponi and Mathews, "Image Enhancement via Adaptive Unsharp Masking", IEEE
Transactions on Image Processing 9(3), 2000, the paper's [12].
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# The adaptive method, for grey levels from 0 to 255: variances that separate flat, medium and high activity, the gains
# wanted for medium and high activity, step size of the adaptation, and forgetting factor of its correlation matrix.
ACTIVITY = (60.0, 200.0)
WANTED = (4.0, 3.0)
STEP, FORGETTING = 0.1, 0.5
SLACK = 0.1  # of the constrained method: overshoot as a share of the local range


def gaussian(image: Tensor, sigma: float) -> Tensor:
    """Blur (B, 1, H, W)."""
    from kornia.filters import gaussian_blur2d

    size = 2 * math.ceil(3 * sigma) + 1
    return gaussian_blur2d(image, (size, size), (sigma, sigma))


def unsharp(image: Tensor, sigma: float) -> Tensor:
    """Plain unsharp masking: the part that a Gaussian removes."""
    return image - gaussian(image, sigma)


def band(image: Tensor, fine: float, coarse: float) -> Tensor:
    """Unsharp masking without the finest grain: a difference of Gaussians."""
    return gaussian(image, fine) - gaussian(image, coarse)


def bilateral(image: Tensor, range_sigma: float) -> Tensor:
    """The part that a bilateral filter of 11x11 pixels removes."""
    from kornia.filters import bilateral_blur

    return image - bilateral_blur(image, (11, 11), range_sigma, (3.0, 3.0))


def guided(image: Tensor, eps: float) -> Tensor:
    """The part that a guided filter of 11x11 pixels removes."""
    from kornia.filters import guided_blur

    return image - guided_blur(image, image, 11, eps)


def adaptive(image: Tensor) -> Tensor:
    """Second differences along rows and columns, each times a gain that is adapted recursively along the row.

    In active areas, the gains adapt until the local dynamics is a multiple of its original; in flat areas, until it is
    unchanged.
    """
    dtype, image = image.dtype, 255 * image.double()
    padded = F.pad(image, (1, 1, 1, 1), mode="reflect")
    across = 2 * image - padded[..., 1:-1, :-2] - padded[..., 1:-1, 2:]
    along = 2 * image - padded[..., :-2, 1:-1] - padded[..., 2:, 1:-1]
    dynamics, dynamics_across, dynamics_along = (_dynamics(x) for x in (image, across, along))
    variance = F.avg_pool2d(padded.square(), 3, 1) - F.avg_pool2d(padded, 3, 1).square()
    medium, high = (torch.full_like(image, gain) for gain in WANTED)
    wanted = torch.where(variance < ACTIVITY[1], medium, high)
    wanted = torch.where(variance < ACTIVITY[0], torch.ones_like(image), wanted)

    batch, _, height, width = image.shape
    gains = image.new_zeros(batch, height, 2)
    correlation = 1e-2 * torch.eye(2).to(image).expand(batch, height, 2, 2)
    columns = []
    for x in range(width):  # all rows at once
        pairs = torch.stack([dynamics_across[:, 0, :, x], dynamics_along[:, 0, :, x]], dim=-1)
        columns.append(gains)
        lack = (wanted * dynamics - dynamics)[:, 0, :, x] - (gains * pairs).sum(-1)
        correlation = (1 - FORGETTING) * correlation + FORGETTING * pairs.unsqueeze(-1) * pairs.unsqueeze(-2)
        step = torch.linalg.solve(correlation + 1e-3 * torch.eye(2).to(image), pairs)
        gains = gains + 2 * STEP * lack.unsqueeze(-1) * step
    adapted = torch.stack(columns, dim=2)  # (B, H, W, 2)
    detail = adapted[..., 0].unsqueeze(1) * across + adapted[..., 1].unsqueeze(1) * along
    return (detail / 255).to(dtype)


def _dynamics(image: Tensor) -> Tensor:
    """Local dynamics: difference of a pixel to its eight neighbours."""
    kernel = -torch.ones(1, 1, 3, 3, dtype=image.dtype)
    kernel[..., 1, 1] = 8
    return F.conv2d(F.pad(image, (1, 1, 1, 1), mode="reflect"), kernel)


def constrained(image: Tensor, amount: float, radius: int = 2) -> Tensor:
    """Unsharp masking with overshoot limited to a tenth of the local range, as in the paper's [28]."""
    size = 2 * radius + 1
    highest, lowest = F.max_pool2d(image, size, 1, radius), -F.max_pool2d(-image, size, 1, radius)
    slack = SLACK * (highest - lowest)
    return torch.minimum(torch.maximum(image + amount * unsharp(image, 1.5), lowest - slack), highest + slack)
