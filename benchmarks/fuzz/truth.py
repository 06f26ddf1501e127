"""Properties of an operator, computed in float64 from its tensors."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch import NonlocalOperator

DENSE = 320  # pixels up to which all eigenvalues are computed
STEPS = 25  # limit of the iteration for the largest eigenvalue, which takes 3 to 6


@dataclass(frozen=True)
class Exact:
    """``W = F^T F + diag(D)`` in float64.

    Attributes:
        factor: F, (B, M, N).
        diagonal: D, (B, N).
    """

    factor: Tensor
    diagonal: Tensor

    @staticmethod
    def of(operator: NonlocalOperator) -> "Exact":
        """Read W from an operator, for every image of its batch."""
        factor, scaling, remainder = (
            t.detach().double() for t in (operator.factor, operator.scaling, operator.remainder)
        )
        return Exact(factor * scaling.unsqueeze(1), remainder)

    def product(self, planes: Tensor) -> Tensor:
        """``W y`` for y (B, R, N)."""
        return (planes @ self.factor.mT) @ self.factor + self.diagonal.unsqueeze(1) * planes

    def dense(self) -> Tensor:
        """W, (B, N, N)."""
        return self.factor.mT @ self.factor + torch.diag_embed(self.diagonal)

    def row_sum_errors(self) -> Tensor:
        """Largest deviation of a row sum from 1, (B,)."""
        return (self.product(torch.ones_like(self.diagonal).unsqueeze(1)) - 1).abs().amax((1, 2))

    def eigenvalue_range(self) -> tuple[Tensor, Tensor]:
        """Smallest and largest eigenvalue, (B,) each; for large images, a lower bound of the smallest."""
        if self.diagonal.shape[1] <= DENSE:
            values = torch.linalg.eigvalsh(self.dense())
            return values[:, 0], values[:, -1]
        pairs = zip(self.factor, self.diagonal, strict=True)
        return self.diagonal.amin(1), torch.stack([_largest(*pair) for pair in pairs])


def _largest(factor: Tensor, diagonal: Tensor) -> Tensor:
    """The largest eigenvalue of ``F^T F + diag(D)``, for F (M, N) and D (N,).

    For l above D, an eigenvector x of eigenvalue l is ``x = (l - D)^-1 F^T v``, where ``S(l) v = v`` and
    ``S(l) = F (l - D)^-1 F^T`` is M x M. For the leading eigenvector v of any S(l), with eigenvalue m, the Rayleigh
    quotient of this x is ``l + (m - 1) m / |x|^2``, the next l. No Rayleigh quotient exceeds the largest eigenvalue.
    """
    floor = diagonal.max()
    best = (factor.square().sum(0) + diagonal).max()  # nor does a diagonal entry of W
    value = torch.maximum(best, torch.ones_like(best)) * (1 + 1e-6)
    for _ in range(STEPS):
        inverse = (value - diagonal).reciprocal()
        values, vectors = torch.linalg.eigh((factor * inverse) @ factor.mT)
        m, x = values[-1], inverse * (vectors[:, -1] @ factor)
        if not x.any():
            break
        before, best = best, torch.maximum(best, value + (m - 1) * m / x.square().sum())
        value = torch.maximum(best, floor + 1e-10 * (1 + floor.abs()))
        if best - before <= 1e-9 * best:
            break
    return best
