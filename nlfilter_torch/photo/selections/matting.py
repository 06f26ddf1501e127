"""Refine a rough mask to a soft one whose borders follow those of the picture, by two solves.

The first minimises ``sum_ij w_ij (a_i - a_j)^2 + sum_i c_i (a_i - t_i)^2`` over pixels and their eight neighbours, with
weights w that decrease with the difference in colour, a rough mask t and confidences c in it; a few Jacobi steps on
each level of a pyramid solve it approximately. The second starts from that solution and is closed-form matting (Levin,
Lischinski and Weiss, 2008): in every small window the mask is a linear function of the colour, which models hair and
soft borders. These functions also give the mask of any pixel of a larger picture (:class:`LinearMasks`).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.photo.picture.colour import dot
from nlfilter_torch.photo.selections.neighbours import SIDES, neighbour_weights

STEPS = (2, 4, 8)  # Jacobi steps per level, finest first; the last number is for all coarser levels
COARSEST = 48  # minimum short side of the coarsest level, in pixels
LEVELS = 4  # maximum number of reduced levels
STEEPNESS = 300.0  # decay of the weights with the mean squared difference of the channels
MIN_WEIGHT = 1e-4
REFINEMENT_ROUNDS, HALF_TRUST_CONTRAST = 2, 0.03  # rounds of refinement; colour difference at which it is half trusted
SIDE_RADIUS = 4  # radius over which the colours on each side of a border are averaged, in pixels of the coarsest level
HALF_TRUST_SHARE = 0.02  # share of nearby pixels on one side at which the colour of that side is half trusted
MIN_SIDE_WEIGHT = 1e-4  # smallest weight of a pixel on either side
REFERENCE = 112  # short side, in pixels, for which the confidences were chosen
WINDOW_RADIUS, NOISE = 2, 1e-6  # radius of the windows in which masks are linear in colour; variance of noise
LINEAR_LEVELS, LINEAR_STEPS = 2, 24  # of the second solve: levels of the pyramid, steps on each
END_MARGIN = 0.1  # mask values closer than this to 0 or 1 are set to 0 or 1
SLOWEST = 0.005  # smallest eigenvalue that the steps of the second solve damp
# Confidence of the second solve in a rough mask of 0 or 1, and in scribbles.
LINEAR_ROUGH_CONFIDENCE, LINEAR_SCRIBBLE_CONFIDENCE = 3e-3, 10.0


def pyramid_levels(short: int) -> int:
    """Number of times a picture with that short side is halved."""
    return max(0, min(LEVELS, int(math.log2(max(short / COARSEST, 1)))))


def solve_mask(image: Tensor, rough: Tensor, confidence: Tensor) -> Tensor:
    """Solve for the soft masks (B, K, H, W) of the first problem.

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
    pyramid = halved(planes, levels)
    count, steepness = rough.shape[1], -STEEPNESS / image.shape[1]
    found: Tensor | None = None
    for level, some in reversed(list(enumerate(pyramid))):
        colours, target, trust = some.split([image.shape[1], count, count], dim=1)
        area = scale * 4**level
        target, trust = area * target, area * trust
        found = target / trust if found is None else doubled(found, some)
        weights = neighbour_weights(colours, lambda squared: torch.exp(steepness * squared) + MIN_WEIGHT)
        steps = STEPS[-1 if level == levels else min(level, len(STEPS) - 1)]
        found = jacobi(found, target, trust, weights, steps)
    assert found is not None  # for mypy
    return found.clamp(0.0, 1.0)


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


def jacobi(found: Tensor, target: Tensor, trust: Tensor, weights: Tensor, steps: int) -> Tensor:
    """Jacobi steps from ``found``, given ``target``, confidence times rough mask, and ``trust``, the confidence."""
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
            following[..., *here].addcmul_(weight, found[..., *there])
            following[..., *there].addcmul_(weight, found[..., *here])
        found = following * inverse
    return found


