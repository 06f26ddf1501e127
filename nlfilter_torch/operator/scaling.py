"""The scaling d of points: its moment, row sums of W, and d of any point as a function of the moment.

Given the moment ``t = sum_i w_i d_i u_i`` over all points, with weights w, a point's scaling satisfies
``d (u . t + c d) = 1``. The only positive root d(t) depends only on the point's own column u and diagonal c.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.tall_skinny import moment, positive_root, spread

EXCESS = {torch.float32: 1e-5, torch.float64: 1e-10}  # amount by which d of a pixel may exceed 1 through rounding


@dataclass(frozen=True)
class Balancing:
    """Result of balancing.

    Attributes:
        scaling: d, (B, N), positive.
        moment: t for this scaling, (B, M, 1) in float64, without a gradient.
        residual: largest deviation of a row sum from 1, (B,).
        steps: number of sweeps over the factor.
    """

    scaling: Tensor
    moment: Tensor
    residual: Tensor
    steps: int


@dataclass(frozen=True)
class Solution(Balancing):
    """Result of a balancing method, with the approximate inverse (B, M, M) of the Jacobian J, in float64."""

    inverse: Tensor


def scaling_from_moment(factor: Tensor, diagonal: Tensor, total: Tensor) -> Tensor:
    """Compute the scaling (B, N) of any pixels, given the moment ``factor @ d`` (B, M, 1) of a balanced image.

    The scaling is the positive root of ``d (u . total + diagonal d) = 1``, computed without cancellation for either
    sign of ``u . total``, which may be negative since approximate affinities may be.
    """
    return positive_root(spread((total / 2).mT, factor).squeeze(1), diagonal)


@dataclass(frozen=True, eq=False)
class KernelMatrix:
    """``K = U^T U + diag(c)`` over some points, never formed.

    Attributes:
        factor: U, (B, M, N).
        diagonal: c, (B, N).
        weights: number of identical pixels that each point represents, (B, N); None means one each.
        among: ranks that the points are distributed over.
    """

    factor: Tensor
    diagonal: Tensor
    weights: Tensor | None = None
    among: Communicator = ALONE

    def moment(self, values: Tensor) -> Tensor:
        """``U (weights * values)`` for values (B, N), summed over the ranks: (B, M, 1) in float64."""
        return self.among.sum(moment(self.factor, weighted(values, self.weights).unsqueeze(1)))

    def affinities(self, total: Tensor) -> Tensor:
        """``U^T total``, (B, N), for a vector of length M, (B, M, 1)."""
        return spread(total.to(self.factor).mT, self.factor).squeeze(1)

    def row_sums(self, scaling: Tensor, found: Tensor) -> Tensor:
        """Row sums (B, N) of W for a scaling d with the moment ``found``."""
        return scaling * (self.affinities(found) + self.diagonal * scaling)

    def largest(self, values: Tensor) -> Tensor:
        """Largest magnitude of the values (B, N) of each image, (B,); infinite if one of the values is NaN."""
        return self.among.max(values.abs().amax(1).nan_to_num(nan=torch.inf))


def isolated(scaling: Tensor, diagonal: Tensor, residual: float, weights: Tensor | None = None) -> Tensor:
    """Find pixels (B, n) whose affinities to all others sum to less than zero, for a kernel with a unit diagonal.

    The diagonal entry of W is d^2 and the other entries of the row sum to 1 - d^2, so d exceeds 1 at these pixels. It
    must exceed 1 by more than ``residual``, the error of row sums. A point that represents only a share w of a pixel
    has ``d^2 (c + w (1 - c))`` in place of d^2.
    """
    if weights is not None:
        scaling = scaling * (diagonal + weights.clamp(max=1.0) * (1 - diagonal)).clamp(min=0.0).sqrt()
    return scaling > 1 + max(EXCESS[scaling.dtype], residual)


@dataclass(frozen=True, eq=False)
class PixelScaling:
    """The scaling of any pixel as a function of the pixel's own column.

    Attributes:
        moment: t, (B, M, 1).
        completed: whether the kernel has a unit diagonal.
        residual: largest deviation of a row sum from 1.
        before: moments of earlier rounds of balancing, after each of which isolated pixels were removed.
        least: smallest weight of the points that the moment is a sum over, (B, 1); None means one.
    """

    moment: Tensor
    completed: bool
    residual: float = 0.0
    before: tuple[Tensor, ...] = ()
    least: Tensor | None = None

    def __call__(self, factor: Tensor, diagonal: Tensor) -> tuple[Tensor, Tensor]:
        """Compute d and r, the diagonal part of W, (B, n), of pixels with factor (B, M, n) and diagonal (B, n).

        An isolated pixel has d = 0 and r = 1.
        """
        scaling = scaling_from_moment(factor, diagonal, self.moment.to(factor))
        remainder = scaling * (scaling * diagonal)  # in this order: without completion d^2 may overflow
        if not self.completed:
            return scaling, remainder
        alone = isolated(scaling, diagonal, self.residual, self.least)
        for total in self.before:
            earlier = scaling_from_moment(factor, diagonal, total.to(factor))
            alone = alone | isolated(earlier, diagonal, self.residual, self.least)
        return torch.where(alone, 0.0, scaling), torch.where(alone, 1.0, remainder)
