"""Bounds of the contraction factor against dense eigenvalues, on random problems."""

import pytest
import torch

from nlfilter_torch.filtering.contraction import squared_norm
from tests.inverse_problems import random_problem


@pytest.mark.parametrize("seed", range(12))
def test_the_factor_is_never_below_the_truth_and_near_it(seed: int) -> None:
    problem = random_problem(seed)
    found, truth = problem.promised, problem.truth()
    assert float(found.factor) >= truth.factor - problem.rounding
    assert float(found.factor) <= truth.factor + 0.05
    assert float(found.at_least) <= truth.factor + problem.rounding
    assert float(found.squared_norm) >= truth.squared_norm * (1 - problem.rounding)
    assert float(found.squared_norm) <= 1.06 * truth.squared_norm
    assert found.failure == 1e-6


def test_bounds_are_too_low_only_as_often_as_they_say() -> None:
    """With a failure of 0.3 and a single product, bounds of a diagonal matrix fail, but not more often than that."""
    values = torch.linspace(0.1, 1.0, 40, dtype=torch.float64).view(1, 1, 5, 8)
    generator, mass = torch.Generator().manual_seed(0), torch.ones(1, 40, dtype=torch.float64)
    starts = torch.randn(200, 1, 5, 8, generator=generator, dtype=torch.float64)
    bounds, _ = squared_norm(lambda x: values * x, lambda y: y, starts, mass, 0.3)
    assert bounds.shape == (200,)
    assert (bounds < 1.0).double().mean() <= 0.3
    certain, _ = squared_norm(lambda x: values * x, lambda y: y, starts, mass, 1e-6)
    assert (certain >= 1.0).all()


def test_factors_of_a_batch_are_those_of_its_images() -> None:
    problem = random_problem(2)
    twice = torch.cat([problem.image, problem.image])
    from nlfilter_torch import NonlocalOperator, NonlocalPrior

    prior = NonlocalPrior(NonlocalOperator.cat([problem.prior.operator] * 2), problem.prior.form)
    assert twice.shape[0] == 2
    strengths = torch.tensor([problem.strength, 3 * problem.strength])
    both = prior.contraction(problem.forward, problem.transpose, strength=strengths)
    for b in range(2):
        one = problem.prior.contraction(problem.forward, problem.transpose, strength=float(strengths[b]))
        assert abs(float(both.factor[b]) - float(one.factor)) < 0.05
        assert float(both.factor[b]) >= float(one.at_least) - 1e-6
