"""The scaling d that balances a kernel: as a function of its moment, and Newton's method for the moment.

Given the moment ``t = sum_i w_i d_i u_i`` over all points, with weights w, a point's scaling satisfies
``d (u . t + c d) = 1``, a quadratic with one positive root d(t), which depends only on the point's own column u and
diagonal c. The M entries of t are thus the only unknowns. The Jacobian of ``t - sum_i u_i d_i(t)`` is symmetric,

    J = I + sum_i p_i u_i u_i^T,    p = d^2 / (1 + c d^2),

with a spectrum in [1, 2] at the solution. Summing over all pixels costs as much as 14 sweeps over the factor, summing
over a sample almost nothing. Pixels are sampled in proportion to their leverage score ``p |u|^2``, because rare pixels,
which a uniform sample misses, converge last. On photographs of a megapixel each sweep then reduces the error by a
factor of 10 to 100; Chebyshev iteration reduces it by 5.8.

:func:`damped` is Newton's method on d with an exact line search: slower than the other methods, but always convergent.
"""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import stratified, weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.grams import gram, sum_grams
from nlfilter_torch.core.kernels.tall_skinny import gather, moment, positive_root, spread, sweep, weigh
from nlfilter_torch.core.torch_internals import is_hidden
from nlfilter_torch.core.warning import warn

EXCESS = {torch.float32: 1e-5, torch.float64: 1e-10}  # amount by which d of a pixel may exceed 1 through rounding
PER_LANDMARK = (8, 32, 160)  # sampled pixels: minimum, usual, maximum; the Jacobian is then within 35, 18 or 8 %
EXPLORED = 8192  # maximum number of pixels for the initial guess
SHARE = 8  # one in this many pixels is sampled, within these bounds
LARGE = 64  # at least one in this many pixels is sampled: larger images have rarer pixels
GUESSES = 3  # fixed-point steps of the initial guess; more do not help pixels outside its sample
REFINEMENTS = 3  # Newton steps on a sample; after two the Jacobian still changes
UNIFORM = 0.05  # fraction of the sample drawn uniformly; limits the weight of a pixel to 20 times the average
LARGEST = 2.0  # bound of d while t is approximate; solutions with a larger d are left to the damped method
MAX_SWEEPS = 12
ACCELERATOR_SWEEPS = 5  # reading the residual would stall the queue of an accelerator
FIRST_TOLERANCE = 1e-6  # tolerance of the float32 solution from which a float64 solution starts
RESAMPLED = 0.2  # a new sample is drawn after a sweep that reduces the error by less than a factor of five
MAX_STEPS = 50  # of the damped method; about ten are needed from any start
SMALL_STEP = 0.1  # relative change of d below which full steps converge quadratically
# Conjugate gradients: maximum number of steps, each of which gains a factor of at least 5.8, and the relative residual,
# below the rounding of the dtype, at which they stop.
STEPS = {torch.float32: 10, torch.float64: 24}
SOLVED = {torch.float32: 1e-7, torch.float64: 1e-16}
UNSOLVED = 1e-2  # relative residual after the last step that causes a warning


@dataclass(frozen=True)
class Balancing:
    """Result of balancing.

    Attributes:
        scaling: d, (B, N), positive.
        moment: t for this scaling, (B, M, 1) in float64, without a gradient.
        residual: largest deviation of a row sum from 1, (B,).
        steps: number of sweeps over the factor.
    """

    scaling: Tensor
    moment: Tensor
    residual: Tensor
    steps: int


@dataclass(frozen=True)
class Solution(Balancing):
    """Result of a balancing method, with the approximate inverse (B, M, M) of the Jacobian J, in float64."""

    inverse: Tensor


def scaling_from_moment(factor: Tensor, diagonal: Tensor, total: Tensor) -> Tensor:
    """Compute the scaling (B, N) of any pixels, given the moment ``factor @ d`` (B, M, 1) of a balanced image.

    The scaling is the positive root of ``d (u . total + diagonal d) = 1``, computed without cancellation for either
    sign of ``u . total``, which may be negative since approximate affinities may be.
    """
    return positive_root(spread((total / 2).mT, factor).squeeze(1), diagonal)


