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
  Chebyshev iteration takes twice as many sweeps there, but needs no Cholesky factor, so that ONNX has all of it.

On CPUs a damped Newton method continues where these do not converge. The gradient is implicit, by the same equation,
and therefore the same for all methods.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import SWEPT, pixel_blocks, weighted
from nlfilter_torch.core.communicator import Communicator
from nlfilter_torch.core.kernels.tall_skinny import gather, spread
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.torch_internals import for_each_gradient, is_hidden, outer_product, register
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.eigenvalue_bound import ALWAYS, exceeds, slack
from nlfilter_torch.operator.pixel_matrix import PixelMatrix
from nlfilter_torch.operator.scaling import (
    Balancing,
    KernelMatrix,
    conjugate_gradients,
    damped,
    isolated,
    sampled_newton,
)

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
# Larger residuals cause a warning, unless the tolerance allows them.
ALARM = {torch.float32: 1e-4, torch.float64: 1e-9}
MOST_ROUNDS = 8  # of removing isolated pixels; one or two are usual
# Chebyshev semi-iteration:
CHEBYSHEV_SWEEPS = 40
UNWATCHED_CHEBYSHEV_SWEEPS = 12  # reading the residual would stall the queue of an accelerator
TRUSTED = (1e-2, 1e2)  # row sums are clamped to this range before taking their logarithm
SMALLEST_SUM = 1e-12  # lower bound of the initial row sums, which may be negative
STALL = 1e-3  # below this residual, the iteration ends after two consecutive sweeps that do not halve it
LARGEST_SCALING = 1e30  # for pixels that no scaling balances because their approximate affinities are negative


def sinkhorn_balance(
    matrix: KernelMatrix,
    *,
    tolerance: float | None = None,
    completed: bool = False,
    bound: bool = False,
) -> Balancing:
    """Scale ``K = factor^T factor + diag(diagonal)`` to unit row sums, by one vector for rows and columns.

    Args:
        matrix: K.
        tolerance: residual at which to stop; None means 1e-5 in float32 and 1e-12 in float64. On CPUs, a final
            residual above both this and 1e-4 (1e-9 in float64) causes a warning.
        completed: whether K has a unit diagonal and, up to approximation errors, no negative entries; a faster method
            then applies. On CPUs, isolated pixels are removed, and balancing is repeated until there are none.
        bound: whether a compiled program warns of eigenvalues above 1 of large factors, too.
    """
    factor, diagonal, weights, communicator = matrix.factor, matrix.diagonal, matrix.weights, matrix.communicator
    tolerance = tolerance or TOLERANCE[factor.dtype]
    if torch.compiler.is_compiling():  # where nothing may depend on the number of pixels; never with weights or a group
        scaling, moments, residual, inverse, removed = sinkhorn(
            factor.detach(), diagonal.detach(), tolerance, completed, bound
        )
        factor, diagonal = without(factor, removed), torch.where(removed, 1.0, diagonal)
        *before, moment = moments.unbind()
        found = Balancing(matrix, scaling, moment, residual, 0, inverse, tuple(before))
    else:
        with torch.no_grad():
            constant = replace(matrix, factor=factor.detach(), diagonal=diagonal.detach())
            found, alone = balanced_in_rounds(constant, tolerance, completed)
        if alone is not None:
            factor, diagonal = factor * ~alone.unsqueeze(1), torch.where(alone, 1.0, diagonal)
    known = found.scaling, found.moment, found.inverse
    scaling = _ImplicitScaling.apply(factor, diagonal, *known, completed, communicator, weights)  # type: ignore[no-untyped-call]
    return replace(found, matrix=replace(matrix, factor=factor, diagonal=diagonal), scaling=scaling)


def balanced_in_rounds(matrix: KernelMatrix, tolerance: float, completed: bool) -> tuple[Balancing, Tensor | None]:
    """Balance a kernel without a gradient; also return its isolated pixels (B, N), or None if there are none.

    On CPUs, if the kernel is completed, the isolated pixels are removed, and this is repeated until there are none.
    """
    watched, removed, before = not is_hidden(matrix.factor), None, list[Tensor]()
    while True:
        found = solve(matrix, tolerance, completed)
        if watched:
            warn_of_residual(found.worst, tolerance, matrix.factor.dtype, completed=completed)
        if not (completed and watched) or len(before) == MOST_ROUNDS:
            break
        alone = isolated(found.scaling, matrix.diagonal, found.worst, matrix.weights)
        if not bool(matrix.communicator.max(alone.any().byte())):
            break
        before.append(found.moment)
        removed = alone if removed is None else removed | alone
        factor, diagonal = matrix.factor * ~alone.unsqueeze(1), torch.where(alone, 1.0, matrix.diagonal)
        matrix = replace(matrix, factor=factor, diagonal=diagonal)
    return replace(found, before=tuple(before)), removed


