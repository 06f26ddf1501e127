"""Parts of k-means: initial centroids, from randomly pivoted Cholesky decomposition, and Lloyd's iteration."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.library import contiguous, kernel, run
from nlfilter_torch.core.torch_internals import register

CACHED_SCORES = 1 << 20  # scores of points and centres; on CPUs a batch is divided into parts with at most this many


def draw_pivots(
    affinities: Callable[[Tensor], Tensor], residual: Tensor, divisor: Tensor, draws: Tensor, captured: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Randomly pivoted Cholesky decomposition: pivots (B, 1, M), rows (B, M, S) and divisors of the rows (B, M).

    Args:
        affinities: computes rows (B, 1, S) of the matrix for pivots (B, 1, 1).
        residual: diagonal of the matrix, (B, 1, S).
        divisor: divisor of the probabilities in the draw, (B, 1, S).
        draws: random numbers (M,) in [0, 1).
        captured: lower bound of residuals; a smaller residual counts as captured.
    """
    rows = residual.new_zeros(residual.shape[0], len(draws), residual.shape[2])
    chosen, scales = [], []
    for step, draw in enumerate(draws.unbind()):
        # Summed in float64, as in C, so that rounding does not decide which of thousands of points is drawn.
        summed = (chance(residual, captured) / divisor).cumsum(2, dtype=torch.float64)
        pivot = torch.searchsorted(summed, draw * summed[:, :, -1:]).clamp_(max=residual.shape[2] - 1)  # (B, 1, 1)
        before = rows[:, :step]
        row = torch.baddbmm(affinities(pivot), pick(before, pivot).mT, before, alpha=-1)
        scale = row.gather(2, pivot).clamp(min=captured).sqrt()
        row /= scale
        residual = residual - row.square()
        rows[:, step] = row.squeeze(1)
        chosen.append(pivot)
        scales.append(scale)
    return torch.cat(chosen, dim=2), rows, torch.cat(scales, dim=2).squeeze(1)


def chance(residual: Tensor, captured: float) -> Tensor:
    """Unnormalised probability of drawing a point as a pivot: the fourth power of its residual."""
    return residual.clamp(min=captured).square().square()


def affinities_between(points: Tensor, norms: Tensor, others: Tensor, lengths: Tensor) -> Tensor:
    """Affinities (B, M, S) of points (B, D, S) to others (B, D, M), given squared norms (B, 1, S) and (B, 1, M)."""
    return torch.baddbmm(norms + lengths.mT, others.mT, points, beta=-1, alpha=2).clamp_(-60.0, 0.0).exp_()


def _affinities_to(points: Tensor, norms: Tensor, pivot: Tensor) -> Tensor:
    """Affinities (B, 1, S) of points (B, D, S) with squared norms (B, 1, S) to those with index ``pivot`` (B, 1, 1)."""
    return affinities_between(points, norms, pick(points, pivot), pick(norms, pivot))


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

    Uses the random numbers ``draws``, (M,) in [0, 1), one per pivot; see :func:`draw_pivots` for ``captured``.
    """
    norms = points.square().sum(1, keepdim=True)  # (B, 1, S)
    ones = torch.ones_like(norms)
    return draw_pivots(partial(_affinities_to, points, norms), ones, ones, draws, captured)[0].squeeze(1)


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
