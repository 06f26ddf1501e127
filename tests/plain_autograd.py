"""The filter as plain tensor operations, differentiated by autograd through every step of the balancing.

It has no blocks of pixels, no recomputation and no derivatives by hand. Tests compare gradients with it, and
``benchmarks/gradients.py`` time and memory.
"""

from itertools import pairwise

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.columns import SMALLEST_EXPONENT
from nlfilter_torch.operator.features import GuideFeatures, patch_window
from nlfilter_torch.operator.landmarks import assign_landmarks
from nlfilter_torch.operator.nystrom import JITTER
from nlfilter_torch.operator.options import FilterOptions

RELAXATION = 2.0 / 3.0


def affinity(left: Tensor, right: Tensor) -> Tensor:
    """exp(-|x_i - z_m|^2), (B, n, m), between features (B, D, n) and (B, D, m)."""
    centre = right.mean(dim=2, keepdim=True)
    x, z = (left - centre).mT, (right - centre).mT
    squared = x.square().sum(2, keepdim=True) + z.square().sum(2).unsqueeze(1) - 2 * x @ z.mT
    return torch.exp(-squared.clamp(0.0, -SMALLEST_EXPONENT))


def balanced(factor: Tensor, diagonal: Tensor, steps: int) -> Tensor:
    """d (B, N) for which diag(d) (F F^T + diag(diagonal)) diag(d) has unit row sums; factor (B, N, M)."""
    d = torch.ones_like(diagonal)
    for _ in range(steps):
        sums = (factor @ (factor.mT @ d.unsqueeze(2))).squeeze(2) + diagonal * d
        d = d * (d * sums) ** -RELAXATION
    return d


def plain_filter(
    guide: Tensor,
    image: Tensor,
    alpha: Tensor,
    *,
    patch_size: int = 5,
    photometric_bandwidth: float | Tensor,
    spatial_bandwidth: float | Tensor | None = None,
    num_landmarks: int = 100,
    completion: str = "diagonal",
    patch_weights: Tensor | None = None,
    steps: int = 14,
) -> Tensor:
    """Return what ``polynomial_filter`` returns for ``nonlocal_operator`` with these options, (B, C, H, W).

    Args:
        guide: (B, C', H, W), taken whole.
        image: (B, C, H, W).
        alpha: (k+1,) or (B, k+1).
        patch_size, photometric_bandwidth, spatial_bandwidth, num_landmarks, completion, patch_weights: of
            ``nonlocal_operator``.
        steps: of the balancing, each of which reduces the error by a factor of three; 14 reach float32.
    """
    weights = patch_window(patch_size).to(guide) if patch_weights is None else patch_weights / patch_weights.sum()
    recipe = GuideFeatures(weights, photometric_bandwidth, spatial_bandwidth, "all")
    features = recipe(guide)
    size = (guide.shape[2], guide.shape[3])
    landmarks, _ = assign_landmarks(features, size, FilterOptions(num_landmarks=num_landmarks), layout=recipe.layout)
    between = affinity(landmarks.double(), landmarks.double())  # (B, M, M), in float64 as it is badly conditioned
    identity = torch.eye(num_landmarks, dtype=torch.float64)
    lower = torch.linalg.cholesky(between + JITTER * identity)
    whitening = torch.linalg.solve_triangular(lower, identity.expand_as(lower), upper=False).to(features)
    factor = affinity(features, landmarks) @ whitening.mT  # (B, N, M)
    diagonal = torch.zeros_like(factor[:, :, 0])
    if completion == "diagonal":
        norms = factor.square().sum(2)
        factor = factor / norms.clamp(min=1.0).sqrt().unsqueeze(2)
        diagonal = (1.0 - norms).clamp(min=0.0)

    d = balanced(factor, diagonal, steps)
    scaled, remainder = factor * d.unsqueeze(2), (d.square() * diagonal).unsqueeze(2)
    y = image.flatten(2).mT  # (B, N, C)
    smooth = [y]
    for _ in range(alpha.shape[-1] - 1):
        smooth.append(scaled @ (scaled.mT @ smooth[-1]) + remainder * smooth[-1])
    layers = [fine - coarse for fine, coarse in pairwise(smooth)] + smooth[-1:]
    filtered = sum(alpha[..., i : i + 1, None] * layer for i, layer in enumerate(layers))
    return filtered.mT.unflatten(2, size)
