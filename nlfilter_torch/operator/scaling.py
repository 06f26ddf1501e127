"""The kernel K in blocks of columns, its scaling d as a function of one vector, and Newton's method for that vector.

K is never formed: sums over pixels are sums over blocks of columns, and over ranks. In memory all columns are one
block, a sample is a smaller one, and a picture that is read by rows has a block for every tile.

Given the moment ``t = sum_i w_i d_i u_i`` over all points, with weights w, a point's scaling satisfies
``d (u . t + c d) = 1``, a quadratic with one positive root d(t), which depends only on the point's own column u and
diagonal c. The M entries of t are thus the only unknowns. The Jacobian of ``t - sum_i w_i u_i d_i(t)`` is symmetric,

    J = I + sum_i w_i p_i u_i u_i^T,    p = d^2 / (1 + c d^2),

with a spectrum in [1, 2] at the solution. Summing J over all pixels costs as much as 14 sweeps over the factor, over a
sample almost nothing. Pixels are sampled in proportion to their leverage score ``p |u|^2``, because rare pixels, which
a uniform sample misses, converge last. On photographs of a megapixel each sweep then reduces the error by a factor of
10 to 100. Three things do not go without a method of their own:

- float64: steps by conjugate gradients on a float32 copy of the factor. With the sample's Jacobian and BFGS updates in
  their place, balancing took 20 to 55 % longer on five photographs of 400x400 pixels (10 and 20 grey levels).
- kernels whose approximate affinities are so negative that the scaling of a pixel exceeds :data:`LARGEST_ROOT`:
  :func:`damped` is Newton's method on d with an exact line search. It is slower, but always convergent, since any
  positive d is a start, while a t may leave a point without a root.
- kernels of the paper's method, whose scalings are large: :mod:`~nlfilter_torch.operator.sinkhorn`.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar, TypeVarTuple

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import stratified, weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.clusters import MULTIPLIED
from nlfilter_torch.core.kernels.library import ONE_THREAD_COLUMNS, by_rows, kernel, pointer, repeated, run_on_factor
from nlfilter_torch.core.kernels.tall_skinny import moment, positive_root, spread, sum_grams, sweep, weigh
from nlfilter_torch.core.torch_internals import cached_constants, is_hidden, register
from nlfilter_torch.core.warning import warn

EXCESS = {torch.float32: 1e-5, torch.float64: 1e-10}  # amount by which d of a pixel may exceed 1 through rounding
LARGEST_ROOT = 2.0  # bound of d while t is approximate; solutions with a larger d are left to the damped method
SAMPLED_PER_LANDMARK = (
    8,
    32,
    160,
)  # sampled pixels: minimum, usual, maximum; the Jacobian is then within 35, 18 or 8 %
EXPLORED = 8192  # maximum number of pixels for the initial guess
SHARE = 8  # one in this many pixels is sampled, within these bounds
LARGE = 64  # at least one in this many pixels is sampled: larger images have rarer pixels
GUESSES = 3  # fixed-point steps of the initial guess; more do not help pixels outside its sample
SAMPLE_STEPS = 3  # Newton steps on a sample; after two the Jacobian still changes
UNIFORM = 0.05  # fraction of the sample drawn uniformly; limits the weight of a pixel to 20 times the average
MAX_SWEEPS = 12
ACCELERATOR_SWEEPS = 5  # reading the residual would stall the queue of an accelerator
FIRST_TOLERANCE = 1e-6  # tolerance of the float32 solution from which a float64 solution starts
RESAMPLED = 0.2  # a new sample is drawn after a sweep that reduces the error by less than a factor of five
DAMPED_STEPS = 50  # of the damped method; about ten are needed from any start
SMALL_STEP = 0.1  # relative change of d below which full steps converge quadratically
# Conjugate gradients: maximum number of steps, each of which gains a factor of at least 5.8, and the relative residual,
# below the rounding of the dtype, at which they stop.
GRADIENT_STEPS = {torch.float32: 10, torch.float64: 24}
SOLVED = {torch.float32: 1e-7, torch.float64: 1e-16}
UNSOLVED = 1e-2  # relative residual after the last step that causes a warning

Block = TypeVar("Block", covariant=True)
Result = TypeVar("Result")
Rest = TypeVarTuple("Rest")


class Pass(Protocol[Block]):
    """A pass over blocks of columns, in memory or of a picture."""

    def __call__(self, function: Callable[[Block, *Rest], Result], /, *arguments: *Rest) -> Iterable[Result]:
        """Apply a function, which takes the arguments, too, to each block, and yield the results in order."""


def summed(parts: Iterable[tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    """Sums over blocks."""
    totals: tuple[Tensor, ...] | None = None
    for part in parts:
        totals = part if totals is None else tuple(map(torch.add, totals, part))
    assert totals is not None  # for mypy; an image has a pixel
    return totals


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
        communicator: ranks that the points are distributed over.
    """

    factor: Tensor
    diagonal: Tensor
    weights: Tensor | None = None
    communicator: Communicator = ALONE

    def whole(self, function: Callable[["KernelMatrix", *Rest], Result], *arguments: *Rest) -> Iterable[Result]:
        """A pass over all points, as one block."""
        return [function(self, *arguments)]

    def moment(self, values: Tensor) -> Tensor:
        """``U (weights * values)`` for values (B, N), summed over the ranks: (B, M, 1) in float64."""
        return self.communicator.sum(moment(self.factor, weighted(values, self.weights).unsqueeze(1)))

    def affinities(self, total: Tensor, scaling: Tensor | None = None) -> Tensor:
        """``diag(scaling) U^T total``, (B, N), for a vector of length M, (B, M, 1), and an optional scaling (B, N)."""
        return spread(total.to(self.factor).mT, self.factor, scaling).squeeze(1)

    def row_sums(self, scaling: Tensor, actual: Tensor) -> Tensor:
        """Row sums (B, N) of W for a scaling d with the moment ``actual``."""
        return scaling * (self.affinities(actual) + self.diagonal * scaling)

    def largest(self, values: Tensor) -> Tensor:
        """Largest magnitude of the values (B, N) of each image, (B,); infinite if one of the values is NaN."""
        return self.communicator.max(values.abs().amax(1).nan_to_num(nan=torch.inf))

    def sweep(self, total: Tensor, most: float = LARGEST_ROOT) -> tuple[Tensor, Tensor]:
        """The scaling d(t), (B, N), at most ``most``, and its moment (B, M, 1), in one read of the factor."""
        half = (total / 2).squeeze(2).to(self.factor)
        scaling, actual = sweep(self.factor, self.diagonal, half, most, self.weights)
        return scaling, self.communicator.sum(actual.unsqueeze(2))

    def total(self, values: Tensor) -> Tensor:
        """Sum (B, 1) of values (B, N) over the pixels that the points represent."""
        return self.communicator.sum(weighted(values, self.weights).sum(1, keepdim=True))

    def at(self, places: Tensor, weights: Tensor) -> "KernelMatrix":
        """A sample of the points, with the numbers (B, n) and their own weights; each rank samples its own rows."""
        columns = self.factor.gather(2, places.unsqueeze(1).expand(-1, self.factor.shape[1], -1))
        return KernelMatrix(columns, self.diagonal.gather(1, places), weights, self.communicator)

    def moment_and_slope(self, total: Tensor, most: float) -> tuple[Tensor, Tensor]:
        """The moment of d(t), (B, M, 1), and ``J - I``, (B, M, M), over the points; both in float64."""
        scaling, actual = self.sweep(total, most)
        remainder = scaling * (scaling * self.diagonal)
        root = scaling * weighted(1 / (1 + remainder), self.weights).sqrt()
        return actual, self.communicator.sum(sum_grams(self.factor, root, None, 1)[:, 0])


