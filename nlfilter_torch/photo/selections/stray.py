"""Stray parts of scribbles: what a stroke covers besides the thing it is meant for, and what therefore does not count.

A stroke that leaves a flower at a gap, or a hat at the cheek, covers a second thing by a small part of it. First, ends
of a stroke are stray that differ from all the rest (:mod:`~nlfilter_torch.photo.selections.stroke_ends`). Then colours
of what is left are divided in two by their means, for gaps that a stroke crosses and things that it touches. The
smaller part is stray if it is small, differs strongly from the larger, is cut off from it in colour, and lies in one or
two pieces: parts of a pattern lie in many, and shading changes gradually. Dabs, boxes and rough masks, which are not
drawn along a thing, stay what they are.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_unreadable
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, blocks_at
from nlfilter_torch.photo.selections.scribbled_colours import colours_in_lab
from nlfilter_torch.photo.selections.stroke_ends import stray_runs

CELLS = 1 << 17  # of the picture, about; colours are compared between their means
FEWEST = 12  # cells of a stroke that may have stray parts
LARGEST = 0.3  # share of a stroke that may be stray
MOST = 0.04  # of the picture that a stroke covers; larger areas are rough masks, which count as they are
ELONGATED = 5.0  # least squared border of a stroke, relative to four times its area: three times as long as wide
DISTANCE = 0.18  # distance of the mean colours in hundredths of Lab, from which they differ strongly
APART = 2.0  # distance of the means, in sums of the mean distances of cells from their own mean
COMPACT = 0.75  # share of the smaller part that lies in two pieces
LIGHTNESS = 0.5  # weight of differences in lightness, much of which is shading
STEPS = 8  # of the division in two

Cells = NDArray[np.int64]
Colours = NDArray[np.float64]


def without_strays(scribbles: Scribbles, size: tuple[int, int]) -> Scribbles:
    """Scribbles of a picture (H, W) without the stray parts of each connected stroke, whose weights become 0."""
    stray = strays(scribbles, size)
    if not bool(stray.any()):
        return scribbles
    return scribbles.weighted(scribbles.weights.masked_fill(stray, 0.0))


@torch.no_grad()
def strays(scribbles: Scribbles, size: tuple[int, int]) -> Tensor:
    """Which pixels of scribbles are stray, (B, K, n); without a gradient. None are if values cannot be read."""
    if is_unreadable(scribbles.weights) or is_unreadable(scribbles.image):
        return torch.zeros_like(scribbles.weights, dtype=torch.bool)
    side = max(1.0, (size[0] * size[1] / CELLS) ** 0.5)
    shape = (max(1, round(size[0] / side)), max(1, round(size[1] / side)))
    at = blocks_at(scribbles.places, size, shape).cpu().numpy()
    colours = colours_in_lab(scribbles.image.detach().clamp(0.0, 1.0).expand(-1, 3, -1)).double()
    colours = colours * colours.new_tensor((LIGHTNESS, 1.0, 1.0)).view(1, 3, 1)
    painted = (scribbles.weights.detach() > 0).cpu().numpy()
    stray = np.zeros_like(painted)
    for image, points in enumerate(colours.mT.cpu().numpy()):
        for region, covered in enumerate(painted[image]):
            stray[image, region, covered] = _of_region(points[covered], at[covered], shape)
    return torch.from_numpy(stray).to(scribbles.weights.device)


def _of_region(points: Colours, at: Cells, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which pixels of a region with colours (n, 3), in cells (n,), are stray, (n,)."""
    cells, back, counts = np.unique(at, return_inverse=True, return_counts=True)
    if len(cells) < FEWEST:
        return np.zeros(len(at), dtype=bool)
    means = np.stack([np.bincount(back, channel) for channel in points.T], axis=1) / counts[:, None]
    grid = Grid.of(cells, shape)
    strokes, ignored = grid.pieces(np.ones(len(cells), dtype=bool)), np.zeros(len(cells), dtype=bool)
    parts, middles = list[tuple[Cells, int]](), list[Colours]()
    for stroke in range(1, strokes.max() + 1):
        own = np.flatnonzero(strokes == stroke)
        kept = own
        if len(own) <= MOST * shape[0] * shape[1] and grid.elongation(own) >= ELONGATED:
            for stray_part in (stray_runs, compact_part):
                part = stray_part(means[kept], grid.rows[kept], grid.columns[kept])
                if part.any() and 2 * (~part).sum() >= len(own):
                    parts.append((kept[part], stroke))
                    kept = kept[~part]
        middles.append(np.median(means[kept], axis=0))
    for places, stroke in parts:  # what another stroke is meant for is not stray
        others = np.array(middles[: stroke - 1] + middles[stroke:]).reshape(-1, 3)
        distances = np.linalg.norm(np.median(means[places], axis=0) - others, axis=1)
        ignored[places] = (distances > DISTANCE / 2).all()
    stray: NDArray[np.bool_] = ignored[back]
    return stray


