"""Means and the range of values of a picture, of the pixels that count."""

import torch
from torch import Tensor

LEAST_WEIGHT = 1e-6  # below which a pixel does not count


def ends_of(planes: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Least and largest values (B, C, 1, 1) of planes (B, C, H, W) where weights (B or 1, 1, H, W) are not 0."""
    least, most = planes, planes
    if weights is not None:
        least, most = (torch.where(weights > 0, planes, end) for end in (torch.inf, -torch.inf))
    return least.amin((2, 3), keepdim=True), most.amax((2, 3), keepdim=True)


def mean_of(planes: Tensor, weights: Tensor | None) -> Tensor:
    """Means (B, C, 1, 1) of planes (B, C, H, W), with weights (B or 1, 1, H, W)."""
    if weights is None:
        return planes.mean((2, 3), keepdim=True)
    return (planes * weights).sum((2, 3), keepdim=True) / weights.sum((2, 3), keepdim=True)


def usable(weights: Tensor | None) -> Tensor | None:
    """Weights (B, 1, H, W), with 0 for tiny ones; None if all are 1, or if no pixel of some image counts."""
    if weights is None or bool((weights == 1).all()):
        return None
    weights = torch.where(weights < LEAST_WEIGHT, 0.0, weights)
    return weights if bool((weights.amax((2, 3)) > 0).all()) else None
