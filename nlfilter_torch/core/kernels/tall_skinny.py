"""Tall-skinny products of a factor with a few rows, which dominate the time of filters, balancing and gradients.

They read the factor once and do little arithmetic, so they are limited by memory bandwidth. BLAS libraries do not reach
it: MKL multiplies a matrix by one vector on a single core, and by a few with a routine meant for many. As a batch of
strips the same products run on all cores. A sweep of balancing forms two products in one read of the factor.
"""

from functools import reduce
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import SWEPT, block_length, buffered_blocks, pixel_blocks, strip_count, strips
from nlfilter_torch.core.kernels.library import (
    ONE_THREAD_COLUMNS,
    by_rows,
    kernel,
    place,
    pointer,
    repeated,
    run_on_factor,
)
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.torch_internals import for_each_gradient, register

FEW_ROWS = range(1, 9)  # numbers of rows for which the kernels in C are fastest
MOST_SPREAD = 9  # with more rows than this, undivided products are no slower
MOST_GATHERED = 24
COMPILED_BLOCKS = 8  # of the sums of a compiled program, for images of any size


def _compiled_spread(rows: Tensor, factor: Tensor, scaling: Tensor | None = None) -> Tensor | None:
    if rows.shape[1] not in FEW_ROWS:
        return None
    factor = by_rows(factor)
    batch, landmarks, pixels = factor.shape
    rows = repeated(rows, batch, landmarks)
    scaling = None if scaling is None else repeated(scaling, batch, pixels)
    out = factor.new_empty(batch, rows.shape[1], pixels)
    run_on_factor("spread", factor, rows.shape[1], rows.data_ptr(), pointer(scaling), out.data_ptr())
    return out


def _fake_spread(rows: Tensor, factor: Tensor, scaling: Tensor | None = None) -> Tensor:
    return factor.new_empty(factor.shape[0], rows.shape[1], factor.shape[2])


@register(
    "spread(Tensor rows, Tensor factor, Tensor? scaling=None) -> Tensor",
    kernel(_compiled_spread),
    _fake_spread,
    differentiable=True,
)
def spread(rows: Tensor, factor: Tensor, scaling: Tensor | None = None) -> Tensor:
    """``rows @ factor diag(scaling)``, (B, R, N), for rows (B, R, M), factor (B, M, N) and optional scaling (B, N)."""
    if scaling is not None:
        return spread(rows, factor) * scaling.unsqueeze(1)
    if not _is_parted(rows, factor) or rows.shape[1] > MOST_SPREAD:
        return rows @ factor
    if rows.shape[1] == 1:
        return _spread_one(rows, factor)
    # One row after the other is faster than several at once, since a block is in the cache after the first.
    blocks = [factor[:, :, block] for block in pixel_blocks(factor.shape[2], 1, factor.device, length=SWEPT)]
    pieces = [[_spread_one(row, block) for row in rows.split(1, dim=1)] for block in blocks]
    return torch.cat([piece for row in zip(*pieces, strict=True) for piece in row], dim=2).view(*rows.shape[:2], -1)


def _spread_one(row: Tensor, factor: Tensor) -> Tensor:
    """``row @ factor``, (1, 1, n), for a row (1, 1, M) and a factor (1, M, n), as a batch of strips."""
    parts = _parts(factor)  # (P, M, n / P)
    return torch.bmm(row.expand(len(parts), -1, -1), parts).view(1, 1, -1)


def gather(images: Tensor, factor: Tensor) -> Tensor:
    """``images @ factor^T``, (B, R, M), for images (B, R, N) and a factor (B, M, N)."""
    if torch.compiler.is_compiling():  # the other layout would specialise compiled code to the number of rows
        return (factor @ images.mT).mT
    if not _is_parted(images, factor) or images.shape[1] > MOST_GATHERED:
        return images @ factor.mT
    return torch.bmm(_parts(images), _parts(factor).mT).sum(0, keepdim=True)


