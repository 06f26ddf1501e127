"""Balancing by Newton's method on d with an exact line search: slower than the other methods, but always convergent."""

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.grams import sum_grams
from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.operator.scaling import Solution, largest_magnitude, moment_of, row_sums

MAX_STEPS = 50  # about ten are needed from any start
SMALL_STEP = 0.1  # relative change of d below which full steps converge quadratically


def damped(
    factor: Tensor,
    diagonal: Tensor,
    start: Solution,
    goal: float,
    among: Communicator = ALONE,
    weights: Tensor | None = None,
) -> Solution:
    """Balance from any start until the residual is at most ``goal``, or does not fall any more.

    A balanced d is the only minimum of ``d^T K d / 2 - sum log d``, which is convex as K is positive semi-definite,
    even if entries of K are negative. If d changes by ``s d x``, the step x solves ``(I + W) x = 1 - W 1``, a system of
    M equations with the Jacobian J of all pixels. Along x the function is a quadratic and a sum of logarithms, whose
    minimum is found without reading the factor again.
    """
    tiny = torch.finfo(factor.dtype).tiny
    usable = start.scaling.isfinite() & (start.scaling > 0)
    scaling = torch.where(usable, start.scaling, torch.ones_like(start.scaling))
    best, slow = start, 0
    for steps in range(1, MAX_STEPS + 1):
        total = moment_of(factor, scaling, among, weights)
        lacking = 1 - row_sums(factor, diagonal, scaling, total)
        share = 1 / (1 + scaling * (scaling * diagonal))  # 1 / (1 + r)
        gram = among.sum(sum_grams(factor, scaling * weighted(share, weights).sqrt(), None, 1)[:, 0])
        lower = torch.linalg.cholesky_ex(gram + torch.eye(gram.shape[1], dtype=gram.dtype, device=gram.device)).L
        residual = largest_magnitude(lacking, among)
        found = Solution(scaling, total, residual, start.sweeps + 3 * steps, torch.cholesky_inverse(lower))
        slow = 0 if bool((residual.max() < 0.5 * best.residual.max()).all()) else slow + 1
        if bool(residual.max() <= best.residual.max()):
            best = found
        right = moment_of(factor, scaling * (share * lacking), among, weights)
        affinity = spread(torch.cholesky_solve(right, lower).to(factor).mT, factor, scaling).squeeze(1)
        step = share * (lacking - affinity)
        small = bool(largest_magnitude(step, among).max() < SMALL_STEP)
        if bool((residual <= goal).all()) or (small and slow > 2) or not bool(torch.isfinite(step).all()):
            break
        length = 1.0 if small else _line_search(step.double(), lacking.double(), among, weights)
        scaling = (scaling * (1 + length * step)).clamp(min=tiny).to(factor)
    return best


def _line_search(step: Tensor, lacking: Tensor, among: Communicator, weights: Tensor | None) -> Tensor:
    """The s (B, 1) that minimises ``(1 + s x)^T W (1 + s x) / 2 - sum log(1 + s x)``, given x and 1 - W 1 (B, N)."""
    # W 1 = 1 - lacking and W x = lacking - x make the quadratic known.

    def total(values: Tensor) -> Tensor:
        return among.sum(weighted(values, weights).sum(1, keepdim=True))

    linear, square = total(step * (1 - lacking)), total(step * (lacking - step))
    longest = among.max((-step).amax(1, keepdim=True)).clamp(min=1e-12).reciprocal()  # where a d reaches zero
    low, high = torch.zeros_like(longest), 0.999 * longest
    length = torch.minimum(torch.ones_like(high), 0.5 * high)
    for _ in range(40):
        ratio = step / (1 + length * step)
        slope = linear + length * square - total(ratio)
        bend = square + total(ratio.square())
        low, high = torch.where(slope < 0, length, low), torch.where(slope < 0, high, length)
        following = length - slope / bend
        inside = (following > low) & (following < high)
        length = torch.where(inside, following, (low + high) / 2)
    return length
