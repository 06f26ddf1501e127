"""The linear systems of balancing and of its gradient, M equations, by preconditioned conjugate gradients."""

import torch
from torch import Tensor

from nlfilter_torch.core.communicator import Communicator
from nlfilter_torch.core.kernels.sweeps import weigh

# Each step gains a factor of at least 5.8: so many steps, or a residual below the rounding of the dtype.
STEPS = {torch.float32: 10, torch.float64: 24}
SOLVED = {torch.float32: 1e-7, torch.float64: 1e-16}


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
    for _ in range(STEPS[factor.dtype]):
        image = direction + weighted_moment(factor, weight, among, direction)
        step = size / (direction * image).sum(1, keepdim=True).clamp(min=tiny)
        solution, residual = solution + step * direction, residual - step * image
        preconditioned = inverse @ residual
        before, size = size, (residual * preconditioned).sum(1, keepdim=True)
        if factor.device.type == "cpu" and bool((size <= goal).all()):
            break
        direction = preconditioned + size / before.clamp(min=tiny) * direction
    return solution
