"""Balancing by Newton's method on the moment ``t = factor @ d``, with the Jacobian of a sample of the pixels.

Given t, a pixel's equation ``d (u . t + c d) = 1`` is a quadratic with one positive root d(t), so the M entries of t
are the only unknowns: ``t = sum_i u_i d_i(t)``. The Jacobian of ``t - sum_i u_i d_i(t)`` is symmetric,

    J = I + sum_i p_i u_i u_i^T,    p = d^2 / (1 + c d^2),

with a spectrum in [1, 2] at the solution. Over all pixels the sum costs as much as 14 sweeps over the factor, over a
sample almost nothing. Pixels are sampled in proportion to their leverage score ``p |u|^2``, because rare pixels, which
a uniform sample misses, converge last. On photographs of a megapixel each sweep then reduces the error by a factor of
10 to 100; Chebyshev's iteration reduces it by 5.8.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.grams import gram
from nlfilter_torch.core.kernels.sweeps import sweep
from nlfilter_torch.core.kernels.tall_skinny import gather, spread
from nlfilter_torch.operator.conjugate_gradients import conjugate_gradients
from nlfilter_torch.operator.landmarks import stratified
from nlfilter_torch.operator.scaling import Solution, largest_magnitude, row_sums, scaling_from_moment

PER_LANDMARK = (8, 32, 160)  # sampled pixels at least, usually and at most: the Jacobian is then within 35, 18 or 8 %
EXPLORED = 8192  # most pixels that the first guess is computed from
SHARE = 8  # one of so many pixels is sampled, within these bounds
LARGE = 64  # at least one of so many pixels is sampled: larger images have rarer pixels
GUESSES = 3  # fixed-point steps of the first guess; more do not help pixels outside its sample
REFINEMENTS = 3  # steps of Newton's method on a sample; after two the Jacobian still changes
UNIFORM = 0.05  # part of the sample that is drawn uniformly, so that a pixel stands for at most 20 times its share
LARGEST = 2.0  # bounds d while t is a guess; a larger d is left to the damped method
MAX_SWEEPS = 12
ACCELERATOR_SWEEPS = 5  # reading the residual would stall the queue of an accelerator
FIRST_TOLERANCE = 1e-6  # of the solution in float32 that one in float64 starts from
RESAMPLED = 0.2  # after a sweep that reduces the error by less than a factor of five, another sample is drawn


@dataclass(frozen=True)
class JacobianSample:
    """A weighted sample of the pixels, from which the Jacobian is computed.

    Attributes:
        factor: their columns, (B, M, n).
        diagonal: (B, n).
        weight: number of pixels that each stands for, (B, n).
        among: ranks, each with a sample of its rows.
    """

    factor: Tensor
    diagonal: Tensor
    weight: Tensor
    among: Communicator

    def scaling(self, total: Tensor) -> Tensor:
        """Their d (B, n), given t (B, M, 1) in float64."""
        return scaling_from_moment(self.factor, self.diagonal, total.to(self.factor)).clamp_(max=LARGEST)

    def moment(self, scaling: Tensor) -> Tensor:
        """The sample's estimate of ``factor @ d``, (B, M, 1) in float64."""
        return self.among.sum(gather((self.weight * scaling).unsqueeze(1), self.factor).mT.double())

    def jacobian(self, scaling: Tensor) -> Tensor:
        """J, (B, M, M) in float64."""
        slope = scaling.square()
        slope = self.weight * slope / (1 + self.diagonal * slope)
        total = self.among.sum(gram(self.factor, slope))
        return total.double() + torch.eye(total.shape[1], dtype=torch.float64, device=total.device)

    def residual(self, total: Tensor, found: Tensor) -> Tensor:
        """Largest deviation of a row sum from 1 among the sample, (B,), where d(total) has the moment ``found``."""
        # Where d is the root for the total, row sums lack d u . (total - found).
        lacking = spread((total - found).to(self.factor).mT, self.factor, self.scaling(total))
        return self.among.max(lacking.abs().amax((1, 2)))


