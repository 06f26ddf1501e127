"""Products of a rational function of W with images: a polynomial by products with W, poles by shifted systems."""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.communicator import Communicator
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.core.torch_internals import for_each_gradient
from nlfilter_torch.operator.pixel_matrix import PixelMatrix


def rational_product(matrix: PixelMatrix, planes: Tensor, form: RationalForm, coefficients: Tensor) -> Tensor:
    """``sum_k a_k T_k(2 W - 1) y + sum_j c_j t_j (W + t_j)^-1 y``, (B, C, N).

    Args:
        matrix: W.
        planes: y, (B, C, N).
        form: of the function.
        coefficients: a and c, (B, degree + 1 + J).

    Returns:
        Planes, whose gradient in all arguments is that of this rational function, to rounding. If W needs none,
        differentiable any number of times, also in forward mode.
    """
    shifts = form.shifts.to(planes)
    if not matrix.needs_gradient:
        return _product(matrix, planes, shifts, matrix.capacitances(shifts), coefficients.to(planes))
    result: Tensor = _RationalProduct.apply(  # type: ignore[no-untyped-call]
        *matrix.parts, planes, coefficients.to(planes), shifts
    )
    return result


def _product(matrix: PixelMatrix, planes: Tensor, shifts: Tensor, inverses: Tensor, coefficients: Tensor) -> Tensor:
    degree = coefficients.shape[1] - len(shifts) - 1
    coefficients = coefficients.unsqueeze(2).unsqueeze(3)  # (B, K, 1, 1)
    total = coefficients[:, 0] * planes
    for k, term in enumerate(_chebyshev(matrix, planes, degree)):
        total = torch.addcmul(total, coefficients[:, k], term) if k else total
    step = max(1, 8 // planes.shape[1])
    for first in range(0, len(shifts), step):  # a few at a time, to save memory
        part = slice(first, first + step)
        solutions = matrix.solve(planes, shifts[part], inverses[:, part])
        total = total + (coefficients[:, degree + 1 :][:, part] * solutions).sum(1)
    return total


def pole_terms(matrix: PixelMatrix, planes: Tensor, form: RationalForm) -> Tensor:
    """``t_j (W + t_j)^-1 y`` for all poles, (B, J, C, N); without a gradient in W."""
    shifts = form.shifts.to(planes)
    return matrix.solve(planes, shifts, matrix.capacitances(shifts))


def weigh_poles(planes: Tensor, terms: Tensor, weights: Tensor) -> Tensor:
    """``w_0 y + sum_j w_j y_j`` for planes y, (B, C, N), terms y_j, (B, J, C, N), and weights (B, 1 + J)."""
    weights = weights.to(planes)[:, :, None, None]
    total = weights[:, 0] * planes
    for j in range(terms.shape[1]):
        total = torch.addcmul(total, weights[:, 1 + j], terms[:, j])
    return total


def _chebyshev(matrix: PixelMatrix, planes: Tensor, degree: int) -> list[Tensor]:
    """``T_k(2 W - 1) y`` for k from 0 to ``degree``."""
    terms = [planes]
    for k in range(degree):
        doubled = 2 * matrix.product(terms[-1]) - terms[-1]  # (2 W - 1) T_k y
        terms.append(doubled if k == 0 else 2 * doubled - terms[-2])
    return terms


class _RationalProduct(torch.autograd.Function):
    """The product, with the derivative of poles: ``d (W + t)^-1 = -(W + t)^-1 dW (W + t)^-1``."""

    @staticmethod
    def forward(
        ctx: Any,
        factor: Tensor,
        scaling: Tensor,
        remainder: Tensor,
        weights: Tensor | None,
        communicator: Communicator,
        planes: Tensor,
        coefficients: Tensor,
        shifts: Tensor,
    ) -> Tensor:
        matrix = PixelMatrix(factor, scaling, remainder, weights, communicator)
        inverses, ctx.communicator = matrix.capacitances(shifts), communicator
        ctx.save_for_backward(factor, scaling, remainder, weights, planes, coefficients, shifts, inverses)
        return _product(matrix, planes, shifts, inverses, coefficients)

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        factor, scaling, remainder, weights, planes, coefficients, shifts, inverses = ctx.saved_tensors
        matrix = PixelMatrix(factor, scaling, remainder, weights, ctx.communicator)
        degree = coefficients.shape[1] - len(shifts) - 1
        parts = coefficients[:, :, None, None]
        terms, adjoints = _chebyshev(matrix, planes, degree), _adjoints(matrix.transpose, grad, parts, degree)
        grad_coefficients = [(grad * term).sum((1, 2)) for term in terms]
        # v_1 = (2 W - 1) v_0 and v_(k+1) = 2 (2 W - 1) v_k - v_(k-1)
        left = [(2 if k == 1 else 4) * adjoints[k] for k in range(1, degree + 1)]
        right, grad_planes = terms[:-1], adjoints[0]
        for j in range(len(shifts)):
            shift = shifts[j : j + 1]
            part, inverse = parts[:, degree + 1 + j], inverses[:, j : j + 1]
            solution = matrix.solve(planes, shift, inverse)[:, 0]
            adjoint = matrix.transpose.solve(part * grad, shift, inverse)[:, 0]
            grad_coefficients.append((grad * solution).sum((1, 2)))
            grad_planes = grad_planes + adjoint
            left.append(-adjoint / shift)
            right.append(solution)
        grads: tuple[Tensor | None, ...] = (None, None, None)
        if left:
            grads = matrix.gradient(torch.cat(left, dim=1), torch.cat(right, dim=1))
        return (*grads, None, None, grad_planes, torch.stack(grad_coefficients, dim=1), None)


def _adjoints(matrix: PixelMatrix, grad: Tensor, coefficients: Tensor, degree: int) -> list[Tensor]:
    """Gradients of the terms of :func:`_chebyshev` (Clenshaw), for the transpose of its matrix."""
    later = last = torch.zeros_like(grad)  # those of the terms k + 2 and k + 1
    adjoints: list[Tensor] = []
    for k in range(degree, -1, -1):
        current = coefficients[:, k] * grad - later
        if k < degree:
            doubled = 2 * matrix.product(last) - last
            current = current + (doubled if k == 0 else 2 * doubled)
        later, last = last, current
        adjoints.append(current)
    return adjoints[::-1]
