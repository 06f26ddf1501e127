"""W of some points as a matrix: products, powers, solutions of shifted systems, and their gradients. Paper: eq. (13).

With ``W = D U^T U D Omega + R`` (scaling D, weights Omega of the points, diagonal part R), the identity of Woodbury
gives ``(W + t I)^-1 y = (R + t)^-1 (y - D U^T C^-1 U D Omega (R + t)^-1 y)`` with the M x M matrix
``C = I + U D^2 Omega (R + t)^-1 U^T``: one Gram matrix and two reads of the factor, without iteration.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import root_weighted, weighted
from nlfilter_torch.core.communicator import Communicator
from nlfilter_torch.core.kernels.grams import compute_grams
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.low_rank import outer_product
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.torch_internals import for_each_gradient, in_transform, is_hidden

SMALL = 1 << 17  # pixels up to which Gram matrices are summed in float64 throughout
ROWS = 8  # images in one product; the kernels in C are fastest for at most so many


@dataclass(frozen=True, eq=False)
class PixelMatrix:
    """W, or its transpose, for planes (B, C, N).

    Attributes:
        factor: U, (B, M, N).
        scaling: d, (B, N).
        remainder: r, (B, N).
        communicator: ranks that the points are distributed over.
        weights: number of pixels that each point represents, (B, N), or None.
        transposed: whether it is the transpose of W, which differs if there are weights.
    """

    factor: Tensor
    scaling: Tensor
    remainder: Tensor
    communicator: Communicator
    weights: Tensor | None = None
    transposed: bool = False

    @property
    def transpose(self) -> "PixelMatrix":
        """W^T."""
        return replace(self, transposed=not self.transposed)

    @property
    def needs_gradient(self) -> bool:
        """Whether W is to be differentiated."""
        return torch.is_grad_enabled() and any(t.requires_grad for t in (self.factor, self.scaling, self.remainder))

    def _sums(self, planes: Tensor) -> Tensor:
        """Sums over points on the right of the product, (B, M, C) in float64."""
        scaling = self.scaling.unsqueeze(1)
        mass = scaling if self.transposed else weighted(scaling, self.weights)
        return self.communicator.sum(moment(self.factor, mass * planes))

    def _spread(self, sums: Tensor) -> Tensor:
        """Planes (B, C, N) on the left of the product, from sums (B, M, C)."""
        scaling = weighted(self.scaling, self.weights) if self.transposed else self.scaling
        return spread(sums.mT.to(self.factor), self.factor, scaling)

    def product(self, planes: Tensor) -> Tensor:
        """``W y`` for planes y, (B, C, N)."""
        return self._product(planes, self._sums(planes))

    def _product(self, planes: Tensor, sums: Tensor) -> Tensor:
        """:meth:`product`, from the sums of the planes."""
        return torch.addcmul(self._spread(sums), self.remainder.unsqueeze(1), planes)

    def powers(self, planes: Tensor, order: int) -> Tensor:
        """``W y, W^2 y, ..., W^k y``, (B, k, C, N), for planes y, (B, C, N); of W itself, not of its transpose.

        Differentiable in W and the planes. If W needs no gradient, differentiable any number of times in the planes,
        also in forward mode.
        """
        if self.needs_gradient and not in_transform():  # which needs ordinary operations
            parts = self.factor, self.scaling, self.remainder
            result: Tensor = _Powers.apply(*parts, self.communicator, self.weights, planes, order)  # type: ignore[no-untyped-call]
            return result
        return torch.stack(self.powers_and_sums(planes, order)[0][1:], dim=1)

    def powers_and_sums(self, planes: Tensor, order: int) -> tuple[list[Tensor], list[Tensor]]:
        """The k + 1 planes ``y, ..., W^k y``, and the sums (B, M, C) of all but the last, as ordinary operations."""
        images, sums = [planes], []
        for _ in range(order):
            sums.append(self._sums(images[-1]).to(self.factor))
            images.append(self._product(images[-1], sums[-1]))
        return images, sums

    def capacitances(self, shifts: Tensor) -> Tensor:
        """Inverses of C for positive shifts (J,), (B, J, M, M) in float64; without a gradient."""
        batch, landmarks, _ = self.factor.shape
        if len(shifts) == 0:
            return self.factor.new_empty(batch, 0, landmarks, landmarks, dtype=torch.float64)
        with torch.no_grad():
            return torch.stack([self._capacitance(shift) for shift in shifts.to(self.remainder).unbind()], dim=1)

    def _capacitance(self, shift: Tensor) -> Tensor:
        """Inverse of C for one shift, (B, M, M)."""
        factor, scaling = self.factor.detach(), root_weighted(self.scaling.detach(), self.weights)
        exact = sums_exactly(factor.dtype, factor.shape[2])
        gram = self.communicator.sum(shifted_gram(factor, scaling, self.remainder.detach(), shift, exact=exact))
        return capacitance_inverse(gram)

    def solve(self, planes: Tensor, shifts: Tensor, capacitances: Tensor) -> Tensor:
        """``t_j (W + t_j I)^-1 y`` for all shifts, (B, J, C, N), for planes y (B, C, N).

        Args:
            planes: y.
            shifts: t, (J,).
            capacitances: those of the shifts, (B, J, M, M).
        """
        step = max(1, ROWS // planes.shape[1])
        parts = zip(shifts.to(self.remainder).split(step), capacitances.split(step, dim=1), strict=True)
        return torch.cat([self._solve(planes, part, inverses) for part, inverses in parts], dim=1)

    def _solve(self, planes: Tensor, shifts: Tensor, inverses: Tensor) -> Tensor:
        """:meth:`solve` for a few shifts, with one read of the factor in each direction."""
        count, channels = len(shifts), planes.shape[1]
        lowered = shifted_remainder(self.remainder, shifts)
        sums = self._sums((lowered * planes.unsqueeze(1)).flatten(1, 2))  # (B, M, J C)
        sums = inverses @ sums.unflatten(2, (count, channels)).transpose(1, 2) / shifts.double().view(1, -1, 1, 1)
        smooth = self._spread(sums.transpose(1, 2).flatten(2)).unflatten(1, (count, channels))
        return lowered * (planes.unsqueeze(1) - smooth)

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


class _Powers(torch.autograd.Function):
    """Powers of W with a single matrix product as gradient of the factor; autograd would form 2k full matrices.

    With ``P_i = W P_(i-1)`` and, backwards, ``A_(i-1) = G_(i-1) + W^T A_i``, the loss changes by ``sum_i A_i^T dW
    P_(i-1)``. Weights multiply the columns of W.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        *parts, planes, order = arguments
        images, moments = PixelMatrix(*parts).powers_and_sums(planes, order)
        factor, scaling, remainder, ctx.communicator, weights = parts
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
        return grad_factor, grad_scaling, grad_remainder, None, None, adjoint, None


def sums_exactly(dtype: torch.dtype, pixels: int) -> bool:
    """Whether Gram matrices of so many pixels are summed in float64."""
    return dtype == torch.float32 and pixels <= SMALL


def shifted_gram(factor: Tensor, scaling: Tensor, remainder: Tensor, shift: Tensor, *, exact: bool) -> Tensor:
    """``U D^2 (R + t)^-1 U^T`` for a shift t, (B, M, M) in float64."""
    return compute_grams(factor, scaling * (remainder + shift).rsqrt(), None, 1, exact=exact)[:, 0]


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


def shifted_remainder(remainder: Tensor, shifts: Tensor) -> Tensor:
    """``t_j / (r + t_j)`` for shifts t, (B, J, 1, N)."""
    return shifts.view(1, -1, 1, 1) / (remainder[:, None, None] + shifts.view(1, -1, 1, 1))
