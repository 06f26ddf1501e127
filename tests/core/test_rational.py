"""Rational functions that approximate a function on an interval."""

import pytest
import torch

from nlfilter_torch.core.rational import best_form, interval_nodes, polynomial_forms, rational_form

ROUNDING = 1e-16


def test_nodes_cover_the_interval() -> None:
    nodes = interval_nodes(9)
    assert nodes[0] == pytest.approx(1e-9)
    assert nodes[-1] == 1
    assert (nodes.diff() > 0).all()
    assert (nodes[1:] / nodes[:-1]).max() < 1.2


def test_polynomials_are_exact() -> None:
    for degree in range(9):
        nodes = interval_nodes(6)
        values = (nodes**degree - 0.3 * nodes).expand(2, -1)
        best = best_form(values, 6, 1e-3, ROUNDING)
        assert best is not None
        assert (best[0].degree, len(best[0].shifts)) == (max(degree, 1), 0)
        assert best[1] < 1e-13


@pytest.mark.parametrize("power", [0.1, 0.3, 0.5, 0.9])
def test_the_error_of_roots_is_that_between_the_nodes(power: float) -> None:
    for tolerance in [1e-2, 1e-3, 1e-4]:
        values = interval_nodes(9) ** power
        best = best_form(values[None], 9, tolerance, ROUNDING)
        assert best is not None
        form, error = best
        assert error <= tolerance
        assert len(form.shifts) <= 16
        points = torch.logspace(-9, 0, 4001, dtype=torch.float64)
        angles = torch.acos(2 * points - 1).unsqueeze(1)
        terms = [torch.cos(angles * torch.arange(form.degree + 1)), form.shifts / (points.unsqueeze(1) + form.shifts)]
        result = torch.cat(terms, dim=1) @ form.coefficients(values[None])[0]
        assert (result - points**power).abs().max() < 1.3 * tolerance


def test_a_logarithm_takes_poles_and_a_step_takes_none() -> None:
    nodes = interval_nodes(9)
    best = best_form((nodes + 1e-3).log()[None], 9, 1e-3, ROUNDING)
    assert best is not None
    assert len(best[0].shifts) > 0
    assert best_form((nodes > 0.5).double()[None], 9, 1e-2, ROUNDING) is None


def test_the_largest_of_several_functions_counts() -> None:
    nodes = interval_nodes(4)
    values = torch.stack([nodes, nodes**0.2, torch.zeros_like(nodes)])
    best = best_form(values, 4, 1e-4, ROUNDING)
    assert best is not None
    assert 0 < best[1] <= 1e-4


def test_large_coefficients_count_with_the_rounding_of_products() -> None:
    form = rational_form(9, 3, 6, 1.0, 0.15)
    values = interval_nodes(9)[None] ** 0.1
    coefficients = form.coefficients(values)
    difference = form.error(values, coefficients, 1e-3) - form.error(values, coefficients, 0.0)
    assert difference == pytest.approx(1e-3 * float(coefficients.abs().sum()))


def test_constants_are_exact_at_one() -> None:
    form = polynomial_forms(9, (4,))[0]
    coefficients = form.coefficients(torch.exp(interval_nodes(9))[None])
    assert float(coefficients.sum()) == pytest.approx(torch.e, abs=2e-4)
