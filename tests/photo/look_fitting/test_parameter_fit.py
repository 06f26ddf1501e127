"""A few parameters by least squares, and what is explained where it is left out."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.photo.look_fitting.parameter_fit import minimize, rounded

TIMES = torch.linspace(0, 3, 200, dtype=torch.float64)
ENDS = [(-10.0, 10.0), (0.0, 10.0)]


def decay(values: Tensor) -> Tensor:
    return values[0] * torch.exp(-values[1] * TIMES)


def noisy() -> Tensor:
    noise = torch.randn(200, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return decay(torch.tensor([2.0, 0.5])) + 0.01 * noise


def test_the_minimum_is_found_and_rounded() -> None:
    target = noisy()
    best = minimize(lambda values: decay(values) - target, (1.0, 3.0), ENDS, 20)
    assert best.values.tolist() == pytest.approx([2.0, 0.5], abs=0.01)
    short = rounded(lambda values: decay(values) - target, best, ((1.0,), ()), ENDS)
    assert short.values.tolist() == [2.0, 0.5]
    assert short.loss <= 1.02 * best.loss


def test_other_values_follow_the_first_ones() -> None:
    target = noisy()
    best = minimize(lambda values: decay(values) - target, (1.0, 3.0), ENDS, 20)
    values = best.following(torch.tensor([2.02], dtype=torch.float64))
    again = minimize(lambda rate: decay(torch.cat([values[:1], rate])) - target, (0.5,), ENDS[1:], 20)
    assert values[0] == 2.02
    assert float(values[1]) == pytest.approx(float(again.values[0]), abs=1e-3)
    assert float(best.predicted(values).square().sum()) == pytest.approx(again.loss, rel=1e-2)


def test_values_stay_within_their_ends() -> None:
    target = decay(torch.tensor([2.0, -0.5]))
    best = minimize(lambda values: decay(values) - target, (1.0, 3.0), ENDS, 20)
    assert float(best.values[1]) == 0.0
    idle = minimize(lambda values: torch.ones(9, dtype=torch.float64), (1.0, 3.0), ENDS, 20)  # depends on nothing
    assert idle.values.tolist() == [1.0, 3.0]


def test_what_is_left_out_is_what_other_fits_leave() -> None:
    target, groups = noisy(), torch.arange(200) % 4
    best = minimize(lambda values: decay(values) - target, (1.0, 3.0), ENDS, 20)
    left_out = best.left_out(groups)
    for group in range(4):
        inside = groups == group
        other = minimize(lambda values, rest=~inside: (decay(values) - target)[rest], (1.0, 1.0), ENDS, 20)
        assert torch.allclose(left_out[inside], (decay(other.values) - target)[inside], atol=1e-4)
    assert float(left_out.square().sum()) > best.loss
