"""W of some points as a matrix: products, powers, solutions of shifted systems, and their gradients. Paper: eq. (13).

With ``W = D U^T U D Omega + R`` (scaling D, weights Omega of the points, diagonal part R), the identity of Woodbury
gives ``(W + t I)^-1 y = (R + t)^-1 (y - D U^T C^-1 U D Omega (R + t)^-1 y)`` with the M x M matrix
``C = I + U D^2 Omega (R + t)^-1 U^T``: one Gram matrix and two reads of the factor, without iteration.

Products, powers and solutions all have one form: sums over the points, a small matrix, and a spread of the result. The
sums of :class:`Columns` are those over a block, such as a tile, and are added up; those of :class:`PixelMatrix` are
over all points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Protocol

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import root_weighted, weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.tall_skinny import compute_grams, moment, spread, sum_grams
from nlfilter_torch.core.precision import Gradients, once_differentiable
from nlfilter_torch.core.torch_internals import for_each_gradient, in_transform, is_hidden, outer_product

SUMMED_EXACTLY = 1 << 17  # pixels up to which Gram matrices are summed in float64 throughout
LEAST_APART = 1e-9  # of the smallest difference from r
ROWS = 8  # images in one product; the kernels in C are fastest for at most so many


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of some points: ``W_ij = d_i u_i . u_j d_j w_j``, plus r_i where i = j.

    A block of the sums over points that products with W and functions of it consist of; F is factor diag(d).

    Attributes:
        factor: u, (B, M, n).
        scaling: d, (B, n).
        remainder: r, (B, n).
        weights: w, the number of pixels that each point represents, (B, n); None means one each.
    """

    factor: Tensor
    scaling: Tensor
    remainder: Tensor
    weights: Tensor | None = None

    @property
    def mass(self) -> Tensor:
        """Coefficients (B, n) of sums over points, d w."""
        return weighted(self.scaling, self.weights)

    def sums(self, planes: Tensor) -> Tensor:
        """``F diag(w) y`` over the points for planes y (B, C, n): (B, M, C) in float64."""
        return moment(self.factor, self.mass.unsqueeze(1) * planes)

    def spread(self, sums: Tensor) -> Tensor:
        """``F^T c``, (B, C, n), from sums c over all points, (B, M, C)."""
        return spread(sums.mT.to(self.factor), self.factor, self.scaling)

    def powers_of(self, planes: Tensor, smooth: Tensor) -> list[Tensor]:
        """``y, W y, ..., W^k y`` for planes y (B, C, n).

        ``smooth`` (B, k, C, n) is ``F^T`` times the sums of all but the last over all points.
        """
        powers = [planes]
        for part in smooth.unbind(1):
            powers.append(torch.addcmul(part, self.remainder.unsqueeze(1), powers[-1]))
        return powers

    def spread_each(self, sums: Tensor) -> Tensor:
        """:meth:`spread` of sums (B, k, M, C) in one read of the factor, (B, k, C, n)."""
        return self.spread(sums.transpose(1, 2).flatten(2)).unflatten(1, (sums.shape[1], sums.shape[3]))

    def grams(self, count: int) -> Tensor:
        """``F diag(w r^j) F^T`` over the points for j = 0 to count - 1, (B, J, M, M) in float64."""
        return sum_grams(self.factor, root_weighted(self.scaling, self.weights), self.remainder, count)

    def gram_below(self, at: Tensor, power: int) -> Tensor:
        """``F diag(w) (x I - R)^-k F^T`` over the points for x (B,) above every r, and k: (B, M, M) in float64."""
        apart = (at.unsqueeze(1) - self.remainder.double()).clamp(min=LEAST_APART)
        scaling = root_weighted(self.scaling, self.weights) * apart.pow(-power / 2)
        return compute_grams(self.factor, scaling.to(self.factor), None, 1)[:, 0]

    def shifted_grams(self, shifts: Tensor, *, exact: bool) -> Tensor:
        """``F diag(w) (R + t_j)^-1 F^T`` over the points for shifts t (J,), (B, J, M, M) in float64."""
        scaling = root_weighted(self.scaling, self.weights)
        roots = ((self.remainder + shift).rsqrt() for shift in shifts.to(self.remainder).unbind())
        grams = [compute_grams(self.factor, scaling * root, None, 1, exact=exact)[:, 0] for root in roots]
        return torch.stack(grams, dim=1)

    def lowered(self, shifts: Tensor) -> Tensor:
        """``t_j / (r + t_j)`` for shifts t, (B, J, 1, n)."""
        shifts = shifts.to(self.remainder).view(1, -1, 1, 1)
        return shifts / (self.remainder[:, None, None] + shifts)

    def shifted_sums(self, planes: Tensor, shifts: Tensor) -> Tensor:
        """``F diag(w) (R + t_j)^-1 y`` over the points for planes y (B, C, n), (B, J, M, C) in float64."""
        sums = self.sums((self.lowered(shifts) * planes.unsqueeze(1)).flatten(1, 2)).unflatten(2, (len(shifts), -1))
        return sums.transpose(1, 2) / shifts.double().view(1, -1, 1, 1)

    def shifted_solutions(self, planes: Tensor, shifts: Tensor, inner: Tensor) -> Tensor:
        """``t_j (W + t_j I)^-1 y``, (B, J, C, n), for planes y (B, C, n).

        ``inner`` (B, J, M, C) are the :meth:`shifted_sums` of all points, times the inverses of C.
        """
        return self.lowered(shifts) * (planes.unsqueeze(1) - self.spread_each(inner))


