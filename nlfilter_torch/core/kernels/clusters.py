"""Parts of k-means: initial centroids, from randomly pivoted Cholesky decomposition, and Lloyd's iteration."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.library import contiguous, kernel, run
from nlfilter_torch.core.torch_internals import register

# As in interface.h. Of the proposals for a pivot, half are drawn in proportion to a power of the distance from the
# nearest pivot too, similar to k-means++ (Arthur and Vassilvitskii, 2007): where clusters are wider than the bandwidth,
# residuals alone do not tell a cluster without a pivot from a point beside one. With the square, as there, the last of
# 90 clusters was sometimes missed; with the fourth power it was not, in six trials. Outliers are proposed more often,
# but rarely chosen.
TRIALS = 6
COVERED = 4.0  # squared distance from the nearest pivot at which a point counts as half covered
UNCOVERED = 1e16  # squared distance before there is a pivot, and the largest that counts
DISTINCT = 1e-6  # added to squared distances, so that there are probabilities where all points are equal
NEARLY = 1e-5  # proposals whose coverage differs by less than this share are equally good
CACHED_SCORES = 1 << 20  # scores of points and centres; on CPUs a batch is divided into parts with at most this many


@dataclass(frozen=True)
class PivotSampler:
    """Matrix of affinities ``exp(-d^2)`` of points (B, D, S), from which pivots are drawn.

    Attributes:
        points: (B, D, S).
        norms: their squared norms, (B, 1, S).
        divisor: divisor of the probabilities in the draw, (B, 1, S): how likely it was that a point is among these.
        captured: lower bound of residuals; a smaller residual counts as captured.
        matrix: residual matrix (B, S, S) if other points than these are pivots already; None: the affinities.
        squares: squared distances (B, S, S) of the points from each other, if they are known.
    """

    points: Tensor
    norms: Tensor
    divisor: Tensor
    captured: float
    matrix: Tensor | None = None
    squares: Tensor | None = None

    def draw(self, residual: Tensor, nearest: Tensor, draws: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Randomly pivoted Cholesky decomposition: pivots (B, 1, M), rows (B, M, S) and divisors of the rows (B, M).

        Of each pivot's :data:`TRIALS` proposals, half are drawn by :func:`odds` with distances and half without. The
        one that covers the points best becomes the pivot.

        Args:
            residual: diagonal of the matrix, (B, 1, S).
            nearest: squared distances of the points from the nearest pivot, (B, 1, S).
            draws: random numbers (M, TRIALS) in [0, 1).
        """
        rows = residual.new_zeros(residual.shape[0], len(draws), residual.shape[2])
        chosen, scales = [], []
        for step, numbers in enumerate(draws.unbind()):
            pivot, apart = self._choose(residual, nearest, numbers)
            before = rows[:, :step]
            row = affinities(apart) if self.matrix is None else pick(self.matrix, pivot).mT
            row = torch.baddbmm(row, pick(before, pivot).mT, before, alpha=-1)
            scale = row.gather(2, pivot).clamp(min=self.captured).sqrt()
            row /= scale
            residual = residual - row.square()
            nearest = torch.minimum(nearest, apart).scatter(2, pivot, 0.0)
            rows[:, step] = row.squeeze(1)
            chosen.append(pivot)
            scales.append(scale)
        return torch.cat(chosen, dim=2), rows, torch.cat(scales, dim=2).squeeze(1)

    def _choose(self, residual: Tensor, nearest: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """The next pivot (B, 1, 1) and the squared distances of all points from it, (B, 1, S)."""
        # Summed in float64, as in C, so that rounding does not decide which of thousands of points is drawn.
        summed = (odds(residual, nearest, self.captured) / self.divisor).cumsum(2, dtype=torch.float64)  # (B, 2, S)
        ticks = numbers.view(2, -1) * summed[:, :, -1:]
        proposed = torch.searchsorted(summed, ticks).clamp_(max=residual.shape[2] - 1).flatten(1).unsqueeze(1)
        if self.squares is None:
            others, lengths = pick(self.points, proposed), pick(self.norms, proposed)
            apart = squared_distances(self.points, self.norms, others, lengths)  # (B, TRIALS, S)
        else:
            apart = pick(self.squares, proposed).mT
        best = best_trial(apart, nearest, self.divisor)
        return proposed.gather(2, best), pick(apart.mT, best).mT


def odds(residual: Tensor, nearest: Tensor, captured: float) -> Tensor:
    """Unnormalised probabilities (B, 2, S) of proposing a point as a pivot.

    The fourth power of its residual (B, 1, S), times the fourth power of its distance from the nearest pivot, of which
    ``nearest`` (B, 1, S) is the square, and alone.
    """
    power = chance(residual, captured)
    return torch.cat([power * (nearest + DISTINCT).square(), power], dim=1)


def chance(residual: Tensor, captured: float) -> Tensor:
    """The fourth power of residuals."""
    return residual.clamp(min=captured).square().square()


def best_trial(apart: Tensor, nearest: Tensor, divisor: Tensor) -> Tensor:
    """Index (B, 1, 1) of the proposal that covers the points best, given squared distances (B, T, S) from proposals.

    A point counts as half covered at the squared distance :data:`COVERED` from the nearest pivot. Of proposals that
    are equally good to rounding, the first is taken.
    """
    covered = (COVERED / (torch.minimum(apart, nearest) + COVERED) / divisor).sum(2, dtype=torch.float64)  # (B, T)
    trials = covered.unbind(1)
    best, most = torch.zeros_like(trials[0], dtype=torch.long), trials[0]
    for number, trial in enumerate(trials[1:], 1):
        better = trial > most * (1 + NEARLY)
        best, most = torch.where(better, number, best), torch.where(better, trial, most)
    return best.view(-1, 1, 1)


def squared_distances(points: Tensor, norms: Tensor, others: Tensor, lengths: Tensor) -> Tensor:
    """Squared distances (B, M, S) of points (B, D, S) from others (B, D, M).

    ``norms`` (B, 1, S) and ``lengths`` (B, 1, M) are their squared norms.
    """
    return torch.baddbmm(norms + lengths.mT, others.mT, points, alpha=-2).clamp_(min=0.0)


def affinities(squared: Tensor) -> Tensor:
    """Affinities of squared distances."""
    return squared.clamp(max=60.0).neg_().exp_()


def pick(planes: Tensor, at: Tensor) -> Tensor:
    """Columns (B, R, M) of planes (B, R, S) with indices (B, 1, M)."""
    return planes.gather(2, at.expand(-1, planes.shape[1], -1))


def _compiled_pivots(points: Tensor, draws: Tensor, captured: float) -> Tensor:
    points, draws = contiguous(points, draws)
    batch, size, count = points.shape
    chosen = torch.empty(batch, len(draws), dtype=torch.long)
    arguments = (size, count, len(draws), captured, points.data_ptr(), draws.data_ptr(), chosen.data_ptr())
    run("pivots", torch.get_num_threads(), batch, *arguments)
    return chosen


def _fake_pivots(points: Tensor, draws: Tensor, captured: float) -> Tensor:
    return points.new_empty(points.shape[0], draws.shape[0], dtype=torch.long)


@register("pivots(Tensor points, Tensor draws, float captured) -> Tensor", kernel(_compiled_pivots), _fake_pivots)
def pivots(points: Tensor, draws: Tensor, captured: float) -> Tensor:
    """Pivots (B, M) of a randomly pivoted Cholesky decomposition of the affinities of points (B, D, S).

    Uses the random numbers ``draws``, (M, TRIALS) in [0, 1); see :class:`PivotSampler`.
    """
    norms = points.square().sum(1, keepdim=True)  # (B, 1, S)
    ones = torch.ones_like(norms)
    return PivotSampler(points, norms, ones, captured).draw(ones, UNCOVERED * ones, draws)[0].squeeze(1)


def _compiled_lloyd(points: Tensor, start: Tensor, iterations: int, margin: float) -> Tensor:
    points, start = contiguous(points, start)
    batch, size, count = points.shape
    nearest = torch.empty(batch, count, dtype=torch.int32)
    run(
        "lloyd", torch.get_num_threads(), batch, size, count, start.shape[2], iterations, margin, points.data_ptr(),
        start.data_ptr(), nearest.data_ptr(),
    )  # fmt: skip
    return nearest.long()


def _fake_lloyd(points: Tensor, start: Tensor, iterations: int, margin: float) -> Tensor:
    return points.new_empty(points.shape[0], points.shape[2], dtype=torch.long)


@register(
    "lloyd(Tensor points, Tensor start, int iterations, float margin) -> Tensor", kernel(_compiled_lloyd), _fake_lloyd
)
def lloyd(points: Tensor, start: Tensor, iterations: int, margin: float) -> Tensor:
    """Run Lloyd's iteration from centres (B, D, M); return the index (B, S) of the nearest centre of points (B, D, S).

    Scores that differ by less than ``margin`` times the magnitude of their terms are ties; the first index wins.
    """
    together = max(1, CACHED_SCORES // (points.shape[2] * start.shape[2]))
    if points.device.type == "cpu" and together < points.shape[0]:
        parts = zip(points.split(together), start.split(together), strict=True)
        return torch.cat([lloyd(*part, iterations, margin) for part in parts])
    extended = torch.cat([points, torch.ones_like(points[:, :1])], dim=1)  # for scores, and for sums and sizes
    slack = margin * points.square().sum(1).unsqueeze(2)  # (B, S, 1)
    centres = start
    for step in range(iterations + 1):
        # Half the squared norm of points minus half their squared distance to centres, (B, S, M).
        score = extended.mT @ torch.cat([centres, -0.5 * centres.square().sum(1, keepdim=True)], dim=1)
        best = score.amax(2, keepdim=True)
        nearest = (score >= best - (slack + margin * best.abs())).byte().argmax(2)  # the first of the nearest
        if step == iterations:
            break
        members = score.zero_().scatter_(2, nearest.unsqueeze(2), 1.0)
        sums = extended @ members  # (B, D + 1, M)
        sizes = sums[:, -1:]
        centres = torch.where(sizes > 0, sums[:, :-1] / sizes.clamp(min=1.0), start)
    return nearest
