"""The mosaic of a sensor, and four ways to interpolate it; what depends on the shot is decided on the noisy one.

All functions take shots (2, ., H, W): the same picture without and with noise. A demosaicer that chooses between
directions or neighbours chooses by the noisy shot, for both: so the first stays what the mean of many shots would be.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

HALF = ((1.0, 2.0, 1.0), (2.0, 4.0, 2.0), (1.0, 2.0, 1.0))
CROSS = ((0.0, 1.0, 0.0), (1.0, 4.0, 1.0), (0.0, 1.0, 0.0))
# Malvar, He and Cutler 2004: the interpolated value plus the Laplacian of the known colour; all over 8.
GREEN_AT_OTHERS = (
    (0.0, 0.0, -1.0, 0.0, 0.0),
    (0.0, 0.0, 2.0, 0.0, 0.0),
    (-1.0, 2.0, 4.0, 2.0, -1.0),
    (0.0, 0.0, 2.0, 0.0, 0.0),
    (0.0, 0.0, -1.0, 0.0, 0.0),
)
BESIDE_AT_GREEN = (
    (0.0, 0.0, 0.5, 0.0, 0.0),
    (0.0, -1.0, 0.0, -1.0, 0.0),
    (-1.0, 4.0, 5.0, 4.0, -1.0),
    (0.0, -1.0, 0.0, -1.0, 0.0),
    (0.0, 0.0, 0.5, 0.0, 0.0),
)
RED_AT_BLUE = (
    (0.0, 0.0, -1.5, 0.0, 0.0),
    (0.0, 2.0, 0.0, 2.0, 0.0),
    (-1.5, 0.0, 6.0, 0.0, -1.5),
    (0.0, 2.0, 0.0, 2.0, 0.0),
    (0.0, 0.0, -1.5, 0.0, 0.0),
)


def masks(height: int, width: int, phase: int) -> Tensor:
    """Which pixels of a Bayer mosaic are red, green and blue, as (3, H, W) of 0 and 1; ``phase`` 0 to 3 shifts it."""
    rows = (torch.arange(height) + phase // 2)[:, None] % 2
    columns = (torch.arange(width) + phase % 2) % 2
    red, blue = (1 - rows) * (1 - columns), rows * columns
    return torch.stack([red, 1 - red - blue, blue]).float()


def mosaic(shots: Tensor, filters: Tensor) -> Tensor:
    """The colour (2, 1, H, W) that each pixel measures, of planes (2, 3, H, W)."""
    return (shots * filters).sum(1, keepdim=True)


def filtered(planes: Tensor, kernel: tuple[tuple[float, ...], ...], divisor: float) -> Tensor:
    """Convolve each plane with a small kernel; the picture is mirrored at its borders, which keeps the mosaic."""
    reach = len(kernel) // 2
    height, width = planes.shape[-2:]
    padded = F.pad(planes, (reach, reach, reach, reach), mode="reflect")
    total = torch.zeros_like(planes)
    for row, line in enumerate(kernel):  # faster than a convolution of single planes
        for column, weight in enumerate(line):
            if weight:
                total.add_(padded[..., row : row + height, column : column + width], alpha=weight / divisor)
    return total


def bilinear(raw: Tensor, filters: Tensor) -> Tensor:
    """Means of the two or four neighbours that measure the colour."""
    measured = raw * filters
    others = filtered(measured[:, ::2], HALF, 4)
    green = filtered(measured[:, 1:2], CROSS, 4)
    return torch.cat([others[:, :1], green, others[:, 1:]], dim=1)


def gradient_corrected(raw: Tensor, filters: Tensor) -> Tensor:
    """Linear interpolation corrected by the Laplacian of the measured colour (Malvar, He and Cutler 2004)."""
    red, green, blue = filters
    at_others = filtered(raw, GREEN_AT_OTHERS, 8)
    beside = filtered(raw, BESIDE_AT_GREEN, 8)
    above = filtered(raw.mT, BESIDE_AT_GREEN, 8).mT
    opposite = filtered(raw, RED_AT_BLUE, 8)
    red_rows = red.amax(-1, keepdim=True)  # rows with red pixels
    planes = [
        red * raw + blue * opposite + green * torch.where(red_rows > 0, beside, above),
        green * raw + (1 - green) * at_others,
        blue * raw + red * opposite + green * torch.where(red_rows > 0, above, beside),
    ]
    return torch.cat(planes, dim=1)


def directional(raw: Tensor, filters: Tensor) -> Tensor:
    """Green along the direction of the smaller change, then differences of colours (after Hamilton and Adams 1997)."""
    green = filters[1]
    across, across_change = _green_along(raw)
    along, along_change = (values.mT for values in _green_along(raw.mT))
    share = along_change.square() / (across_change.square() + along_change.square()).clamp(min=1e-12)
    share = share[1:]
    interpolated = green * raw + (1 - green) * (share * across + (1 - share) * along)
    differences = filtered((raw - interpolated) * filters[::2], HALF, 4)
    return interpolated + torch.cat([differences[:, :1], 0 * raw, differences[:, 1:]], dim=1)


def median_of_differences(raw: Tensor, filters: Tensor) -> Tensor:
    """Bilinear, and then medians over 3x3 pixels of the differences to green (Freeman 1988)."""
    planes = bilinear(raw, filters)
    green = planes[:, 1:2]
    differences = F.pad(planes[:, ::2] - green, (1, 1, 1, 1), mode="reflect")
    height, width = raw.shape[-2:]
    near = F.unfold(differences, 3).view(2, 2, 9, height, width)
    middle = near[1].median(1, keepdim=True).indices.expand(2, -1, -1, -1, -1)
    medians = near.gather(2, middle)[:, :, 0]
    return torch.cat([medians[:, :1], 0 * green, medians[:, 1:]], dim=1) + green


def _green_along(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Green between the left and right neighbours, and how much the picture changes between these."""
    padded = F.pad(raw, (2, 2, 0, 0), mode="reflect")
    far_left, left, middle, right, far_right = (padded[..., start : start + raw.shape[-1]] for start in range(5))
    curvature = 2 * middle - far_left - far_right
    return (left + right) / 2 + curvature / 4, (left - right).abs() + curvature.abs()


DEMOSAICERS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "bilinear": bilinear,
    "gradient corrected": gradient_corrected,
    "directional": directional,
    "median of differences": median_of_differences,
}
