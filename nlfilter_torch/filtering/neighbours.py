"""Linear systems over the eight neighbours of each pixel, by preconditioned conjugate gradients.

With weights ``w_ij`` between neighbours and ``a_i`` of the pixels, the minimum over u of ``sum w_ij (u_i - u_j)^2 +
sum a_i (u_i - v_i)^2`` solves ``(L + diag(a)) u = a v``, where L is the Laplacian of the grid: every pixel is a
weighted mean of its neighbours and of its own value v. Pixels at the border have fewer neighbours.
"""

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_image, check_same_size
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.values import is_hidden

OFFSETS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (row, column) offsets to half of the neighbours, so each pair occurs once
STEPS = 300
SOLVED = {torch.float32: 1e-6, torch.float64: 1e-12}  # residual relative to the initial one

Slices = tuple[slice, slice]


def _sides(offset: tuple[int, int]) -> tuple[Slices, Slices]:
    """Slices of the pixels that have a neighbour at ``offset``, and of these neighbours."""
    down, right = offset
    here = (slice(None, -down or None), slice(1, None) if right < 0 else slice(None, -right or None))
    there = (slice(down, None), slice(None, -1) if right < 0 else slice(right, None))
    return here, there


SIDES = tuple(_sides(offset) for offset in OFFSETS)
PADDING = ((0, 1, 0, 0), (0, 0, 0, 1), (0, 1, 0, 1), (1, 0, 0, 1))  # from pixels with such a neighbour to all pixels


def neighbour_weights(guide: Tensor, weight: Callable[[Tensor], Tensor]) -> Tensor:
    """Compute weights between neighbours from their squared distances.

    Args:
        guide: (B, C, H, W).
        weight: function of squared distances (B, h, w), summed over the channels.

    Returns:
        (B, 4, H, W): weights of each pixel with its neighbour at each of :data:`OFFSETS`, 0 where there is none.
    """
    weights = []
    for (here, there), padding in zip(SIDES, PADDING, strict=True):
        distance = (guide[..., *here] - guide[..., *there]).square().sum(1)
        weights.append(F.pad(weight(distance), padding))
    return torch.stack(weights, dim=1)


@full_precision
def solve_neighbours(
    weights: Tensor, anchor: Tensor, values: Tensor, *, steps: int = STEPS, tolerance: float | None = None
) -> Tensor:
    """Minimise ``sum w_ij (u_i - u_j)^2 + sum a_i (u_i - v_i)^2`` over u.

    Args:
        weights: w, (B, 4, H, W), from :func:`neighbour_weights`, non-negative.
        anchor: a, (B, 1, H, W), non-negative. 1e5 times the weights fixes a pixel.
        values: v, (B, C, H, W); the iteration starts from them. A pixel without anchor and neighbours keeps its value.
        steps: maximum number of conjugate gradient steps; about ``sqrt(weights / anchor)`` times a small number is
            needed. In n steps a pixel depends on the pixels within n rows and columns, apart from the global inner
            products.
        tolerance: residual, relative to the initial one, below which the iteration stops on a CPU; None means 1e-6 in
            float32 and 1e-12 in float64.

    Returns:
        u, (B, C, H, W), within the range of the values up to the tolerance. Differentiable any number of times in
        weights, anchor and values.

    Raises:
        TypeError, ValueError: if the sizes differ.

    Example:
        >>> anchor, values = torch.zeros(1, 1, 1, 5), torch.zeros(1, 1, 1, 5)
        >>> anchor[..., 0] = anchor[..., 4] = 1e5
        >>> values[..., 4] = 1
        >>> weights = neighbour_weights(torch.zeros(1, 1, 1, 5), torch.ones_like)
        >>> solve_neighbours(weights, anchor, values).flatten().round(decimals=2)
        tensor([0.0000, 0.2500, 0.5000, 0.7500, 1.0000])
    """
    check_image(values, "values")
    check_image(weights, "weights", channels=4)
    check_image(anchor, "anchor", channels=1)
    size = (values.shape[-2], values.shape[-1])
    check_same_size(weights, size, "weights", "values")
    check_same_size(anchor, size, "anchor", "values")
    check_count(steps, "steps")
    batch, dtype = max(len(weights), len(anchor), len(values)), working_dtype(values)
    tolerance = SOLVED[dtype] if tolerance is None else tolerance
    weights, anchor, start = (part.to(dtype).expand(batch, -1, -1, -1) for part in (weights, anchor, values))
    # Solve for the difference from the values, which is small where they are fixed.
    change = _Solution.apply(weights, anchor, -laplacian(weights, start), steps, tolerance)  # type: ignore[no-untyped-call]
    return (start + change).to(values.dtype)


