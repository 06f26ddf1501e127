"""Products with ``W = F^T F + diag(r)``, where F = factor diag(d). Paper: eq. (13)."""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.low_rank import outer_product
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.torch_internals import for_each_gradient, in_transform


def apply_powers(
    factor: Tensor,
    scaling: Tensor,
    remainder: Tensor,
    image: Tensor,
    order: int,
    communicator: Communicator = ALONE,
    weights: Tensor | None = None,
) -> Tensor:
    """Compute ``W y, W^2 y, ..., W^k y``, (B, k, C, N), for y (B, C, N), factor (B, M, N), d, r and weights (B, N).

    Differentiable in operator and image. If the operator needs no gradient, differentiable any number of times in the
    image, also in forward mode.
    """
    derived = torch.is_grad_enabled() and not in_transform()  # which needs ordinary operations
    if derived and (factor.requires_grad or scaling.requires_grad or remainder.requires_grad):
        result: Tensor = _Powers.apply(factor, scaling, remainder, image, order, communicator, weights)  # type: ignore[no-untyped-call]
        return result
    images, _ = _powers(factor, scaling, remainder, image, order, communicator, weights)
    return torch.stack(images[1:], dim=1)


def _powers(
    factor: Tensor,
    scaling: Tensor,
    remainder: Tensor,
    image: Tensor,
    order: int,
    communicator: Communicator,
    weights: Tensor | None,
) -> tuple[list[Tensor], list[Tensor]]:
    """Compute the k + 1 images y, ..., W^k y, and the k moments (B, M, C) of the images y, ..., W^(k-1) y."""
    images, moments = [image], []
    mass = weighted(scaling.unsqueeze(1), weights)
    for _ in range(order):
        moments.append(communicator.sum(moment(factor, mass * images[-1])).to(factor))
        smooth = spread(moments[-1].mT, factor, scaling)
        images.append(torch.addcmul(smooth, remainder.unsqueeze(1), images[-1]))
    return images, moments


class _Powers(torch.autograd.Function):
    """Powers of W with a single matrix product as gradient of the factor; autograd would form 2k full matrices.

    With ``P_i = W P_(i-1)`` and, backwards, ``A_(i-1) = G_(i-1) + W^T A_i``, the loss changes by ``sum_i A_i^T dW
    P_(i-1)``. Weights multiply the columns of W.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        images, moments = _powers(*arguments)
        factor, scaling, remainder, _, _, ctx.communicator, weights = arguments
        ctx.save_for_backward(factor, scaling, remainder, weights, *images, *moments)
        return torch.stack(images[1:], dim=1)

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        factor, scaling, remainder, weights, *rest = ctx.saved_tensors
        order = len(rest) // 2
        images, moments = rest[: order + 1], rest[order + 1 :]
        d, r = scaling.unsqueeze(1), remainder.unsqueeze(1)
        grad_scaling, grad_remainder = torch.zeros_like(scaling), torch.zeros_like(remainder)
        left, right = [], []  # columns (B, M, C) and rows (B, C, N) whose product is the gradient of the factor
        adjoint = torch.zeros_like(images[0])
        for i in range(order, 0, -1):
            adjoint = adjoint + grad[:, i - 1]
            before = images[i - 1]
            total = ctx.communicator.sum(moment(factor, d * adjoint)).to(factor)
            affinity = spread(total.mT, factor)  # the image of the adjoint, before scaling
            summed = weighted(before, weights)
            # The scaling multiplies the factor on both sides; each side contributes a product with the other.
            grad_scaling += (adjoint * spread(moments[i - 1].mT, factor) + summed * affinity).sum(1)
            grad_remainder += (adjoint * before).sum(1)
            left += [moments[i - 1], total]
            right += [d * adjoint, d * summed]
            adjoint = weighted(d * affinity, weights) + r * adjoint
        grad_factor = outer_product(torch.cat(left, dim=2), torch.cat(right, dim=1))
        return grad_factor, grad_scaling, grad_remainder, adjoint, None, None, None