def _draw(
    factor: Tensor, diagonal: Tensor, scaling: Tensor, count: int, among: Communicator, weights: Tensor | None
) -> tuple[JacobianSample, Tensor]:
    """A systematic sample in proportion to leverage scores, and its part of ``scaling``, (B, n)."""
    if 2 * count >= factor.shape[2]:
        return JacobianSample(factor, diagonal, weighted(torch.ones_like(diagonal), weights), among), scaling
    slope = scaling.square()
    leverage = weighted(slope * (1 - diagonal) / (1 + slope * diagonal), weights)  # |u|^2 is 1 - c
    leverage = leverage + leverage.mean(1, keepdim=True) * UNIFORM + torch.finfo(leverage.dtype).tiny
    summed = leverage.double().cumsum(1)
    ticks = (torch.arange(count, dtype=torch.float64, device=factor.device) + 0.5) / count
    chosen = torch.searchsorted(summed, summed[:, -1:] * ticks).clamp_(max=factor.shape[2] - 1)  # (B, n)
    weight = (summed[:, -1:] / count).to(factor) / leverage.gather(1, chosen)
    weight = weight if weights is None else weight * weights.gather(1, chosen)
    columns = factor.gather(2, chosen.unsqueeze(1).expand(-1, factor.shape[1], -1))
    return JacobianSample(columns, diagonal.gather(1, chosen), weight, among), scaling.gather(1, chosen)


