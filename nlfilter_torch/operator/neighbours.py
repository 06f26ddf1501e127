"""Distances of points to their nearest neighbours, from which scales of points follow, and a bandwidth for all."""

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_features
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.operator.traps import sampled_points

NEIGHBOURS = 10
LEAST_BANDWIDTH = 1e-6  # bandwidth over the largest distance from the centre, for points of which most are equal
POINTS_AT_ONCE = 256  # points whose affinities are added up
HALVINGS = 40


@full_precision
def neighbour_distances(points: Tensor, k: int = NEIGHBOURS) -> Tensor:
    """Distance of points to the k-th nearest of all others: the local scale of Zelnik-Manor and Perona, 2004.

    Args:
        points: (B, D, N).
        k: number of the neighbour, from 1; the farthest one where there are fewer.

    Returns:
        (B, N) in the units and dtype of the points, in time proportional to N^2. Differentiable in the points, with the
        neighbours held.

    Raises:
        TypeError, ValueError: if ``points`` are not a finite floating-point (B, D, N) tensor, or ``k`` is not positive.

    Example:
        >>> neighbour_distances(torch.tensor([[[0.0, 1.0, 3.0, 7.0]]]), k=1)
        tensor([[1., 1., 2., 4.]])
    """
    check_features(points, "points")
    check_count(k, "k")
    values = points.to(working_dtype(points))
    places = torch.arange(points.shape[2], device=points.device)
    kept = min(k, points.shape[2] - 1)
    parts = []
    with torch.no_grad():  # a block at a time
        centred = (values - values.mean(2, keepdim=True)).double()
        norms = centred.square().sum(1)
        for block in places.split(512):
            squared = norms[:, block, None] + norms[:, None] - 2 * centred[:, :, block].mT @ centred
            squared[:, torch.arange(len(block)), block] = -torch.inf  # the point itself comes first
            parts.append(squared.topk(kept + 1, largest=False).indices[..., -1])
    nearest = torch.cat(parts, dim=1).unsqueeze(1).expand(-1, points.shape[1], -1)
    squares = (values - values.gather(2, nearest)).double().square().sum(1)  # which would overflow in float32
    apart = squares > 0  # the root has no derivative at 0
    return torch.where(apart, torch.where(apart, squares, 1.0).sqrt(), 0.0).to(points.dtype)


@torch.no_grad()
@full_precision
def bandwidth_of_points(points: Tensor, k: int = NEIGHBOURS) -> Tensor:
    """Estimate a bandwidth (B,) of points (B, D, N), at which a point has k neighbours.

    It is the bandwidth at which the affinities ``exp(-|x_i - x_j|^2 / h^2)`` of a point to all others add up to k, in
    the median of a sample of points. On a plane that is the distance to the k-th neighbour. In many dimensions, where
    far points are many and hardly farther than near ones, it is less, so that they do not outweigh the neighbours.
    Divide the points by it for :func:`operator_from_features`. No gradient is propagated.

    Raises:
        TypeError, ValueError: if ``points`` are not a finite floating-point (B, D, N) tensor, or ``k`` is not positive.

    Example:
        >>> points = torch.rand(1, 2, 2000, generator=torch.Generator().manual_seed(0))
        >>> bandwidth_of_points(points).round(decimals=2)
        tensor([0.0400])
    """
    check_features(points, "points")
    check_count(k, "k")
    sample = sampled_points(points.shape[2], POINTS_AT_ONCE)[:: 2 if points.shape[2] <= 2 * POINTS_AT_ONCE else 1].to(
        points.device
    )
    values = (points - points.mean(2, keepdim=True)).double()
    norms = values.square().sum(1)
    squared = norms[:, sample, None] + norms[:, None] - 2 * values[:, :, sample].mT @ values
    squared[:, torch.arange(len(sample)), sample] = torch.inf  # not of itself
    squared = squared.clamp(min=0)
    wanted = min(k, 0.5 * (points.shape[2] - 1))  # all others only at an infinite bandwidth
    largest = norms.amax(1).sqrt()
    largest = torch.where(largest > 0, largest, 1.0)
    low, high = (LEAST_BANDWIDTH * largest).log(), (1e3 * largest).log()
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        sums = torch.exp(-squared / (2 * middle).exp()[:, None, None]).sum(2).median(1).values
        few = sums < wanted
        low, high = torch.where(few, middle, low), torch.where(few, high, middle)
    return high.exp().to(points.dtype)
