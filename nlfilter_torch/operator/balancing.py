"""Factor to balancing: the vector d that makes ``W = diag(d) K diag(d)`` doubly stochastic. Paper: Sec. II-C, Fig. 2.

The scaling of a completed kernel comes from :mod:`~nlfilter_torch.operator.newton`, that of any other from
:mod:`~nlfilter_torch.operator.chebyshev`. On processors, damped steps of Newton's method continue where these do not
converge. The gradient is implicit and the same for all methods.
"""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.autograd import once_differentiable, outer_product
from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.checks import warn
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.operator import chebyshev, newton
from nlfilter_torch.operator.scaling import Balancing, KernelMatrix

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
ALARM = {
    torch.float32: 1e-4,
    torch.float64: 1e-9,
}  # larger residuals raise a warning, unless the tolerance allows them


def balance(
    factor: Tensor,
    diagonal: Tensor,
    *,
    tolerance: float | None = None,
    completed: bool = False,
    among: Communicator = ALONE,
    weights: Tensor | None = None,
) -> Balancing:
    """Scale ``K = factor^T factor + diag(diagonal)`` to unit row sums.

    Args:
        factor: (B, M, N).
        diagonal: (B, N), non-negative.
        tolerance: residual at which to stop; None is 1e-5 in float32 and 1e-12 in float64. On processors, a final
            residual above it and above 1e-4 (1e-9 in float64) raises a warning.
        completed: whether K has a unit diagonal and no negative entries but for errors; a faster method then applies.
        among: ranks that the rows of the image are spread over.
        weights: number of equal pixels that each point stands for, (B, N), a constant; None is one each.
    """
    tolerance = tolerance or TOLERANCE[factor.dtype]
    scaling, total, residual, steps = _Balance.apply(factor, diagonal, tolerance, completed, among, weights)  # type: ignore[no-untyped-call]
    warn_of_residual(residual, tolerance, factor.dtype, completed=completed)
    return Balancing(scaling, total, residual, int(steps))


def warn_of_residual(residual: Tensor, tolerance: float | None, dtype: torch.dtype, *, completed: bool) -> None:
    """Warn, on processors, of row sums that are off by more than was asked for and more than rounding."""
    if residual.device.type == "cpu" and not bool((residual <= max(tolerance or 0.0, ALARM[dtype])).all()):
        remedy = "raise photometric_bandwidth or num_landmarks" + (
            ", or use completion='diagonal'" if not completed else ""
        )
        warn(f"balancing left row sums off by up to {residual.max().item():.1e}; {remedy}")


def attainable(factor: Tensor, tolerance: float, among: Communicator) -> float:
    """The residual that balancing aims at: the tolerance, or the rounding error of row sums if that is larger."""
    pixels = among.pixels(factor.shape[2])
    # |u . t| is formed from terms of up to |u| |t|, and |t|^2 is at most the number of pixels.
    return max(tolerance, 0.5 * torch.finfo(factor.dtype).eps * pixels**0.5)


class _Balance(torch.autograd.Function):
    """Implicit differentiation of ``log d + log(K d) = 0``.

    Differentiated, ``(I + W) d(log d) = -diag(d) dK d``. With g the gradient of the loss in d, ``(I + W) x = d * g``
    and ``a = d * x``, the loss changes by ``-a^T dK d``. Its gradient is ``-(z a^T + s d^T)`` in the factor, with
    z = factor d and s = factor a, and ``-a d`` in the diagonal.

    With r = d^2 c the equation reads ``(1 + r) x + d (factor^T s) = d * g``: x follows from s, which solves a system of
    M equations whose matrix is the Jacobian J of :mod:`~nlfilter_torch.operator.newton`. Conjugate gradients solve it,
    preconditioned by the approximate inverse of J from balancing.
    """

    @staticmethod
    def forward(
        ctx: Any,
        factor: Tensor,
        diagonal: Tensor,
        tolerance: float,
        completed: bool,
        among: Communicator,
        weights: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, int]:
        matrix = KernelMatrix(factor, diagonal, weights, among)
        found = newton.solve(matrix, tolerance) if completed else chebyshev.solve(matrix, tolerance)
        goal = attainable(factor, tolerance, among)
        if factor.device.type == "cpu" and not bool((found.residual <= goal).all()):
            found = newton.damped(matrix, found, goal)
        ctx.save_for_backward(factor, diagonal, found.scaling, found.moment, found.inverse, weights)
        ctx.among, ctx.completed = among, completed
        ctx.mark_non_differentiable(found.moment, found.residual)
        return found.scaling, found.moment, found.residual, found.steps

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        factor, diagonal, scaling, total, inverse, weights = ctx.saved_tensors
        dtype = factor.dtype
        if not ctx.completed:  # d may be 1e25 without completion, its square too large for float32
            factor, diagonal, scaling, grad = (tensor.double() for tensor in (factor, diagonal, scaling, grad))
        share = 1 / (1 + scaling * (scaling * diagonal))  # 1 / (1 + r)
        weight = scaling.square() * share
        matrix = KernelMatrix(factor, diagonal, None, ctx.among)
        right = matrix.moment(weight * grad)
        solution = newton.conjugate_gradients(factor, weighted(weight, weights), right, inverse, ctx.among)
        affinity = weighted(matrix.affinities(solution), weights)
        a = scaling * scaling * share * (grad - affinity)
        totals = torch.cat([total, solution], dim=2).to(dtype)  # (B, M, 2)
        grad_factor = outer_product(totals, torch.stack([-a, -weighted(scaling, weights)], dim=1).to(dtype))
        return grad_factor, (-a * scaling).to(dtype), None, None, None, None
