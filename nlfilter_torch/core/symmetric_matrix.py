"""Functions of small symmetric matrices, with a gradient that is finite for repeated eigenvalues.

The gradient of eigenvectors from ``torch.linalg.eigh`` divides by ``lambda_i - lambda_j`` and is NaN for equal
eigenvalues, as on any image of two flat colours. A function ``f(A) = Q f(Lambda) Q^T`` does not depend on the choice of
Q, and its derivative is finite: ``Q (D * (Q^T dA Q)) Q^T`` with the divided differences ``D_ij = (f_i - f_j) /
(lambda_i - lambda_j)``, or f' if the eigenvalues are equal (Daleckii and Krein, 1965).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.precision import once_differentiable, uncompiled
from nlfilter_torch.core.torch_internals import are_derived, for_each_gradient, in_transform

# For eigenvalues with a relative distance below MEETING, f' at their midpoint is used: the truncation error, in f''',
# and the cancellation error are then both near 1e-10. For eigenvalues below FLOOR the distance is relative to FLOOR,
# since zero eigenvalues are zero only up to rounding. A function that computes in float32 needs a larger distance.
MEETING = {torch.float64: 1e-5, torch.float32: 3e-3}
FLOOR = 1e-5


@dataclass(frozen=True)
class SymmetricMatrix:
    """A batch of symmetric matrices with its eigen-decomposition.

    Attributes:
        matrix: (B, M, M), with its gradient.
        eigenvalues: (B, M), descending, without gradient.
        vectors: (B, M, M), columns, without gradient.
    """

    matrix: Tensor
    eigenvalues: Tensor
    vectors: Tensor

    @staticmethod
    def of(matrix: Tensor) -> "SymmetricMatrix":
        """Decompose ``matrix`` (B, M, M), positive semi-definite up to rounding."""
        eigenvalues, vectors = torch.linalg.eigh(matrix.detach())
        return SymmetricMatrix(matrix, eigenvalues.flip(-1).clamp(min=0.0), vectors.flip(-1))

    @uncompiled
    def apply(self, function: Callable[[Tensor], Tensor], support: Tensor) -> Tensor:
        """Compute f(A) restricted to the eigenvalues in ``support``.

        Args:
            function: elementwise and differentiable, (B, M) to (B, M); may have parameters that need a gradient.
            support: (B, M) bool; where False, f is 0 and ``function`` is not evaluated.

        Returns:
            (B, M, M), differentiable once in the matrix and in the parameters of ``function``.
        """
        # Outside the support f is evaluated at 1, where responses and their derivatives are finite.
        points = torch.where(support, self.eigenvalues, torch.ones_like(self.eigenvalues))
        gains = function(points)
        meeting = MEETING.get(gains.dtype, MEETING[torch.float32])
        values = torch.where(support, gains.to(points), torch.zeros_like(points))
        if not self.matrix.requires_grad or in_transform():
            constant = (self.vectors * values.unsqueeze(-2)) @ self.vectors.mT
            if not are_derived([self.matrix]):
                return constant
            change = self.matrix - self.matrix.detach()  # zero, with a derivative
            inner = self.vectors.mT @ ((change + change.mT) / 2) @ self.vectors
            return (
                constant
                + self.vectors @ (self._differences(function, values, support, meeting) * inner) @ self.vectors.mT
            )
        result: Tensor = _SpectralFunction.apply(  # type: ignore[no-untyped-call]
            self.matrix, values, self.vectors, self._differences(function, values, support, meeting)
        )
        return result

    def _differences(
        self, function: Callable[[Tensor], Tensor], values: Tensor, support: Tensor, meeting: float
    ) -> Tensor:
        """Divided differences (B, M, M) of f over the eigenvalues; those of float32 functions ``meet`` earlier."""
        both = support.unsqueeze(-1) & support.unsqueeze(-2)
        pair = self.eigenvalues, values
        return divided_differences(function, pair, pair, both, meeting=meeting)


def divided_differences(
    function: Callable[[Tensor], Tensor],
    left: tuple[Tensor, Tensor],
    right: tuple[Tensor, Tensor],
    both: Tensor | None = None,
    *,
    meeting: float,
) -> Tensor:
    """Divided differences (..., k, l) of f between two sets of points, (..., k) and (..., l).

    Args:
        function: f, elementwise, (B, R) to (B, R).
        left: points, and values of f there.
        right: the same of the other set.
        both: (..., k, l) bool, where f is defined at both points; None means everywhere.
        meeting: relative distance of points below which the derivative at their midpoint is taken.
    """
    gap = left[0].unsqueeze(-1) - right[0].unsqueeze(-2)
    middle = (left[0].unsqueeze(-1) + right[0].unsqueeze(-2)) / 2
    near = gap.abs() < meeting * middle.clamp(min=FLOOR)
    near = near if both is None else both & near
    slopes = slope(function, torch.where(near, middle, torch.ones_like(middle)))
    change = left[1].detach().unsqueeze(-1) - right[1].detach().unsqueeze(-2)
    return torch.where(near, slopes, change / torch.where(gap == 0, torch.ones_like(gap), gap))


def slope(function: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """Derivative of f at ``points`` (B, ...); f may differ between the images of a batch."""
    if in_transform():
        gradient: Tensor = torch.func.grad(lambda flat: function(flat).sum())(points.detach().flatten(1))
        return gradient.view_as(points)
    with torch.enable_grad():
        points = points.detach().requires_grad_()
        total = function(points.flatten(1)).sum()
        if not total.requires_grad:
            return torch.zeros_like(points)
        # A constant function may still have parameters.
        return torch.autograd.grad(total, points, allow_unused=True, materialize_grads=True)[0]


class _SpectralFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrix: Tensor, values: Tensor, vectors: Tensor, differences: Tensor) -> Tensor:
        ctx.save_for_backward(vectors, differences, matrix)
        return (vectors * values.unsqueeze(-2)) @ vectors.mT

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        vectors, differences, _ = ctx.saved_tensors
        inner = vectors.mT @ ((grad + grad.mT) / 2) @ vectors
        grad_matrix = vectors @ (differences * inner) @ vectors.mT
        return grad_matrix, inner.diagonal(dim1=-2, dim2=-1), None, None
