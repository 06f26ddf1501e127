"""Nystrom factor of the affinity matrix: ``K ~ factor^T factor + diag(diagonal)``. Paper: Sec. II-C.

Where the paper uses square roots and pseudo-inverses of the landmark block, the inverse of its Cholesky factor is used
here. ``completion`` restores the unit diagonal of K, so that a pixel unlike all landmarks keeps its value; without it
the row of such a pixel is nearly zero.

A pixel's column of the factor is a function of its own patch and of the landmarks; its scaling follows from the column
and one vector of length M. Tiles of a large image, rows on another machine and other frames of a film therefore get
exact columns, without seams or flicker, if they share landmarks and moments.
"""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.columns import columns, columns_backward
from nlfilter_torch.core.precision import once_differentiable
from nlfilter_torch.core.torch_internals import factors_of, for_each_gradient, is_hidden, register
from nlfilter_torch.operator.options import Completion

DISTANCE_ERROR = 1e-7  # error of a squared distance above which distances are not computed from matrix products
LARGEST_SQUARE = 60.0  # distance: smaller affinities would become denormal numbers of float32, which are slow
JITTER = 1e-5  # added to the landmark block; limits the amplification of rounding by the inverse factor to 316 times

ROOT_CONVERGED = 1e-12  # distance from 1, the limit of all eigenvalues of the Newton-Schulz iteration


def inverse_cholesky(landmarks: Tensor) -> Tensor:
    """Inverse Cholesky factor (B, M, M) of the affinities between ``landmarks`` (B, D, M), computed in float64."""
    points = landmarks.double()
    points = points - points.mean(dim=2, keepdim=True)
    squared = _squared_distances(points)
    identity = torch.eye(landmarks.shape[2], dtype=torch.float64, device=landmarks.device)
    # The distance of a landmark to itself is zero by definition, whatever the rounding of the three terms.
    squared = squared.clamp(0.0, LARGEST_SQUARE) * (1 - identity)
    return invert(torch.exp(-squared) + JITTER * identity).to(landmarks)


@register(
    "invert(Tensor affinity) -> Tensor",
    None,
    lambda affinity: affinity.new_empty(affinity.shape),
    differentiable=True,
)
def invert(affinity: Tensor) -> Tensor:
    """Inverse Cholesky factor (B, M, M) of positive definite matrices (B, M, M)."""
    if torch.compiler.is_compiling():  # a program is traced through, as for ONNX, which has no Cholesky factors
        return inverse_root(affinity)
    lower = torch.linalg.cholesky(affinity)
    identity = torch.eye(affinity.shape[1], dtype=affinity.dtype, device=affinity.device)
    return torch.linalg.solve_triangular(lower, identity.expand_as(lower), upper=False).contiguous()


def inverse_root(affinity: Tensor) -> Tensor:
    """Inverse square root (B, M, M) of the affinities between landmarks, in matrix products alone.

    Like the inverse Cholesky factor, it makes a Nystrom factor of the affinities of pixels; the two factors differ by a
    rotation. In the coupled Newton-Schulz iteration all eigenvalues tend to 1; scaling by a bound of the smallest
    halves the steps.
    """
    batch, count, _ = affinity.shape
    identity = torch.eye(count, dtype=affinity.dtype, device=affinity.device).expand(batch, -1, -1)
    most = affinity.sum(2, keepdim=True).amax(1, keepdim=True)  # bounds the eigenvalues; at most M + JITTER
    root, inverse = affinity / most, identity
    least = (JITTER / (count + JITTER)) ** 0.5
    while least < 1 - ROOT_CONVERGED:
        scale = (3 / (1 + least + least * least)) ** 0.5
        step = torch.baddbmm(identity, inverse, root, beta=1.5 * scale, alpha=-0.5 * scale**3)
        root, inverse = torch.bmm(root, step), torch.bmm(step, inverse)
        least = scale * least * (3 - (scale * least) ** 2) / 2
    return inverse / most.sqrt()


def _squared_distances(points: Tensor) -> Tensor:
    """Squared distances (B, M, M) between points (B, D, M) in float64."""
    norms = points.square().sum(1)
    # Matrix products cancel where points are many bandwidths apart, and the affinity matrix may then have a negative
    # eigenvalue.
    if not is_hidden(points) and not float(norms.detach().max()) * torch.finfo(points.dtype).eps < DISTANCE_ERROR:
        return torch.stack([(points - landmark.unsqueeze(2)).square().sum(1) for landmark in points.unbind(2)], dim=1)
    return norms.unsqueeze(2) + norms.unsqueeze(1) - 2 * points.mT @ points


def nystrom_factor(
    features: Tensor, landmarks: Tensor, inverse: Tensor, completion: Completion
) -> tuple[Tensor, Tensor]:
    """Compute the Nystrom factor of the affinities of all pixels, and the correction of its diagonal.

    Takes features (B, D, N), landmarks (B, D, M) and their :func:`inverse_cholesky`. With completion, the factor
    (B, M, N) has columns of norm at most 1 and the diagonal (B, N) lies in [0, 1]; without it the diagonal is zero.
    Differentiable once in the three tensors; the backward pass recomputes the affinities block by block.
    """
    factor, diagonal, _ = _NystromFactor.apply(features, landmarks, inverse, completion == "diagonal")  # type: ignore[no-untyped-call]
    return factor, diagonal


class _NystromFactor(torch.autograd.Function):
    """u = A c(x, z), scaled to norm at most 1, and 1 - |u|^2. The third output, the scale, is for the backward pass."""

    @staticmethod
    def forward(
        ctx: Any, features: Tensor, landmarks: Tensor, inverse: Tensor, complete: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        factor, norms = columns(features, landmarks, inverse, limited=complete)
        diagonal, scale = (1.0 - norms).clamp_(min=0.0), norms.clamp_(min=1.0).rsqrt_()
        ctx.save_for_backward(features, landmarks, inverse, factor, scale)
        ctx.complete = complete
        ctx.mark_non_differentiable(scale)
        return factor, diagonal, scale

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad_factor: Tensor, grad_diagonal: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        features, landmarks, inverse, factor, scale = ctx.saved_tensors
        gradients = columns_backward(
            features,
            landmarks,
            inverse,
            limited=ctx.complete,
            factor=factor,
            scale=scale,
            gradient=factors_of(grad_factor),
            diagonal=grad_diagonal,
        )
        return *gradients, None