@dataclass(frozen=True, eq=False)
class LinearMasks:
    """Masks that are a linear function of colour in every window of a picture; windows overlap.

    In flat windows the functions are steep, so that float32 would not be exact: small rounding errors of the sums over
    a window are divided by the variance of its colours.

    Attributes:
        image: the image minus 0.5, (B, C, H, W).
        share: 1 divided by the number of pixels of the window around each pixel, (1, 1, H, W).
        mean: mean colour of that window, (B, C, H, W).
        inverse: inverse covariance of the colours in it, (B, C, C, H, W).
    """

    image: Tensor
    share: Tensor
    mean: Tensor
    inverse: Tensor

    @staticmethod
    def of(image: Tensor) -> "LinearMasks":
        """The model of an image (B, C, H, W), in float64."""
        image = image.double() - 0.5
        count = image.shape[1]
        share = 1 / window_sums(torch.ones_like(image[:1, :1]))
        mean = share * window_sums(image)
        products = (image.unsqueeze(1) * image.unsqueeze(2)).flatten(1, 2)
        product = (share * window_sums(products)).unflatten(1, (count, count))
        covariance = (product - mean.unsqueeze(1) * mean.unsqueeze(2)).permute(0, 3, 4, 1, 2)
        inverse = torch.linalg.inv(covariance + NOISE * torch.eye(count).to(covariance))
        return LinearMasks(image, share, mean, inverse.permute(0, 3, 4, 1, 2).contiguous())

    def to(self, like: Tensor) -> "LinearMasks":
        """The model in the dtype of a tensor."""
        return LinearMasks(self.image.to(like), self.share.to(like), self.mean.to(like), self.inverse.to(like))

    def fit(self, mask: Tensor) -> Tensor:
        """Fit the linear functions (B, C+1, H, W) of a mask (B, 1, H, W), averaged over all windows around a pixel.

        The last channel is the constant; the others multiply the colour minus 0.5.
        """
        mean, product = (self.share * window_sums(torch.cat([mask, mask * self.image], dim=1))).tensor_split([1], dim=1)
        covariance = torch.addcmul(product, mean, self.mean, value=-1)
        slopes = dot(self.inverse, covariance.unsqueeze(1), dim=2).squeeze(2)
        return self.share * window_sums(torch.cat([slopes, mean - dot(slopes, self.mean)], dim=1))

    def smoothed(self, mask: Tensor) -> Tensor:
        """The mask that the fitted functions give."""
        return linear_mask(self.image, self.fit(mask))


def linear_mask(image: Tensor, functions: Tensor) -> Tensor:
    """Mask (B, 1, H, W) that functions of :meth:`LinearMasks.fit` give for an image minus 0.5."""
    return dot(functions[:, :-1], image) + functions[:, -1:]


def window_sums(planes: Tensor) -> Tensor:
    """Sums over the window around each pixel, cut off at the borders of the picture."""
    for axis in (2, 3):
        total, length = planes.clone(), planes.shape[axis]
        for shift in range(1, min(WINDOW_RADIUS + 1, length)):  # F.avg_pool2d takes several times as long
            total.narrow(axis, shift, length - shift).add_(planes.narrow(axis, 0, length - shift))
            total.narrow(axis, 0, length - shift).add_(planes.narrow(axis, shift, length - shift))
        planes = total
    return planes


def linear_models(image: Tensor) -> list[LinearMasks]:
    """Models of an image (B, C, H, W) on the levels of the second solve, finest first."""
    levels = min(LINEAR_LEVELS - 1, pyramid_levels(min(image.shape[-2:])))
    return [LinearMasks.of(colours) for colours in halved(image, levels)]


def solve_linear(models: list[LinearMasks], start: Tensor, rough: Tensor, front: Tensor, back: Tensor) -> Tensor:
    """Solve the second problem for the functions (B, K, C+1, H, W) of :meth:`LinearMasks.fit`.

    Args:
        models: :func:`linear_models` of the image.
        start: initial masks, (B, K, H, W).
        rough: rough masks, (B, K, H, W); values near 0 or 1 have a higher confidence.
        front: weights of foreground scribbles, (B, K, H, W).
        back: weights of background scribbles, (B, K, H, W).
    """
    trust = LINEAR_ROUGH_CONFIDENCE * ((2 * rough - 1).square() + 0.01)
    certain = LINEAR_SCRIBBLE_CONFIDENCE * (front + back)
    planes = torch.cat([trust * rough + LINEAR_SCRIBBLE_CONFIDENCE * front, trust + certain, start], dim=1)
    found: Tensor | None = None
    levels = zip(models, halved(planes, len(models) - 1), strict=True)
    for level, (model, some) in reversed(list(enumerate(levels))):
        target, trust, first = some.chunk(3, dim=1)
        found = first if found is None else doubled(found, some)
        masks = [
            damped(model, a, 4**level * t, 4**level * c)
            for a, t, c in zip(found.split(1, 1), target.split(1, 1), trust.split(1, 1), strict=True)
        ]
        found = torch.cat(masks, dim=1)
    assert found is not None  # for mypy
    functions = torch.stack([models[0].fit(mask.clamp(0.0, 1.0).double()) for mask in found.split(1, 1)], dim=1)
    slopes, rest = functions.tensor_split([-1], dim=2)
    return (torch.cat([slopes, rest - END_MARGIN], dim=2) / (1 - 2 * END_MARGIN)).to(found)


