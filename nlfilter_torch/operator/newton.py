"""Balancing by Newton's method on the moment ``t = factor @ d``, with the Jacobian of a sample of the pixels.

Given t, a pixel's equation ``d (u . t + c d) = 1`` is a quadratic with one positive root d(t), so M numbers are all
that is unknown: ``t = sum_i u_i d_i(t)``. The Jacobian of ``t - sum_i u_i d_i(t)`` is symmetric,

    J = I + sum_i w_i u_i u_i^T,    w = d^2 / (1 + c d^2),

with its spectrum in [1, 2] at the solution. It costs as much as 14 sweeps over the factor, its sum over a sample next
to nothing. Pixels enter the sample in proportion to ``w |u|^2``, their leverage, so that the rare ones, which a uniform
sample misses and which converge last, are in it: on photographs of a megapixel each sweep then gains a factor of 10 to
100, where Chebyshev's iteration gains 5.8.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.grams import gram, sum_grams
from nlfilter_torch.core.kernels.sweeps import positive_root, sweep, weigh
from nlfilter_torch.core.kernels.tall_skinny import gather, moment, spread
from nlfilter_torch.operator.landmarks import stratified

PER_LANDMARK = (8, 32, 160)  # pixels of the sample: its Jacobian is then within 35, 18 or 8 % of the true one
EXPLORED = 8192  # pixels that the first guess comes from, at most
SHARE = 8  # the part of the pixels that either is, between these bounds
LARGE = 64  # the part that the sample is at least: larger images have rarer pixels
GUESSES = 3  # steps of the first guess towards its fixed point; more gain nothing for pixels outside its sample
REFINEMENTS = 3  # steps of Newton's method on the sample; after two the Jacobian still changes
UNIFORM = 0.05  # of the sample is drawn uniformly, so that no pixel of it stands for more than 20 times its share
EXCESS = {torch.float32: 1e-5, torch.float64: 1e-10}  # by which rounding may take the d of a pixel above 1
LARGEST = 2.0  # bounds d while t is a guess; a larger one is left to the damped method
MAX_SWEEPS = 12
ACCELERATOR_SWEEPS = 5  # reading the residual would stall the queue of an accelerator
ROUGHLY = 1e-6  # residual of a first solution in float32
ROUGH = 0.2  # a sweep that gains less than a factor of five asks for another sample
# Conjugate gradients gain a factor 5.8 a step or more: so many steps, or a residual below the rounding of the dtype.
SOLVE_STEPS = {torch.float32: 10, torch.float64: 24}
SOLVED = {torch.float32: 1e-7, torch.float64: 1e-16}
MAX_STEPS = 50  # of the damped method, which needs about ten from any start
SMALL_STEP = 0.1  # relative change of d below which full steps converge quadratically


def scaling_from_moment(factor: Tensor, diagonal: Tensor, total: Tensor) -> Tensor:
    """The scaling (B, N) of any pixels, given the moment ``factor @ d`` (B, M, 1) of a balanced image.

    A pixel's equation is ``d (u . total + diagonal d) = 1``. Its positive root is formed without cancellation whichever
    sign ``u . total`` has; approximate affinities may be negative.
    """
    return positive_root(spread((total / 2).mT, factor).squeeze(1), diagonal)


def isolated(scaling: Tensor, residual: float) -> Tensor:
    """Pixels (B, n) whose affinities to all others sum to less than zero, given the d of a kernel with a unit diagonal.

    Their row of W reads ``d^2 + (the others) = 1``, so that d^2, itself an entry on the diagonal of W, exceeds 1, by
    more than row sums that are off by ``residual`` do.
    """
    return scaling > 1 + max(EXCESS[scaling.dtype], residual)


@dataclass(frozen=True, eq=False)
class PixelScaling:
    """What the scaling of any pixel of a balanced image is a function of, beside the pixel's own column.

    Attributes:
        moment: t, (B, M, 1).
        completed: the kernel has a unit diagonal.
        residual: largest deviation of a row sum from 1.
        before: moments that found pixels to be isolated, before these were taken out.
    """

    moment: Tensor
    completed: bool
    residual: float = 0.0
    before: tuple[Tensor, ...] = ()

    def __call__(self, factor: Tensor, diagonal: Tensor) -> tuple[Tensor, Tensor]:
        """Scaling d and diagonal part r of W, (B, n), of pixels with columns (B, M, n) and (B, n).

        A pixel that is isolated has d = 0 and r = 1.
        """
        scaling = scaling_from_moment(factor, diagonal, self.moment.to(factor))
        remainder = scaling * (scaling * diagonal)  # in this order: without completion d^2 may overflow
        if not self.completed:
            return scaling, remainder
        alone = isolated(scaling, self.residual)
        for total in self.before:
            alone = alone | isolated(scaling_from_moment(factor, diagonal, total.to(factor)), self.residual)
        return torch.where(alone, 0.0, scaling), torch.where(alone, 1.0, remainder)


@dataclass(frozen=True)
class Sample:
    """Pixels that stand for the image.

    Attributes:
        factor: their columns, (B, M, n).
        diagonal: (B, n).
        weight: how many pixels each stands for, (B, n).
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


