"""Propagation of values from scribbles to neighbouring pixels, up to changes of luminance.

The values solve a linear system over the eight neighbours of each pixel, as in Levin, Lischinski and Weiss,
"Colorization using Optimization" (2004), with these differences: the system is symmetric; differences in luminance are
not relative to the local variance, which is large at edges; and the influence of scribbles falls to zero far from them
and behind edges.

The system is solved on the picture reduced to about :data:`SOLVED` pixels, so that its cost does not grow with the
size. The values of a pixel are then a mean over the four nearest blocks, weighted by similarity of luminance. They
depend only on the pixel's own luminance and position, so that tiles are exact.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.filtering.neighbours import neighbour_weights, solve_neighbours

SOLVED = 1 << 14  # pixels
SAME = 0.007  # difference in luminance at which the weight of a neighbour falls to a quarter
SAME_BLOCK, MIN_WEIGHT = 0.042, 1e-5  # difference of a pixel from a block, and least weight of a block
SCRIBBLE_WEIGHT = 1e3  # weight of the value of a scribbled pixel
# Distance at which the influence falls to 1/e in flat areas, relative to the square root of the area.
DECAY_DISTANCE = 2.0
TOLERANCE = {torch.float32: 1e-3, torch.float64: 1e-10}


@dataclass(frozen=True, eq=False)
class LocalValues:
    """Values of any pixel, by interpolation of a solution on blocks.

    Attributes:
        values: solutions for the scribbles' values and for ones, (B, C+1, h, w). The solution for ones, in [0, 1], is
            the degree to which the scribbles determine a block; the ratio of both is a weighted mean of the scribbles'
            values.
        guide: luminance of the blocks, (B, 1, h, w).
        step: side of a block in pixels.
        width: W of the picture.
    """

    values: Tensor
    guide: Tensor
    step: int
    width: int

    @staticmethod
    def of(guide: Tensor, step: int, width: int, places: Tensor, weights: Tensor, values: Tensor) -> "LocalValues":
        """Solve for scribbled pixels with row-major indices (n,), weights (B, 1, n) and values (B, C, n)."""
        rows, columns = guide.shape[2:]
        blocks = places // width // step * columns + places % width // step
        weighted = torch.cat([values * weights, weights], dim=1)
        sums = weighted.new_zeros(*weighted.shape[:2], rows * columns).index_add(2, blocks, weighted)
        sums = sums.unflatten(2, (rows, columns)) * (SCRIBBLE_WEIGHT / step**2)
        # In flat areas the system is a u = 3 u'', as there are three neighbours on each side.
        anchor = sums[:, -1:] + 3 / (DECAY_DISTANCE**2 * rows * columns)
        links = neighbour_weights(guide, lambda squared: (1 + squared / SAME**2) ** -2)
        solved = solve_neighbours(links, anchor, sums / anchor, tolerance=TOLERANCE[guide.dtype])
        return LocalValues(solved, guide, step, width)

    def __call__(self, own: Tensor, first: int) -> tuple[Tensor, Tensor]:
        """Return values times influence (B, C, h, w), and influence (B, 1, h, w) in [0, 1], of a rectangle of pixels.

        The influence is the square root of the interpolated solution for ones.

        Args:
            own: luminance of the pixels, (B, 1, h, w).
            first: row-major index of the first pixel.
        """
        found = self._at(own, *divmod(first, self.width))
        influence = found[:, -1:].clamp(min=1e-6).sqrt()
        return found[:, :-1] / influence, influence

    def _at(self, own: Tensor, top: int, left: int) -> Tensor:
        """Interpolate the solutions (B, C+1, h, w) in a rectangle."""
        height, width = own.shape[2:]
        if self.step == 1:
            return self.values[:, :, top : top + height, left : left + width]
        rows = self._two_nearest(top, height, self.guide.shape[2], own)
        columns = self._two_nearest(left, width, self.guide.shape[3], own)
        total, weight = self.values.new_zeros(()), self.values.new_zeros(())
        first = max(0, top // self.step - 1)  # of the rows of blocks that are used
        blocks = torch.cat([self.guide, self.values], dim=1)[:, :, first : (top + height) // self.step + 2]
        for column, column_share in columns:
            near = blocks[..., column]  # rows of which are then copied whole
            for row, row_share in rows:
                guide, values = near[:, :, row - first].tensor_split([1], dim=1)
                alike = torch.exp((own - guide).square() / -(SAME_BLOCK**2)) + MIN_WEIGHT
                share = row_share.unsqueeze(1) * column_share * alike
                total, weight = torch.addcmul(total, share, values), weight + share
        return total / weight

    def _two_nearest(self, first: int, count: int, blocks: int, like: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Indices (count,) of the blocks before and after pixels along an axis, with linear weights (count,)."""
        position = (torch.arange(first, first + count, device=like.device) + 0.5) / self.step - 0.5
        before = position.floor()
        share = (position - before).to(like)
        number = before.long()
        return [(number.clamp(0, blocks - 1), 1 - share), ((number + 1).clamp(0, blocks - 1), share)]


def block_size(size: tuple[int, int]) -> int:
    """Side in pixels of the blocks of a picture (H, W)."""
    return max(1, round(math.sqrt(size[0] * size[1] / SOLVED)))
