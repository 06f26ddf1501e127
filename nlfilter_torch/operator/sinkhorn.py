"""Sinkhorn balancing: the vector d that makes ``W = diag(d) K diag(d)`` doubly stochastic. Paper: Sec. II-C, Fig. 2.

K is symmetric, so that one vector scales both rows and columns (symmetric Sinkhorn-Knopp scaling, in the literature
also matrix balancing). It solves ``d * (K d) = 1``, or with ``v = log d``

    v + log(K d) = 0.

The Jacobian at the solution is ``I + W``. The eigenvalues of W lie in [0, 1], and so those of the Jacobian in [1, 2].
Three methods solve the equation; the result does not depend on which:

- The fixed-point iteration of Sinkhorn and Knopp, ``v <- -log(K d)``, multiplies the error by -W. It does not converge
  for the eigenvalue 1 of W, and barely with damping, so it serves only as the start of the others.
- Chebyshev semi-iteration for the interval [1, 2] reduces the error by a factor of 5.8 per sweep over the factor. It
  balances the kernels of the paper's method (``completion="none"``), whose affinities may be negative and whose
  scalings are large.
- Newton's method on M unknowns (:mod:`~nlfilter_torch.operator.scaling`) balances kernels with a completed diagonal.

On CPUs a damped Newton method continues where these do not converge. The gradient is implicit, by the same equation,
and therefore the same for all methods.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import SWEPT, pixel_blocks, weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.tall_skinny import gather, spread
from nlfilter_torch.core.low_rank import outer_product
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.torch_internals import for_each_gradient, is_hidden, register
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.eigenvalue_bound import ALWAYS, exceeds, shifted_gram, slack
from nlfilter_torch.operator.scaling import (
    Balancing,
    KernelMatrix,
    Solution,
    conjugate_gradients,
    damped,
    isolated,
    newton,
)

Result = TypeVar("Result", bound=Balancing)

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
# Larger residuals cause a warning, unless the tolerance allows them.
ALARM = {torch.float32: 1e-4, torch.float64: 1e-9}
# Chebyshev semi-iteration:
MAX_SWEEPS = 40
ACCELERATOR_SWEEPS = 12  # reading the residual would stall the queue of an accelerator
TRUSTED = (1e-2, 1e2)  # row sums are clamped to this range before taking their logarithm
SMALLEST_SUM = 1e-12  # lower bound of the initial row sums, which may be negative
STALL = 1e-3  # below this residual, the iteration ends after two consecutive sweeps that do not halve it
LARGEST_SCALING = 1e30  # for pixels that no scaling balances because their approximate affinities are negative


def sinkhorn_balance(
    factor: Tensor,
    diagonal: Tensor,
    *,
    tolerance: float | None = None,
    completed: bool = False,
    communicator: Communicator = ALONE,
    weights: Tensor | None = None,
) -> Balancing:
    """Scale ``K = factor^T factor + diag(diagonal)`` to unit row sums, by one vector for rows and columns.

    Args:
        factor: (B, M, N).
        diagonal: (B, N), non-negative.
        tolerance: residual at which to stop; None means 1e-5 in float32 and 1e-12 in float64. On CPUs, a final
            residual above both this and 1e-4 (1e-9 in float64) causes a warning.
        completed: whether K has a unit diagonal and, up to approximation errors, no negative entries; a faster method
            then applies.
        communicator: ranks that the rows of the image are distributed over.
        weights: number of identical pixels that each point represents, (B, N), a constant; None means one each.
    """
    tolerance = tolerance or TOLERANCE[factor.dtype]
    with torch.no_grad():
        solution = solve(KernelMatrix(factor, diagonal, weights, communicator), tolerance, completed)
    warn_of_residual(solution.residual, tolerance, factor.dtype, completed=completed)
    known = solution.scaling, solution.moment, solution.inverse
    scaling = _ImplicitScaling.apply(factor, diagonal, *known, completed, communicator, weights)  # type: ignore[no-untyped-call]
    return Balancing(scaling, solution.moment, solution.residual, solution.steps)


def warn_of_residual(residual: Tensor, tolerance: float | None, dtype: torch.dtype, *, completed: bool) -> None:
    """Warn, on CPUs, if row sums deviate from 1 by more than the tolerance and more than rounding."""
    if not is_hidden(residual) and not bool((residual <= max(tolerance or 0.0, ALARM[dtype])).all()):
        remedy = "raise photometric_bandwidth or num_landmarks" + (
            ", or use completion='diagonal'" if not completed else ""
        )
        warn(f"balancing left row sums that differ from 1 by up to {residual.max().item():.1e}; {remedy}")


def attainable(factor: Tensor, tolerance: float, communicator: Communicator) -> float:
    """Return the target residual: the tolerance, or the rounding error of row sums if that is larger."""
    pixels = communicator.pixels(factor.shape[2])
    # u . t is a sum of terms of magnitude up to |u| |t|, and |t|^2 is at most the number of pixels.
    return max(tolerance, 0.5 * torch.finfo(factor.dtype).eps * pixels**0.5)


class _ImplicitScaling(torch.autograd.Function):
    """The scaling d (B, N) that a balancing found, with implicit differentiation of ``log d + log(K d) = 0``.

    Differentiating gives ``(I + W) d(log d) = -diag(d) dK d``. With g the gradient of the loss with respect to d,
    ``(I + W) x = d * g`` and ``a = d * x``, the loss changes by ``-a^T dK d``. Its gradient with respect to the factor
    is ``-(z a^T + s d^T)``, with z = factor d and s = factor a; with respect to the diagonal it is ``-a d``.

    With r = d^2 c the equation for x reads ``(1 + r) x + d (factor^T s) = d * g``: x follows from s, the solution of M
    equations whose matrix is the Jacobian J of :mod:`~nlfilter_torch.operator.scaling`. They are solved by conjugate
    gradients, preconditioned by the approximate inverse of J from balancing.
    """

    @staticmethod
    def forward(
        ctx: Any,
        factor: Tensor,
        diagonal: Tensor,
        scaling: Tensor,
        moment: Tensor,
        inverse: Tensor,
        completed: bool,
        communicator: Communicator,
        weights: Tensor | None,
    ) -> Tensor:
        scaling = scaling.clone()
        ctx.save_for_backward(factor, diagonal, scaling, moment, inverse, weights)
        ctx.communicator, ctx.completed = communicator, completed
        return scaling

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        factor, diagonal, scaling, moment, inverse, weights = ctx.saved_tensors
        matrix = KernelMatrix(factor, diagonal, weights, ctx.communicator)
        solution = Balancing(scaling, moment, scaling, 0)  # the residual is not used
        gradients = implicit_gradients(matrix, solution, inverse, grad, ctx.completed)
        return *gradients, None, None, None, None, None, None


def solve(matrix: KernelMatrix, tolerance: float, completed: bool) -> Solution:
    """Balance a kernel by the method that suits it, and continue with the damped method if that does not converge."""
    # A program that is traced through has neither Cholesky factors nor the search for a place in a sorted list.
    quick = completed and not torch.compiler.is_compiling()
    solution = newton(matrix, tolerance) if quick else _chebyshev(matrix, tolerance)
    goal = attainable(matrix.factor, tolerance, matrix.communicator)
    if not is_hidden(matrix.factor) and not bool((solution.residual <= goal).all()):
        solution = damped(matrix, solution, goal)
    return solution


def implicit_gradients(
    matrix: KernelMatrix, balancing: Balancing, inverse: Tensor, grad: Tensor, completed: bool
) -> tuple[Tensor, Tensor]:
    """Gradients with respect to factor and diagonal from that with respect to the scaling.

    See :class:`_ImplicitScaling`.
    """
    factor, diagonal, weights, communicator = matrix.factor, matrix.diagonal, matrix.weights, matrix.communicator
    scaling, total, dtype = balancing.scaling, balancing.moment, factor.dtype
    if not completed:  # without completion d may reach 1e25, and its square overflows float32
        factor, diagonal, scaling, grad = (tensor.double() for tensor in (factor, diagonal, scaling, grad))
    share = 1 / (1 + scaling * (scaling * diagonal))  # 1 / (1 + r)
    weight = scaling.square() * share
    matrix = KernelMatrix(factor, diagonal, None, communicator)
    right = matrix.moment(weight * grad)
    solution = conjugate_gradients(factor, weighted(weight, weights), right, inverse, communicator)
    affinity = weighted(matrix.affinities(solution), weights)
    a = scaling * scaling * share * (grad - affinity)
    totals = torch.cat([total, solution], dim=2).to(dtype)  # (B, M, 2)
    grad_factor = outer_product(totals, torch.stack([-a, -weighted(scaling, weights)], dim=1).to(dtype))
    return grad_factor, (-a * scaling).to(dtype)


@dataclass(frozen=True)
class Rounds(Generic[Result]):
    """A balancing without isolated pixels, and the rounds that led to it.

    Attributes:
        factor: (B, M, N), zero at the removed pixels.
        diagonal: (B, N), 1 at the removed pixels.
        result: the balancing.
        residual: largest deviation of a row sum from 1; 0 if values are hidden.
        before: moments of the earlier rounds, in which isolated pixels were found.
        removed: the isolated pixels, (B, N) bool; None if there are none.
    """

    MOST: ClassVar[int] = 8  # maximum number of rounds; one or two are usual

    factor: Tensor
    diagonal: Tensor
    result: Result
    residual: float
    before: tuple[Tensor, ...]
    removed: Tensor | None


def sinkhorn_in_rounds(
    factor: Tensor,
    diagonal: Tensor,
    balanced: Callable[[Tensor, Tensor], tuple[Result, float]],
    *,
    completed: bool,
    communicator: Communicator = ALONE,
    weights: Tensor | None = None,
) -> Rounds[Result]:
    """Balance a kernel. If it is ``completed``, remove isolated pixels and repeat until there are none."""
    result, worst = balanced(factor, diagonal)
    before: list[Tensor] = []
    removed: Tensor | None = None
    while completed and len(before) < Rounds.MOST:
        alone = isolated(result.scaling.detach(), diagonal.detach(), worst, weights)
        if not bool(communicator.max(alone.any().to(factor))):
            break
        before.append(result.moment)
        removed = alone if removed is None else removed | alone
        factor, diagonal = factor * ~alone.unsqueeze(1), torch.where(alone, 1.0, diagonal)
        result, worst = balanced(factor, diagonal)
    return Rounds(factor, diagonal, result, worst, tuple(before), removed)


def chebyshev_weights(low: float, high: float) -> Iterator[tuple[float, float]]:
    """Generate the weights (momentum, gradient) of Chebyshev semi-iteration for a spectrum in [low, high]."""
    centre, radius = (high + low) / 2, (high - low) / 2
    sigma = centre / radius
    rho = 1 / sigma
    yield 0.0, 1 / centre
    while True:
        previous, rho = rho, 1 / (2 * sigma - rho)
        yield rho * previous, 2 * rho / radius


def _chebyshev(matrix: KernelMatrix, tolerance: float) -> Solution:
    """Balance any kernel by Chebyshev semi-iteration; on CPUs until the residual reaches ``tolerance`` or stalls."""
    factor, diagonal, weights, communicator = matrix.factor, matrix.diagonal, matrix.weights, matrix.communicator
    sums = matrix.affinities(matrix.moment(torch.ones_like(diagonal))) + diagonal
    scaling = sums.clamp(min=SMALLEST_SUM).rsqrt()  # initial guess: (K 1)^(-1/2)
    total = matrix.moment(scaling)
    move = torch.zeros_like(scaling)
    watched = not is_hidden(factor)
    worst, slow = float("inf"), 0
    for sweeps, (momentum, gain) in enumerate(chebyshev_weights(1.0, 2.0), start=1):
        current, following = total.to(factor).mT, torch.empty_like(scaling)
        next_total, residual = torch.zeros_like(total), scaling.new_zeros(scaling.shape[0])
        # One read of the factor: row sums, update and contribution to the next moment while a block is in the cache.
        for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
            rows, d = factor[:, :, block], scaling[:, block]
            sums = d * (spread(current, rows).squeeze(1) + diagonal[:, block] * d)  # row sums of W
            residual = torch.maximum(residual, (sums - 1).abs().amax(1))
            # Far from the solution the linearisation is poor: bounded steps keep the iteration convergent.
            step = move[:, block].mul_(momentum).sub_(sums.clamp(*TRUSTED).log_(), alpha=gain)
            torch.mul(d, step.exp(), out=following[:, block]).clamp_(max=LARGEST_SCALING)
            part = None if weights is None else weights[:, block]
            next_total += gather(weighted(following[:, None, block], part), rows).mT
        residual, next_total = communicator.max(residual), communicator.sum(next_total)
        previous, worst = worst, residual.max().item() if watched else worst
        slow = slow + 1 if worst > previous / 2 else 0
        stalled = worst < STALL and slow > 1  # because of rounding; a single slow sweep may have other causes
        if worst <= tolerance or stalled or sweeps == (MAX_SWEEPS if watched else ACCELERATOR_SWEEPS):
            break
        scaling, total = following, next_total
    identity = torch.eye(factor.shape[1], dtype=torch.float64, device=factor.device).expand(len(factor), -1, -1)
    return Solution(scaling, total, residual.nan_to_num(nan=torch.inf), sweeps, identity)


def _solve_and_warn(factor: Tensor, diagonal: Tensor, *, tolerance: float, completed: bool) -> tuple[Solution, float]:
    """Balance a kernel without a gradient; return the solution and its residual, 0 on accelerators."""
    solution = solve(KernelMatrix(factor, diagonal), tolerance, completed)
    warn_of_residual(solution.residual, tolerance, factor.dtype, completed=completed)
    return solution, 0.0 if is_hidden(factor) else float(solution.residual.max())


def _fake_sinkhorn(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, ...]:
    batch, landmarks, _ = factor.shape
    moments = factor.new_empty(Rounds.MOST + 1, batch, landmarks, 1, dtype=torch.float64)
    inverse = factor.new_empty(batch, landmarks, landmarks, dtype=torch.float64)
    removed = torch.empty_like(diagonal, dtype=torch.bool)
    return torch.empty_like(diagonal), moments, factor.new_empty(batch), inverse, removed


@register(
    "sinkhorn(Tensor factor, Tensor diagonal, float tolerance, bool completed, bool bound) "
    "-> (Tensor, Tensor, Tensor, Tensor, Tensor)",
    None,
    _fake_sinkhorn,
)
def sinkhorn(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Balance a kernel: return d (B, N), moments, residual (B,), inverse Jacobian and a mask of the removed pixels.

    The moments are those of the rounds, padded with copies of the last to ``Rounds.MOST + 1``. Warn if eigenvalues
    exceed 1, of large factors only with ``bound``.
    """
    balanced = partial(_solve_and_warn, tolerance=tolerance, completed=completed)
    watched = not is_hidden(factor)
    rounds = sinkhorn_in_rounds(factor, diagonal, balanced, completed=completed and watched)
    result, factor, diagonal = rounds.result, rounds.factor, rounds.diagonal
    if watched and (bound or factor.shape[1] * factor.shape[2] <= ALWAYS):
        remainder = result.scaling * (result.scaling * diagonal)
        gram = shifted_gram(factor, result.scaling, remainder, ALONE)
        if exceeds(gram, result.moment, slack(factor.dtype, rounds.residual)):
            warn("eigenvalues exceed 1, which compiled programs do not correct; use landmarks='kmeans'")
    moments = [*rounds.before, *[result.moment] * (Rounds.MOST + 1 - len(rounds.before))]
    removed = torch.zeros_like(diagonal, dtype=torch.bool) if rounds.removed is None else rounds.removed
    return result.scaling, torch.stack(moments), result.residual, result.inverse.contiguous(), removed


def _fake_without(factor: Tensor, removed: Tensor) -> Tensor:
    return torch.empty_like(factor)


@register("without(Tensor factor, Tensor removed) -> Tensor", None, _fake_without, differentiable=True)
def without(factor: Tensor, removed: Tensor) -> Tensor:
    """The factor (B, M, N) without the removed pixels (B, N).

    An operator of its own, since inductor would write the product once for every operator that takes it.
    """
    return factor * ~removed.unsqueeze(1)


def sinkhorn_in_graph(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, Tensor, Balancing, tuple[Tensor, ...]]:
    """Factor and diagonal without isolated pixels, their balancing, and the moments of the rounds before it."""
    scaling, moments, residual, inverse, removed = sinkhorn(
        factor.detach(), diagonal.detach(), tolerance, completed, bound
    )
    factor, diagonal = without(factor, removed), torch.where(removed, 1.0, diagonal)
    known = scaling, moments[-1], inverse
    scaling = _ImplicitScaling.apply(factor, diagonal, *known, completed, ALONE, None)  # type: ignore[no-untyped-call]
    return factor, diagonal, Balancing(scaling, moments[-1], residual, 0), moments[:-1].unbind()
