"""Stray parts of scribbles: what a stroke covers besides the thing it is meant for, and what therefore does not count.

A stroke that leaves a flower at a gap, or a hat at the cheek, covers a second thing by a small part of it.

First, ends of a stroke, and gaps that it crosses, are stray if they differ from all the rest. A stroke is cut into
slices across it. A run of slices is stray if its colours are far from all colours of the rest; patterns and shades that
occur elsewhere in the stroke are not. It begins where colours begin to leave those of the rest, since slices at a
border hold colours of both sides. The farther of both ends is judged first, then gaps, then what is left once more.

Dabs, boxes and rough masks, which are not drawn along a thing, stay what they are.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_unreadable
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, blocks_at
from nlfilter_torch.photo.picture.source import Reduced
from nlfilter_torch.photo.selections.connected import connected_pieces
from nlfilter_torch.photo.selections.scribbled_colours import SOLVED_PIXELS, colours_in_lab

# Chosen with benchmarks.scribbles on the choosing set.
SLICE = 0.4  # length of a slice, relative to the width of the stroke
SLICES = 6, 48  # least and largest number of them
BLUR = 1  # slices on either side of the border of a run that may hold colours of both sides
LARGEST_STRAY = 0.3  # share of a stroke that may be stray
# Distances in hundredths of Lab, from which on colours differ strongly: of an end from the nearest colours of the rest,
# on average, and of a gap, likewise, or of the mean colours of two parts.
END, GAP = 0.12, 0.18
# The same, relative to how much colours vary: mean distance of slices of the rest from the nearest other ones, or the
# sum of the mean distances of cells of both parts from their own mean.
SPREADS = 2.0
BEGINNING = 0.35  # share of a run's distance at which it begins
ROUNDS = 2  # so many runs may be stray

Cells = NDArray[np.int64]
Numbers = NDArray[np.float64]


def stray_runs(colours: Numbers, rows: Cells, columns: Cells) -> NDArray[np.bool_]:
    """Which cells (m,) of a connected stroke with colours (m, 3) belong to its stray ends and gaps."""
    stray = np.zeros(len(rows), dtype=bool)
    for _ in range(ROUNDS):
        rest = np.flatnonzero(~stray)
        run = _stray_run(colours[rest], rows[rest], columns[rest])
        if not run.any() or 2 * (stray.sum() + run.sum()) > len(rows):  # at least half of it counts
            break
        stray[rest[run]] = True
    return stray


def _stray_run(colours: Numbers, rows: Cells, columns: Cells) -> NDArray[np.bool_]:
    """Which cells belong to the end that is farther from the rest, if it is stray, or else to a gap."""
    sides = [Slices.of(distances, colours) for distances in distances_along(rows, columns)]
    ends = [slices.farthest(slices.ends()) for slices in sides]
    farther = int(ends[1].distance > ends[0].distance)
    end = ends[farther]
    if end.is_stray(END):
        return end.holds(sides[farther].numbers)
    gap = sides[0].farthest(sides[0].gaps())
    return gap.holds(sides[0].numbers) & gap.is_stray(GAP)


def distances_along(rows: Cells, columns: Cells) -> tuple[Numbers, Numbers]:
    """Distances (m,) through a stroke of its cells from either end."""
    at = rows - rows.min(), columns - columns.min()
    costs = np.full((at[0].max() + 1, at[1].max() + 1), np.inf)
    costs[at] = 1.0
    end = int(_distances_from(0, costs, at).argmax())
    first = _distances_from(end, costs, at)
    return first, _distances_from(int(first.argmax()), costs, at)


def _distances_from(number: int, costs: Numbers, at: tuple[Cells, Cells]) -> Numbers:
    """Distances (m,) from the cell of that number; 0 for cells that are not connected with it."""
    from skimage.graph import MCP_Geometric

    plane = MCP_Geometric(costs).find_costs([(int(at[0][number]), int(at[1][number]))])[0]
    distances: Numbers = np.where(np.isfinite(plane), plane, 0.0)[at]
    return distances


@dataclass(frozen=True)
class SliceRun:
    """Successive slices of a stroke.

    Attributes:
        first: number of its first slice.
        last: number of the slice after its last one.
        distance: mean distance of its slices from the nearest colours of the rest.
        spread: mean distance of slices of the rest from the nearest other ones.
    """

    first: int
    last: int
    distance: float = 0.0
    spread: float = 0.0

    def is_stray(self, least: float) -> bool:
        """Whether the run is at least that far from the rest, and far enough for how much the rest varies."""
        return self.distance >= max(least, SPREADS * self.spread)

    def holds(self, numbers: Cells) -> NDArray[np.bool_]:
        """Which slices with these numbers belong to the run."""
        return (numbers >= self.first) & (numbers < self.last)


@dataclass(frozen=True)
class Slices:
    """Slices across a stroke, numbered from one of its ends.

    Attributes:
        numbers: of the slice that a cell is in, (m,).
        distances: between mean colours, (n, n).
        shares: of the stroke that lie before a slice, (n + 1,).
    """

    numbers: Cells
    distances: Numbers
    shares: Numbers

    @staticmethod
    def of(along: Numbers, colours: Numbers) -> "Slices":
        """Cut a stroke with colours (m, 3) at equal distances (m,) from an end."""
        length = along.max() + 1.0
        count = int(np.clip(round(length / max(1.0, SLICE * len(along) / length)), *SLICES))
        numbers = np.unique((along / length * count).astype(np.int64), return_inverse=True)[1]
        cells = np.bincount(numbers)
        means = np.stack([np.bincount(numbers, channel) for channel in colours.T], axis=1) / cells[:, None]
        distances = np.linalg.norm(means[:, None] - means[None], axis=2)
        return Slices(numbers, distances, np.concatenate([[0.0], cells.cumsum() / len(along)]))

    def ends(self) -> list[SliceRun]:
        """The runs up to the last slice that are not larger than the largest share."""
        count = len(self.distances)
        runs = [SliceRun(first, count) for first in range(BLUR + 1, count - BLUR)]
        return [run for run in runs if self.share(run) <= LARGEST_STRAY]

    def gaps(self) -> list[SliceRun]:
        """The runs with the same colour on both sides that are not larger than the largest share."""
        count = len(self.distances)
        runs = [
            SliceRun(first, last)
            for first in range(BLUR + 1, count - BLUR)
            for last in range(first + 2 * BLUR + 1, count - BLUR)
            if self.distances[first - BLUR - 1, last + BLUR] <= GAP / 2
        ]
        return [run for run in runs if self.share(run) <= LARGEST_STRAY]

    def share(self, run: SliceRun) -> float:
        """The share of the stroke that a run covers."""
        return float(self.shares[run.last] - self.shares[run.first])

    def farthest(self, runs: list[SliceRun]) -> SliceRun:
        """The run that is farthest from the rest in colour, from where colours begin to leave those of the rest."""
        count = len(self.distances)
        inner = [(run.first + BLUR, run.last - BLUR * (run.last < count)) for run in runs]
        means = [self._nearest(run, *ends).mean() for run, ends in zip(runs, inner, strict=True)]
        if not means:
            return SliceRun(count, count)
        run, distance = runs[int(np.argmax(means))], float(max(means))
        rest = self._rest(run)
        spread = _spread(self.distances[np.ix_(rest, rest)])
        least = max(BEGINNING * distance, spread)
        run = self._widened(run, run.first - BLUR - 1, least, before=1)
        run = self._widened(run, count - BLUR - 1 - run.last, least, after=1)
        return SliceRun(run.first, run.last, distance, spread)

    def _widened(self, run: SliceRun, most: int, least: float, *, before: int = 0, after: int = 0) -> SliceRun:
        """Add up to so many slices before or after a run, as long as its outermost one there is far from the rest."""
        for _ in range(most):
            wider = SliceRun(run.first - before, run.last + after)
            end = run.first if before else run.last - 1
            if self._nearest(run, end, end + 1)[0] <= least or self.share(wider) > LARGEST_STRAY:
                break
            run = wider
        return run

    def _nearest(self, run: SliceRun, first: int, last: int) -> Numbers:
        """Distances of slices from the nearest colours outside a run."""
        nearest: Numbers = self.distances[first:last, self._rest(run)].min(1)
        return nearest

    def _rest(self, run: SliceRun) -> Cells:
        """The numbers of slices outside a run that hold no colours of it."""
        places = np.arange(len(self.distances))
        return places[(places < run.first - BLUR) | (places >= run.last + BLUR)]


def _spread(distances: Numbers) -> float:
    """Mean of the smallest distances, (n, n), of slices from those that are not beside them."""
    places = np.arange(len(distances))
    blurred = np.abs(places[:, None] - places) <= 2 * BLUR  # the colours at a border may be in both
    nearest = np.where(blurred, np.inf, distances).min(1)
    return float(nearest[np.isfinite(nearest)].mean()) if np.isfinite(nearest).any() else 0.0


LARGEST_AREA = 0.04  # of the picture that a stroke covers; larger areas are rough masks, which count as they are
ELONGATED = 5.0  # least squared border of a stroke, relative to four times its area: three times as long as wide
STRAY_LIGHTNESS = 0.5  # weight of differences in lightness, much of which is shading
SHARED_COLOURS = 0.2  # of a stroke that has colours of another one, which are then meant


def without_strays(scribbles: Scribbles, size: tuple[int, int], *, of_one_colour: bool = False) -> Scribbles:
    """Scribbles of a picture (H, W) without the stray parts of each connected stroke, whose weights become 0.

    If things ``of_one_colour`` are meant, what a stroke shares with another one is, and all else on it is stray.
    """
    stray = strays(scribbles, size, of_one_colour=of_one_colour)
    if not bool(stray.any()):
        return scribbles
    return scribbles.weighted(scribbles.weights.masked_fill(stray, 0.0))


@torch.no_grad()
def strays(scribbles: Scribbles, size: tuple[int, int], *, of_one_colour: bool = False) -> Tensor:
    """Which pixels of scribbles are stray, (B, K, n); without a gradient. None are if values cannot be read."""
    if is_unreadable(scribbles.weights) or is_unreadable(scribbles.image):
        return torch.zeros_like(scribbles.weights, dtype=torch.bool)
    side = max(1.0, (size[0] * size[1] / SOLVED_PIXELS) ** 0.5)
    shape = (max(1, round(size[0] / side)), max(1, round(size[1] / side)))
    at = blocks_at(scribbles.places, size, shape).cpu().numpy()
    colours = colours_in_lab(scribbles.image.detach().clamp(0.0, 1.0).expand(-1, 3, -1)).double()
    colours = colours * colours.new_tensor((STRAY_LIGHTNESS, 1.0, 1.0)).view(1, 3, 1)
    painted = (scribbles.weights.detach() > 0).cpu().numpy()
    stray = np.zeros_like(painted)
    for image, points in enumerate(colours.mT.cpu().numpy()):
        for region, covered in enumerate(painted[image]):
            stray[image, region, covered] = _of_region(points[covered], at[covered], shape, of_one_colour)
    return torch.from_numpy(stray).to(scribbles.weights.device)


def _of_region(points: Numbers, at: Cells, shape: tuple[int, int], of_one_colour: bool) -> NDArray[np.bool_]:
    """Which pixels of a region with colours (n, 3), in cells (n,), are stray, (n,)."""
    cells, back, counts = np.unique(at, return_inverse=True, return_counts=True)
    if not len(cells):
        return np.zeros(0, dtype=bool)
    means = np.stack([np.bincount(back, channel) for channel in points.T], axis=1) / counts[:, None]
    grid = Grid.of(cells, shape)
    strokes, ignored = connected_pieces(cells, shape[1]) + 1, np.zeros(len(cells), dtype=bool)
    parts, middles = list[tuple[Cells, int]](), list[Numbers]()
    for stroke in range(1, strokes.max() + 1):
        own = np.flatnonzero(strokes == stroke)
        kept = own
        if len(own) <= LARGEST_AREA * shape[0] * shape[1] and grid.elongation(own) >= ELONGATED:
            part = stray_runs(means[own], grid.rows[own], grid.columns[own])
            if part.any():
                parts.append((own[part], stroke))
                kept = own[~part]
        middles.append(np.median(means[kept], axis=0))
    for stroke in range(1, len(middles) + 1) if of_one_colour else ():
        own = np.flatnonzero(strokes == stroke)
        others = np.array(middles[: stroke - 1] + middles[stroke:]).reshape(-1, 3)
        apart = (np.linalg.norm((means[own, None] - others)[..., 1:], axis=2) > GAP).all(
            1
        )  # in a* and b*, without shade
        if len(others) and apart.mean() <= 1 - SHARED_COLOURS:
            ignored[own[apart]] = True
    for places, stroke in parts:  # what another stroke is meant for is not stray
        others = np.array(middles[: stroke - 1] + middles[stroke:]).reshape(-1, 3)
        distances = np.linalg.norm(np.median(means[places], axis=0) - others, axis=1)
        ignored[places] = (distances > GAP / 2).all()
    stray: NDArray[np.bool_] = ignored[back]
    return stray


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


def stray_parts(source: Reduced, painted: Tensor) -> Tensor:
    """The parts (1, 1, H, W) of scribbles (1, 1, H, W) on an image that do not count."""
    scribbles = source.scribbles(painted, None, "scribbles", needed=False)
    return scribbles.weighted(strays(scribbles, source.size).to(source.image)).planes(source)
