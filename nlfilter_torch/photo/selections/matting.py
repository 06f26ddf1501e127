"""Closed-form matting (Levin, Lischinski and Weiss, 2008) on a pyramid: it aligns rough masks with soft borders.

In every small window the mask is a linear function of the colour, which models hair and soft borders. These functions
also give the mask of any pixel of a larger picture (:class:`LinearMasks`).
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.workers import in_order, single_threaded, threads_for
from nlfilter_torch.photo.picture.colour import dot
from nlfilter_torch.photo.picture.resizing import block_means
from nlfilter_torch.photo.selections.scribbled_colours import by_trimap

COARSEST = 48  # minimum short side of the coarsest level, in pixels


def pyramid_levels(short: int) -> int:
    """Number of times a picture with that short side is halved."""
    return int(math.log2(max(short / COARSEST, 1)))


def halved(planes: Tensor, levels: int) -> list[Tensor]:
    """A pyramid of planes (B, C, H, W), each level half the size, rounded up."""
    pyramid = [planes]
    for _ in range(levels):
        pyramid.append(block_means(pyramid[-1], 2))
    return pyramid


def doubled(planes: Tensor, like: Tensor) -> Tensor:
    """Planes of one level, enlarged to the next finer level, which has the size of ``like``."""
    return F.interpolate(planes, like.shape[-2:], mode="bilinear", align_corners=False)


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


def solve_linear(models: list[LinearMasks], rough: Tensor, front: Tensor, back: Tensor, trimap: Tensor) -> Tensor:
    """Solve for the functions (B, K, C+1, H, W) of :meth:`LinearMasks.fit`.

    Args:
        models: :func:`linear_models` of the image.
        rough: rough masks, with which the steps begin, (B, K, H, W); values near 0 or 1 have a higher confidence.
        front: weights of foreground scribbles, (B, K, H, W).
        back: weights of background scribbles, (B, K, H, W).
        trimap: how nearly the scribbles are a trimap, (B, K) in [0, 1].
    """
    trust = LINEAR_ROUGH_CONFIDENCE * ((2 * rough - 1).square() + 0.01)
    certain = LINEAR_SCRIBBLE_CONFIDENCE * (front + back)
    planes = torch.cat([trust * rough + LINEAR_SCRIBBLE_CONFIDENCE * front, trust + certain, rough], dim=1)
    threads = threads_for(planes, models[0].image)
    masks = [(image, region) for image in range(len(rough)) for region in range(rough.shape[1])]
    workers = min(threads, len(masks))
    if workers < FEWEST_WORKERS:
        with single_threaded(threads):  # so few pixels that a second thread would wait most of the time
            return _solve_levels(models, planes, trimap).to(rough)
    solve = partial(_solve_mask, models, planes, trimap)
    functions = list(in_order(solve, masks, workers, divided=False))
    return torch.cat(functions).unflatten(0, rough.shape[:2]).squeeze(2).to(rough)


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
