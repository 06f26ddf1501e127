"""Local variance of luminance, by which edits tell texture from flat areas."""

import torch
from torch import Tensor

from nlfilter_torch.core.precision import per_image
from nlfilter_torch.operator.features import blur, reduce_channels

VARIANCE_SIGMA = 2.0  # standard deviation in pixels of the Gaussian window for the local variance
EPSILON = 1e-12


def limit_by_activity(changes: Tensor, activity: Tensor, threshold: float | Tensor) -> Tensor:
    """Sum added detail and the rest of the change, (B, 2 C, H, W), with less added detail where the image is flat.

    Added detail is multiplied by ``v / (v + threshold^2)``, with v the activity (B, 1, H, W).
    """
    if not isinstance(threshold, Tensor) and threshold == 0:
        return sum_of(changes)
    added, rest = changes.chunk(2, dim=1)
    least = per_image(threshold, activity, 4).square()
    shares = torch.where(least == 0, 1.0, activity / (activity + least).clamp(min=EPSILON))
    return added * shares + rest


def activity(image: Tensor) -> Tensor:
    """Local variance (B, 1, H, W) of the luminance of an image."""
    grey = reduce_channels(image, "luminance").mean(1, keepdim=True)
    mean, square = blur(torch.cat([grey, grey.square()], dim=1), VARIANCE_SIGMA).chunk(2, dim=1)
    return (square - mean.square()).clamp(min=0)


def sum_of(changes: Tensor) -> Tensor:
    """Sum of added detail and the rest of the change, given as (B, 2 C, H, W)."""
    added, rest = changes.chunk(2, dim=1)
    return added + rest
