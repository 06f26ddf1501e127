"""How much the pixels of a picture that is read by rows count: in proportion to their opacity."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.operator.landmarks import candidate_pixels, weighted_draws
from nlfilter_torch.operator.options import Sampling
from nlfilter_torch.operator.orientation import EXCHANGED
from nlfilter_torch.photo.declared.rows import Stored

LEAST_WEIGHT = 1e-6  # below which a pixel does not count


@dataclass(frozen=True, eq=False)
class CountedPixels:
    """The opacity of a picture, of which some pixel counts and not all count alike.

    Attributes:
        opacity: as it is stored, (H, W), in the dtype of the file.
        total: sum of the weights.
        count: number of pixels of a weight other than 0.
        even: whether these have the same weight.
        corner: first row and column of the smallest rectangle that holds them.
        box: height and width of the rectangle.
    """

    opacity: Stored
    total: float
    count: int
    even: bool
    corner: tuple[int, int]
    box: tuple[int, int]

    def rows(self, start: int, stop: int) -> Tensor:
        """The weights (1, 1, h, W) of rows, in float32."""
        return torch.from_numpy(_weights(self.opacity[start:stop]))[None, None]

    def at(self, places: Tensor) -> Tensor:
        """The weights (n,) of single pixels, given by row-major indices, in float32."""
        width = self.opacity.shape[1]
        return torch.from_numpy(_weights(self.opacity[(places // width).numpy(), (places % width).numpy()]))

    def in_box(self, rows: slice) -> NDArray[np.bool_]:
        """Which pixels of some rows of the picture count, in the columns of the rectangle."""
        return _weights(self.opacity[rows, self.corner[1] : self.corner[1] + self.box[1]]) > 0

    def whole(self, numbers: Tensor) -> Tensor:
        """Row-major indices in the picture of pixels of the rectangle."""
        rows, columns = numbers // self.box[1] + self.corner[0], numbers % self.box[1] + self.corner[1]
        return rows * self.opacity.shape[1] + columns

    def candidates(self, count: int, sampling: Sampling, generator: torch.Generator, orientation: int) -> Tensor:
        """Numbers, in an orientation of the rectangle, of the pixels that landmarks are made of.

        They are those of the picture in memory, see :mod:`nlfilter_torch.operator.counting`.
        """
        (top, left), (height, width) = self.corner, self.box
        lines = self.opacity[top : top + height, left : left + width]
        lines = lines[::-1] if orientation % 2 else lines
        lines = lines[:, ::-1] if orientation // 2 % 2 else lines
        lines = lines.T if orientation >= EXCHANGED else lines
        if self.even or sampling != "kmeans":
            filled = self.box if self.count == height * width and sampling != "kmeans" else (1, self.count)
            ranks = candidate_pixels(filled, count, sampling, generator).cpu().numpy()
            return _numbers(lines, ranks.astype(np.float64), 1.0, counted=True)
        scale = max(1.0, self.count / self.total)  # a point may represent less than a pixel
        draws = weighted_draws(round(self.total * scale), count, generator).double().cpu().numpy()
        return _numbers(lines, draws, scale, counted=False)


def _numbers(lines: Stored, values: NDArray[np.float64], scale: float, *, counted: bool) -> Tensor:
    """Numbers in lines (n, m) of the pixels at which the sum of weights, times a scale, first exceeds values.

    With ``counted``, pixels of any other weight than 0 have the weight 1.
    """
    sums = np.array([_line(line, scale, counted=counted).sum() for line in lines])
    ends = np.cumsum(sums)
    wanted = np.minimum(np.searchsorted(ends, values, side="right"), len(lines) - 1)
    numbers = np.empty(len(values), np.int64)
    for row in np.unique(wanted):
        chosen = wanted == row
        inside = np.cumsum(_line(lines[row], scale, counted=counted))
        places = np.searchsorted(inside, values[chosen] - (ends[row] - sums[row]), side="right")
        last = int(np.flatnonzero(inside == inside[-1])[0])
        numbers[chosen] = row * lines.shape[1] + np.minimum(places, last)
    return torch.from_numpy(numbers)


def _line(line: Stored, scale: float, *, counted: bool) -> NDArray[np.float64]:
    weights = _weights(line)
    return (weights > 0).astype(np.float64) if counted else scale * weights.astype(np.float64)


def _weights(opacity: Stored) -> NDArray[np.float32]:
    """Weights from stored opacity of any shape."""
    white = np.iinfo(opacity.dtype.name).max if opacity.dtype.kind == "u" else 1
    weights = (opacity.astype(np.float32) / np.float32(white)).clip(0, 1)
    return np.where(weights < LEAST_WEIGHT, np.float32(0), weights)


def counted_pixels(opacity: Stored) -> CountedPixels | None:
    """How much the pixels of a picture (H, W) count; None if all count alike, or none does."""
    rows, columns = np.zeros(opacity.shape[0], np.bool_), np.zeros(opacity.shape[1], np.bool_)
    total, count, least, most = 0.0, 0, np.inf, 0.0
    for row, line in enumerate(opacity):
        weights = _weights(line)
        counts = weights > 0
        rows[row], columns = counts.any(), columns | counts
        total, count = total + float(weights.sum(dtype=np.float64)), count + int(counts.sum())
        if rows[row]:
            least, most = min(least, float(weights[counts].min())), max(most, float(weights.max()))
    if count == 0 or (count == opacity.size and least == 1):
        return None
    down, across = np.flatnonzero(rows), np.flatnonzero(columns)
    corner = int(down[0]), int(across[0])
    box = int(down[-1]) - corner[0] + 1, int(across[-1]) - corner[1] + 1
    return CountedPixels(opacity, total, count, least == most, corner, box)