@dataclass(frozen=True, eq=False)
class PixelMatrix(Columns):
    """W, or its transpose, for planes (B, C, N): the columns of all points, or of those of this rank.

    Attributes:
        communicator: ranks that the points are distributed over.
        transposed: whether it is the transpose of W, which differs if there are weights.
    """

    communicator: Communicator = ALONE
    transposed: bool = False

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Communicator]:
        """What W is made of."""
        return self.factor, self.scaling, self.remainder, self.weights, self.communicator

    @property
    def transpose(self) -> "PixelMatrix":
        """W^T."""
        return replace(self, transposed=not self.transposed)

    @property
    def needs_gradient(self) -> bool:
        """Whether W is to be differentiated."""
        return torch.is_grad_enabled() and any(t.requires_grad for t in (self.factor, self.scaling, self.remainder))

    @property
    def mass(self) -> Tensor:
        """Coefficients (B, N) of sums on the right of the product."""
        return self.scaling if self.transposed else weighted(self.scaling, self.weights)

    def sums(self, planes: Tensor) -> Tensor:
        """Sums over all points on the right of the product, (B, M, C) in float64."""
        return self.communicator.sum(super().sums(planes))

    def spread(self, sums: Tensor) -> Tensor:
        """Planes (B, C, N) on the left of the product, from sums (B, M, C)."""
        return weighted(super().spread(sums), self.weights) if self.transposed else super().spread(sums)

    def gram_below(self, at: Tensor, power: int) -> Tensor:
        """:meth:`Columns.gram_below` over all points."""
        return self.communicator.sum(super().gram_below(at, power))

    def product(self, planes: Tensor) -> Tensor:
        """``W y`` for planes y, (B, C, N)."""
        return torch.addcmul(self.spread(self.sums(planes)), self.remainder.unsqueeze(1), planes)

    def powers(self, planes: Tensor, order: int) -> Tensor:
        """``W y, W^2 y, ..., W^k y``, (B, k, C, N), for planes y, (B, C, N); of W itself, not of its transpose.

        Differentiable in W and the planes. If W needs no gradient, differentiable any number of times in the planes,
        also in forward mode.
        """
        if self.needs_gradient and not in_transform():  # which needs ordinary operations
            result: Tensor = _Powers.apply(*self.parts, planes, order)  # type: ignore[no-untyped-call]
            return result
        return torch.stack(self.powers_and_sums(planes, order)[0][1:], dim=1)

    def powers_and_sums(self, planes: Tensor, order: int) -> tuple[list[Tensor], list[Tensor]]:
        """The k + 1 planes ``y, ..., W^k y``, and the sums (B, M, C) of all but the last, as ordinary operations."""
        images, sums = [planes], []
        for _ in range(order):
            sums.append(self.sums(images[-1]).to(self.factor))
            images.append(torch.addcmul(self.spread(sums[-1]), self.remainder.unsqueeze(1), images[-1]))
        return images, sums

    @torch.no_grad()
    def capacitances(self, shifts: Tensor) -> Tensor:
        """Inverses of C for positive shifts (J,), (B, J, M, M) in float64; without a gradient."""
        batch, landmarks, pixels = self.factor.shape
        if len(shifts) == 0:
            return self.factor.new_empty(batch, 0, landmarks, landmarks, dtype=torch.float64)
        grams = self.shifted_grams(shifts, exact=sums_exactly(self.factor.dtype, pixels))
        return torch.stack([capacitance_inverse(self.communicator.sum(gram)) for gram in grams.unbind(1)], dim=1)

    def solve(self, planes: Tensor, shifts: Tensor, capacitances: Tensor) -> Tensor:
        """``t_j (W + t_j I)^-1 y`` for all shifts, (B, J, C, N), for planes y (B, C, N).

        Args:
            planes: y.
            shifts: t, (J,).
            capacitances: those of the shifts, (B, J, M, M).
        """
        step = max(1, ROWS // planes.shape[1])  # a few shifts with one read of the factor in each direction
        parts = zip(shifts.split(step), capacitances.split(step, dim=1), strict=True)
        solutions = [
            self.shifted_solutions(planes, part, inverses @ self.shifted_sums(planes, part)) for part, inverses in parts
        ]
        return torch.cat(solutions, dim=1)

    def apply(self, function: "MatrixFunction", planes: Tensor, gains: Tensor) -> Tensor:
        """``f(W) y`` for planes y, (B, C, N), and the gains of f; differentiable once in W and both."""
        tensors = self.factor, self.scaling, self.remainder
        factor, scaling, remainder = (tensor.detach() for tensor in tensors)
        constant = replace(self, factor=factor, scaling=scaling, remainder=remainder)
        result: Tensor = _Application.apply(*tensors, planes, gains, constant, function)  # type: ignore[no-untyped-call]
        return result

    def gradient(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gradient of ``sum_k left_k^T W right_k`` for planes (B, K, N): those of factor, scaling and remainder.

        For W itself, not for its transpose.
        """
        d, summed = self.scaling.unsqueeze(1), weighted(right, self.weights)
        totals, moments = (
            self.communicator.sum(moment(self.factor, d * planes)).to(self.factor) for planes in (left, summed)
        )
        grad_scaling = (left * spread(moments.mT, self.factor) + summed * spread(totals.mT, self.factor)).sum(1)
        grad_factor = outer_product(torch.cat([moments, totals], dim=2), torch.cat([d * left, d * summed], dim=1))
        return grad_factor, grad_scaling, (left * right).sum(1)


class MatrixFunction(Protocol):
    """A function f of W whose derivative is written by hand."""

    def value(self, matrix: PixelMatrix, planes: Tensor, gains: Tensor) -> Tensor:
        """``f(W) y`` for planes y, (B, C, N), and gains that determine f."""

    def gradients(
        self, matrix: PixelMatrix, planes: Tensor, gains: Tensor, grad: Tensor, needed: Sequence[bool]
    ) -> Gradients:
        """Those of factor, scaling, remainder, planes and gains; None where none is ``needed``, in this order."""


class _Application(torch.autograd.Function):
    """``f(W) y`` by a :class:`MatrixFunction`."""

    @staticmethod
    def forward(
        ctx: Any,
        factor: Tensor,
        scaling: Tensor,
        remainder: Tensor,
        planes: Tensor,
        gains: Tensor,
        constant: PixelMatrix,
        function: MatrixFunction,
    ) -> Tensor:
        ctx.save_for_backward(factor, scaling, remainder, planes, gains)
        ctx.constant, ctx.function = constant, function
        return function.value(constant, planes, gains)

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        *_, planes, gains = ctx.saved_tensors
        return *ctx.function.gradients(ctx.constant, planes, gains, grad, ctx.needs_input_grad), None, None


class _Powers(torch.autograd.Function):
    """Powers of W with a single matrix product as gradient of the factor; autograd would form 2k full matrices.

    With ``P_i = W P_(i-1)`` and, backwards, ``A_(i-1) = G_(i-1) + W^T A_i``, the loss changes by ``sum_i A_i^T dW
    P_(i-1)``. Weights multiply the columns of W. Written out, since sums of the forward pass and of the adjoints serve
    twice: by :meth:`PixelMatrix.gradient` for all powers at once, a training step took 22 % longer.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        factor, scaling, remainder, weights, ctx.communicator, planes, order = arguments
        matrix = PixelMatrix(factor, scaling, remainder, weights, ctx.communicator)
        images, moments = matrix.powers_and_sums(planes, order)
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
        of_scaling, of_remainder = list[Tensor](), list[Tensor]()  # terms of the gradients
        left, right = [], []  # columns (B, M, C) and rows (B, C, N) whose product is the gradient of the factor
        adjoint = grad[:, order - 1]
        for i in range(order, 0, -1):
            before = images[i - 1]
            total = ctx.communicator.sum(moment(factor, d * adjoint)).to(factor)
            affinity = spread(total.mT, factor)  # the image of the adjoint, before scaling
            summed = weighted(before, weights)
            # The scaling multiplies the factor on both sides; each side contributes a product with the other.
            of_scaling.append((adjoint * spread(moments[i - 1].mT, factor) + summed * affinity).sum(1))
            of_remainder.append((adjoint * before).sum(1))
            left += [moments[i - 1], total]
            right += [d * adjoint, d * summed]
            adjoint = weighted(d * affinity, weights) + r * adjoint
            adjoint = adjoint + grad[:, i - 2] if i > 1 else adjoint
        grad_factor = outer_product(torch.cat(left, dim=2), torch.cat(right, dim=1))
        return grad_factor, reduce(torch.add, of_scaling), reduce(torch.add, of_remainder), None, None, adjoint, None


def sums_exactly(dtype: torch.dtype, pixels: int) -> bool:
    """Whether Gram matrices of so many pixels are summed in float64."""
    return dtype == torch.float32 and pixels <= SUMMED_EXACTLY


def capacitance_inverse(gram: Tensor) -> Tensor:
    """Inverse of I plus Gram matrices (..., M, M)."""
    unit = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    if not is_hidden(gram):
        triangle, failure = torch.linalg.cholesky_ex(unit + gram)
        if not bool(failure.any()):
            return torch.cholesky_inverse(triangle)
    # Rounding may leave a Gram matrix with negative eigenvalues, if the shift is far below the largest eigenvalue.
    values, vectors = torch.linalg.eigh((gram + gram.mT) / 2)
    return (vectors / (1 + values.clamp(min=0.0)).unsqueeze(-2)) @ vectors.mT
