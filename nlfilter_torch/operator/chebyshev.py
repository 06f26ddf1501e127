"""Balancing by Chebyshev's semi-iteration on ``log d``, for kernels without diagonal correction.

With ``v = log d`` the equation is ``v + log(K d) = 0``. Its Jacobian at the solution is ``I + W``, whose spectrum lies
in [1, 2]. The semi-iteration for that interval reduces the error by a factor of 5.8 a sweep; plain Sinkhorn iteration
barely converges. The paper's method (``completion="none"``), whose affinities may be negative and whose scalings are
large, is balanced this way.
"""

from collections.abc import Iterator

import torch

from nlfilter_torch.core.blocks import SWEPT, pixel_blocks, weighted
from nlfilter_torch.core.kernels.tall_skinny import gather, spread
from nlfilter_torch.operator.scaling import KernelMatrix, Solution

MAX_SWEEPS = 40
ACCELERATOR_SWEEPS = 12  # reading the residual would stall the queue of an accelerator
TRUSTED = (1e-2, 1e2)  # row sums outside are clamped before their logarithm
SMALLEST_SUM = 1e-12  # of the first guess, whose row sums may be negative
STALL = 1e-3  # below this residual, the iteration ends after two sweeps in turn that do not halve it
LARGEST_SCALING = 1e30  # of a pixel that no scaling balances, as its approximate affinities are negative


def _weights(low: float, high: float) -> Iterator[tuple[float, float]]:
    """Weights (momentum, gradient) of the semi-iteration for a spectrum in [low, high]."""
    centre, radius = (high + low) / 2, (high - low) / 2
    sigma = centre / radius
    rho = 1 / sigma
    yield 0.0, 1 / centre
    while True:
        previous, rho = rho, 1 / (2 * sigma - rho)
        yield rho * previous, 2 * rho / radius


def solve(matrix: KernelMatrix, tolerance: float) -> Solution:
    """Balance any kernel; on processors until the residual is at most ``tolerance`` or stalls."""
    factor, diagonal, weights, among = matrix.factor, matrix.diagonal, matrix.weights, matrix.among
    sums = matrix.affinities(matrix.moment(torch.ones_like(diagonal))) + diagonal
    scaling = sums.clamp(min=SMALLEST_SUM).rsqrt()  # a first guess: (K 1)^(-1/2)
    total = matrix.moment(scaling)
    move = torch.zeros_like(scaling)
    watched = factor.device.type == "cpu"
    worst, slow = float("inf"), 0
    for sweeps, (momentum, gain) in enumerate(_weights(1.0, 2.0), start=1):
        current, following = total.to(factor).mT, torch.empty_like(scaling)
        next_total, residual = torch.zeros_like(total), scaling.new_zeros(scaling.shape[0])
        # One read of the factor: while a block is cached, its row sums, its update and its part of the next moment.
        for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
            rows, d = factor[:, :, block], scaling[:, block]
            sums = d * (spread(current, rows).squeeze(1) + diagonal[:, block] * d)  # row sums of W
            residual = torch.maximum(residual, (sums - 1).abs().amax(1))
            # Far from the solution the linearisation is poor: bounded steps keep the iteration convergent.
            step = move[:, block].mul_(momentum).sub_(sums.clamp(*TRUSTED).log_(), alpha=gain)
            torch.mul(d, step.exp(), out=following[:, block]).clamp_(max=LARGEST_SCALING)
            part = None if weights is None else weights[:, block]
            next_total += gather(weighted(following[:, None, block], part), rows).mT
        residual, next_total = among.max(residual), among.sum(next_total)
        previous, worst = worst, residual.max().item() if watched else worst
        slow = slow + 1 if worst > previous / 2 else 0
        stalled = worst < STALL and slow > 1  # by rounding; a single slow step may have other causes
        if worst <= tolerance or stalled or sweeps == (MAX_SWEEPS if watched else ACCELERATOR_SWEEPS):
            break
        scaling, total = following, next_total
    identity = torch.eye(factor.shape[1], dtype=torch.float64, device=factor.device).expand(len(factor), -1, -1)
    return Solution(scaling, total, residual.nan_to_num(nan=torch.inf), sweeps, identity)
