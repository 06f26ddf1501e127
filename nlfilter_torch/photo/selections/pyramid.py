"""Pyramids of pictures, for solvers that start on a small copy."""

import math

import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.photo.picture.resizing import block_means

COARSEST = 48  # minimum short side of the coarsest level, in pixels
LEVELS = 4  # maximum number of reduced levels


def pyramid_levels(short: int) -> int:
    """Number of times a picture with that short side is halved."""
    return max(0, min(LEVELS, int(math.log2(max(short / COARSEST, 1)))))


def halved(planes: Tensor, levels: int) -> list[Tensor]:
    """A pyramid of planes (B, C, H, W), each level half the size, rounded up."""
    pyramid = [planes]
    for _ in range(levels):
        pyramid.append(block_means(pyramid[-1], 2))
    return pyramid


def doubled(planes: Tensor, like: Tensor) -> Tensor:
    """Planes of one level, enlarged to the next finer level, which has the size of ``like``."""
    return F.interpolate(planes, like.shape[-2:], mode="bilinear", align_corners=False)
