"""The model of an object: mixtures, the cut, distances along the picture, and what the parts do together."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.selections import object_model
from nlfilter_torch.photo.selections.object_model import OFFSETS, Points, cut, nearness, neighbours, radii_beyond
from tests.problems import box, noise, seeded


def test_log_densities_are_those_of_gaussians() -> None:
    places = noise(1, 3, 1, 40)[0, :, 0]
    points, weights = Points.of(places), noise(1, 1, 1, 40, seed=1).flatten()
    mixture = points.mixture(weights, 3)
    gaussians = torch.distributions.MultivariateNormal(mixture.means, mixture.covariances)
    wanted = gaussians.log_prob(points.places.T.unsqueeze(1)).T + mixture.weights.log().unsqueeze(1)
    found = points.log_densities(mixture) - 1.5 * np.log(2 * np.pi)
    torch.testing.assert_close(found, wanted)


def test_moments_are_weighted_means_and_covariances() -> None:
    places, weights = noise(1, 2, 1, 30)[0, :, 0], noise(1, 1, 1, 30, seed=1)[0, :, 0]
    (share,), (mean,), (covariance,) = Points.of(places).moments(weights)
    centred = (places - places.mean(1, keepdim=True)).numpy()
    assert float(share) == 1
    np.testing.assert_allclose(mean, np.average(centred, axis=1, weights=weights[0]))
    wanted = np.cov(centred, aweights=weights[0], bias=True) + object_model.FLOOR * np.eye(2)
    np.testing.assert_allclose(covariance, wanted)


def test_apart_groups_are_found_whatever_the_order_of_the_points() -> None:
    middles = torch.tensor([[0.0, 0.0], [1.0, 0.1], [0.2, 1.0]]).double()
    places = (middles[:, :, None] + 0.05 * noise(3, 2, 1, 50)[:, :, 0]).permute(1, 0, 2).flatten(1)
    order = torch.randperm(150, generator=seeded(0))
    labels = [Points.of(places[:, way]).split(torch.ones(150).double(), 3) for way in (torch.arange(150), order)]
    for part in labels[0].unflatten(1, (3, 50)):
        assert part.double().mean(1).max() > 0.9
    assert torch.equal(labels[0][:, order], labels[1])


def test_the_cut_is_the_maximum_of_the_sum() -> None:
    height, width = 3, 4
    odds = 2 * (noise(1, 1, height, width)[0, 0] - 0.5)
    weights = 0.4 * noise(1, 4, height, width, seed=1)[0] * neighbours(odds.unsqueeze(0))
    mask, flow = cut(odds, weights, torch.zeros_like(weights), 2000)
    assert (flow.abs() <= weights).all()

    def loss(flat: np.ndarray) -> float:
        u = np.clip(flat, 1e-9, 1 - 1e-9).reshape(height, width)
        total = (odds.numpy() * u).sum() - (u * np.log(u) + (1 - u) * np.log(1 - u)).sum()
        for k, (down, right) in enumerate(OFFSETS):
            for row in range(height - down):
                for column in range(width):
                    if 0 <= column + right < width:
                        total -= float(weights[k, row, column]) * abs(u[row, column] - u[row + down, column + right])
        return -total

    best = loss(mask.numpy().ravel())
    found = minimize(loss, np.full(height * width, 0.5), bounds=[(0, 1)] * (height * width), method="Powell")
    assert best <= found.fun + 1e-6
    for seed in range(20):
        other = mask.flatten().numpy() + 0.02 * (noise(1, 1, height, width, seed=seed).flatten().numpy() - 0.5)
        assert loss(other) >= best


def test_cuts_turn_with_the_picture() -> None:
    odds = 4 * (noise(1, 1, 9, 11)[0, 0] - 0.5)
    mask, turned = (
        cut(part, 0.7 * neighbours(part.unsqueeze(0)), torch.zeros(4, *part.shape).double(), 60)[0]
        for part in (odds, odds.mT.flip(0))
    )
    torch.testing.assert_close(mask.mT.flip(0), turned)


def test_nearness_follows_the_picture_not_the_ruler() -> None:
    lab = torch.zeros(3, 40, 60).double()
    lab[0, :, 30:] = 0.5
    sides = torch.zeros(2, 40, 60).double()
    sides[0, 20, 5], sides[1, 20, 34] = 1, 1
    near = nearness(lab, sides)
    assert near.abs().max() <= 1
    assert near[20, 5] > 0.9
    assert near[20, 34] < -0.9
    assert near[:, 28].min() > 0  # nearer to the other by the ruler, but across the border
    torch.testing.assert_close(nearness(lab.flip(2), sides.flip(2)).flip(1), near, atol=1e-9, rtol=0)


def test_radii_beyond_strokes() -> None:
    strokes = torch.zeros(50, 60)
    strokes[20, 20], strokes[20, 30] = 1, 1  # 5 pixels from their middle
    away = radii_beyond(strokes)
    assert float(away[20, 20]) == 0
    assert float(away[20, 35]) == pytest.approx(1)
    assert float(away[49, 59]) == object_model.FARTHEST


@pytest.mark.parametrize("extent", ["near", "object"])
def test_only_one_of_two_equal_objects_is_connected_with_a_stroke(extent: str) -> None:
    image = 0.2 + 0.1 * noise(1, 3, 60, 100, dtype=torch.float32)
    objects = [box(20, left, 20, 20, size=(60, 100)).float() for left in (10, 60)]
    for thing in objects:
        image[:, :1] += 0.6 * thing
    mask = region_mask(image, box(28, 16, 3, 8, size=(60, 100)).float(), extent=extent)
    assert mask[objects[0] > 0].mean() > 0.9
    if extent == "object":
        assert mask[objects[1] > 0].max() == 0
    else:
        assert mask[objects[1] > 0].mean() > 0.9