def compact_part(colours: Colours, rows: Cells, columns: Cells) -> NDArray[np.bool_]:
    """Which cells (m,) of a stroke are the smaller of two parts, if these differ strongly and it lies in few pieces."""
    part = smaller_part(colours)
    if part is None or not Grid(rows - rows.min(), columns - columns.min()).is_compact(np.flatnonzero(part)):
        return np.zeros(len(colours), dtype=bool)
    return part


def smaller_part(colours: Colours) -> NDArray[np.bool_] | None:
    """Which cells of a stroke with colours (m, 3) are the smaller of two parts, if these differ strongly; else None."""
    if len(colours) < FEWEST:
        return None
    middle = np.median(colours, axis=0)
    part = _far(np.linalg.norm(colours - middle, axis=1))
    for _ in range(STEPS):
        if not 0 < part.sum() < len(part):
            return None
        ends = np.stack([colours[~part].mean(0), colours[part].mean(0)])
        before, part = part, np.linalg.norm(colours - ends[1], axis=1) < np.linalg.norm(colours - ends[0], axis=1)
        if (before == part).all():
            break
    if part.sum() > len(part) / 2:
        part = ~part
    if not 0 < part.sum() <= LARGEST * len(part):
        return None
    ends = np.stack([colours[~part].mean(0), colours[part].mean(0)])
    spread = sum(
        np.linalg.norm(colours[side] - end, axis=1).mean() for side, end in zip((~part, part), ends, strict=True)
    )
    distance = np.linalg.norm(ends[1] - ends[0])
    return part if distance >= max(DISTANCE, APART * spread) else None


def _far(distances: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The cells beyond the middle between the nearest and the farthest."""
    return distances > (distances.min() + distances.max()) / 2


@dataclass(frozen=True)
class Grid:
    """Cells of a grid, in ascending order, within the rectangle that holds them.

    Attributes:
        rows: of the cells, (m,).
        columns: of the cells, (m,).
    """

    rows: Cells
    columns: Cells

    @staticmethod
    def of(cells: Cells, shape: tuple[int, int]) -> "Grid":
        """The cells with row-major indices (m,) in a grid of so many rows and columns."""
        rows, columns = np.divmod(cells, shape[1])
        return Grid(rows - rows.min(), columns - columns.min())

    def elongation(self, part: Cells) -> float:
        """Squared number of cells on the border of a part, relative to four times its cells: 4 for a square."""
        plane = np.zeros((self.rows.max() + 3, self.columns.max() + 3), dtype=bool)
        plane[self.rows[part] + 1, self.columns[part] + 1] = True
        inner = plane[:-2, 1:-1] & plane[2:, 1:-1] & plane[1:-1, :-2] & plane[1:-1, 2:]
        border = int((plane[1:-1, 1:-1] & ~inner).sum())
        return border**2 / (4 * len(part))

    def is_compact(self, part: Cells) -> bool:
        """Whether cells with these numbers lie in one or two pieces, but for a few of them."""
        chosen = np.zeros(len(self.rows), dtype=bool)
        chosen[part] = True
        sizes = np.sort(np.bincount(self.pieces(chosen)[part]))[::-1]
        return bool(sizes[:2].sum() >= COMPACT * sizes.sum())

    def pieces(self, chosen: NDArray[np.bool_]) -> Cells:
        """Number of the connected piece of chosen cells at each cell, (m,), from 1 on; 0 for others."""
        from skimage.measure import label

        plane = np.zeros((self.rows.max() + 1, self.columns.max() + 1), dtype=bool)
        plane[self.rows[chosen], self.columns[chosen]] = True
        numbers: Cells = label(plane, connectivity=2)[self.rows, self.columns]
        return numbers
