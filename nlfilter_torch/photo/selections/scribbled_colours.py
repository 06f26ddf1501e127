"""Scribbles that cover most of a picture on both sides of a border, and settings of masks that depend on that."""

import math
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import CACHED, order_by, pixel_blocks
from nlfilter_torch.core.precision import per_image
from nlfilter_torch.core.workers import divided_among, threads_for
from nlfilter_torch.operator.features import blur
from nlfilter_torch.photo.picture.colour import hundredths_of_lab
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles

SPARSE, DENSE = 0.3, 0.6  # share of a picture under scribbles up to which they are a few, and from which on a trimap


def trimap_share(painted: Tensor) -> Tensor:
    """How nearly scribbles are a trimap: 0 for a few of them, 1 for most of the picture, (...).

    Args:
        painted: weights (..., 2, n), for all pixels, of the scribbles on a region and on its background. 0 is returned
            where either side has none.
    """
    shares = (painted.detach() > 0).to(painted).mean(-1)
    return ((shares.sum(-1) - SPARSE) / (DENSE - SPARSE)).clamp(0.0, 1.0) * (shares.amin(-1) > 0)


def by_trimap(values: tuple[float, float], trimap: Tensor) -> Tensor:
    """A setting between its values for a few scribbles and for a trimap, by :func:`trimap_share`."""
    few, most = values
    return few + (most - few) * trimap


SOLVED_PIXELS = 1 << 17  # pixels, about, of the reduced picture in which masks are solved and strays are found
REFERENCE = (112, 160)  # size of the reduced pictures for which confidences and weights were chosen
FRAME_POINTS = 64  # approximate number of points along the upper or left border of a picture
NUM_COMPARED = 512  # approximate number of scribbled pixels that the frame is compared with
SIMILAR_SHARE = 0.3  # a pixel that is similar to this share of the scribbled ones counts as similar to them
EVEN_SIGMA = 2.0  # pixels; standard deviation of the surroundings whose evenness is judged
HALF_EVEN_DEVIATION = 0.007  # standard deviation of colours, in hundredths of Lab, that counts as half even
UNLINKED, LINKED = 0.25, 0.5  # least evenness along a path up to which it links nothing, and from which on it does
# Step of the search for paths in pixels; EVEN_SIGMA makes borders wider than that. It is larger along an axis of more
# steps than MOST_LINKED, in long, narrow pictures.
LINK_STEP, MOST_LINKED = 3, 1000
INNER_ROWS, MOST_INNER = 16, 64  # points inside the picture that are compared, along its short side, and at most
LEAST_GAUSSIAN = -30.0  # of Gaussians: smaller ones give denormal numbers, which are slow
EPSILON = 1e-6  # least sum of weights that is divided by; rounding errors of float32 sums of them are smaller


