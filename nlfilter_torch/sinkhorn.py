"""Factor to balancing: the vector d that makes ``W = diag(d) K diag(d)`` doubly stochastic. Paper: Sec. II-C, Fig. 2.

With ``u = log d`` the equation is ``u + log(K d) = 0``. Its Jacobian at the solution is ``I + W``, whose spectrum lies
in [1, 2]: Chebyshev's semi-iteration for that interval gains a factor 5.8 a step, where the textbook alternation barely
converges. The same interval makes the implicit gradient cheap: ten steps of the same recurrence solve ``(I + W) x =
b``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.blocks import SWEPT, moment, pixel_blocks
from nlfilter_torch.checks import warn
from nlfilter_torch.differentiation import once_differentiable, outer_product

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
MAX_STEPS = 40
ACCELERATOR_STEPS = 12  # on an accelerator a look at the residual would stop the queue: a fixed number of steps instead
ALARM = 1e-3  # a residual that balancing ends above is worth a warning
SOLVE_STEPS = {torch.float32: 10, torch.float64: 21}  # 2 * 5.8^-steps is below the rounding of the dtype
TRUSTED = (1e-2, 1e2)  # row sums outside are clamped before their logarithm
SMALLEST_AFFINITY = 1e-12  # keeps the plain method, whose affinities may be negative, finite
LARGEST_SCALING = 1e30  # of a pixel whose affinities the plain method makes negative, so that no scaling balances it


@dataclass(frozen=True)
class Balancing:
    """Result of :func:`balance`.

    Attributes:
        scaling: d, (B, N), positive; differentiable in factor and diagonal.
        residual: largest deviation of a row sum of W from 1, (B,).
        steps: sweeps over the factor that it took.
    """

    scaling: Tensor
    residual: Tensor
    steps: int


def balance(factor: Tensor, diagonal: Tensor, *, tolerance: float | None = None) -> Balancing:
    """Scale ``K = factor^T factor + diag(diagonal)`` to unit row sums.

    Args:
        factor: (B, M, N).
        diagonal: (B, N), non-negative.
        tolerance: residual at which to stop; None is 1e-5 in float32 and 1e-12 in float64. The iteration also stops
            where rounding keeps the residual from falling, and warns if that is above 1e-3.
    """
    scaling, residual, steps = _Balance.apply(factor, diagonal, tolerance or TOLERANCE[factor.dtype])  # type: ignore[no-untyped-call]
    if factor.device.type == "cpu" and not bool((residual <= ALARM).all()):
        warn(
            f"balancing left row sums off by up to {residual.max().item():.1e}; "
            "raise photometric_bandwidth or num_landmarks, or use completion='diagonal'"
        )
    return Balancing(scaling, residual, int(steps))


def _chebyshev(low: float, high: float) -> Iterator[tuple[float, float]]:
    """Weights (momentum, gradient) of Chebyshev's semi-iteration for a spectrum in [low, high]."""
    centre, radius = (high + low) / 2, (high - low) / 2
    sigma = centre / radius
    rho = 1 / sigma
    yield 0.0, 1 / centre
    while True:
        previous, rho = rho, 1 / (2 * sigma - rho)
        yield rho * previous, 2 * rho / radius


def _start(factor: Tensor, diagonal: Tensor) -> Tensor:
    """A first guess of d (B, N): ``(K 1)^(-1/2)``."""
    total = moment(factor, torch.ones_like(diagonal).unsqueeze(1)).to(factor)
    return ((total.mT @ factor).squeeze(1) + diagonal).clamp(min=SMALLEST_AFFINITY).rsqrt()


def scaling_from_moment(factor: Tensor, diagonal: Tensor, total: Tensor) -> Tensor:
    """The scaling (B, N) of any pixels, given the moment ``factor @ d`` (B, M, 1) of a balanced image.

    A pixel's equation is ``d (u . total + diagonal d) = 1``, so d is the positive root of a quadratic.
    """
    affinity = (total.mT @ factor).squeeze(1).clamp(min=SMALLEST_AFFINITY)
    return 2 / (affinity + torch.sqrt(affinity.square() + 4 * diagonal))