def weighted(values: Tensor, weights: Tensor | None) -> Tensor:
    """Values (B, ..., N) times how many pixels each point stands for, (B, N); None is one each."""
    if weights is None:
        return values
    return values * weights.view(weights.shape[0], *[1] * (values.ndim - 2), -1).to(values)


def root_mass(scaling: Tensor, weights: Tensor | None) -> Tensor:
    """``d sqrt(w)``, (B, N): the scaling of the symmetric operator with the eigenvalues of W."""
    return scaling if weights is None else scaling * weights.sqrt()


def row_sums(factor: Tensor, diagonal: Tensor, scaling: Tensor, found: Tensor) -> Tensor:
    """Row sums (B, N) of W for any scaling d whose moment ``factor @ d`` is ``found``."""
    return scaling * (spread(found.to(factor).mT, factor).squeeze(1) + diagonal * scaling)


def _draw(
    factor: Tensor, diagonal: Tensor, scaling: Tensor, count: int, among: Communicator, weights: Tensor | None
) -> tuple[Sample, Tensor]:
    """A systematic sample in proportion to leverage, and its part of ``scaling``, (B, n)."""
    if 2 * count >= factor.shape[2]:
        return Sample(factor, diagonal, weighted(torch.ones_like(diagonal), weights), among), scaling
    slope = scaling.square()
    leverage = weighted(slope * (1 - diagonal) / (1 + slope * diagonal), weights)  # |u|^2 is 1 - c
    leverage = leverage + leverage.mean(1, keepdim=True) * UNIFORM + torch.finfo(leverage.dtype).tiny
    summed = leverage.double().cumsum(1)
    ticks = (torch.arange(count, dtype=torch.float64, device=factor.device) + 0.5) / count
    chosen = torch.searchsorted(summed, summed[:, -1:] * ticks).clamp_(max=factor.shape[2] - 1)  # (B, n)
    weight = (summed[:, -1:] / count).to(factor) / leverage.gather(1, chosen)
    weight = weight if weights is None else weight * weights.gather(1, chosen)
    columns = factor.gather(2, chosen.unsqueeze(1).expand(-1, factor.shape[1], -1))
    return Sample(columns, diagonal.gather(1, chosen), weight, among), scaling.gather(1, chosen)


