"""Features and landmarks to a factor of the affinity matrix: ``K ~ factor^T factor + diag(diagonal)``.

Paper: Sec. II-C. The paper takes square roots and pseudo-inverses of the sampled block; here it is whitened by its
Cholesky factor, and what the landmarks miss is put back on the diagonal (``completion``), so that K keeps its unit
diagonal and a pixel like no other keeps its value. The plain method gives such a pixel a row of about zero.
"""

from typing import Any, Literal

import torch
from torch import Tensor

from nlfilter_torch.core import kernels as native
from nlfilter_torch.core.autograd import factors_of, once_differentiable, strips_of_gradient, write_columns
from nlfilter_torch.core.blocks import buffered_blocks, large_empty, strip_count, strips
from nlfilter_torch.core.kernels.affinity import Affinity, cancels

Completion = Literal["diagonal", "none"]

JITTER = 1e-5  # bounds the amplification of rounding by the whitening at 316, which float32 can bear


def whitener(landmarks: Tensor) -> Tensor:
    """Inverse Cholesky factor (B, M, M) of the affinities between ``landmarks`` (B, D, M), worked out in float64."""
    points = landmarks.double()
    points = points - points.mean(dim=2, keepdim=True)
    norms = points.square().sum(1)
    squared = norms.unsqueeze(2) + norms.unsqueeze(1) - 2 * points.mT @ points
    identity = torch.eye(landmarks.shape[2], dtype=torch.float64, device=landmarks.device)
    # The distance of a landmark to itself is zero by definition, whatever the rounding of the three terms.
    affinity = torch.exp(-squared.clamp(min=0.0) * (1 - identity)) + JITTER * identity
    lower = torch.linalg.cholesky(affinity)
    return torch.linalg.solve_triangular(lower, identity.expand_as(lower), upper=False).to(landmarks)


def nystrom_factor(
    features: Tensor, landmarks: Tensor, whitening: Tensor, completion: Completion
) -> tuple[Tensor, Tensor]:
    """Nystrom factor of the affinities of every pixel, and the diagonal that completes it.

    Args:
        features: (B, D, N).
        landmarks: (B, D, M).
        whitening: (B, M, M) of :func:`whitener`.
        completion: ``"diagonal"`` or ``"none"``.

    Returns:
        factor (B, M, N) with columns of norm at most 1, and diagonal (B, N) in [0, 1] (zero without completion).
        Differentiable once in the three tensors; the backward pass recomputes the affinities block by block.
    """
    factor, diagonal, _ = _NystromFactor.apply(features, landmarks, whitening, completion == "diagonal")  # type: ignore[no-untyped-call]
    return factor, diagonal