def _solve(factor: Tensor, diagonal: Tensor, tolerance: float) -> tuple[Tensor, Tensor, int]:
    """Scaling (B, N), its measured residual (B,), and the number of sweeps."""
    scaling = _start(factor, diagonal)
    total = moment(factor, scaling.unsqueeze(1))
    move = torch.zeros_like(scaling)
    watched = factor.device.type == "cpu"
    worst, slow = float("inf"), 0
    for steps, (momentum, gain) in enumerate(_chebyshev(1.0, 2.0), start=1):
        current, following = total.to(factor).mT, torch.empty_like(scaling)
        next_total, residual = torch.zeros_like(total), scaling.new_zeros(scaling.shape[0])
        # One read of the factor: a block gives its row sums, takes its update and adds to the next moment while cached.
        for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
            rows, d = factor[:, :, block], scaling[:, block]
            sums = d * ((current @ rows).squeeze(1) + diagonal[:, block] * d)  # row sums of W
            residual = torch.maximum(residual, (sums - 1).abs().amax(1))
            # Far from the solution the logarithm is no guide: bounded steps keep the iteration in its basin.
            step = move[:, block].mul_(momentum).sub_(sums.clamp(*TRUSTED).log_(), alpha=gain)
            torch.mul(d, step.exp(), out=following[:, block]).clamp_(max=LARGEST_SCALING)
            next_total += rows @ following[:, block].unsqueeze(2)
        previous, worst = worst, residual.max().item() if watched else worst
        slow = slow + 1 if worst > previous / 2 else 0
        stalled = worst < ALARM and slow > 1  # at the level of rounding; a single slow step is no sign of it
        if worst <= tolerance or stalled or steps == (MAX_STEPS if watched else ACCELERATOR_STEPS):
            break
        scaling, total = following, next_total
    return scaling, residual, steps


class _Balance(torch.autograd.Function):
    """Implicit differentiation of ``log d + log(K d) = 0``.

    ``(I + W) d(log d) = -diag(d) dK d``, so with ``(I + W) x = d * g`` and ``a = d * x`` the loss changes by ``-a^T dK
    d``: its gradient is ``-(z a^T + w d^T)`` in the factor, z = factor d, w = factor a, and ``-a d`` in the diagonal.
    """

    @staticmethod
    def forward(ctx: Any, factor: Tensor, diagonal: Tensor, tolerance: float) -> tuple[Tensor, Tensor, int]:
        scaling, residual, steps = _solve(factor, diagonal, tolerance)
        ctx.save_for_backward(factor, diagonal, scaling)
        ctx.mark_non_differentiable(residual)
        return scaling, residual, steps

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        factor, diagonal, scaling = ctx.saved_tensors
        target = scaling * grad
        solution, move = torch.zeros_like(target), torch.zeros_like(target)
        total = factor.new_zeros(*factor.shape[:2], 1, dtype=torch.float64)  # factor @ (d x)
        for momentum, gain in islice(_chebyshev(1.0, 2.0), SOLVE_STEPS[factor.dtype]):
            current, total = total.to(factor).mT, torch.zeros_like(total)
            for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
                rows, d, x = factor[:, :, block], scaling[:, block], solution[:, block]
                image = x + d * ((current @ rows).squeeze(1) + diagonal[:, block] * d * x)  # (I + W) x
                x += move[:, block].mul_(momentum).add_(target[:, block] - image, alpha=gain)
                total += rows @ (d * x).unsqueeze(2)
        a = scaling * solution
        totals = torch.cat([moment(factor, scaling.unsqueeze(1)), total], dim=2).to(factor)  # (B, M, 2)
        grad_factor = outer_product(totals, torch.stack([-a, -scaling], dim=1))
        return grad_factor, -a * scaling, None