def frame_places(size: tuple[int, int]) -> Tensor:
    """Indices (n,), ascending, of pixels spaced along the borders of a picture, one pixel inside where possible."""
    height, width = size
    spacing = max(1, (height + width) // FRAME_POINTS)
    top, left = min(1, height - 1), min(1, width - 1)
    rows, columns = (_spaced(first, length, spacing) for first, length in ((top, height), (left, width)))
    lines = [(top + 0 * columns, columns), (height - 1 - top + 0 * columns, columns)]
    lines += [(rows, left + 0 * rows), (rows, width - 1 - left + 0 * rows)]
    return torch.cat([down * width + along for down, along in lines]).unique()


def _spaced(first: int, length: int, spacing: int) -> Tensor:
    """Places (n,) along an axis, from ``first`` to that from its end, symmetric about the middle."""
    distance = max(0, length - 1 - 2 * first)
    steps = max(1, round(distance / spacing))
    half = first + torch.arange(steps // 2 + 1) * distance // steps
    return torch.cat([half, length - 1 - half]).unique()


def inner_places(size: tuple[int, int]) -> Tensor:
    """Indices (n,), ascending, of pixels on a regular grid, symmetric about the middle."""
    step = max(1, min(size) // INNER_ROWS, math.ceil(max(size) / MOST_INNER))
    axes = []
    for length in size:
        count = len(range(min(step, length) // 2, length, step))
        half = (2 * torch.arange((count + 1) // 2) + 1) * length // (2 * count)
        axes.append(torch.cat([half, length - 1 - half]).unique())
    return (axes[0].unsqueeze(1) * size[1] + axes[1]).flatten()


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
    counts = (math.ceil(height / steps[0]), math.ceil(width / steps[1]))
    passable = -F.adaptive_max_pool2d(-even, counts)
    start = passable * F.adaptive_max_pool2d((scribbles > 0).to(even), counts)
    front, back = _widest_paths(passable.expand_as(start), start).split(1, dim=1)
    linked = ((front - back - UNLINKED) / (LINKED - UNLINKED)).clamp(0.0, 1.0)
    return _repeated(_repeated(linked, 2, height), 3, width)


def _repeated(blocks: Tensor, axis: int, length: int) -> Tensor:
    """Blocks along an axis, repeated for each of so many pixels; one on a border has the mean of both."""
    count = blocks.shape[axis]
    middles = (2 * torch.arange(length, device=blocks.device) + 1) * count
    before, after = (blocks.index_select(axis, ends // (2 * length)) for ends in (middles - 1, middles))
    return (before + after) / 2


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


class Coloured(NamedTuple):
    """Pixels by their colours (B, C, n) and weights (B, K, n)."""

    colours: Tensor
    weights: Tensor


def outwards(scribbles: Scribbles, size: tuple[int, int]) -> Coloured:
    """Colours (B, C, n) and weights (B, K, n) of scribbled pixels of a picture (H, W), from its middle outwards.

    Pixels at the same distance are ordered by brightness, so that the order turns with the picture.
    """
    height, width = size
    rows, columns = scribbles.places // width, scribbles.places % width
    distances = (2 * rows + 1 - height).square() + (2 * columns + 1 - width).square()
    light = scribbles.image.detach().mean(1)
    order = order_by(distances.expand_as(light), light).unsqueeze(1)
    image, weights = scribbles.image, scribbles.weights
    return Coloured(image.gather(2, order.expand_as(image)), weights.gather(2, order.expand_as(weights)))


def every_nth(colours: Tensor, weights: Tensor, number: int | Tensor) -> tuple[Tensor, Tensor]:
    """Choose every n-th pixel of positive weight, about ``number`` in each image, independently of the other images.

    The order of the pixels matters: see :func:`outwards`.

    Args:
        colours: (B, C, n).
        weights: (B, 1, n).
        number: of pixels, or for each image, (B, 1, 1).

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
    part, workers = partial(_density, places, left, weights), threads_for(places, left, weights)
    # A worker computes a whole block, so that each has to fit the cache of one core.
    blocks = list(pixel_blocks(places.shape[2], len(places), places.device, length=CACHED // workers))
    return torch.cat(list(divided_among(min(workers, len(blocks)), part, blocks)), dim=1).mT


def _density(places: Tensor, left: Tensor, weights: Tensor, block: slice) -> Tensor:
    """Sums (B, k, J) at a block of the places, of which ``left`` (B, C+2, m) has the exponents by a product."""
    part = places[:, :, block]
    right = torch.cat([part, part.square().sum(1, keepdim=True), torch.ones_like(part[:, :1])], dim=1)
    exponents = right.mT @ left  # (B, k, m), minus the squared distances
    return exponents.clamp(LEAST_GAUSSIAN, 0.0).exp() @ weights.mT


def colours_in_lab(colours: Tensor) -> Tensor:
    """:func:`hundredths_of_lab` of colours (B, C, n)."""
    return hundredths_of_lab(colours.unsqueeze(2)).squeeze(2)