def _guess(factor: Tensor, diagonal: Tensor, among: Communicator, weights: Tensor | None) -> Tensor:
    """A first t (B, M, 1), from a few thousand pixels that are spread evenly over the image."""
    pixels = factor.shape[2]
    few, rest, each = factor, diagonal, weighted(torch.ones_like(diagonal), weights)
    count = min(max(pixels // SHARE, 16 * factor.shape[1]), EXPLORED)
    if 2 * count < pixels:
        # One at random from every stretch: a fixed stride would meet the periods of a texture.
        chosen = stratified(pixels, count, torch.Generator().manual_seed(0)).to(factor.device)
        few, rest = factor.gather(2, chosen.expand(*factor.shape[:2], -1)), diagonal[:, chosen]
        each = each[:, chosen] * (each.sum(1, keepdim=True) / each[:, chosen].sum(1, keepdim=True))
    sample = Sample(few, rest, each, among)
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


@dataclass(frozen=True)
class Solution:
    """Result of balancing.

    Attributes:
        scaling: d, (B, N), positive.
        moment: ``factor @ d``, (B, M, 1) in float64.
        residual: largest deviation of a row sum of this very scaling from 1, (B,).
        sweeps: over the factor.
        inverse: of J, to a few per cent, (B, M, M) in float64.
    """

    scaling: Tensor
    moment: Tensor
    residual: Tensor
    sweeps: int
    inverse: Tensor


def solve(
    factor: Tensor, diagonal: Tensor, tolerance: float, among: Communicator = ALONE, weights: Tensor | None = None
) -> Solution:
    """Balance a kernel with a unit diagonal, quickly where sweeps converge and by damped steps where they do not.

    On a processor the result has a residual of at most ``tolerance`` or of rounding, unless no scaling balances the
    kernel. On an accelerator a fixed number of sweeps is taken, as reading a residual would stall its queue.
    """
    solver = _refined if factor.dtype == torch.float64 and factor.device.type == "cpu" else _quasi_newton
    found = solver(factor, diagonal, tolerance, among, weights)
    if factor.device.type != "cpu" or bool((found.residual <= accepted(factor, tolerance, among)).all()):
        return found
    return damped(factor, diagonal, found, tolerance, among, weights)


def accepted(factor: Tensor, tolerance: float, among: Communicator) -> float:
    """The residual that balancing aims at: the tolerance, or what rounding leaves of it in a large image."""
    pixels = among.pixels(factor.shape[2])
    # |u . t| is formed from terms of up to |u| |t|, and |t|^2 is at most the number of pixels.
    return max(tolerance, 0.5 * torch.finfo(factor.dtype).eps * pixels**0.5)


def _quasi_newton(
    factor: Tensor, diagonal: Tensor, tolerance: float, among: Communicator, weights: Tensor | None
) -> Solution:
    """Newton's method with the Jacobian of a sample, updated by what the sweeps show of the true one (BFGS)."""
    watched = factor.device.type == "cpu"
    marks, pixels = factor.shape[1:]
    least, usual, most = (bound * marks // among.size for bound in PER_LANDMARK)
    count = max(min(pixels // SHARE, max(most, pixels // LARGE)), min(usual, EXPLORED // among.size), least)
    total = _guess(factor, diagonal, among, weights)
    scaling, found = _sweep(factor, diagonal, total, among, weights)
    worst, slow, gain, inverse = 1.0, 0, 1.0, total.new_zeros(len(total), marks, marks)
    for sweeps in range(1, (MAX_SWEEPS if watched else ACCELERATOR_SWEEPS) + 1):
        before, error = total, total - found
        if gain > ROUGH if watched else sweeps < 3:
            sample, part = _draw(factor, diagonal, scaling, count, among, weights)
            # The sample foretells how the moment changes with t; its value here is known, so is the sample's error.
            bias = found - sample.moment(part)
            total = found
            for _ in range(REFINEMENTS):
                part = sample.scaling(total)
                # J is positive definite; its Cholesky factor, unlike batched LU in MKL, withstands several threads.
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
    """A solution in float64, by steps worked out from the factor in float32, for which there are kernels in C."""
    single, each = factor.float(), None if weights is None else weights.float()
    rough = _quasi_newton(single, diagonal.float(), max(tolerance, ROUGHLY), among, each)
    total, sweeps = rough.moment, rough.sweeps
    for _ in range(MAX_SWEEPS):
        scaling, found = _sweep(factor, diagonal, total, among, weights)
        sweeps += 1
        error, d = total - found, scaling.float()
        if bool((_largest(spread(error.to(single).mT, single, d).squeeze(1), among) <= tolerance / 2).all()):
            break
        weight = weighted(d.square() / (1 + d.square() * diagonal.float()), each)
        total = total - conjugate_gradients(single, weight, error, rough.inverse, among)
    residual = _largest(row_sums(factor, diagonal, scaling, found) - 1, among)
    return Solution(scaling, found, residual, sweeps, rough.inverse)


def _measure(
    factor: Tensor, diagonal: Tensor, scaling: Tensor, total: Tensor, found: Tensor, among: Communicator
) -> tuple[Tensor, Tensor]:
    """Largest deviation of a row sum from 1, (B,): as measured, and as d = d(total) would have it without rounding."""
    rows = spread(torch.cat([found, total - found], dim=2).to(factor).mT, factor)  # (B, 2, N): one read of the factor
    sums = scaling * (rows[:, 0] + diagonal * scaling)
    return _largest(sums - 1, among), _largest(scaling * rows[:, 1], among)


def _updated(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """BFGS: an inverse (B, M, M) that takes the change of ``t - factor @ d(t)`` (B, M, 1) to the step in t."""
    curvature = (step * change).sum(1, keepdim=True)  # positive, as the Jacobian is
    rho = torch.where(curvature > 0, 1 / curvature, torch.zeros_like(curvature))
    moved = inverse @ change
    scale = rho * (1 + rho * (change * moved).sum(1, keepdim=True))
    cross = rho * moved @ step.mT
    return inverse - cross - cross.mT + scale * step @ step.mT


def _largest(values: Tensor, among: Communicator) -> Tensor:
    """Largest magnitude among values (B, N), (B,); infinite where one is not finite."""
    return among.max(values.abs().nan_to_num(nan=torch.inf).amax(1))


def damped(
    factor: Tensor,
    diagonal: Tensor,
    start: Solution,
    tolerance: float,
    among: Communicator = ALONE,
    weights: Tensor | None = None,
) -> Solution:
    """Balance by Newton's method on d itself, with an exact line search: it converges from any start.

    A balanced d is the one minimum of ``d^T K d / 2 - sum log d``, which is convex as K is positive semi-definite,
    whatever the signs of its entries. With d changing by ``s d x`` the step x solves ``(I + W) x = 1 - W 1``, a system
    of M equations with the Jacobian J of all pixels. Along x the function is a quadratic and a sum of logarithms, whose
    minimum takes no further read of the factor.
    """
    tiny = torch.finfo(factor.dtype).tiny
    usable = start.scaling.isfinite() & (start.scaling > 0)
    scaling = torch.where(usable, start.scaling, torch.ones_like(start.scaling))
    goal, best, slow = accepted(factor, tolerance, among), start, 0
    for steps in range(1, MAX_STEPS + 1):
        total = among.sum(moment(factor, weighted(scaling, weights).unsqueeze(1)))
        lacking = 1 - row_sums(factor, diagonal, scaling, total)
        share = 1 / (1 + scaling * (scaling * diagonal))  # 1 / (1 + r)
        gram = among.sum(sum_grams(factor, scaling * weighted(share, weights).sqrt(), None, 1)[:, 0])
        lower = torch.linalg.cholesky_ex(gram + torch.eye(gram.shape[1], dtype=gram.dtype, device=gram.device)).L
        residual = _largest(lacking, among)
        found = Solution(scaling, total, residual, start.sweeps + 3 * steps, torch.cholesky_inverse(lower))
        slow = 0 if bool((residual.max() < 0.5 * best.residual.max()).all()) else slow + 1
        if bool(residual.max() <= best.residual.max()):
            best = found
        right = among.sum(moment(factor, weighted(scaling * (share * lacking), weights).unsqueeze(1)))
        affinity = spread(torch.cholesky_solve(right, lower).to(factor).mT, factor, scaling).squeeze(1)
        step = share * (lacking - affinity)
        small = bool(_largest(step, among).max() < SMALL_STEP)
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


def weighted_moment(factor: Tensor, weight: Tensor, among: Communicator, total: Tensor) -> Tensor:
    """``factor @ (weight * (factor^T total))``, (B, M, 1) in float64."""
    return among.sum(weigh(factor, weight, total.to(factor).squeeze(2)).unsqueeze(2))


def conjugate_gradients(factor: Tensor, weight: Tensor, right: Tensor, inverse: Tensor, among: Communicator) -> Tensor:
    """The s (B, M, 1) in float64 with ``(I + factor diag(weight) factor^T) s = right``."""
    tiny = torch.finfo(torch.float64).tiny  # where the right side is zero, so is the solution
    solution, residual = torch.zeros_like(right), right
    preconditioned = inverse @ residual
    direction, size = preconditioned, (residual * preconditioned).sum(1, keepdim=True)
    goal = SOLVED[factor.dtype] ** 2 * size
    for _ in range(SOLVE_STEPS[factor.dtype]):
        image = direction + weighted_moment(factor, weight, among, direction)
        step = size / (direction * image).sum(1, keepdim=True).clamp(min=tiny)
        solution, residual = solution + step * direction, residual - step * image
        preconditioned = inverse @ residual
        before, size = size, (residual * preconditioned).sum(1, keepdim=True)
        if factor.device.type == "cpu" and bool((size <= goal).all()):
            break
        direction = preconditioned + size / before.clamp(min=tiny) * direction
    return solution
