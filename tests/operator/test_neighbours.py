"""Distances to neighbours, their gradients, and the bandwidth that follows."""

import torch

from nlfilter_torch import bandwidth_of_points, neighbour_distances
from tests.problems import noise


def test_distances_are_those_of_all_pairs() -> None:
    points = noise(2, 3, 40)
    distances = torch.cdist(points.mT, points.mT).sort(2).values
    torch.testing.assert_close(neighbour_distances(points, 4), distances[:, :, 4])
    torch.testing.assert_close(neighbour_distances(points, 99), distances[:, :, -1])


def test_affinities_at_the_bandwidth_add_up_to_the_number() -> None:
    points = noise(2, 3, 60)
    bandwidth = bandwidth_of_points(points, 4)
    affinities = torch.exp(-(torch.cdist(points.mT, points.mT) / bandwidth[:, None, None]).square()).sum(2) - 1
    torch.testing.assert_close(affinities[:, ::2].median(1).values, torch.full((2,), 4.0, dtype=torch.float64))
    torch.testing.assert_close(bandwidth_of_points(10 * points, 4), 10 * bandwidth)
    assert bool(bandwidth_of_points(points[..., :1]).isfinite().all())


def test_gradients_and_equal_points() -> None:
    points = noise(1, 2, 12).requires_grad_()
    torch.autograd.gradcheck(lambda x: neighbour_distances(x, 3), points)
    same = torch.ones(1, 2, 5, requires_grad=True)
    neighbour_distances(same, 2).sum().backward()
    assert torch.equal(same.grad, torch.zeros_like(same))
    assert float(bandwidth_of_points(same)) > 0
