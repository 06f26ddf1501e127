"""Random-walker segmentation (Grady, 2006) with a rough mask as prior: a soft mask that changes along borders.

It minimises ``sum_ij w_ij (a_i - a_j)^2 + sum_i c_i (a_i - t_i)^2`` over pixels and their eight neighbours, with
weights w that decrease with the difference in colour, a rough mask t and confidences c in it. A few Jacobi steps on
each level of a pyramid solve it approximately.
"""

from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.photo.selections.neighbours import SIDES, neighbour_weights
from nlfilter_torch.photo.selections.pyramid import doubled, halved, pyramid_levels

STEPS = (2, 4, 8)  # Jacobi steps per level, finest first; the last number is for all coarser levels
STEEPNESS = 300.0  # decay of the weights with the mean squared difference of the channels
MIN_WEIGHT = 1e-4
REFERENCE = 112  # short side, in pixels, for which the confidences were chosen


def solve_mask(image: Tensor, rough: Tensor, confidence: Tensor) -> Tensor:
    """Solve for soft masks (B, K, H, W).

    Args:
        image: (B, C, H, W), C = 1 or 3.
        rough: t, (B, K, H, W).
        confidence: c, (B, K, H, W), for a short side of at most :data:`REFERENCE` pixels; rescaled for larger pictures.
    """
    height, width = image.shape[-2:]
    short = min(height, width)
    levels = pyramid_levels(short)
    planes = torch.cat([image, confidence * rough, confidence], dim=1)
    scale = min(1.0, REFERENCE / short) ** 2
    count, channels = rough.shape[1], image.shape[1]
    coarser: Tensor | None = None
    for level, planes_of_level in reversed(list(enumerate(halved(planes, levels)))):
        colours, target, trust = planes_of_level.split([channels, count, count], dim=1)
        area = scale * 4**level
        target, trust = area * target, area * trust
        mask = target / trust if coarser is None else doubled(coarser, planes_of_level)
        weights = neighbour_weights(colours, partial(_weight, steepness=STEEPNESS / channels))
        coarser = jacobi(mask, target, trust, weights, STEPS[-1 if level == levels else min(level, len(STEPS) - 1)])
    assert coarser is not None  # for mypy
    return coarser.clamp(0.0, 1.0)


def _weight(squared: Tensor, steepness: float) -> Tensor:
    """Weight of neighbours whose colours have these squared distances."""
    return torch.exp(-steepness * squared) + MIN_WEIGHT


def jacobi(mask: Tensor, target: Tensor, trust: Tensor, weights: Tensor, steps: int) -> Tensor:
    """Jacobi steps from a mask.

    Args:
        mask: the start, (B, K, H, W).
        target: c t, confidence times rough mask.
        trust: c, the confidence.
        weights: w, :func:`neighbour_weights`.
        steps: their number.
    """
    total = trust.clone()
    links = [weights[:, k : k + 1, *here] for k, (here, _) in enumerate(SIDES)]
    for (here, there), weight in zip(SIDES, links, strict=True):
        total[..., *here] += weight
        total[..., *there] += weight
    inverse = 1 / total
    for _ in range(steps):
        # Not in place: the gradient needs every iterate.
        following = target.clone()
        for (here, there), weight in zip(SIDES, links, strict=True):
            following[..., *here].addcmul_(weight, mask[..., *there])
            following[..., *there].addcmul_(weight, mask[..., *here])
        mask = following * inverse
    return mask