@dataclass(frozen=True, eq=False)
class KernelMatrix:
    """``K = U^T U + diag(c)`` over some points, never formed.

    Attributes:
        factor: U, (B, M, N).
        diagonal: c, (B, N).
        weights: number of identical pixels that each point represents, (B, N); None means one each.
        among: ranks that the points are distributed over.
    """

    factor: Tensor
    diagonal: Tensor
    weights: Tensor | None = None
    communicator: Communicator = ALONE

    def moment(self, values: Tensor) -> Tensor:
        """``U (weights * values)`` for values (B, N), summed over the ranks: (B, M, 1) in float64."""
        return self.communicator.sum(moment(self.factor, weighted(values, self.weights).unsqueeze(1)))

    def affinities(self, total: Tensor) -> Tensor:
        """``U^T total``, (B, N), for a vector of length M, (B, M, 1)."""
        return spread(total.to(self.factor).mT, self.factor).squeeze(1)

    def row_sums(self, scaling: Tensor, actual: Tensor) -> Tensor:
        """Row sums (B, N) of W for a scaling d with the moment ``actual``."""
        return scaling * (self.affinities(actual) + self.diagonal * scaling)

    def largest(self, values: Tensor) -> Tensor:
        """Largest magnitude of the values (B, N) of each image, (B,); infinite if one of the values is NaN."""
        return self.communicator.max(values.abs().amax(1).nan_to_num(nan=torch.inf))


def isolated(scaling: Tensor, diagonal: Tensor, residual: float, weights: Tensor | None = None) -> Tensor:
    """Find pixels (B, n) whose affinities to all others sum to less than zero, for a kernel with a unit diagonal.

    The diagonal entry of W is d^2 and the other entries of the row sum to 1 - d^2, so d exceeds 1 at these pixels. It
    must exceed 1 by more than ``residual``, the error of row sums. A point that represents only a share w of a pixel
    has ``d^2 (c + w (1 - c))`` in place of d^2.
    """
    if weights is not None:
        scaling = scaling * (diagonal + weights.clamp(max=1.0) * (1 - diagonal)).clamp(min=0.0).sqrt()
    return scaling > 1 + max(EXCESS[scaling.dtype], residual)


@dataclass(frozen=True, eq=False)
class PixelScaling:
    """The scaling of any pixel as a function of the pixel's own column.

    Attributes:
        moment: t, (B, M, 1).
        completed: whether the kernel has a unit diagonal.
        residual: largest deviation of a row sum from 1.
        before: moments of earlier rounds of balancing, after each of which isolated pixels were removed.
        least: smallest weight of the points that the moment is a sum over, (B, 1); None means one.
    """

    moment: Tensor
    completed: bool
    residual: float = 0.0
    before: tuple[Tensor, ...] = ()
    least: Tensor | None = None

    def __call__(self, factor: Tensor, diagonal: Tensor) -> tuple[Tensor, Tensor]:
        """Compute d and r, the diagonal part of W, (B, n), of pixels with factor (B, M, n) and diagonal (B, n).

        An isolated pixel has d = 0 and r = 1.
        """
        scaling = scaling_from_moment(factor, diagonal, self.moment.to(factor))
        remainder = scaling * (scaling * diagonal)  # in this order: without completion d^2 may overflow
        if not self.completed:
            return scaling, remainder
        alone = isolated(scaling, diagonal, self.residual, self.least)
        for total in self.before:
            earlier = scaling_from_moment(factor, diagonal, total.to(factor))
            alone = alone | isolated(earlier, diagonal, self.residual, self.least)
        return torch.where(alone, 0.0, scaling), torch.where(alone, 1.0, remainder)