def newton(
    blocks: Pass[KernelMatrix],
    total: Tensor,
    *,
    steps: int,
    most: float = LARGEST_ROOT,
    bias: Tensor | float = 0.0,
    tolerance: float = 0.0,
) -> tuple[Tensor, Tensor, float]:
    """Newton's method for the moment t (B, M, 1) that equals the sum over the blocks at d(t) plus a ``bias``.

    With a bias, the blocks may be a sample: the sum over all points at some t, minus that over the sample. The error is
    then the error of the sample times that of the t at which the bias was taken.

    Args:
        blocks: the points.
        total: an initial guess of t.
        steps: their largest number.
        most: bound of d. Scalings would start large for points that the guess does not represent, and every step would
            only halve them.
        bias: added to the sums over the blocks.
        tolerance: relative length of a step at which to stop; the error after it is its square. 0 takes all steps, and
            reads no values.

    Returns:
        t, the inverse (B, M, M) of the Cholesky factor of J in the last step, and with a tolerance the relative length
        of that step.
    """
    identity, change = torch.eye(total.shape[1], dtype=total.dtype, device=total.device), math.inf
    for _ in range(steps):
        sums, slope = summed(blocks(KernelMatrix.moment_and_slope, total, most))
        lower = torch.linalg.cholesky_ex(identity + slope).L  # J is positive definite
        # Unlike cholesky_solve and cholesky_inverse, this reads no values.
        root = torch.linalg.solve_triangular(lower, identity.expand_as(lower), upper=False)
        step = root.mT @ (root @ (sums + bias - total))
        total = total + step
        if tolerance and (change := float(step.norm() / total.norm())) <= tolerance:
            break
    return total, root, change


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


