"""A rough mask to a soft one whose borders follow those of the picture: a small linear solve over neighbours.

The mask a minimises ``sum_ij w_ij (a_i - a_j)^2 + sum_i c_i (a_i - t_i)^2`` over pixels and their eight neighbours,
with weights w that fall with the difference of colours, a rough mask t and confidences c in it. A fixed number of
Jacobi steps on each level of a pyramid, from the coarsest to the finest, solves it nearly, and sees a bounded
neighbourhood, so that tiles agree with the whole picture.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.filtering.neighbours import SIDES, neighbour_weights

STEPS = (2, 4, 8)  # on each level from the finest on; the last number holds for all further ones, and the coarsest
COARSEST = 48  # pixels of the short side on the coarsest level, at least
LEVELS = 4  # at most, beside the picture itself
STEEPNESS = 300.0  # of the weights, per mean squared difference of the channels
LEAST = 1e-4  # weight of neighbours that differ as much as they can
REFINED, CONTRAST = 2, 0.03  # rounds; difference of colours from which on they tell how much of each a pixel holds
BESIDE = 4  # coarsest pixels that the colours on either side of a border are averaged over, to each direction
KNOWN = 0.02  # share of a side, of what is nearby, at which its colour counts as half known
TINY = 1e-4  # weight of pixels that hardly belong to a side
REFERENCE = 112  # short side for which confidences are meant


def pyramid_levels(short: int) -> int:
    """How often a picture with so many pixels on its short side is halved."""
    return max(0, min(LEVELS, int(math.log2(max(short / COARSEST, 1)))))


def pyramid_margin(levels: int) -> int:
    """How many pixels around a pixel the solve depends on; a multiple of the pixels of the coarsest level."""
    seen = sum((steps_on(level, levels) + 1) << level for level in range(levels + 1))
    step = 1 << levels
    return -(-seen // step) * step + step


def steps_on(level: int, levels: int) -> int:
    """Steps on a level, 0 is the finest, of a pyramid."""
    return STEPS[-1] if level == levels else STEPS[min(level, len(STEPS) - 1)]


def sides_margin(levels: int) -> int:
    """How many pixels around a pixel :func:`colours_beside` depends on."""
    return (2 + BESIDE) << levels


def solve_mask(image: Tensor, rough: Tensor, confidence: Tensor, short: int) -> Tensor:
    """The soft mask (B, K, H, W).

    Args:
        image: (B, C, H, W), C = 1 or 3.
        rough: t, (B, K, H, W).
        confidence: c, (B, K, H, W), for a picture whose short side is at most
            :data:`REFERENCE`.
        short: pixels of the short side of the whole picture.
    """
    height, width = image.shape[-2:]
    levels = pyramid_levels(short)
    step = 1 << levels
    # A multiple of the coarsest pixels, so that these are the same in tiles and in the whole.
    pad = (0, -width % step, 0, -height % step)
    planes = torch.cat([image, confidence * rough, confidence], dim=1)
    planes = F.pad(planes, pad, "replicate")
    scale = min(1.0, REFERENCE / short) ** 2
    pyramid = [planes]
    for _ in range(levels):
        pyramid.append(F.avg_pool2d(pyramid[-1], 2))
    count, steepness = rough.shape[1], -STEEPNESS / image.shape[1]
    found: Tensor | None = None
    for level, some in reversed(list(enumerate(pyramid))):
        colours, target, trust = some.split([image.shape[1], count, count], dim=1)
        area = scale * 4**level
        target, trust = area * target, area * trust
        if found is None:
            found = target / trust
        else:
            found = F.interpolate(found, scale_factor=2, mode="bilinear", align_corners=False)
        weights = neighbour_weights(colours, lambda squared: torch.exp(steepness * squared) + LEAST)
        found = jacobi(found, target, trust, weights, steps_on(level, levels))
    assert found is not None  # for mypy
    return found[..., :height, :width].clamp(0.0, 1.0)


def jacobi(found: Tensor, target: Tensor, trust: Tensor, weights: Tensor, steps: int) -> Tensor:
    """Steps towards the solution from ``found``, given products of confidences with the rough mask, and the former."""
    total = trust.clone()
    links = [weights[:, k : k + 1, *here] for k, (here, _) in enumerate(SIDES)]
    for (here, there), weight in zip(SIDES, links, strict=True):
        total[..., *here] += weight
        total[..., *there] += weight
    inverse = 1 / total
    for _ in range(steps):
        # A new tensor each time, which the gradient needs.
        following = target.clone()
        for (here, there), weight in zip(SIDES, links, strict=True):
            following[..., *here].addcmul_(weight, found[..., *there])
            following[..., *there].addcmul_(weight, found[..., *here])
        found = following * inverse
    return found


def colours_beside(image: Tensor, mask: Tensor, levels: int) -> tuple[Tensor, Tensor, Tensor]:
    """The mean colours nearby of what is inside a mask and of what is outside, both (B, C, H, W).

    Third, how far these are known, (B, 1, H, W) in [0, 1]: hardly where nearly all or nearly nothing nearby is inside.

    Args:
        image: (B, C, H, W).
        mask: (B, 1, H, W).
        levels: as of :func:`pyramid_levels`.
    """
    (height, width), step = image.shape[-2:], 1 << levels
    weights = torch.cat([mask, 1 - mask], dim=1).pow(4) + TINY  # (B, 2, H, W)
    planes = torch.cat([weights, image * weights[:, :1], image * weights[:, 1:]], dim=1)
    planes = F.pad(planes, (0, -width % step, 0, -height % step), "replicate")
    coarse = F.avg_pool2d(planes, step)
    size = 2 * BESIDE + 1
    # Along one axis after the other; nothing is outside the picture.
    sums = F.avg_pool2d(coarse, (size, 1), 1, (BESIDE, 0))
    sums = F.avg_pool2d(sums, (1, size), 1, (0, BESIDE))
    means = sums[:, 2:].unflatten(1, (2, -1)) / sums[:, :2].unsqueeze(2)  # (B, 2, C, h, w)
    least = sums[:, :2].amin(1, keepdim=True)
    found = torch.cat([means.flatten(1, 2), least / (least + KNOWN)], dim=1)
    if levels:
        found = F.interpolate(found, scale_factor=step, mode="bilinear", align_corners=False)
    channels = image.shape[1]
    inside, outside, known = found[..., :height, :width].split([channels, channels, 1], dim=1)
    return inside, outside, known


def refine_mask(image: Tensor, mask: Tensor, levels: int) -> Tensor:
    """A mask (B, 1, H, W) whose border pixels hold as much of the inside as their own colours say.

    For things of one colour on grounds of another; of textures it would make patterns.

    Args:
        image: (B, C, H, W).
        mask: (B, 1, H, W).
        levels: as of :func:`colours_beside`.
    """
    for _ in range(REFINED):
        inside, outside, known = colours_beside(image, mask, levels)
        across = inside - outside
        contrast = across.square().mean(1, keepdim=True)
        share = ((image - outside) * across).mean(1, keepdim=True) / (contrast + TINY * CONTRAST)
        trust = known * contrast / (contrast + CONTRAST**2) * (1 - (2 * mask - 1).pow(8))  # 0 and 1 are certain
        mask = torch.lerp(mask, share.clamp(0.0, 1.0), trust)
    return mask
