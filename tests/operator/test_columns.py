"""Columns of W."""

import pytest
import torch

from nlfilter_torch import (
    nonlocal_operator,
    operator_from_features,
)
from nlfilter_torch.operator.pixel_matrix import Columns
from tests.problems import noise, picture, seeded


def test_one_operator_evaluates_a_batch_of_points_and_several_operators_one_set() -> None:
    features, points = noise(2, 3, 60, seed=1).float(), noise(3, 3, 40, seed=2).float()
    both = operator_from_features(features, size=(60,), num_landmarks=20)
    single = operator_from_features(features[:1], size=(60,), num_landmarks=20)
    many, pair = single.at(points), both.at(points[:1])
    for result, expected in (
        *((many.factor[i : i + 1], single.at(points[i : i + 1]).factor) for i in range(3)),
        *((many.scaling[i : i + 1], single.at(points[i : i + 1]).scaling) for i in range(3)),
        (pair.factor, both.at(points[:1].repeat(2, 1, 1)).factor),
        (pair.scaling, both.at(points[:1].repeat(2, 1, 1)).scaling),
    ):
        torch.testing.assert_close(result, expected, atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match="features must have batch size 1 or 2, like the operator, got 3"):
        both.at(points)


def test_columns_at_the_points_themselves_are_those_of_the_operator() -> None:
    image = picture("coffee", 30, 30)
    operator = nonlocal_operator(image)
    columns = operator.at(operator.kernel.recipe(image))
    assert isinstance(columns, Columns)
    torch.testing.assert_close(columns.factor, operator.factor, atol=1e-12, rtol=0)
    torch.testing.assert_close(columns.scaling, operator.scaling, atol=1e-9, rtol=0)
    torch.testing.assert_close(columns.remainder, operator.remainder, atol=1e-9, rtol=0)


def test_columns_of_other_features_are_checked() -> None:
    operator = operator_from_features(noise(1, 3, 12), size=(3, 4), num_landmarks=4)
    assert operator.at(noise(1, 3, 5, dtype=torch.float32)).factor.shape == (1, 4, 5)
    with pytest.raises(ValueError, match="features must have 3 features per point"):
        operator.at(noise(1, 2, 5))


def test_columns_are_differentiable_in_the_features_of_the_operator() -> None:
    points = torch.rand(1, 2, 30, generator=seeded(5), dtype=torch.float64) * 2
    others = torch.rand(1, 2, 5, generator=seeded(6), dtype=torch.float64) * 2

    def total(features: torch.Tensor) -> torch.Tensor:
        built = operator_from_features(
            features, size=(30,), num_landmarks=6, landmarks="random", tolerance=1e-13, generator=seeded(0)
        )
        return built.at(others).scaling.sum()

    leaf = points.clone().requires_grad_()
    (result,) = torch.autograd.grad(total(leaf), leaf)
    for index in range(0, 30, 5):
        step = torch.zeros_like(points)
        step[0, 0, index] = 1e-5
        wanted = float(total(points + step) - total(points - step)) / 2e-5
        assert float(result[0, 0, index]) == pytest.approx(wanted, rel=1e-4, abs=1e-7)