class JacobianSample(KernelMatrix):
    """A weighted sample of the pixels for computing the Jacobian; each rank samples its own rows."""

    def scaling(self, total: Tensor) -> Tensor:
        """Scaling d (B, n) of the sampled pixels, given t (B, M, 1) in float64."""
        return scaling_from_moment(self.factor, self.diagonal, total.to(self.factor)).clamp_(max=LARGEST)

    def moment(self, values: Tensor) -> Tensor:
        """Estimate of ``factor @ values``, (B, M, 1), summed in the precision of the factor."""
        return self.communicator.sum(gather(weighted(values, self.weights).unsqueeze(1), self.factor).mT.double())

    def jacobian(self, scaling: Tensor) -> Tensor:
        """J, (B, M, M) in float64."""
        slope = scaling.square()
        slope = weighted(slope, self.weights) / (1 + self.diagonal * slope)
        total = self.communicator.sum(gram(self.factor, slope))
        return total.double() + torch.eye(total.shape[1], dtype=torch.float64, device=total.device)

    def residual(self, total: Tensor, actual: Tensor) -> Tensor:
        """Largest deviation of a row sum of the sample from 1, (B,), if d(total) has the moment ``actual``."""
        # As d is the root for the given total, row sums are 1 - d u . (total - actual).
        deficit = spread((total - actual).to(self.factor).mT, self.factor, self.scaling(total))
        return self.communicator.max(deficit.abs().amax((1, 2)))


def _draw(matrix: KernelMatrix, scaling: Tensor, count: int) -> tuple[JacobianSample, Tensor]:
    """Draw a systematic sample in proportion to leverage scores; also return its part of ``scaling``, (B, n)."""
    factor, diagonal, weights, communicator = matrix.factor, matrix.diagonal, matrix.weights, matrix.communicator
    if 2 * count >= factor.shape[2]:
        return JacobianSample(factor, diagonal, weights, communicator), scaling
    slope = scaling.square()
    leverage = weighted(slope * (1 - diagonal) / (1 + slope * diagonal), weights)  # |u|^2 is 1 - c
    leverage = leverage + leverage.mean(1, keepdim=True) * UNIFORM + torch.finfo(leverage.dtype).tiny
    summed = leverage.double().cumsum(1)
    ticks = (torch.arange(count, dtype=torch.float64, device=factor.device) + 0.5) / count
    chosen = torch.searchsorted(summed, summed[:, -1:] * ticks).clamp_(max=factor.shape[2] - 1)  # (B, n)
    weight = (summed[:, -1:] / count).to(factor) / leverage.gather(1, chosen)
    weight = weight if weights is None else weight * weights.gather(1, chosen)
    columns = factor.gather(2, chosen.unsqueeze(1).expand(-1, factor.shape[1], -1))
    return JacobianSample(columns, diagonal.gather(1, chosen), weight, communicator), scaling.gather(1, chosen)


