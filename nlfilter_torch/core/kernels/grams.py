"""Gram matrices of a factor."""

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import buffered_blocks, strip_count, strips
from nlfilter_torch.core.kernels.library import by_rows, register, run_on_factor

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


@register("grams(Tensor factor, Tensor scaling, Tensor? remainder, int count) -> Tensor", _compiled_grams, _fake_grams)
def sum_grams(factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int) -> Tensor:
    """Compute ``F diag(r^j) F^T`` for j = 0 to count - 1 and F = factor diag(d), (B, J, M, M) in float64.

    F is formed before the product: without completion d^2 may overflow, and products of the factor underflow. The
    factor is (B, M, N), d and r are (B, N); r is not needed if ``count`` is 1.
    """
    batch, landmarks, pixels = factor.shape
    parts = strip_count(batch, pixels, factor.device)
    each = scaling if remainder is None else remainder
    factor, scaling, weights = (strips(t, parts) for t in (factor, scaling.unsqueeze(1), each.unsqueeze(1)))
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


def _fake_gram(factor: Tensor, weights: Tensor) -> Tensor:
    batch, landmarks, _ = factor.shape
    return factor.new_empty(batch, landmarks, landmarks)


def _compiled_gram(factor: Tensor, weights: Tensor) -> Tensor:
    return _compiled_grams(factor, weights.sqrt(), None, 1)[:, 0].to(factor.dtype)


@register("gram(Tensor factor, Tensor weights) -> Tensor", _compiled_gram, _fake_gram)
def gram(factor: Tensor, weights: Tensor) -> Tensor:
    """``factor diag(weights) factor^T``, (B, M, M) in the precision of the factor, for weights (B, N) >= 0."""
    return (factor * weights.unsqueeze(1)) @ factor.mT
