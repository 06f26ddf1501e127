"""Ends of strokes, and gaps that they cross, that lie on something else than the rest.

A stroke is cut into slices across it. A run of slices is stray if its colours are far from all colours of the rest;
patterns and shades that occur elsewhere in the stroke are not. It begins where colours begin to leave those of the
rest, since slices at a border hold colours of both sides. The farther of both ends is judged first, then gaps, then
what is left once more.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Chosen with benchmarks.scribbles on the choosing set.
SLICE = 0.4  # length of a slice, relative to the width of the stroke
SLICES = 6, 48  # least and largest number of them
BLUR = 1  # slices on either side of the border of a run that may hold colours of both sides
LARGEST, SLACK = 0.3, 0.05  # share of a stroke that may be stray, and with its beginning
END, GAP = 0.12, 0.18  # least mean distance of a run from the nearest colours of the rest, in hundredths of Lab
SELF = 2.0  # the same, relative to the mean distance of slices of the rest from the nearest other ones
NARROWEST = 2  # slices of a gap that hold no other colours
BEGINNING = 0.35  # share of a run's distance at which it begins
APART = 3  # slices of the rest that are nearer to each other are not compared
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
class Run:
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
        return self.distance >= max(least, SELF * self.spread)

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

    def ends(self) -> list[Run]:
        """The runs up to the last slice that are not larger than the largest share."""
        count = len(self.distances)
        runs = [Run(first, count) for first in range(BLUR + 1, count - BLUR)]
        return [run for run in runs if self.share(run) <= LARGEST]

    def gaps(self) -> list[Run]:
        """The runs with the same colour on both sides that are not larger than the largest share."""
        count = len(self.distances)
        runs = [
            Run(first, last)
            for first in range(BLUR + 1, count - BLUR)
            for last in range(first + 2 * BLUR + NARROWEST, count - BLUR)
            if self.distances[first - BLUR - 1, last + BLUR] <= GAP / 2
        ]
        return [run for run in runs if self.share(run) <= LARGEST]

    def share(self, run: Run) -> float:
        """The share of the stroke that a run covers."""
        return float(self.shares[run.last] - self.shares[run.first])

    def farthest(self, runs: list[Run]) -> Run:
        """The run that is farthest from the rest in colour, from where colours begin to leave those of the rest."""
        count = len(self.distances)
        inner = [(run.first + BLUR, run.last - BLUR * (run.last < count)) for run in runs]
        means = [self._nearest(run, *ends).mean() for run, ends in zip(runs, inner, strict=True)]
        if not means:
            return Run(count, count)
        run, distance = runs[int(np.argmax(means))], float(max(means))
        rest = self._rest(run)
        spread = _spread(self.distances[np.ix_(rest, rest)])
        least = max(BEGINNING * distance, spread)
        run = self._widened(run, run.first - BLUR - 1, least, before=1)
        run = self._widened(run, count - BLUR - 1 - run.last, least, after=1)
        return Run(run.first, run.last, distance, spread)

    def _widened(self, run: Run, most: int, least: float, *, before: int = 0, after: int = 0) -> Run:
        """Add up to so many slices before or after a run, as long as its outermost one there is far from the rest."""
        for _ in range(most):
            wider = Run(run.first - before, run.last + after)
            end = run.first if before else run.last - 1
            if self._nearest(run, end, end + 1)[0] <= least or self.share(wider) > LARGEST + SLACK:
                break
            run = wider
        return run

    def _nearest(self, run: Run, first: int, last: int) -> Numbers:
        """Distances of slices from the nearest colours outside a run."""
        nearest: Numbers = self.distances[first:last, self._rest(run)].min(1)
        return nearest

    def _rest(self, run: Run) -> Cells:
        """The numbers of slices outside a run that hold no colours of it."""
        places = np.arange(len(self.distances))
        return places[(places < run.first - BLUR) | (places >= run.last + BLUR)]


def _spread(distances: Numbers) -> float:
    """Mean of the smallest distances, (n, n), of slices from those that are not beside them."""
    places = np.arange(len(distances))
    nearest = np.where(np.abs(places[:, None] - places) < APART, np.inf, distances).min(1)
    return float(nearest[np.isfinite(nearest)].mean()) if np.isfinite(nearest).any() else 0.0