def _guess(matrix: KernelMatrix) -> Tensor:
    """Initial guess of t (B, M, 1), from a few thousand pixels distributed evenly over the image."""
    factor, diagonal = matrix.factor, matrix.diagonal
    sample = JacobianSample(factor, diagonal, matrix.weights, matrix.communicator)
    pixels = factor.shape[2]
    count = min(max(pixels // SHARE, 16 * factor.shape[1]), EXPLORED)
    if 2 * count < pixels:
        # One random pixel from each interval: a fixed stride could coincide with the period of a texture.
        chosen = stratified(pixels, count, torch.Generator().manual_seed(0)).to(factor.device).expand(len(factor), -1)
        counts = torch.ones_like(diagonal[:, :1]) * (pixels / count)
        if matrix.weights is not None:  # in proportion to the weights, so that no point of weight 0 is drawn
            summed = matrix.weights.double().cumsum(1)
            ticks = (chosen.double() + 0.5) / pixels * summed[:, -1:]
            chosen = torch.searchsorted(summed, ticks.contiguous()).clamp_(max=pixels - 1)
            counts = (summed[:, -1:] / count).to(factor)
        few = factor.gather(2, chosen.unsqueeze(1).expand(-1, factor.shape[1], -1))
        sample = JacobianSample(few, diagonal.gather(1, chosen), counts.expand(-1, count), matrix.communicator)
    sums = sample.affinities(sample.moment(torch.ones_like(sample.diagonal))) + sample.diagonal
    total = sample.moment(sums.clamp_(min=1.0).rsqrt_())  # no row of K sums to less than its unit diagonal
    for _ in range(GUESSES):
        total = (total + sample.moment(sample.scaling(total))) / 2
    return total


def _sweep(matrix: KernelMatrix, total: Tensor) -> tuple[Tensor, Tensor]:
    """Compute d(t) for all points, (B, N), and its moment (B, M, 1), in one read of the factor."""
    half = (total / 2).squeeze(2).to(matrix.factor)
    scaling, actual = sweep(matrix.factor, matrix.diagonal, half, LARGEST, matrix.weights)
    return scaling, matrix.communicator.sum(actual.unsqueeze(2))


def newton(matrix: KernelMatrix, tolerance: float) -> Solution:
    """Balance a kernel with a unit diagonal; on CPUs until the residual is at most ``tolerance`` or stalls.

    On an accelerator the number of sweeps is fixed, as reading a residual would stall its queue.
    """
    refined = matrix.factor.dtype == torch.float64 and not is_hidden(matrix.factor)
    return _refined(matrix, tolerance) if refined else _quasi_newton(matrix, tolerance)


def _quasi_newton(matrix: KernelMatrix, tolerance: float) -> Solution:
    """Newton's method with the Jacobian of a sample, corrected by BFGS updates from the sweeps over all pixels."""
    watched, ranks = not is_hidden(matrix.factor), matrix.communicator.size
    landmarks, pixels = matrix.factor.shape[1:]
    least, usual, most = (bound * landmarks // ranks for bound in PER_LANDMARK)
    count = max(min(pixels // SHARE, max(most, pixels // LARGE)), min(usual, EXPLORED // ranks), least)
    total = _guess(matrix)
    scaling, actual = _sweep(matrix, total)
    worst, slow, gain, inverse = 1.0, 0, 1.0, total.new_zeros(len(total), landmarks, landmarks)
    for sweeps in range(1, (MAX_SWEEPS if watched else ACCELERATOR_SWEEPS) + 1):
        before, error = total, total - actual
        resampled = gain > RESAMPLED if watched else sweeps < 3
        if resampled:
            sample, part = _draw(matrix, scaling, count)
            # The sample predicts how the moment changes with t. Its error at the current t, where the true moment is
            # known, is subtracted.
            bias = actual - sample.moment(part)
            total = actual
            for _ in range(REFINEMENTS):
                part = sample.scaling(total)
                # J is positive definite. Cholesky is safe with several threads; batched LU of MKL is not.
                lower = torch.linalg.cholesky_ex(sample.jacobian(part)).L
                total = total - torch.cholesky_solve(total - sample.moment(part) - bias, lower)
            inverse = torch.cholesky_inverse(lower)
        else:
            total = total - inverse @ error
        scaling, actual = _sweep(matrix, total)
        if not resampled:  # steps with a new sample are so long that the Jacobian changes along them
            inverse = _updated(inverse, total - before, total - actual - error)
        if not watched:
            continue
        previous, worst = worst, sample.residual(total, actual).max().item()
        gain = worst / previous
        slow = slow + 1 if not gain <= 0.5 else 0
        if worst <= tolerance or slow > 1:
            measured = _measure(matrix, scaling, total, actual)
            if slow > 1 or bool((measured[1] <= tolerance).all()):
                break
    else:
        measured = _measure(matrix, scaling, total, actual)
    return Solution(scaling, actual, measured[0], sweeps, inverse)


def _refined(matrix: KernelMatrix, tolerance: float) -> Solution:
    """Find a float64 solution by steps that are computed from a float32 copy of the factor, by the kernels in C."""
    weights = None if matrix.weights is None else matrix.weights.float()
    single = KernelMatrix(matrix.factor.float(), matrix.diagonal.float(), weights, matrix.communicator)
    rough = _quasi_newton(single, max(tolerance, FIRST_TOLERANCE))
    total, sweeps = rough.moment, rough.steps
    for _ in range(MAX_SWEEPS):
        scaling, actual = _sweep(matrix, total)
        sweeps += 1
        error, d = total - actual, scaling.float()
        deficit = spread(error.to(single.factor).mT, single.factor, d).squeeze(1)
        if bool((single.largest(deficit) <= tolerance / 2).all()):
            break
        weight = weighted(d.square() / (1 + d.square() * single.diagonal), weights)
        total = total - conjugate_gradients(single.factor, weight, error, rough.inverse, matrix.communicator)
    residual = matrix.largest(matrix.row_sums(scaling, actual) - 1)
    return Solution(scaling, actual, residual, sweeps, rough.inverse)


def _measure(matrix: KernelMatrix, scaling: Tensor, total: Tensor, actual: Tensor) -> tuple[Tensor, Tensor]:
    """Largest deviation of a row sum from 1, (B,): including rounding errors of d = d(total), and excluding them."""
    both = torch.cat([actual, total - actual], dim=2).to(matrix.factor)
    rows = spread(both.mT, matrix.factor)  # (B, 2, N): one read of the factor
    sums = scaling * (rows[:, 0] + matrix.diagonal * scaling)
    return matrix.largest(sums - 1), matrix.largest(scaling * rows[:, 1])


def _updated(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """BFGS update of the inverse (B, M, M); it then maps a ``change`` of ``t - factor @ d(t)`` to the ``step`` of t."""
    curvature = (step * change).sum(1, keepdim=True)  # positive, since the Jacobian is positive definite
    rho = torch.where(curvature > 0, 1 / curvature, torch.zeros_like(curvature))
    moved = inverse @ change
    scale = rho * (1 + rho * (change * moved).sum(1, keepdim=True))
    cross = rho * moved @ step.mT
    return inverse - cross - cross.mT + scale * step @ step.mT


def damped(matrix: KernelMatrix, start: Solution, goal: float) -> Solution:
    """Balance from any start until the residual is at most ``goal`` or stops decreasing.

    A balanced d is the unique minimum of ``d^T K d / 2 - sum log d``, which is convex because K is positive
    semi-definite, even if entries of K are negative. In an update of d by ``s d x``, the step x solves
    ``(I + W) x = 1 - W 1``, which reduces to M equations with the Jacobian J of all pixels. Along x the function is a
    quadratic plus a sum of logarithms, whose minimum is found without reading the factor again.
    """
    factor, weights, communicator = matrix.factor, matrix.weights, matrix.communicator
    tiny = torch.finfo(factor.dtype).tiny
    usable = start.scaling.isfinite() & (start.scaling > 0)
    scaling = torch.where(usable, start.scaling, torch.ones_like(start.scaling))
    best, slow = start, 0
    for steps in range(1, MAX_STEPS + 1):
        total = matrix.moment(scaling)
        deficit = 1 - matrix.row_sums(scaling, total)
        share = 1 / (1 + scaling * (scaling * matrix.diagonal))  # 1 / (1 + r)
        sums = communicator.sum(sum_grams(factor, scaling * weighted(share, weights).sqrt(), None, 1)[:, 0])
        lower = torch.linalg.cholesky_ex(sums + torch.eye(sums.shape[1], dtype=sums.dtype, device=sums.device)).L
        residual = matrix.largest(deficit)
        candidate = Solution(scaling, total, residual, start.steps + 3 * steps, torch.cholesky_inverse(lower))
        slow = 0 if bool((residual.max() < 0.5 * best.residual.max()).all()) else slow + 1
        if bool(residual.max() <= best.residual.max()):
            best = candidate
        right = matrix.moment(scaling * (share * deficit))
        affinity = spread(torch.cholesky_solve(right, lower).to(factor).mT, factor, scaling).squeeze(1)
        step = share * (deficit - affinity)
        small = bool(matrix.largest(step).max() < SMALL_STEP)
        if bool((residual <= goal).all()) or (small and slow > 2) or not bool(torch.isfinite(step).all()):
            break
        length = 1.0 if small else _line_search(step.double(), deficit.double(), communicator, weights)
        scaling = (scaling * (1 + length * step)).clamp(min=tiny).to(factor)
    return best


def _line_search(step: Tensor, deficit: Tensor, communicator: Communicator, weights: Tensor | None) -> Tensor:
    """Find s (B, 1) that minimises ``(1 + s x)^T W (1 + s x) / 2 - sum log(1 + s x)``, given x and 1 - W 1 (B, N)."""
    total = partial(_total, weights=weights, communicator=communicator)
    # W 1 = 1 - deficit and W x = deficit - x determine the quadratic.
    linear, square = total(step * (1 - deficit)), total(step * (deficit - step))
    longest = (
        communicator.max((-step).amax(1, keepdim=True)).clamp(min=1e-12).reciprocal()
    )  # here the first d reaches zero
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


def _total(values: Tensor, *, weights: Tensor | None, communicator: Communicator) -> Tensor:
    """Sum (B, 1) of values (B, N) over the pixels that the points represent."""
    return communicator.sum(weighted(values, weights).sum(1, keepdim=True))


def weighted_moment(factor: Tensor, weight: Tensor, communicator: Communicator, total: Tensor) -> Tensor:
    """``factor @ (weight * (factor^T total))``, (B, M, 1) in float64."""
    return communicator.sum(weigh(factor, weight, total.to(factor).squeeze(2)).unsqueeze(2))


def conjugate_gradients(
    factor: Tensor, weight: Tensor, right: Tensor, inverse: Tensor, communicator: Communicator
) -> Tensor:
    """Solve ``(I + factor diag(weight) factor^T) s = right`` for s, (B, M, 1) in float64.

    Preconditioned conjugate gradients, at most :data:`STEPS` of them: the eigenvalues of the matrix lie in [1, 2] where
    the kernel is balanced, so that each step gains a factor of at least 5.8 whatever the preconditioner. On CPUs the
    iteration ends when the residual reaches :data:`SOLVED`, and it warns if the steps leave more than :data:`UNSOLVED`,
    as they may where balancing failed. On accelerators all steps are taken, since reading a residual would stall the
    queue.
    """
    tiny = torch.finfo(torch.float64).tiny  # avoids 0 / 0: if the right side is zero, so is the solution
    solution, residual = torch.zeros_like(right), right
    preconditioned = inverse @ residual
    direction, size = preconditioned, (residual * preconditioned).sum(1, keepdim=True)
    goal = SOLVED[factor.dtype] ** 2 * size
    for _ in range(STEPS[factor.dtype]):
        image = direction + weighted_moment(factor, weight, communicator, direction)
        step = size / (direction * image).sum(1, keepdim=True).clamp(min=tiny)
        solution, residual = solution + step * direction, residual - step * image
        preconditioned = inverse @ residual
        before, size = size, (residual * preconditioned).sum(1, keepdim=True)
        if not is_hidden(factor) and bool((size <= goal).all()):
            break
        direction = preconditioned + size / before.clamp(min=tiny) * direction
    else:
        _warn_of_unsolved(size, goal * (UNSOLVED / SOLVED[factor.dtype]) ** 2)
    return solution


def _warn_of_unsolved(size: Tensor, allowed: Tensor) -> None:
    """Warn, on CPUs, if conjugate gradients left more than the allowed squared residual, (B, 1, 1)."""
    if not is_hidden(size) and not bool((size <= allowed).all()):
        warn(
            "balancing left a linear system unsolved, so that a gradient may be inexact; raise photometric_bandwidth "
            "or num_landmarks"
        )
