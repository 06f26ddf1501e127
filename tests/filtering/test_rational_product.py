"""Rational functions of W, and their gradients."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch import nonlocal_operator
from nlfilter_torch.core.rational import rational_form
from nlfilter_torch.filtering.rational_product import pole_terms, rational_product, weigh_poles
from nlfilter_torch.operator.pixel_matrix import PixelMatrix
from tests.problems import noise

FORMS = [(0, 0), (1, 0), (5, 0), (0, 1), (3, 5)]
GUIDE = noise(2, 1, 5, 6)


def product(guide: Tensor, planes: Tensor, coefficients: Tensor, degree: int, poles: int) -> Tensor:
    operator = nonlocal_operator(guide, num_landmarks=7, photometric_bandwidth=0.4, landmarks="uniform")
    parts = operator.factor, operator.scaling, operator.remainder
    form = rational_form(6, degree, poles, 1.0, 0.15)
    return rational_product(PixelMatrix(*parts), planes, form, coefficients)


@pytest.mark.parametrize(("degree", "poles"), FORMS)
def test_products_are_those_of_the_dense_matrix(degree: int, poles: int) -> None:
    planes, coefficients = noise(2, 3, 30, seed=1), noise(2, degree + 1 + poles, seed=2)
    dense = nonlocal_operator(GUIDE, num_landmarks=7, photometric_bandwidth=0.4, landmarks="uniform").to_dense()
    values, vectors = torch.linalg.eigh((dense + dense.mT) / 2)
    form = rational_form(6, degree, poles, 1.0, 0.15)
    points = values.clamp(1e-6, 1).unsqueeze(2)
    terms = [torch.cos(torch.acos(2 * points - 1) * torch.arange(degree + 1)), form.shifts / (points + form.shifts)]
    gains = (torch.cat(terms, dim=2) @ coefficients.unsqueeze(2)).squeeze(2)
    wanted = planes @ ((vectors * gains.unsqueeze(1)) @ vectors.mT)
    torch.testing.assert_close(product(GUIDE, planes, coefficients, degree, poles), wanted, atol=2e-5, rtol=0)


@pytest.mark.parametrize(("degree", "poles"), FORMS)
def test_gradients(degree: int, poles: int) -> None:
    leaves = GUIDE, noise(2, 2, 30, seed=1), noise(2, degree + 1 + poles, seed=2)
    leaves = tuple(leaf.clone().requires_grad_() for leaf in leaves)
    assert torch.autograd.gradcheck(
        lambda guide, planes, c: product(guide, planes, c, degree, poles), leaves, atol=1e-6
    )


def test_second_derivatives_for_a_fixed_operator() -> None:
    planes, coefficients = noise(2, 1, 30, seed=1).requires_grad_(), noise(2, 9, seed=2).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda y, c: product(GUIDE, y, c, 3, 5), (planes, coefficients), atol=1e-6)


def test_poles_are_weighed_after_their_systems_are_solved() -> None:
    operator = nonlocal_operator(GUIDE, num_landmarks=7, photometric_bandwidth=0.4, landmarks="uniform")
    planes, weights, form = noise(2, 3, 30, seed=1), noise(2, 5, seed=2), rational_form(6, 0, 4, 1.0, 0.15)
    matrix = operator.matrix
    result = weigh_poles(planes, pole_terms(matrix, planes, form), weights)
    torch.testing.assert_close(result, rational_product(matrix, planes, form, weights))