def laplacian(weights: Tensor, planes: Tensor) -> Tensor:
    """``L u`` for planes u (B, C, H, W)."""
    return multiply(weights, degrees(weights), planes)


def degrees(weights: Tensor) -> Tensor:
    """Sum (B, 1, H, W) of the weights of each pixel to its neighbours."""
    total = torch.zeros_like(weights[:, :1])
    for number, (here, there) in enumerate(SIDES):
        part = weights[:, number : number + 1, *here]
        total[..., *here] += part
        total[..., *there] += part
    return total


def multiply(weights: Tensor, diagonal: Tensor, planes: Tensor) -> Tensor:
    """``(diag(d) - w) u`` for planes u (B, C, H, W) and d (B, 1, H, W)."""
    product = diagonal * planes
    for number, (here, there) in enumerate(SIDES):
        part = weights[:, number : number + 1, *here]
        product[..., *here].addcmul_(part, planes[..., *there], value=-1)
        product[..., *there].addcmul_(part, planes[..., *here], value=-1)
    return product


class _Solution(torch.autograd.Function):
    """Solution u of ``(L + diag(a)) u = right``. The gradient takes one more solve with the same matrix."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, anchor: Tensor, right: Tensor, steps: int, tolerance: float) -> Tensor:
        solution = conjugate_gradients(weights, anchor, right, steps, tolerance)
        ctx.save_for_backward(weights, anchor, solution)
        ctx.options = steps, tolerance
        return solution

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        weights, anchor, solution = ctx.saved_tensors
        right: Tensor = _Solution.apply(weights, anchor, gradients[0], *ctx.options)  # type: ignore[no-untyped-call]
        by_weights = []
        for (here, there), padding in zip(SIDES, PADDING, strict=True):
            one, other = (planes[..., *here] - planes[..., *there] for planes in (right, solution))
            by_weights.append(F.pad(-(one * other).sum(1), padding))
        by_anchor = -(right * solution).sum(1, keepdim=True)
        return torch.stack(by_weights, dim=1), by_anchor, right, None, None


def conjugate_gradients(weights: Tensor, anchor: Tensor, right: Tensor, steps: int, tolerance: float) -> Tensor:
    """Solve ``(L + diag(a)) u = right`` for u (B, C, H, W), independently for each image and channel."""
    tiny = torch.finfo(right.dtype).tiny  # avoids 0 / 0: if the right side is zero, so is the solution
    diagonal = degrees(weights) + anchor
    inverse = torch.where(diagonal > 0, 1 / diagonal.clamp(min=tiny), 0.0)
    solution, residual = torch.zeros_like(right), right.clone()
    direction = inverse * residual
    size = _products(residual, direction)
    goal = tolerance**2 * size
    for _ in range(steps):
        image = multiply(weights, diagonal, direction)
        step = size / _products(direction, image).clamp(min=tiny)
        solution.addcmul_(step, direction)
        residual.addcmul_(step, image, value=-1)
        preconditioned = inverse * residual
        before, size = size, _products(residual, preconditioned)
        if not is_hidden(right) and bool((size <= goal).all()):
            break
        direction = torch.addcmul(preconditioned, size / before.clamp(min=tiny), direction)
    return solution


def _products(one: Tensor, other: Tensor) -> Tensor:
    """Inner products (B, C, 1, 1)."""
    return one.flatten(2).unsqueeze(2) @ other.flatten(2).unsqueeze(3)
