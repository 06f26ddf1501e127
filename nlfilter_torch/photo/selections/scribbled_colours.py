"""Comparison of colours with those of scribbled pixels, for masks.

Regressions blur: their features include the surroundings of a pixel. Densities of colours on both sides of a border
separate hair and thin parts, too, where their colours differ.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import pixel_blocks
from nlfilter_torch.core.precision import per_image
from nlfilter_torch.operator.features import blur
from nlfilter_torch.photo.picture.colour import hundredths_of_lab
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles

FRAME_POINTS = 64  # approximate number of points along the upper or left border of a picture
NUM_COMPARED = 512  # approximate number of scribbled pixels that the frame is compared with
SIMILAR_SHARE = 0.1  # a frame point similar to this share of the scribbled pixels does not count as background
NUM_COLOURS = 32  # approximate number of scribbled pixels on each side that the colours of all pixels are compared with
BANDWIDTH_SHARE = 0.4  # bandwidth of that comparison as a share of the photometric bandwidth
EVEN_SIGMA = 2.0  # pixels; standard deviation of the surroundings whose evenness is judged
HALF_EVEN_DEVIATION = 0.007  # standard deviation of colours, in hundredths of Lab, that counts as half even
UNLINKED, LINKED = 0.25, 0.5  # least evenness along a path up to which it links nothing, and from which on it does
# Step of the search for paths in pixels; EVEN_SIGMA makes borders wider than that. It is larger along an axis of more
# steps than MOST_LINKED, in long, narrow pictures.
LINK_STEP, MOST_LINKED = 3, 1000
INNER_ROWS, MOST_INNER = 16, 64  # points inside the picture that are compared, along its short side, and at most
MIN_DENSITY = 1e-4  # colours that are rarer than this on both sides belong to neither
SMALLEST_EXPONENT = -30.0  # of Gaussians: smaller ones give denormal numbers, which are slow
EPSILON = 1e-6


def frame_places(size: tuple[int, int]) -> Tensor:
    """Indices (n,), ascending, of pixels spaced along the borders of a picture, one pixel inside where possible."""
    height, width = size
    spacing = max(1, (height + width) // FRAME_POINTS)
    top, left = min(1, height - 1), min(1, width - 1)
    rows, columns = torch.arange(top, height, spacing), torch.arange(left, width, spacing)
    lines = [(top + 0 * columns, columns), (height - 1 - top + 0 * columns, columns)]
    lines += [(rows, left + 0 * rows), (rows, width - 1 - left + 0 * rows)]
    return torch.cat([down * width + along for down, along in lines]).unique()


def inner_places(size: tuple[int, int]) -> Tensor:
    """Indices (n,), ascending, of pixels on a regular grid."""
    height, width = size
    step = max(1, min(size) // INNER_ROWS, math.ceil(max(size) / MOST_INNER))
    rows, columns = (torch.arange(min(step, length) // 2, length, step) for length in (height, width))
    return (rows.unsqueeze(1) * width + columns).flatten()


@torch.no_grad()
def linked_evenly(even: Tensor, scribbles: Tensor) -> Tensor:
    """Certainty (B, 1, H, W), in [0, 1], that an even area, such as a sky, links a pixel to scribbles on a region.

    It grows with the least evenness along the best path to such a scribble, minus that along the best path to one on
    the background. It has no gradient, and is 0 or 1 nearly everywhere.

    Args:
        even: :func:`evenness`, (B, 1, H, W).
        scribbles: weights of those on the region and on its background, (B, 2, H, W).
    """
    height, width = even.shape[-2:]
    steps = [max(min(LINK_STEP, length), math.ceil(length / MOST_LINKED)) for length in (height, width)]
    passable = -F.max_pool2d(-even, steps, ceil_mode=True)
    start = passable * F.max_pool2d((scribbles > 0).to(even), steps, ceil_mode=True)
    front, back = _widest_paths(passable.expand_as(start), start).split(1, dim=1)
    linked = ((front - back - UNLINKED) / (LINKED - UNLINKED)).clamp(0.0, 1.0)
    return linked.repeat_interleave(steps[0], 2).repeat_interleave(steps[1], 3)[..., :height, :width]


def _widest_paths(passable: Tensor, start: Tensor) -> Tensor:
    """Least value of ``passable`` along the best path from a start to each pixel, (B, C, h, w).

    ``start`` is 0 where no path starts; it is overwritten. Sweeps along rows and columns are repeated as often as the
    paths turn.
    """
    values, before = start, torch.full_like(start, -1.0)
    while not torch.equal(values, before):
        before.copy_(values)
        for axis in (2, 3):
            lines, limits = values.unbind(axis), passable.unbind(axis)
            count = len(lines)
            for direction, order in ((-1, range(1, count)), (1, range(count - 2, -1, -1))):
                for k in order:
                    torch.maximum(lines[k], limits[k].minimum(lines[k + direction]), out=lines[k])
    return values


def likeness(scribbled: Tensor, weights: Tensor, others: Tensor, bandwidth: float | Tensor) -> Tensor:
    """Similarity (B, 1, k), in [0, 1], of other colours (B, C, k) to those of scribbled pixels, (B, C, n).

    Position does not matter: the far end of a sky still counts as the same sky. Pixels whose weight, of (B, 1, n), is 0
    do not count. The bandwidth is that of the regression.
    """
    sample, counted = every_nth(scribbled, (weights.detach() > 0).to(others), NUM_COMPARED)
    scale = per_image(bandwidth, others, 3)
    return (density(colours_in_lab(others), colours_in_lab(sample), counted, scale) / SIMILAR_SHARE).clamp(max=1.0)


def evenness(image: Tensor) -> Tensor:
    """Evenness of the colours around each pixel, (B, 1, H, W) in (0, 1]: 1 if all are equal, near 0 in texture."""
    colours = hundredths_of_lab(image)
    mean, squares = blur(torch.cat([colours, colours.square()], dim=1), EVEN_SIGMA).chunk(2, dim=1)
    variance = (squares - mean.square()).clamp(min=0.0).mean(1, keepdim=True)
    return 1 / (1 + variance / HALF_EVEN_DEVIATION**2)


def colour_likelihood(
    image: Tensor,
    scribbles: Scribbles,
    frame: Tensor,
    unlike: Tensor,
    likely: Tensor,
    inner: Tensor,
    linked: Tensor,
    bandwidth: float | Tensor,
) -> Tensor:
    """Likelihood (B, 1, h, w), in [0, 1], that a pixel belongs to a region, by its own colour alone.

    Where colours separate the sides, it follows hair and borders more closely than the regression, whose features
    include the surroundings of a pixel. 0.5 for colours that neither side has.

    Args:
        image: the reduced picture.
        scribbles: on the region and on its background.
        frame: colours (B, C, n) of the pixels along the borders of the picture.
        unlike: dissimilarity of these pixels to the scribbles on the region, (B, 1, n).
        likely: likelihood of these pixels by the regression, (B, 1, n), times their :func:`evenness`. Where an even
            region, such as a sky, reaches the border of the picture, they show its colours far from its scribbles; in
            textures, the regression is too often wrong for that.
        inner: colours (B, C, m) of :func:`inner_places`.
        linked: :func:`linked_evenly` of these, (B, 1, m).
        bandwidth: photometric bandwidth of the regression.
    """
    places = hundredths_of_lab(image).flatten(2)
    scale = BANDWIDTH_SHARE * per_image(bandwidth, image, 3)
    samples = (every_nth(scribbles.image, weights, NUM_COLOURS) for weights in scribbles.weights.split(1, dim=1))
    inside, outside = (density(places, colours_in_lab(sample), shares, scale) for sample, shares in samples)
    shares = unlike * torch.cat([likely.square(), (1 - likely).square()], dim=1)
    shares = shares / unlike.sum(2, keepdim=True).clamp(min=EPSILON)
    within, around = density(places, colours_in_lab(frame), shares, scale).split(1, dim=1)
    shares = linked / linked.sum(2, keepdim=True).clamp(min=1.0)
    inside = inside + within + density(places, colours_in_lab(inner), shares, scale)
    opposed = (scribbles.weights[:, 1].detach() > 0).any(1).view(-1, 1, 1)
    outside = torch.where(opposed, (outside + around) / 2, around)
    return ((inside + MIN_DENSITY) / (inside + outside + 2 * MIN_DENSITY)).unflatten(2, image.shape[-2:])


def every_nth(colours: Tensor, weights: Tensor, number: int) -> tuple[Tensor, Tensor]:
    """Choose every n-th pixel of positive weight, about ``number`` in each image, independently of the other images.

    Args:
        colours: (B, C, n).
        weights: (B, 1, n).
        number: of pixels.

    Returns:
        Colours (B, C, m) of the pixels that are chosen in any image; and their weights (B, 1, m), divided by their sum,
        0 where the pixel is not chosen in this image.
    """
    counted = weights.detach() > 0
    place = counted.cumsum(2) - 1
    counted = counted & (place % (counted.sum(2, keepdim=True) // number).clamp(min=1) == 0)
    chosen = counted.any(0).squeeze(0)
    kept = weights[:, :, chosen] * counted[:, :, chosen]
    return colours[:, :, chosen], kept / kept.sum(2, keepdim=True).clamp(min=EPSILON)


def density(places: Tensor, points: Tensor, weights: Tensor, bandwidth: Tensor) -> Tensor:
    """Sums (B, J, k), at places (B, C, k), of Gaussians around points (B, C, m) with each of J weights (B, J, m).

    The Gaussian is ``exp(-d / bandwidth^2)``, with d the mean square over the channels.
    """
    places, points = (t / (bandwidth * math.sqrt(t.shape[1])) for t in (places, points))
    squares = points.square().sum(1, keepdim=True)
    left = torch.cat([2 * points, -torch.ones_like(squares), -squares], dim=1)  # (B, C+2, m)
    sums = []
    for block in pixel_blocks(places.shape[2], len(places), places.device):
        part = places[:, :, block]
        right = torch.cat([part, part.square().sum(1, keepdim=True), torch.ones_like(part[:, :1])], dim=1)
        exponents = right.mT @ left  # (B, k, m), minus the squared distances
        sums.append(exponents.clamp(SMALLEST_EXPONENT, 0.0).exp() @ weights.mT)
    return torch.cat(sums, dim=1).mT


def colours_in_lab(colours: Tensor) -> Tensor:
    """:func:`hundredths_of_lab` of colours (B, C, n)."""
    return hundredths_of_lab(colours.unsqueeze(2)).squeeze(2)
