"""Limiting the eigenvalues of W to 1, and bounding them from above, by means of M x M matrices.

The entries of an approximate kernel may be negative, so unit row sums do not imply eigenvalues of at most 1. For
``W = F^T F + R`` and x above every r, the Schur complement gives a criterion: no eigenvalue of W exceeds x if and only
if the eigenvalues of ``S = F (x I - R)^-1 F^T`` are at most 1. At x = 1 the moment ``t = F 1`` is an eigenvector of S
with eigenvalue 1, since ``F^T t = 1 - r``. Reducing the larger eigenvalues of S to 1 therefore preserves the row sums:
with ``X = min(1, S^-1)`` the operator ``F^T X F + R`` is symmetric, has unit row sums and eigenvalues in [0, 1], and
differs from W only in the directions whose eigenvalues of S exceed 1.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from nlfilter_torch.core.symmetric_matrix import SymmetricMatrix
from nlfilter_torch.operator.options import Landmarks

# Amount by which eigenvalues may exceed 1 through rounding and inexact row sums; r exceeds 1 by less.
SLACK = {torch.float32: 3e-5, torch.float64: 1e-9}
MAX_STEPS = 12
ALWAYS = 1 << 22  # elements of a factor; up to this size the bound takes a few milliseconds

# ``F (x I - R)^-k F^T``, (B, M, M) in float64, for x of shape (B,) and k; see :meth:`PixelMatrix.gram_below`.
ShiftedGram = Callable[[Tensor, int], Tensor]


def is_bounded(landmarks: Landmarks, pixels: int, num_landmarks: int) -> bool:
    """Whether the eigenvalues of an operator are checked against 1 when it is built.

    They are not for large images with k-means landmarks: among thousands of such operators, of photographs and of
    adversarial images, no eigenvalue exceeded 1, and the check would add a third to the time of building one.
    Landmarks that are held or passed may lie anywhere.
    """
    return not isinstance(landmarks, str) or landmarks != "kmeans" or pixels * num_landmarks <= ALWAYS


def slack(dtype: torch.dtype, residual: float) -> float:
    """Amount by which eigenvalues may exceed 1 if row sums deviate from 1 by up to ``residual``."""
    return max(SLACK[dtype], residual)


@torch.no_grad()
def exceeds(gram: ShiftedGram, moment: Tensor, slack: float) -> Tensor:
    """Whether an eigenvalue of W exceeds 1 by more than ``slack``, of each image of a batch, (B,)."""
    matrix = gram(torch.full_like(moment[:, 0, 0], 1 + slack), 1)
    identity = torch.eye(matrix.shape[1], dtype=matrix.dtype, device=matrix.device)
    return torch.linalg.cholesky_ex(identity - matrix).info != 0


def limiter(gram: ShiftedGram, moment: Tensor, slack: float) -> Tensor:
    """Compute ``X^(1/2)``, (B, M, M) in float64; multiplying the factor by it limits eigenvalues to 1 + ``slack``.

    Differentiable in whatever ``gram`` and the moment t = F 1, (B, M, 1) in float64, depend on.
    """
    matrix = gram(torch.full_like(moment[:, 0, 0], 1 + slack), 1)
    # t is an eigenvector up to the slack. Projecting it out makes it an exact one, which keeps the row sums exact.
    unit = moment / moment.norm(dim=1, keepdim=True).clamp(min=torch.finfo(moment.dtype).tiny)
    others = torch.eye(matrix.shape[1], dtype=matrix.dtype, device=matrix.device) - unit @ unit.mT
    matrix = others @ torch.where(matrix.isfinite(), matrix, torch.zeros_like(matrix)) @ others
    largest = 1 - slack / 10
    every = torch.ones_like(moment[:, :, 0], dtype=torch.bool)
    symmetric = SymmetricMatrix.of((matrix + matrix.mT) / 2)
    return symmetric.apply(lambda values: (values / largest).clamp(min=1.0).rsqrt(), every)


def largest_eigenvalue(gram: ShiftedGram, remainder: Tensor, dtype: torch.dtype) -> Tensor:
    """Upper bound of the eigenvalues of W, (B,) in float64: 1 if none exceeds 1 by more than rounding.

    ``remainder`` is the largest r of each image, (B,), and ``dtype`` that of the factor.
    """
    limit = 1 + SLACK[dtype]
    # S is singular at the largest r. If that exceeds the limit, start a thousandth above it.
    at = torch.where(remainder < limit, limit, 1.001 * remainder.double())
    matrix = gram(at, 1)
    identity = torch.eye(matrix.shape[1], dtype=matrix.dtype, device=matrix.device)
    holds = (torch.linalg.cholesky_ex(identity - matrix).info == 0) & (at == limit)
    for _ in range(MAX_STEPS):
        finite = matrix.isfinite().all(2).all(1)
        values, vectors = torch.linalg.eigh(torch.where(finite[:, None, None], matrix, identity))
        largest, vector = values[:, -1], vectors[:, :, -1:]
        exceeds = finite & (largest > limit)
        if not bool(exceeds.any()):
            break
        # Rayleigh quotient of (x I - R)^-1 F^T v; converges quadratically from below.
        length = (vector.mT @ gram(at, 2) @ vector)[:, 0, 0]
        at = torch.where(exceeds, at + (largest.square() - largest) / length, at)
        matrix = gram(at, 1)
    return torch.where(holds, 1.0, torch.where(finite, at * largest.clamp(min=1.0), torch.inf))