def warn_of_residual(residual: float, tolerance: float | None, dtype: torch.dtype, *, completed: bool) -> None:
    """Warn if row sums deviate from 1 by up to ``residual``, more than the tolerance and more than rounding."""
    if not residual <= max(tolerance or 0.0, ALARM[dtype]):
        remedy = "raise photometric_bandwidth or num_landmarks" + (
            ", or use completion='diagonal'" if not completed else ""
        )
        warn(f"balancing left row sums that differ from 1 by up to {residual:.1e}; {remedy}")


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
        dtype = factor.dtype
        if not ctx.completed:  # without completion d may reach 1e25, and its square overflows float32
            factor, diagonal, scaling, grad = (tensor.double() for tensor in (factor, diagonal, scaling, grad))
        share = 1 / (1 + scaling * (scaling * diagonal))  # 1 / (1 + r)
        weight = scaling.square() * share
        matrix = KernelMatrix(factor, diagonal, None, ctx.communicator)
        solution = conjugate_gradients(matrix, weighted(weight, weights), matrix.moment(weight * grad), inverse)
        affinity = weighted(matrix.affinities(solution), weights)
        a = scaling * scaling * share * (grad - affinity)
        totals = torch.cat([moment, solution], dim=2).to(dtype)  # (B, M, 2)
        grad_factor = outer_product(totals, torch.stack([-a, -weighted(scaling, weights)], dim=1).to(dtype))
        return grad_factor, (-a * scaling).to(dtype), None, None, None, None, None, None


def solve(matrix: KernelMatrix, tolerance: float, completed: bool) -> Balancing:
    """Balance a kernel by the method that suits it, and continue with the damped method if that does not converge."""
    # A program that is traced through has neither Cholesky factors nor the search for a place in a sorted list.
    quick = completed and not torch.compiler.is_compiling()
    solution = sampled_newton(matrix, tolerance) if quick else _chebyshev(matrix, tolerance)
    goal = attainable(matrix.factor, tolerance, matrix.communicator)
    if not is_hidden(matrix.factor) and not solution.worst <= goal:
        solution = damped(matrix, solution, goal)
    return solution


def chebyshev_weights(low: float, high: float) -> Iterator[tuple[float, float]]:
    """Generate the weights (momentum, gradient) of Chebyshev semi-iteration for a spectrum in [low, high]."""
    centre, radius = (high + low) / 2, (high - low) / 2
    sigma = centre / radius
    rho = 1 / sigma
    yield 0.0, 1 / centre
    while True:
        previous, rho = rho, 1 / (2 * sigma - rho)
        yield rho * previous, 2 * rho / radius


def _chebyshev(matrix: KernelMatrix, tolerance: float) -> Balancing:
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
        if worst <= tolerance or stalled or sweeps == (CHEBYSHEV_SWEEPS if watched else UNWATCHED_CHEBYSHEV_SWEEPS):
            break
        scaling, total = following, next_total
    identity = torch.eye(factor.shape[1], dtype=torch.float64, device=factor.device).expand(len(factor), -1, -1)
    return Balancing(matrix, scaling, total, residual.nan_to_num(nan=torch.inf), sweeps, identity)


def _fake_sinkhorn(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, ...]:
    batch, landmarks, _ = factor.shape
    moments = factor.new_empty(MOST_ROUNDS + 1, batch, landmarks, 1, dtype=torch.float64)
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

    The moments are those of the rounds, padded with copies of the last to ``MOST_ROUNDS + 1``. Warn if eigenvalues
    exceed 1, of large factors only with ``bound``.
    """
    result, removed = balanced_in_rounds(KernelMatrix(factor, diagonal), tolerance, completed)
    if not is_hidden(factor) and (bound or factor.shape[1] * factor.shape[2] <= ALWAYS):
        remainder = result.scaling * (result.scaling * result.matrix.diagonal)
        balanced = PixelMatrix(result.matrix.factor, result.scaling, remainder)
        if bool(exceeds(balanced.gram_below, result.moment, slack(factor.dtype, result.worst)).any()):
            warn("eigenvalues exceed 1, which compiled programs do not correct; use landmarks='kmeans'")
    moments = [*result.before, *[result.moment] * (MOST_ROUNDS + 1 - len(result.before))]
    removed = torch.zeros_like(diagonal, dtype=torch.bool) if removed is None else removed
    return result.scaling, torch.stack(moments), result.residual, result.inverse.contiguous(), removed


def _fake_without(factor: Tensor, removed: Tensor) -> Tensor:
    return torch.empty_like(factor)


@register("without(Tensor factor, Tensor removed) -> Tensor", None, _fake_without, differentiable=True)
def without(factor: Tensor, removed: Tensor) -> Tensor:
    """The factor (B, M, N) without the removed pixels (B, N).

    An operator of its own, since inductor would write the product once for every operator that takes it.
    """
    return factor * ~removed.unsqueeze(1)
