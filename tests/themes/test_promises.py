"""Guarantees of operators against W in float64: row sums, residuals, eigenvalues and the certificate."""

import pytest
import torch

from nlfilter_torch import (
    nonlocal_operator,
)
from nlfilter_torch.operator.scaling import PixelScaling
from tests.problems import noise

FLOATS = (torch.float32, torch.float64)


# --- balancing


# --- eigenvalues


def test_a_pixel_whose_affinities_sum_to_less_than_zero_keeps_its_value() -> None:
    moment = torch.tensor([[[-0.5]]], dtype=torch.float64)
    factor, diagonal = torch.full((1, 1, 1), 0.6, dtype=torch.float64), torch.full((1, 1), 0.64, dtype=torch.float64)
    scaling, remainder = PixelScaling(moment, completed=True)(factor, diagonal)
    assert (scaling.item(), remainder.item()) == (0.0, 1.0)
    scaling, remainder = PixelScaling(-3 * moment, completed=True, before=(moment,))(factor, diagonal)
    assert (scaling.item(), remainder.item()) == (0.0, 1.0)
    scaling, _ = PixelScaling(-3 * moment, completed=True)(factor, diagonal)
    assert scaling.item() > 0


# --- gradients without completion, orthogonality, distances


@pytest.mark.parametrize("dtype", FLOATS)
def test_gradients_without_completion_are_finite_where_scalings_are_huge(dtype: torch.dtype) -> None:
    guide = noise(1, 1, 8, 8, dtype=dtype).requires_grad_()
    options = {"photometric_bandwidth": 4 / 255, "num_landmarks": 5, "landmarks": "uniform", "completion": "none"}
    operator = nonlocal_operator(guide, **options)
    assert operator.scaling.max() > 1e20
    operator.matmul(guide.detach()).square().sum().backward()
    assert guide.grad is not None
    assert guide.grad.isfinite().all()
    assert guide.grad.abs().max() > 0


def test_gradients_without_completion_agree_between_precisions() -> None:
    gradients = []
    for dtype in FLOATS:
        guide = noise(1, 1, 8, 8).to(dtype).requires_grad_()
        options = {"photometric_bandwidth": 4 / 255, "num_landmarks": 5, "landmarks": "uniform", "completion": "none"}
        operator = nonlocal_operator(guide, **options)
        (operator.matmul(guide.detach()) * noise(1, 1, 8, 8, seed=1).to(dtype)).sum().backward()
        gradients.append(guide.grad.double())
    assert (gradients[0] - gradients[1]).norm() < 1e-2 * gradients[1].norm()