class _NystromFactor(torch.autograd.Function):
    """u = A c(x, z), scaled to norm at most 1, and 1 - |u|^2; the third output is the scale, kept for the backward."""

    @staticmethod
    def forward(
        ctx: Any, features: Tensor, landmarks: Tensor, whitening: Tensor, complete: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        batch, _, pixels = features.shape
        factor = large_empty((batch, landmarks.shape[2], pixels), features)
        norms = features.new_ones(batch, pixels)  # |u|^2
        natively = native.suits(features, landmarks, whitening) and not cancels(landmarks)
        (_fill_natively if natively else _fill)(features, landmarks, whitening, complete, factor, norms)
        diagonal, scale = (1.0 - norms).clamp_(min=0.0), norms.clamp_(min=1.0).rsqrt_()
        ctx.save_for_backward(features, landmarks, whitening, factor, scale)
        ctx.complete = complete
        ctx.mark_non_differentiable(scale)
        return factor, diagonal, scale

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_factor: Tensor, grad_diagonal: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        features, landmarks, whitening, factor, scale = ctx.saved_tensors
        tensors = (features, landmarks, whitening, factor, scale, grad_diagonal, *factors_of(grad_factor))
        if native.suits(*tensors) and not cancels(landmarks):
            inputs = (features, landmarks, whitening)
            return *_backward_natively(*inputs, factor, scale, ctx.complete, grad_factor, grad_diagonal), None
        grad_features = large_empty(features.shape, features)
        batch, pixels = scale.shape
        count = strip_count(batch, pixels, features.device)
        landmarks, whitening = _repeat(landmarks, count), _repeat(whitening, count)
        features, factor = strips(features, count), strips(factor, count)
        scale, grad_diagonal = (vector.reshape(count * batch, -1) for vector in (scale, grad_diagonal))
        grad_factor, grad_parts = strips_of_gradient(grad_factor, count), strips(grad_features, count)
        affinity = Affinity(landmarks, ctx.complete)
        grad_landmarks = torch.zeros_like(landmarks, dtype=torch.float64)
        grad_whitening = torch.zeros_like(whitening, dtype=torch.float64)
        for block, (first, second, third) in buffered_blocks(factor, 3):
            kernel, centred = affinity(features[:, :, block], first)
            grad = write_columns(grad_factor, block, second)
            if ctx.complete:
                # Columns scaled to u / |u| lose the gradient along themselves; the others gain that of 1 - |u|^2.
                shrink = scale[:, None, block]
                along = torch.mul(factor[:, :, block], grad, out=third).sum(1, keepdim=True)
                along = torch.where(shrink < 1.0, along, 2.0 * grad_diagonal[:, None, block])
                grad.sub_(torch.mul(factor[:, :, block], along, out=third)).mul_(shrink)
            grad_whitening += grad @ kernel.mT
            # K_im = exp(-|x_i - z_m|^2): its derivative is -2 (x_i - z_m) K_im in x_i and the opposite in z_m.
            pull = torch.bmm(whitening.mT, grad, out=third).mul_(kernel)  # (B, M, n)
            grad_parts[:, :, block] = 2.0 * (affinity.landmarks @ pull - centred * pull.sum(1, keepdim=True))
            grad_landmarks += 2.0 * (centred @ pull.mT - affinity.landmarks * pull.sum(2).unsqueeze(1))
        if count > 1:
            grad_landmarks, grad_whitening = grad_landmarks.sum(0, keepdim=True), grad_whitening.sum(0, keepdim=True)
        return grad_features, grad_landmarks.to(landmarks), grad_whitening.to(whitening), None


def _fill(
    features: Tensor, landmarks: Tensor, whitening: Tensor, complete: bool, factor: Tensor, norms: Tensor
) -> None:
    """Write the columns to ``factor`` and, of a completed kernel, what they measured before to ``norms``."""
    batch, pixels = norms.shape
    count = strip_count(batch, pixels, features.device)
    affinity = Affinity(_repeat(landmarks, count), complete)
    whitenings = _repeat(whitening, count)
    parts, columns_of, norms_of = strips(features, count), strips(factor, count), norms.view(count * batch, -1)
    for block, (first, second) in buffered_blocks(columns_of, 2):
        kernel, _ = affinity(parts[:, :, block], first)
        columns = torch.bmm(whitenings, kernel, out=second)  # into a buffer: rows of the factor are far apart
        if complete:
            norm = torch.sum(torch.square(columns, out=first), 1, out=norms_of[:, block])
            # Norms exceed 1 by rounding alone, most blocks need no scaling; looking is a wait on accelerators.
            if features.device.type != "cpu" or norm.max().item() > 1.0:
                columns.mul_(norm.clamp(min=1.0).rsqrt_().unsqueeze(1))
        columns_of[:, :, block] = columns


def _fill_natively(
    features: Tensor, landmarks: Tensor, whitening: Tensor, complete: bool, factor: Tensor, norms: Tensor
) -> None:
    """:func:`_fill` by the kernel in C."""
    native.columns(features, Affinity(landmarks, complete), whitening, limited=complete, out=factor, norms=norms)


def _backward_natively(
    features: Tensor,
    landmarks: Tensor,
    whitening: Tensor,
    factor: Tensor,
    scale: Tensor,
    complete: bool,
    grad_factor: Tensor,
    grad_diagonal: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """The gradients of features, landmarks and whitening by the kernel in C."""
    affinity = Affinity(landmarks, complete)
    # K_im = exp(-|x_i - z_m|^2): its derivative is -2 (x_i - z_m) K_im in x_i and the opposite in z_m.
    points = 2.0 * torch.cat([affinity.landmarks, torch.ones_like(landmarks[:, :1])], dim=1)
    grad_features = large_empty(features.shape, features)
    grad_whitening, sums = native.columns_backward(
        features, affinity, whitening, limited=complete, factor=factor, scale=scale,
        gradient=factors_of(grad_factor), diagonal=grad_diagonal, points=points, out=grad_features,
    )  # fmt: skip
    grad_landmarks = 2.0 * (sums[:, :, :-1].mT - affinity.landmarks * sums[:, None, :, -1])
    return grad_features, grad_landmarks.to(landmarks), grad_whitening.to(whitening)


def _repeat(matrices: Tensor, count: int) -> Tensor:
    """Matrices (1, ., .) for each of the strips of an image; those of a batch, (B, ., .), which counts as one, once."""
    return matrices.repeat(count, 1, 1)