def _guess(factor: Tensor, diagonal: Tensor, among: Communicator, weights: Tensor | None) -> Tensor:
    """A first guess of t (B, M, 1), from a few thousand pixels that are spread evenly over the image."""
    pixels = factor.shape[2]
    few, rest, each = factor, diagonal, weighted(torch.ones_like(diagonal), weights)
    count = min(max(pixels // SHARE, 16 * factor.shape[1]), EXPLORED)
    if 2 * count < pixels:
        # One pixel at random from each stretch: a fixed stride could coincide with the period of a texture.
        chosen = stratified(pixels, count, torch.Generator().manual_seed(0)).to(factor.device)
        few, rest = factor.gather(2, chosen.expand(*factor.shape[:2], -1)), diagonal[:, chosen]
        each = each[:, chosen] * (each.sum(1, keepdim=True) / each[:, chosen].sum(1, keepdim=True))
    sample = JacobianSample(few, rest, each, among)
    sums = spread(sample.moment(torch.ones_like(rest)).to(few).mT, few).squeeze(1) + rest
    total = sample.moment(sums.clamp_(min=1.0).rsqrt_())  # no row of K sums to less than its unit diagonal
    for _ in range(GUESSES):
        total = (total + sample.moment(sample.scaling(total))) / 2
    return total


def _sweep(
    factor: Tensor, diagonal: Tensor, total: Tensor, among: Communicator, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """d(t) for all points, (B, N), and its moment (B, M, 1): one read of the factor."""
    half = (total / 2).squeeze(2).to(factor)
    scaling, found = sweep(factor, diagonal, half, LARGEST, weights)
    return scaling, among.sum(found.unsqueeze(2))


def solve(
    factor: Tensor, diagonal: Tensor, tolerance: float, among: Communicator = ALONE, weights: Tensor | None = None
) -> Solution:
    """Balance a kernel with a unit diagonal; on processors until the residual is at most ``tolerance`` or stalls.

    On an accelerator the number of sweeps is fixed, as reading a residual would stall its queue.
    """
    solver = _refined if factor.dtype == torch.float64 and factor.device.type == "cpu" else _quasi_newton
    return solver(factor, diagonal, tolerance, among, weights)


def _quasi_newton(
    factor: Tensor, diagonal: Tensor, tolerance: float, among: Communicator, weights: Tensor | None
) -> Solution:
    """Newton's method with the Jacobian of a sample, corrected by BFGS updates from the sweeps over all pixels."""
    watched = factor.device.type == "cpu"
    landmarks, pixels = factor.shape[1:]
    least, usual, most = (bound * landmarks // among.size for bound in PER_LANDMARK)
    count = max(min(pixels // SHARE, max(most, pixels // LARGE)), min(usual, EXPLORED // among.size), least)
    total = _guess(factor, diagonal, among, weights)
    scaling, found = _sweep(factor, diagonal, total, among, weights)
    worst, slow, gain, inverse = 1.0, 0, 1.0, total.new_zeros(len(total), landmarks, landmarks)
    for sweeps in range(1, (MAX_SWEEPS if watched else ACCELERATOR_SWEEPS) + 1):
        before, error = total, total - found
        if gain > RESAMPLED if watched else sweeps < 3:
            sample, part = _draw(factor, diagonal, scaling, count, among, weights)
            # The sample predicts how the moment changes with t. The true moment at the current t is known, and so the
            # error of the sample there, which is subtracted.
            bias = found - sample.moment(part)
            total = found
            for _ in range(REFINEMENTS):
                part = sample.scaling(total)
                # J is positive definite. Cholesky is safe with several threads; batched LU of MKL is not.
                lower = torch.linalg.cholesky_ex(sample.jacobian(part)).L
                total = total - torch.cholesky_solve(total - sample.moment(part) - bias, lower)
            inverse = torch.cholesky_inverse(lower)
        else:
            total = total - inverse @ error
        scaling, found = _sweep(factor, diagonal, total, among, weights)
        inverse = _updated(inverse, total - before, total - found - error)
        if not watched:
            continue
        previous, worst = worst, sample.residual(total, found).max().item()
        gain = worst / previous
        slow = slow + 1 if not gain <= 0.5 else 0
        if worst <= tolerance or slow > 1:
            measured = _measure(factor, diagonal, scaling, total, found, among)
            if slow > 1 or bool((measured[1] <= tolerance).all()):
                break
    else:
        measured = _measure(factor, diagonal, scaling, total, found, among)
    return Solution(scaling, found, measured[0], sweeps, inverse)


def _refined(
    factor: Tensor, diagonal: Tensor, tolerance: float, among: Communicator, weights: Tensor | None
) -> Solution:
    """A solution in float64, whose steps are computed from the factor in float32 by the kernels in C."""
    single, each = factor.float(), None if weights is None else weights.float()
    rough = _quasi_newton(single, diagonal.float(), max(tolerance, FIRST_TOLERANCE), among, each)
    total, sweeps = rough.moment, rough.sweeps
    for _ in range(MAX_SWEEPS):
        scaling, found = _sweep(factor, diagonal, total, among, weights)
        sweeps += 1
        error, d = total - found, scaling.float()
        if bool((largest_magnitude(spread(error.to(single).mT, single, d).squeeze(1), among) <= tolerance / 2).all()):
            break
        weight = weighted(d.square() / (1 + d.square() * diagonal.float()), each)
        total = total - conjugate_gradients(single, weight, error, rough.inverse, among)
    residual = largest_magnitude(row_sums(factor, diagonal, scaling, found) - 1, among)
    return Solution(scaling, found, residual, sweeps, rough.inverse)


def _measure(
    factor: Tensor, diagonal: Tensor, scaling: Tensor, total: Tensor, found: Tensor, among: Communicator
) -> tuple[Tensor, Tensor]:
    """Largest deviation of a row sum from 1, (B,): with the rounding of d = d(total), and without it."""
    rows = spread(torch.cat([found, total - found], dim=2).to(factor).mT, factor)  # (B, 2, N): one read of the factor
    sums = scaling * (rows[:, 0] + diagonal * scaling)
    return largest_magnitude(sums - 1, among), largest_magnitude(scaling * rows[:, 1], among)


def _updated(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """BFGS update of the inverse (B, M, M): it then maps ``change``, of ``t - factor @ d(t)``, to ``step``, of t."""
    curvature = (step * change).sum(1, keepdim=True)  # positive, as the Jacobian is
    rho = torch.where(curvature > 0, 1 / curvature, torch.zeros_like(curvature))
    moved = inverse @ change
    scale = rho * (1 + rho * (change * moved).sum(1, keepdim=True))
    cross = rho * moved @ step.mT
    return inverse - cross - cross.mT + scale * step @ step.mT
