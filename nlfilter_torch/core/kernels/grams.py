"""Gram matrices of a factor."""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import SWEPT, buffered_blocks, pixel_blocks, strip_count, strips
from nlfilter_torch.core.kernels.library import by_rows, kernel, run_on_factor
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.torch_internals import for_each_gradient, register

NEGLIGIBLE = 1e-15  # entries of F in float32 that count as zero: their products would be denormal, which is slow


def _fake_grams(factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int) -> Tensor:
    batch, landmarks, _ = factor.shape
    return factor.new_empty(batch, count, landmarks, landmarks, dtype=torch.float64)


def _compiled_grams(factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int) -> Tensor:
    out = _fake_grams(factor, scaling, remainder, count)
    factor, scaling = by_rows(factor), scaling.contiguous()
    remainder = scaling if remainder is None else remainder.contiguous()
    run_on_factor("grams", factor, count, scaling.data_ptr(), remainder.data_ptr(), out.data_ptr())
    return out


@register(
    "grams(Tensor factor, Tensor scaling, Tensor? remainder, int count) -> Tensor", kernel(_compiled_grams), _fake_grams
)
def sum_grams(factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int) -> Tensor:
    """Compute ``F diag(r^j) F^T`` for j = 0 to count - 1 and F = factor diag(d), (B, J, M, M) in float64.

    F is formed before the product: without completion d^2 may overflow, and products of the factor underflow. The
    factor is (B, M, N), d and r are (B, N); r is not needed if ``count`` is 1.
    """
    batch, landmarks, pixels = factor.shape
    parts = strip_count(batch, pixels, factor.device)
    powers = scaling if remainder is None else remainder
    factor, scaling, weights = (strips(t, parts) for t in (factor, scaling.unsqueeze(1), powers.unsqueeze(1)))
    total = factor.new_zeros(len(factor), count, landmarks, landmarks, dtype=torch.float64)
    for block, (rows, weighted) in buffered_blocks(factor, 2):
        left = torch.mul(factor[:, :, block], scaling[:, :, block], out=rows)
        if left.dtype == torch.float32:
            torch.ops.aten.hardshrink.out(left, NEGLIGIBLE, out=left)
        for j in range(count):
            if j:
                left = torch.mul(left, weights[:, :, block], out=weighted)
            total[:, j] += left @ rows.mT
    return total.sum(0, keepdim=True) if parts > 1 else total


def compute_grams(
    factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int, *, exact: bool = False
) -> Tensor:
    """:func:`sum_grams` with a gradient, in float64 if ``exact``."""
    recorded = torch.is_grad_enabled() and (factor.requires_grad or scaling.requires_grad)
    sums = _Grams.apply if recorded else _exact_or_quick  # torch.func transforms do not support the class
    grams: Tensor = sums(factor, scaling, remainder, count, exact)
    return grams


def _exact_or_quick(factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int, exact: bool) -> Tensor:
    """:func:`sum_grams`; if ``exact``, in float64, block by block."""
    if not exact:
        return sum_grams(factor, scaling, remainder, count)
    total = factor.new_zeros(())
    for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
        part = None if remainder is None else remainder[:, block].double()
        total = total + sum_grams(factor[:, :, block].double(), scaling[:, block].double(), part, count)
    return total


class _Grams(torch.autograd.Function):
    """:func:`sum_grams` with a hand-written gradient, for which no intermediate blocks are stored."""

    @staticmethod
    def forward(ctx: Any, factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int, exact: bool) -> Tensor:
        ctx.save_for_backward(factor, scaling, remainder)
        return _exact_or_quick(factor, scaling, remainder, count, exact)

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        factor, scaling, remainder = ctx.saved_tensors
        grad_factor, grad_scaling = torch.empty_like(factor), torch.empty_like(scaling)
        grad_remainder = None if remainder is None else torch.empty_like(remainder)
        symmetric = (grad + grad.mT).to(factor)  # (B, J, M, M)
        for block, (rows, pulled, inner, product) in buffered_blocks(factor, 4):
            d = scaling[:, None, block]
            torch.mul(factor[:, :, block], d, out=rows)
            torch.bmm(symmetric[:, 0], rows, out=pulled)
            if remainder is not None and grad_remainder is not None:
                torch.bmm(symmetric[:, 1], rows, out=inner)
                grad_remainder[:, block] = torch.mul(inner, rows, out=product).sum(1) / 2
                pulled.addcmul_(inner, remainder[:, None, block])
            grad_scaling[:, block] = torch.mul(pulled, factor[:, :, block], out=product).sum(1)
            grad_factor[:, :, block] = pulled.mul_(d)
        return grad_factor, grad_scaling, grad_remainder, None, None