@dataclass(frozen=True, eq=False)
class Balancing:
    """Result of balancing.

    Attributes:
        matrix: the kernel, without pixels that were removed because they are isolated.
        scaling: d, (B, N), positive.
        moment: t for this scaling, (B, M, 1) in float64, without a gradient.
        residual: largest deviation of a row sum from 1, (B,).
        steps: number of sweeps over the factor.
        inverse: approximate inverse (B, M, M) of the Jacobian J, in float64.
        before: moments of earlier rounds, after each of which isolated pixels were removed.
    """

    matrix: KernelMatrix
    scaling: Tensor
    moment: Tensor
    residual: Tensor
    steps: int
    inverse: Tensor
    before: tuple[Tensor, ...] = ()

    @cached_property
    def worst(self) -> float:
        """The largest residual of a batch; reads values."""
        return float(self.residual.max())


def _draw(matrix: KernelMatrix, scaling: Tensor, count: int) -> tuple[KernelMatrix, Tensor | None]:
    """Draw a systematic sample in proportion to leverage scores; also return the numbers (B, n) of its points.

    Of few points all are the sample, and there are no numbers.
    """
    factor, diagonal, weights = matrix.factor, matrix.diagonal, matrix.weights
    if 2 * count >= factor.shape[2]:
        return matrix, None
    slope = scaling.square()
    leverage = weighted(slope * (1 - diagonal) / (1 + slope * diagonal), weights)  # |u|^2 is 1 - c
    leverage = leverage + leverage.mean(1, keepdim=True) * UNIFORM + torch.finfo(leverage.dtype).tiny
    summed = leverage.double().cumsum(1)
    ends = 0.5 / count, 1 - 0.5 / count
    ticks = torch.linspace(*ends, count, dtype=torch.float64, device=factor.device)
    chosen = torch.searchsorted(summed, summed[:, -1:] * ticks).clamp_(max=factor.shape[2] - 1)  # (B, n)
    weight = (summed[:, -1:] / count).to(factor) / leverage.gather(1, chosen)
    weight = weight if weights is None else weight * weights.gather(1, chosen)
    return matrix.at(chosen, weight), chosen


