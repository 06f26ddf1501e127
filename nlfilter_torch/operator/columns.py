"""Columns of ``W = F^T F + diag(r)``, where F = factor diag(d)."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of some points: ``W_ij = d_i u_i . u_j d_j``, plus r_i where i = j.

    Attributes:
        factor: u, (B, M, n).
        scaling: d, (B, n).
        remainder: r, (B, n).
    """

    factor: Tensor
    scaling: Tensor
    remainder: Tensor
