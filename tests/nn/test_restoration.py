"""Restoration against the solution of the linear system, and its promise kept along the way."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalPrior, nonlocal_operator, restore
from tests.inverse_problems import random_problem
from tests.problems import noise, picture

IMAGE = picture("camera", 16, 16)


def test_the_limit_minimises_the_objective() -> None:
    prior = NonlocalPrior(nonlocal_operator(IMAGE, num_landmarks=40, photometric_bandwidth=0.2))
    known = (noise(1, 1, 16, 16) < 0.6).double()

    def mask(x: Tensor) -> Tensor:
        return known * x

    found = restore(known * IMAGE, mask, mask, prior, strength=0.3, steps=2000, tolerance=1e-12)
    assert float(found.contraction.factor) < 1
    w = prior.operator.to_dense()[0]
    system = torch.diag(known.flatten()) + 0.3 * (torch.eye(256, dtype=torch.float64) - w)
    wanted = torch.linalg.solve(system, (known * IMAGE).flatten()).view_as(IMAGE)
    torch.testing.assert_close(found.image, wanted, atol=1e-8, rtol=0)
    assert len(found.changes) < 2000


@pytest.mark.parametrize("seed", range(6))
def test_no_step_contracts_less_than_promised(seed: int) -> None:
    problem = random_problem(seed)
    assert max(problem.measured_factors(12)) <= float(problem.promised.factor) + problem.rounding


def test_w_is_renewed_for_the_first_steps_only() -> None:
    made: list[Tensor] = []

    def make(x: Tensor) -> NonlocalPrior:
        made.append(x)
        return NonlocalPrior(nonlocal_operator(x, num_landmarks=20, photometric_bandwidth=0.2))

    found = restore(IMAGE, lambda x: x, lambda y: y, make, strength=0.3, step=0.5, steps=6, renewals=3)
    assert len(made) == 3
    assert found.prior.operator is not None
    assert len(found.changes) == 6
    frozen = restore(IMAGE, lambda x: x, lambda y: y, make(IMAGE), strength=0.3, step=0.5, steps=6, renewals=3)
    assert len(made) == 4
    assert float(frozen.changes[-1]) < float(frozen.changes[0])


def test_measurements_have_gradients() -> None:
    prior = NonlocalPrior(nonlocal_operator(IMAGE, num_landmarks=20, photometric_bandwidth=0.2))
    observed = IMAGE.clone().requires_grad_()
    restore(observed, lambda x: x, lambda y: y, prior, strength=0.3, steps=3).image.sum().backward()
    torch.testing.assert_close(observed.grad, torch.full_like(IMAGE, float(observed.grad.mean())), atol=1e-6, rtol=0)


def test_what_is_refused() -> None:
    prior = NonlocalPrior(nonlocal_operator(IMAGE, num_landmarks=20, photometric_bandwidth=0.2))

    def same(x: Tensor) -> Tensor:
        return x

    with pytest.raises(ValueError, match="steps must be"):
        restore(IMAGE, same, same, prior, strength=0.3, steps=0)
    with pytest.raises(ValueError, match="renewals must be"):
        restore(IMAGE, same, same, prior, strength=0.3, renewals=0)
    with pytest.raises(ValueError, match="tolerance must be"):
        restore(IMAGE, same, same, prior, strength=0.3, tolerance=-1.0)
    with pytest.raises(TypeError, match="prior must be"):
        restore(IMAGE, same, same, lambda x: x, strength=0.3)  # type: ignore[arg-type, return-value]
    with pytest.raises(ValueError, match="start must have shape"):
        restore(IMAGE, same, same, prior, strength=0.3, start=IMAGE[0])
    with pytest.warns(UserWarning, match="forward must be linear"):
        restore(IMAGE, torch.sin, same, prior, strength=0.3, steps=1, step=0.5)
