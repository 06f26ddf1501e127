"""Alignment of rough masks with the borders of a picture, by two solves on a pyramid.

The random walker (Grady, 2006), with the rough mask as prior, gives a soft mask that changes along borders. It
minimises ``sum_ij w_ij (a_i - a_j)^2 + sum_i c_i (a_i - t_i)^2`` over pixels and their eight neighbours, with weights w
that decrease with the difference in colour, a rough mask t and confidences c in it. A few Jacobi steps on each level
solve it approximately.

Closed-form matting (Levin, Lischinski and Weiss, 2008) starts from there. In every small window the mask is a linear
function of the colour, which models hair and soft borders. These functions also give the mask of any pixel of a larger
picture (:class:`LinearMasks`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.workers import in_order, single_threaded, threads_for
from nlfilter_torch.photo.picture.colour import dot
from nlfilter_torch.photo.picture.resizing import block_means
from nlfilter_torch.photo.selections.scribbled_colours import REFERENCE, by_trimap

COARSEST = 48  # minimum short side of the coarsest level, in pixels
MOST_HALVINGS = 4  # maximum number of reduced levels


def pyramid_levels(short: int) -> int:
    """Number of times a picture with that short side is halved."""
    return max(0, min(MOST_HALVINGS, int(math.log2(max(short / COARSEST, 1)))))


def halved(planes: Tensor, levels: int) -> list[Tensor]:
    """A pyramid of planes (B, C, H, W), each level half the size, rounded up."""
    pyramid = [planes]
    for _ in range(levels):
        pyramid.append(block_means(pyramid[-1], 2))
    return pyramid


def doubled(planes: Tensor, like: Tensor) -> Tensor:
    """Planes of one level, enlarged to the next finer level, which has the size of ``like``."""
    return F.interpolate(planes, like.shape[-2:], mode="bilinear", align_corners=False)


OFFSETS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (row, column) offsets to half of the neighbours, so each pair occurs once

Slices = tuple[slice, slice]


def _sides(offset: tuple[int, int]) -> tuple[Slices, Slices]:
    """Slices of the pixels that have a neighbour at ``offset``, and of these neighbours."""
    down, right = offset
    here = (slice(None, -down or None), slice(1, None) if right < 0 else slice(None, -right or None))
    there = (slice(down, None), slice(None, -1) if right < 0 else slice(right, None))
    return here, there


NEIGHBOURS = tuple(_sides(offset) for offset in OFFSETS)
#: Padding (left, right, top, bottom) from the pixels with such a neighbour to all pixels.
PADDING = tuple((max(-right, 0), max(right, 0), 0, down) for down, right in OFFSETS)


def neighbour_weights(guide: Tensor, weight: Callable[[Tensor], Tensor]) -> Tensor:
    """Weights (B, 4, H, W) of each pixel of a guide with its neighbours at :data:`OFFSETS`, 0 where there is none.

    ``weight`` is a function of squared distances (B, h, w), summed over the channels.
    """
    weights = []
    for (here, there), padding in zip(NEIGHBOURS, PADDING, strict=True):
        distance = (guide[..., *here] - guide[..., *there]).square().sum(1)
        weights.append(F.pad(weight(distance), padding))
    return torch.stack(weights, dim=1)


JACOBI_STEPS = (2, 4, 8)  # Jacobi steps per level, finest first; the last number is for all coarser levels
STEEPNESS = 300.0  # decay of the weights with the mean squared difference of the channels
MIN_WEIGHT = 1e-4


def solve_mask(image: Tensor, rough: Tensor, confidence: Tensor) -> Tensor:
    """Solve for soft masks (B, K, H, W).

    Args:
        image: (B, C, H, W), C = 1 or 3.
        rough: t, (B, K, H, W).
        confidence: c, (B, K, H, W), for a short side of at most that of :data:`REFERENCE`; rescaled for others.
    """
    height, width = image.shape[-2:]
    short = min(height, width)
    levels = pyramid_levels(short)
    planes = torch.cat([image, confidence * rough, confidence], dim=1)
    scale = min(1.0, min(REFERENCE) / short) ** 2
    count, channels = rough.shape[1], image.shape[1]
    coarser: Tensor | None = None
    for level, planes_of_level in reversed(list(enumerate(halved(planes, levels)))):
        colours, target, trust = planes_of_level.split([channels, count, count], dim=1)
        area = scale * 4**level
        target, trust = area * target, area * trust
        mask = target / trust if coarser is None else doubled(coarser, planes_of_level)
        weights = neighbour_weights(colours, partial(_weight, steepness=STEEPNESS / channels))
        steps = JACOBI_STEPS[-1 if level == levels else min(level, len(JACOBI_STEPS) - 1)]
        coarser = jacobi(mask, target, trust, weights, steps)
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
    links = [weights[:, k : k + 1, *here] for k, (here, _) in enumerate(NEIGHBOURS)]
    for (here, there), weight in zip(NEIGHBOURS, links, strict=True):
        total[..., *here] += weight
        total[..., *there] += weight
    inverse = 1 / total
    for _ in range(steps):
        # Not in place: the gradient needs every iterate.
        following = target.clone()
        for (here, there), weight in zip(NEIGHBOURS, links, strict=True):
            following[..., *here].addcmul_(weight, mask[..., *there])
            following[..., *there].addcmul_(weight, mask[..., *here])
        mask = following * inverse
    return mask


WINDOW_RADIUS, NOISE = 2, 1e-6  # radius of the windows in which masks are linear in colour; variance of noise
LINEAR_LEVELS, LINEAR_STEPS = 2, 24  # levels of the pyramid, steps on each
# Mask values closer than this to 0 or 1 are set to 0 or 1: of a few scribbles, and of a trimap.
CERTAIN_MARGIN = (0.1, 0.05)
FEWEST_WORKERS = 3  # that solve for one mask each; each takes more than 1.5 times as long as the calling thread alone
SLOWEST = 0.005  # smallest eigenvalue that the steps damp
# Confidence in a rough mask of 0 or 1, and in scribbles.
LINEAR_ROUGH_CONFIDENCE, LINEAR_SCRIBBLE_CONFIDENCE = 3e-3, 10.0


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
    """Sums over the window around each pixel, cut off at the borders of the picture.

    ``F.avg_pool2d`` takes several times as long.
    """
    return _sums_along(_sums_along(F.pad(planes, [WINDOW_RADIUS] * 4), 2), 3)


def _sums_along(planes: Tensor, dim: int) -> Tensor:
    """Sums over windows of 2r+1 pixels along an axis, of padded planes: as r pairs and one pixel."""
    count = planes.shape[dim]
    length = count - 2 * WINDOW_RADIUS
    last = planes.narrow(dim, 2 * WINDOW_RADIUS, length)
    pairs = planes.narrow(dim, 0, count - 1) + planes.narrow(dim, 1, count - 1)
    total = pairs.narrow(dim, 0, length)
    for pair in range(1, WINDOW_RADIUS):
        total = total + pairs.narrow(dim, 2 * pair, length)
    return total.add_(last)


def linear_models(image: Tensor) -> list[LinearMasks]:
    """Models of an image (B, C, H, W) on the levels of the pyramid, finest first."""
    levels = min(LINEAR_LEVELS - 1, pyramid_levels(min(image.shape[-2:])))
    return [LinearMasks.of(colours) for colours in halved(image, levels)]


def solve_linear(
    models: list[LinearMasks], start: Tensor, rough: Tensor, front: Tensor, back: Tensor, trimap: Tensor
) -> Tensor:
    """Solve for the functions (B, K, C+1, H, W) of :meth:`LinearMasks.fit`.

    Args:
        models: :func:`linear_models` of the image.
        start: initial masks, (B, K, H, W).
        rough: rough masks, (B, K, H, W); values near 0 or 1 have a higher confidence.
        front: weights of foreground scribbles, (B, K, H, W).
        back: weights of background scribbles, (B, K, H, W).
        trimap: how nearly the scribbles are a trimap, (B, K) in [0, 1].
    """
    trust = LINEAR_ROUGH_CONFIDENCE * ((2 * rough - 1).square() + 0.01)
    certain = LINEAR_SCRIBBLE_CONFIDENCE * (front + back)
    planes = torch.cat([trust * rough + LINEAR_SCRIBBLE_CONFIDENCE * front, trust + certain, start], dim=1)
    threads = threads_for(planes, models[0].image)
    masks = [(image, region) for image in range(len(rough)) for region in range(rough.shape[1])]
    workers = min(threads, len(masks))
    if workers < FEWEST_WORKERS:
        with single_threaded(threads):  # so few pixels that a second thread would wait most of the time
            return _solve_levels(models, planes, trimap).to(start)
    solve = partial(_solve_mask, models, planes, trimap)
    functions = list(in_order(solve, masks, workers, divided=False))
    return torch.cat(functions).unflatten(0, rough.shape[:2]).squeeze(2).to(start)


def _solve_mask(models: list[LinearMasks], planes: Tensor, trimap: Tensor, mask: tuple[int, int]) -> Tensor:
    """:func:`_solve_levels` of one mask, given by the numbers of image and region: (1, 1, C+1, H, W)."""
    image, region = (slice(number, number + 1) for number in mask)
    own = [replace(m, image=m.image[image], mean=m.mean[image], inverse=m.inverse[image]) for m in models]
    return _solve_levels(own, planes[image, mask[1] :: trimap.shape[1]], trimap[image, region])


def _solve_levels(models: list[LinearMasks], planes: Tensor, trimap: Tensor) -> Tensor:
    """:func:`solve_linear`, of the planes (B, 3 K, H, W) of the target, the confidence and the initial masks."""
    coarser: Tensor | None = None
    levels = zip(models, halved(planes, len(models) - 1), strict=True)
    for level, (model, planes_of_level) in reversed(list(enumerate(levels))):
        target, trust, first = planes_of_level.chunk(3, dim=1)
        masks = first if coarser is None else doubled(coarser, planes_of_level)
        solved = [
            chebyshev_steps(model, a, 4**level * t, 4**level * c)
            for a, t, c in zip(masks.split(1, 1), target.split(1, 1), trust.split(1, 1), strict=True)
        ]
        coarser = torch.cat(solved, dim=1)
    assert coarser is not None  # for mypy
    functions = torch.stack([models[0].fit(mask.clamp(0.0, 1.0).double()) for mask in coarser.split(1, 1)], dim=1)
    slopes, constant = functions.tensor_split([-1], dim=2)
    margin = by_trimap(CERTAIN_MARGIN, trimap)[:, :, None, None, None]
    return torch.cat([slopes, constant - margin], dim=2) / (1 - 2 * margin)


def chebyshev_steps(model: LinearMasks, mask: Tensor, target: Tensor, trust: Tensor) -> Tensor:
    """Chebyshev steps from a mask (B, 1, H, W) towards ``(1 + c) a = S a + c t``, S being :meth:`LinearMasks.smoothed`.

    The eigenvalues of the preconditioned system lie in [0, 1]; error components with an eigenvalue below
    :data:`SLOWEST` are left to coarser levels. All is computed in float64: in float32, rounding errors in flat windows
    would change masks by up to half a grey level.

    Args:
        model: the linear model of the picture.
        mask: initial mask.
        target: c t, confidence times rough mask.
        trust: c, the confidence.
    """
    middle, half = (1 + SLOWEST) / 2, (1 - SLOWEST) / 2
    mask, target, trust = mask.double(), target.double(), trust.double()
    residual = (model.smoothed(mask) + target) / (1 + trust) - mask
    damping = 1 / (1 + trust)
    ratio, step = half / middle, residual / middle
    mask = mask + step
    for _ in range(LINEAR_STEPS - 1):
        residual = residual + damping * model.smoothed(step) - step
        following = 1 / (2 * middle / half - ratio)
        step = following * ratio * step + 2 * following / half * residual
        ratio, mask = following, mask + step
    return mask