def _compiled_moment(factor: Tensor, images: Tensor) -> Tensor | None:
    if images.shape[1] not in FEW_ROWS:
        return None
    factor = by_rows(factor)
    batch, landmarks, pixels = factor.shape
    if images.shape[0] != batch or images.shape[2] != pixels:
        images = images.expand(batch, -1, pixels)
    images = by_rows(images)
    out = factor.new_empty(batch, images.shape[1], landmarks, dtype=torch.float64)
    run_on_factor("gather", factor, images.shape[1], *place(images), out.data_ptr())
    return out.mT.contiguous()


def _fake_moment(factor: Tensor, images: Tensor) -> Tensor:
    return factor.new_empty(factor.shape[0], factor.shape[1], images.shape[1], dtype=torch.float64)


@register("moment(Tensor factor, Tensor images) -> Tensor", kernel(_compiled_moment), _fake_moment, differentiable=True)
def moment(factor: Tensor, images: Tensor) -> Tensor:
    """``factor @ images^T``, (B, M, C) in float64, for a factor (B, M, N) and images (B, C, N): sums over pixels.

    A float32 sum over a million pixels would lose the difference between row sums of 1 and 1.001.
    """
    batch, _, pixels = factor.shape
    # Splitting, unlike slicing, keeps the backward pass linear in the number of blocks.
    # A number of blocks that depends on the size would be compiled anew for each number.
    compiled = torch.compiler.is_compiling()
    step = -(-pixels // COMPILED_BLOCKS) if compiled else block_length(batch, factor.device, SWEPT)
    parts = zip(factor.split(step, dim=2), images.split(step, dim=2), strict=True)
    sums = (gather(part, rows).mT for rows, part in parts)
    doubled = (t.to(torch.float64, memory_format=torch.contiguous_format).contiguous() for t in sums)
    return reduce(torch.add, doubled)


def _is_parted(thin: Tensor, factor: Tensor) -> bool:
    """Whether to divide products into strips: for one image on a CPU, unless autograd would store every strip."""
    if torch.compiler.is_compiling():  # the test of the batch size would make it a constant
        return False
    recorded = torch.is_grad_enabled() and (thin.requires_grad or factor.requires_grad)
    return factor.device.type == "cpu" and len(factor) == len(thin) == 1 and not recorded


def _parts(planes: Tensor) -> Tensor:
    """View planes (1, R, n) as a batch of strips."""
    return strips(planes, strip_count(1, planes.shape[2], planes.device))


def positive_root(half: Tensor, diagonal: Tensor) -> Tensor:
    """Positive root d of ``d (2 half + diagonal d) = 1``, without cancellation for either sign of ``half``."""
    larger = torch.addcmul(diagonal, half, half).sqrt() + half.abs()
    # With a zero diagonal and negative ``half`` there is no root; the bound, below the rounding of 1 - |u|^2, keeps d
    # finite.
    least = torch.finfo(half.dtype).eps / 4
    return torch.where(half < 0, larger / diagonal.clamp(min=least), larger.clamp(min=least).reciprocal())


def _empty(factor: Tensor) -> tuple[Tensor, Tensor]:
    """An uninitialised (B, N) tensor, and a moment of zeros, (B, M) in float64."""
    batch, landmarks, pixels = factor.shape
    return factor.new_empty(batch, pixels), factor.new_zeros(batch, landmarks, dtype=torch.float64)


def _run(
    factor: Tensor,
    row: Tensor,
    scaling: Tensor | None,
    diagonal: Tensor | None,
    most: float,
    weights: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    out, total = _empty(factor)
    factor = by_rows(factor)
    batch, landmarks, pixels = factor.shape
    row = repeated(row, batch, landmarks)
    vectors = [t if t is None else repeated(t, batch, pixels) for t in (scaling, diagonal, weights)]
    pointers = map(pointer, vectors)
    run_on_factor("sweep", factor, row.data_ptr(), *pointers, most, out.data_ptr(), total.data_ptr())
    return out, total


def _compiled_sweep(
    factor: Tensor, diagonal: Tensor, half: Tensor, most: float, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    return _run(factor, half, None, diagonal, most, weights)


@register(
    "sweep(Tensor factor, Tensor diagonal, Tensor half, float most, Tensor? weights=None) -> (Tensor, Tensor)",
    kernel(_compiled_sweep),
    lambda factor, *_: _empty(factor),
)
def sweep(
    factor: Tensor, diagonal: Tensor, half: Tensor, most: float, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Compute the scaling d (B, N) for an estimate t of the moment, and the moment of d, (B, M) in float64.

    It takes ``half`` of t, (B, M), the upper limit ``most`` of d, and the number of pixels that each point represents,
    (B, N); None means one each. The moment is ``factor @ (weights * d)``.
    """
    scaling, row, totals = factor.new_empty(diagonal.shape), half.unsqueeze(2).mT, list[Tensor]()
    for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
        columns = factor[:, :, block]
        root = positive_root(spread(row, columns).squeeze(1), diagonal[:, block])
        part = torch.clamp(root, max=most, out=scaling[:, block])
        part = part if weights is None else part * weights[:, block]
        totals.append(gather(part.unsqueeze(1), columns).squeeze(1).double())
    return scaling, reduce(torch.add, totals)


def _compiled_weigh(factor: Tensor, weights: Tensor, vector: Tensor) -> Tensor:
    return _run(factor, vector, weights, None, 0.0)[1]


@register(
    "weigh(Tensor factor, Tensor weights, Tensor vector) -> Tensor",
    kernel(_compiled_weigh),
    lambda factor, *_: _empty(factor)[1],
)
def weigh(factor: Tensor, weights: Tensor, vector: Tensor) -> Tensor:
    """``factor diag(weights) factor^T vector``, (B, M) in float64, for a factor (B, M, N), (B, N) and (B, M)."""
    row, totals = vector.unsqueeze(2).mT, list[Tensor]()
    for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
        columns = factor[:, :, block]
        totals.append(gather(weights[:, None, block] * spread(row, columns), columns).squeeze(1).double())
    return reduce(torch.add, totals)


NEGLIGIBLE = 1e-15  # entries of F in float32 that count as zero: their products would be denormal, which is slow


def _fake_grams(factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int) -> Tensor:
    batch, landmarks, _ = factor.shape
    return factor.new_empty(batch, count, landmarks, landmarks, dtype=torch.float64)


def _compiled_grams(factor: Tensor, scaling: Tensor, remainder: Tensor | None, count: int) -> Tensor:
    out = _fake_grams(factor, scaling, remainder, count)
    factor, scaling = by_rows(factor), scaling.contiguous()
    remainder = scaling if remainder is None else remainder.contiguous()
    pointers = scaling.data_ptr(), remainder.data_ptr(), out.data_ptr()
    run_on_factor("grams", factor, count, *pointers, least=ONE_THREAD_COLUMNS)
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
        weights = scaling if remainder is None else remainder  # which are not needed for a single sum
        grad_weights = torch.zeros_like(weights)
        symmetric = (grad + grad.mT).to(factor)  # (B, J, M, M)
        for block, (rows, pulled, inner, product) in buffered_blocks(factor, 4):
            d = scaling[:, None, block]
            torch.mul(factor[:, :, block], d, out=rows)
            torch.bmm(symmetric[:, 0], rows, out=pulled)
            power = None  # r^(j - 1)
            for j in range(1, grad.shape[1]):
                torch.bmm(symmetric[:, j], rows, out=inner)
                slope = torch.mul(inner, rows, out=product).sum(1).mul_(j / 2)
                grad_weights[:, block] += slope if power is None else slope * power
                power = weights[:, block] if power is None else power * weights[:, block]
                pulled.addcmul_(inner, power.unsqueeze(1))
            grad_scaling[:, block] = torch.mul(pulled, factor[:, :, block], out=product).sum(1)
            grad_factor[:, :, block] = pulled.mul_(d)
        return grad_factor, grad_scaling, None if remainder is None else grad_weights, None, None