def _explored_count(landmarks: int, pixels: int) -> int:
    """Number of points of the initial guess; 0 for all."""
    count = min(max(pixels // SHARE, 16 * landmarks), EXPLORED)
    return count if 2 * count < pixels else 0


@cached_constants
def _explored(pixels: int, count: int) -> Tensor:
    """Numbers (n,) of the points of the initial guess, or, of weighted points, of the places in the sum of weights.

    One random pixel from each interval: a fixed stride could coincide with the period of a texture.
    """
    return stratified(pixels, count, torch.Generator().manual_seed(0))


def _sampled_count(landmarks: int, pixels: int, ranks: int = 1) -> int:
    """Number of points on which Newton's method runs; all, if these are more than half of them."""
    least, usual, most = (bound * landmarks // ranks for bound in SAMPLED_PER_LANDMARK)
    return max(min(pixels // SHARE, max(most, pixels // LARGE)), min(usual, EXPLORED // ranks), least)


def _guess(matrix: KernelMatrix) -> Tensor:
    """Initial guess of t (B, M, 1), from a few thousand pixels distributed evenly over the image."""
    (batch, landmarks, pixels), sample = matrix.factor.shape, matrix
    if count := _explored_count(landmarks, pixels):
        chosen = _explored(pixels, count).to(matrix.factor.device).expand(batch, -1)
        counts = torch.full_like(matrix.diagonal[:, :1], pixels / count)
        if matrix.weights is not None:  # in proportion to the weights, so that no point of weight 0 is drawn
            summed = matrix.weights.double().cumsum(1)
            ticks = (chosen.double() + 0.5) / pixels * summed[:, -1:]
            chosen = torch.searchsorted(summed, ticks.contiguous()).clamp_(max=pixels - 1)
            counts = (summed[:, -1:] / count).to(matrix.factor)
        sample = matrix.at(chosen, counts.expand(-1, count))
    sums = sample.affinities(sample.moment(torch.ones_like(sample.diagonal))) + sample.diagonal
    total = sample.moment(sums.clamp_(min=1.0).rsqrt_())  # no row of K sums to less than its unit diagonal
    for _ in range(GUESSES):
        total = (total + sample.sweep(total)[1]) / 2
    return total


def sampled_newton(matrix: KernelMatrix, tolerance: float) -> Balancing:
    """Balance a kernel with a unit diagonal; on CPUs until the residual is at most ``tolerance`` or stalls.

    Newton's method with the Jacobian of a sample, corrected by BFGS updates from the sweeps over all pixels. On an
    accelerator the number of sweeps is fixed, as reading a residual would stall its queue.
    """
    hidden = is_hidden(matrix.factor)
    if matrix.factor.dtype == torch.float64 and not hidden:
        return _refined(matrix, tolerance)
    if matrix.communicator.size > 1:
        return _by_sweeps(matrix, tolerance)
    *found, sweeps = balance_kernel(matrix.factor, matrix.diagonal, matrix.weights, tolerance)
    scaling, actual, residual, inverse = found
    return Balancing(matrix, scaling, actual, residual, ACCELERATOR_SWEEPS if hidden else int(sweeps.max()), inverse)


def _compiled_balance(
    factor: Tensor, diagonal: Tensor, weights: Tensor | None, tolerance: float
) -> tuple[Tensor, ...] | None:
    batch, landmarks, pixels = factor.shape
    if landmarks > MULTIPLIED:
        return None
    factor, found = by_rows(factor), _fake_balance(factor)
    diagonal = repeated(diagonal, batch, pixels)
    weights = None if weights is None else repeated(weights, batch, pixels)
    count, sampled = _explored_count(landmarks, pixels), _sampled_count(landmarks, pixels)
    explored = _explored(pixels, count) if count else None
    arguments = diagonal.data_ptr(), pointer(weights), pointer(explored), count, sampled, tolerance
    run_on_factor("balance", factor, *arguments, *(tensor.data_ptr() for tensor in found), least=ONE_THREAD_COLUMNS)
    return found


def _fake_balance(factor: Tensor, *others: object) -> tuple[Tensor, ...]:
    batch, landmarks, _ = factor.shape
    moment, inverse = (factor.new_empty(batch, landmarks, n, dtype=torch.float64) for n in (1, landmarks))
    sweeps = factor.new_empty(batch, dtype=torch.long)
    return factor.new_empty(batch, factor.shape[2]), moment, factor.new_empty(batch), inverse, sweeps


@register(
    "balance_kernel(Tensor factor, Tensor diagonal, Tensor? weights, float tolerance) "
    "-> (Tensor, Tensor, Tensor, Tensor, Tensor)",
    kernel(_compiled_balance),
    _fake_balance,
)
def balance_kernel(factor: Tensor, diagonal: Tensor, weights: Tensor | None, tolerance: float) -> tuple[Tensor, ...]:
    """Scaling (B, N), moment (B, M, 1), residual (B,), inverse (B, M, M) and number of sweeps (B,) of a balancing.

    By :func:`sampled_newton`; images of a batch end together here, and by themselves in C.
    """
    found = _by_sweeps(KernelMatrix(factor, diagonal, weights), tolerance)
    sweeps = torch.full_like(found.residual, found.steps, dtype=torch.long)
    return found.scaling, found.moment, found.residual, found.inverse, sweeps


def _by_sweeps(matrix: KernelMatrix, tolerance: float) -> Balancing:
    """The definition of :func:`sampled_newton`, also over ranks."""
    watched, ranks = not is_hidden(matrix.factor), matrix.communicator.size
    landmarks, pixels = matrix.factor.shape[1:]
    count = _sampled_count(landmarks, pixels, ranks)
    total = _guess(matrix)
    scaling, actual = matrix.sweep(total)
    worst, slow, gain, inverse = 1.0, 0, 1.0, total.new_zeros(len(total), landmarks, landmarks)
    for sweeps in range(1, (MAX_SWEEPS if watched else ACCELERATOR_SWEEPS) + 1):
        before, error = total, total - actual
        resampled = gain > RESAMPLED if watched else sweeps < 3
        if resampled:
            sample, places = _draw(matrix, scaling, count)
            # The sample predicts how the moment changes with t. Its error at the current t, where the true moment is
            # known, is subtracted; a sample of all points has none. Ranks differ in whether they sample.
            part = scaling if places is None else scaling.gather(1, places)
            bias = 0.0 if places is None and ranks == 1 else actual - sample.moment(part)
            total, root, _ = newton(sample.whole, actual, steps=SAMPLE_STEPS, bias=bias)
            inverse = root.mT @ root
        else:
            total = total - inverse @ error
        scaling, actual = matrix.sweep(total)
        if not resampled:  # steps with a new sample are so long that the Jacobian changes along them
            inverse = _updated(inverse, total - before, total - actual - error)
        if not watched:
            continue
        # As d is the root for the given total, row sums are 1 - d u . (total - actual).
        part = scaling if places is None else scaling.gather(1, places)
        previous, worst = worst, float(sample.largest(sample.affinities(total - actual, part)).max())
        gain = worst / previous
        slow = slow + 1 if not gain <= 0.5 else 0
        if worst <= tolerance or slow > 1:
            measured = _measure(matrix, scaling, total, actual)
            if slow > 1 or bool((measured[1] <= tolerance).all()):
                break
    else:
        measured = _measure(matrix, scaling, total, actual)
    return Balancing(matrix, scaling, actual, measured[0], sweeps, inverse)


def _refined(matrix: KernelMatrix, tolerance: float) -> Balancing:
    """Find a float64 solution by steps that are computed from a float32 copy of the factor, by the kernels in C."""
    weights = None if matrix.weights is None else matrix.weights.float()
    single = KernelMatrix(matrix.factor.float(), matrix.diagonal.float(), weights, matrix.communicator)
    rough = sampled_newton(single, max(tolerance, FIRST_TOLERANCE))
    total, sweeps = rough.moment, rough.steps
    for _ in range(MAX_SWEEPS):
        scaling, actual = matrix.sweep(total)
        sweeps += 1
        error, d = total - actual, scaling.float()
        if bool((single.largest(single.affinities(error, d)) <= tolerance / 2).all()):
            break
        weight = weighted(d.square() / (1 + d.square() * single.diagonal), weights)
        total = total - conjugate_gradients(single, weight, error, rough.inverse)
    residual = matrix.largest(matrix.row_sums(scaling, actual) - 1)
    return Balancing(matrix, scaling, actual, residual, sweeps, rough.inverse)


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


def damped(matrix: KernelMatrix, start: Balancing, goal: float) -> Balancing:
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
    for steps in range(1, DAMPED_STEPS + 1):
        total = matrix.moment(scaling)
        deficit = 1 - matrix.row_sums(scaling, total)
        share = 1 / (1 + scaling * (scaling * matrix.diagonal))  # 1 / (1 + r)
        sums = communicator.sum(sum_grams(factor, scaling * weighted(share, weights).sqrt(), None, 1)[:, 0])
        lower = torch.linalg.cholesky_ex(sums + torch.eye(sums.shape[1], dtype=sums.dtype, device=sums.device)).L
        residual = matrix.largest(deficit)
        candidate = Balancing(matrix, scaling, total, residual, start.steps + 3 * steps, torch.cholesky_inverse(lower))
        slow = 0 if bool((residual.max() < 0.5 * best.residual.max()).all()) else slow + 1
        if bool(residual.max() <= best.residual.max()):
            best = candidate
        right = matrix.moment(scaling * (share * deficit))
        step = share * (deficit - matrix.affinities(torch.cholesky_solve(right, lower), scaling))
        small = bool(matrix.largest(step).max() < SMALL_STEP)
        if bool((residual <= goal).all()) or (small and slow > 2) or not bool(torch.isfinite(step).all()):
            break
        length = 1.0 if small else _line_search(matrix, step.double(), deficit.double())
        scaling = (scaling * (1 + length * step)).clamp(min=tiny).to(factor)
    return best


def _line_search(matrix: KernelMatrix, step: Tensor, deficit: Tensor) -> Tensor:
    """Find s (B, 1) that minimises ``(1 + s x)^T W (1 + s x) / 2 - sum log(1 + s x)``, given x and 1 - W 1 (B, N)."""
    total = matrix.total
    # W 1 = 1 - deficit and W x = deficit - x determine the quadratic.
    linear, square = total(step * (1 - deficit)), total(step * (deficit - step))
    # Here the first d reaches zero.
    longest = matrix.communicator.max((-step).amax(1, keepdim=True)).clamp(min=1e-12).reciprocal()
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


def conjugate_gradients(matrix: KernelMatrix, weight: Tensor, right: Tensor, inverse: Tensor) -> Tensor:
    """Solve ``(I + U diag(weight) U^T) s = right`` for s, (B, M, 1) in float64, with the factor U of a kernel.

    Preconditioned conjugate gradients, at most :data:`GRADIENT_STEPS` of them: the eigenvalues of the matrix lie in
    [1, 2] where the kernel is balanced, so that each step gains a factor of at least 5.8 whatever the preconditioner.
    On CPUs the iteration ends when the residual reaches :data:`SOLVED`, and it warns if more than :data:`UNSOLVED` is
    left, as it may be where balancing failed. On accelerators all steps are taken, since reading a residual would stall
    the queue.
    """
    if matrix.communicator.size > 1:
        solution, left = _by_directions(matrix, weight, right, inverse)
    else:
        solution, left = conjugate(matrix.factor, weight, right, inverse)
    if not is_hidden(left) and not bool((left <= UNSOLVED**2).all()):
        warn(
            "balancing left a linear system unsolved, so that a gradient may be inexact; raise photometric_bandwidth "
            "or num_landmarks"
        )
    return solution


def _compiled_conjugate(factor: Tensor, weight: Tensor, right: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    factor, (batch, landmarks, pixels) = by_rows(factor), factor.shape
    solution, left = right.new_empty(batch, landmarks, 1), right.new_empty(batch)
    vectors = repeated(weight, batch, pixels), right.contiguous(), inverse.contiguous()
    bounds = GRADIENT_STEPS[factor.dtype], SOLVED[factor.dtype]
    pointers = [tensor.data_ptr() for tensor in (*vectors, solution, left)]
    run_on_factor("conjugate", factor, *pointers[:3], *bounds, *pointers[3:])
    return solution, left


@register(
    "conjugate(Tensor factor, Tensor weight, Tensor right, Tensor inverse) -> (Tensor, Tensor)",
    kernel(_compiled_conjugate, sums=2),
    lambda factor, weight, right, inverse: (torch.empty_like(right), right.new_empty(right.shape[0])),
)
def conjugate(factor: Tensor, weight: Tensor, right: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """The solution of :func:`conjugate_gradients`, and what is left (B,) of the squared residual, relative."""
    return _by_directions(KernelMatrix(factor, weight), weight, right, inverse)


def _by_directions(matrix: KernelMatrix, weight: Tensor, right: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """The definition of :func:`conjugate`, also over ranks."""
    factor, communicator = matrix.factor, matrix.communicator
    tiny = torch.finfo(torch.float64).tiny  # avoids 0 / 0: if the right side is zero, so is the solution
    solution, residual = torch.zeros_like(right), right
    preconditioned = inverse @ residual
    direction, size = preconditioned, (residual * preconditioned).sum(1, keepdim=True)
    first = size
    for _ in range(GRADIENT_STEPS[factor.dtype]):
        image = direction + communicator.sum(weigh(factor, weight, direction.to(factor).squeeze(2)).unsqueeze(2))
        step = size / (direction * image).sum(1, keepdim=True).clamp(min=tiny)
        solution, residual = solution + step * direction, residual - step * image
        preconditioned = inverse @ residual
        before, size = size, (residual * preconditioned).sum(1, keepdim=True)
        if not is_hidden(factor) and bool((size <= SOLVED[factor.dtype] ** 2 * first).all()):
            break
        direction = preconditioned + size / before.clamp(min=tiny) * direction
    return solution, (size / first.clamp(min=tiny)).flatten()
