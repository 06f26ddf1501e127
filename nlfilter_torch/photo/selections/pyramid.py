"""Pyramids of pictures, for solvers that start on a small copy."""

import math

import torch.nn.functional as F
from torch import Tensor

COARSEST = 48  # minimum short side of the coarsest level, in pixels
LEVELS = 4  # maximum number of reduced levels


def pyramid_levels(short: int) -> int:
    """Number of times a picture with that short side is halved."""
    return max(0, min(LEVELS, int(math.log2(max(short / COARSEST, 1)))))


def halved(planes: Tensor, levels: int) -> list[Tensor]:
    """A pyramid of planes (B, C, H, W), each level half the size; an odd last row or column is kept as it is."""
    pyramid = [planes]
    for _ in range(levels):
        pyramid.append(F.avg_pool2d(pyramid[-1], 2, ceil_mode=True, count_include_pad=False))
    return pyramid


def doubled(planes: Tensor, like: Tensor) -> Tensor:
    """Planes of one level, enlarged to the next finer level, which has the size of ``like``."""
    twice = F.interpolate(planes, scale_factor=2, mode="bilinear", align_corners=False)
    return twice[..., : like.shape[-2], : like.shape[-1]]
