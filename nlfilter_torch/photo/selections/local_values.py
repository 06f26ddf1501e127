"""Propagation of values from scribbles to neighbouring pixels, up to changes of luminance.

The values solve a linear system over the eight neighbours of each pixel. Two kinds of weights relate neighbours:

- :data:`ABSOLUTE` weights fall with the difference in luminance;
- :data:`RELATIVE` ones compare the difference with the variance around the pixel, as in Levin, Lischinski and Weiss,
  "Colorization using Optimization" (2004). Pixels at an edge depend on both sides, but those beside it hardly on them.

The influence of scribbles falls to zero behind edges and, with absolute weights, far from them. The system is solved on
the picture reduced to a limited number of pixels, so that its cost does not grow with the size. The values of a pixel
are then a mean over the four nearest blocks, weighted by similarity of luminance. They depend only on the pixel's own
luminance and position, so that tiles are exact.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.kernels.stencil import solve_stencil
from nlfilter_torch.photo.picture.scribbled_pixels import parts_in_blocks, sums_in_blocks
from nlfilter_torch.photo.selections.connected import StrokeGroups

SAME_LUMINANCE = 0.007  # difference in luminance at which an absolute weight falls to a quarter
SHARE_OF_VARIANCE, MIN_VARIANCE = 0.6, 2e-6  # squared differences at which a relative weight falls to 1/e
MIN_RELATIVE = 1e-6  # relative weight of the least similar neighbour
SAME_BLOCK, MIN_WEIGHT = 0.042, 1e-5  # difference from a block at which its weight falls to 1/e, and least weight
SCRIBBLE_WEIGHT = 1e3  # weight of the value of a scribbled pixel
MIN_INFLUENCE = 1e-8


@dataclass(frozen=True)
class Links:
    """A way to weigh the links between neighbouring pixels.

    Attributes:
        weights: function that returns the weights (B, 9, h, w) of the links of a pixel. Its arguments are the
            differences in luminance of the neighbours from the pixel, and whether they are in the picture, both
            (B, 9, h, w); the pixel itself, in the middle, counts as not in the picture. The weights sum to 8 in flat
            areas.
        pixels: number of pixels to which the picture is reduced.
        decay_distance: distance at which the influence of scribbles falls to 1/e in flat areas, relative to the square
            root of the area.
    """

    weights: Callable[[Tensor, Tensor], Tensor]
    pixels: int
    decay_distance: float

    def step(self, size: tuple[int, int]) -> int:
        """Side in pixels of the blocks of a picture (H, W)."""
        return max(1, round(math.sqrt(size[0] * size[1] / self.pixels)))


def _absolute(difference: Tensor, inside: Tensor) -> Tensor:
    return inside * (1 + difference.square() / SAME_LUMINANCE**2) ** -2


def _relative(difference: Tensor, inside: Tensor) -> Tensor:
    squared, count = difference.square(), inside.sum(1, keepdim=True)
    mean = difference.sum(1, keepdim=True) / (count + 1)
    variance = squared.sum(1, keepdim=True) / (count + 1) - mean.square()
    nearest = torch.where(inside > 0, squared, torch.inf).amin(1, keepdim=True)
    distance = (squared - torch.where(count > 0, nearest, 0.0)) / (SHARE_OF_VARIANCE * variance).clamp(MIN_VARIANCE)
    alike = inside * (torch.exp(-distance.clamp(0.0, 80.0)) + MIN_RELATIVE)
    return 8 * alike / alike.sum(1, keepdim=True).clamp(min=MIN_RELATIVE)


# With RELATIVE weights the influence hardly decays: scribbles far away then count as they do for Levin et al.
ABSOLUTE, RELATIVE = Links(_absolute, 1 << 13, 1.0), Links(_relative, 1 << 17, 20.0)


@dataclass(frozen=True, eq=False)
class LocalValues:
    """Values of any pixel, by interpolation of a solution on blocks.

    Attributes:
        links: between neighbours.
        values: solutions for the scribbles' values and for ones, (B, C+1, h, w). The solution for ones, in [0, 1], is
            the degree to which the scribbles determine a block; the ratio of both is a weighted mean of the scribbles'
            values.
        guide: luminance of the blocks, (B, 1, h, w).
        size: (H, W) of the picture.
        left_out: at each scribbled pixel, the solutions of its block if the values and ones of its own group of strokes
            are replaced by 0, (B, P+1, n) in float64; None if no strokes were compared. The ratio of both is the
            prediction from the other strokes.
    """

    links: Links
    values: Tensor
    guide: Tensor
    size: tuple[int, int]
    left_out: Tensor | None = None

    @staticmethod
    def of(
        links: Links,
        guide: Tensor,
        size: tuple[int, int],
        places: Tensor,
        weights: Tensor,
        values: Tensor,
        groups: StrokeGroups | None = None,
        predicted: Tensor | None = None,
    ) -> "LocalValues":
        """Solve for scribbled pixels with row-major indices (n,), weights (B, 1, n) and values (B, C, n).

        ``guide`` holds the means over blocks of ``links.step(size)`` pixels of a picture of that size (H, W). With
        ``groups``, the ``predicted`` values (B, P, n) are also extended from the other groups of strokes.
        """
        rows, columns = shape = (guide.shape[2], guide.shape[3])
        area = size[0] * size[1] / (rows * columns)
        sets = [torch.cat([values * weights, weights], dim=1)]
        if groups is not None and predicted is not None:
            sets += groups.without_each(torch.cat([predicted * weights, weights], dim=1))
        sums = sums_in_blocks(torch.cat(sets, dim=1), places, size, shape).double()
        sums, count = sums * (SCRIBBLE_WEIGHT / area), values.shape[1]
        # In flat areas the system is a u = 3 u'', as there are three neighbours on each side.
        anchor = sums[:, count : count + 1] + 3 / (links.decay_distance**2 * rows * columns)
        around, inside = (F.unfold(planes, 3, padding=1) for planes in (guide, torch.ones_like(guide[:1])))
        inside[:, 4] = 0.0  # the pixel itself
        alike = links.weights((around - guide.flatten(2)) * inside, inside).double().unflatten(2, (rows, columns))
        own = alike.sum(1, keepdim=True) + anchor
        stencil = torch.cat([-alike[:, :4], own, -alike[:, 5:]], dim=1).unflatten(1, (3, 3))
        solution, *others = solve_stencil(stencil, sums).split([known.shape[1] for known in sets], dim=1)
        left_out = None
        if groups is not None and others:
            parts = parts_in_blocks(places, size, shape)
            at = [sum(other.flatten(2)[:, :, block] * part for block, part in parts) for other in others]
            left_out = groups.of_own([torch.as_tensor(values) for values in at])
        return LocalValues(links, solution.to(guide), guide, size, left_out)

    def __call__(self, own: Tensor, first: int) -> Tensor:
        """Return mean values of scribbles, and their influence in [0, 1], for a rectangle: (B, C+1, h, w).

        The influence is the square root of the interpolated solution for ones. ``own`` is the luminance of the pixels,
        (B, 1, h, w), and ``first`` the row-major index of the first of them.
        """
        values = self._at(own, *divmod(first, self.size[1]))
        influence = values[:, -1:].clamp(min=MIN_INFLUENCE)
        return torch.cat([values[:, :-1] / influence, influence.sqrt()], dim=1)

    def _at(self, own: Tensor, top: int, left: int) -> Tensor:
        """Interpolate the solutions (B, C+1, h, w) in a rectangle."""
        height, width = own.shape[2:]
        if self.size == self.guide.shape[2:]:
            return self.values[:, :, top : top + height, left : left + width]
        rows, columns = self._two_nearest(0, top, height, own), self._two_nearest(1, left, width, own)
        total, weight = self.values.new_zeros(()), self.values.new_zeros(())
        first, last = int(rows[0][0][0]), int(rows[1][0][-1])  # of the rows of blocks that are used
        blocks = torch.cat([self.guide, self.values], dim=1)[:, :, first : last + 1]
        for column, column_share in columns:
            near = blocks[..., column]  # rows of which are then copied whole
            for row, row_share in rows:
                guide, values = near[:, :, row - first].tensor_split([1], dim=1)
                alike = torch.exp((own - guide).square() / -(SAME_BLOCK**2)) + MIN_WEIGHT
                share = row_share.unsqueeze(1) * column_share * alike
                total, weight = torch.addcmul(total, share, values), weight + share
        return total / weight

    def _two_nearest(self, axis: int, first: int, count: int, like: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Indices (count,) of the blocks before and after pixels along an axis, with linear weights (count,)."""
        blocks, length = self.guide.shape[2 + axis], self.size[axis]
        places = torch.arange(first, first + count, dtype=torch.float64, device=like.device)
        position = (places + 0.5) * blocks / length - 0.5
        before = position.floor()
        share = (position - before).to(like)
        number = before.long()
        return [(number.clamp(0, blocks - 1), 1 - share), ((number + 1).clamp(0, blocks - 1), share)]