def damped(model: LinearMasks, mask: Tensor, target: Tensor, trust: Tensor) -> Tensor:
    """Chebyshev steps from a mask (B, 1, H, W) towards ``(1 + c) a = S a + c t``, S being :meth:`LinearMasks.smoothed`.

    The eigenvalues of the preconditioned system lie in [0, 1]; error components with an eigenvalue below
    :data:`SLOWEST` are left to coarser levels. Only the first residual is computed in float64: the others follow from
    it by steps that get smaller, and so do their rounding errors.

    Args:
        model: the linear model of the picture.
        mask: initial mask.
        target: c t, confidence times rough mask.
        trust: c, the confidence.
    """
    middle, half = (1 + SLOWEST) / 2, (1 - SLOWEST) / 2
    residual = ((model.smoothed(mask.double()) + target) / (1 + trust) - mask).to(mask)
    model, damping = model.to(mask), 1 / (1 + trust)
    ratio, step = half / middle, residual / middle
    mask = mask + step
    for _ in range(LINEAR_STEPS - 1):
        residual = residual + damping * model.smoothed(step) - step
        following = 1 / (2 * middle / half - ratio)
        step = following * ratio * step + 2 * following / half * residual
        ratio, mask = following, mask + step
    return mask


@dataclass(frozen=True, eq=False)
class Sides:
    """Comparison of pixels with the mean colours of nearby pixels inside and outside a mask.

    Attributes:
        mixture: linear function (B, C+1, H, W), see :func:`linear_mask`, from the colour of a pixel to the fraction of
            the colour inside in it, if it is a mixture of both.
        trust: confidence in that fraction, (B, 1, H, W) in [0, 1]; low where the two colours are similar, or nearly all
            nearby pixels are on one side.
        across: colour inside minus colour outside, (B, C, H, W), towards 0 where nearly all are on one side.
    """

    mixture: Tensor
    trust: Tensor
    across: Tensor

    @staticmethod
    def of(planes: Tensor) -> "Sides":
        """Separate :attr:`planes`."""
        count = (planes.shape[1] - 2) // 2
        return Sides(*planes.split([count + 1, 1, count], dim=1))

    @property
    def planes(self) -> Tensor:
        """All attributes, one below the other, (B, 2C+2, H, W)."""
        return torch.cat([self.mixture, self.trust, self.across], dim=1)

    def refine(self, image: Tensor, mask: Tensor) -> Tensor:
        """Replace border values of a mask (B, 1, H, W) by the mixing ratio of the two colours in each pixel.

        Meant for plain colours on both sides; in textures it would produce patterns.
        """
        decided = (2 * mask - 1).square().square().square()  # 0 and 1 are certain
        return torch.lerp(mask, linear_mask(image, self.mixture).clamp(0.0, 1.0), self.trust * (1 - decided))


def colours_beside(image: Tensor, mask: Tensor) -> Sides:
    """Compare an image (B, C, H, W) with the colours on both sides of the borders of a mask (B, 1, H, W)."""
    (height, width), step = image.shape[-2:], 1 << pyramid_levels(min(image.shape[-2:]))
    weights = torch.cat([mask, 1 - mask], dim=1).square().square() + MIN_SIDE_WEIGHT  # (B, 2, H, W)
    planes = torch.cat([weights, image * weights[:, :1], image * weights[:, 1:]], dim=1)
    planes = F.pad(planes, (0, -width % step, 0, -height % step), "replicate")
    coarse = F.avg_pool2d(planes, step)
    size = 2 * SIDE_RADIUS + 1
    # Separable box sums; pixels outside the picture do not count.
    sums = F.avg_pool2d(coarse, (size, 1), 1, (SIDE_RADIUS, 0))
    sums = F.avg_pool2d(sums, (1, size), 1, (0, SIDE_RADIUS))
    inside, outside = (sums[:, 2:].unflatten(1, (2, -1)) / sums[:, :2].unsqueeze(2)).unbind(1)  # (B, C, h, w)
    least = sums[:, :2].amin(1, keepdim=True)
    found = torch.cat([outside, inside - outside, least / (least + HALF_TRUST_SHARE)], dim=1)
    if step > 1:
        found = F.interpolate(found, scale_factor=step, mode="bilinear", align_corners=False)
    channels = image.shape[1]
    outside, across, known = found[..., :height, :width].split([channels, channels, 1], dim=1)
    contrast = dot(across, across) / channels
    slopes = across / (channels * (contrast + MIN_SIDE_WEIGHT * HALF_TRUST_CONTRAST))
    mixture = torch.cat([slopes, -dot(outside, slopes)], dim=1)
    return Sides(mixture, known * contrast / (contrast + HALF_TRUST_CONTRAST**2), known * across)


def refine_mask(image: Tensor, mask: Tensor) -> Tensor:
    """Refine a mask (B, 1, H, W) by the colours beside its borders, which are computed anew in each round."""
    for _ in range(REFINEMENT_ROUNDS):
        mask = colours_beside(image, mask).refine(image, mask)
    return mask
