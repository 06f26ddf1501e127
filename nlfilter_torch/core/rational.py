"""Approximation of functions on [a, 1] by a polynomial and simple poles on the negative axis, at fixed places.

Poles that lie in a geometric sequence between -a and -1 resolve singularities at or near 0, such as those of roots and
logarithms: the number of poles grows with the logarithms of a and of the error (Stahl, "Best uniform rational
approximation of x^alpha on [0, 1]", 1993; Trefethen, Nakatsukasa and Weideman, "Exponential node clustering at
singularities for rational approximation", 2021). As their places do not depend on the function, its values at the nodes
determine the coefficients by one matrix, which is differentiable and is computed once.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import in_fake_mode

DECADES = {torch.float64: 16, torch.float32: 12}  # smallest eigenvalues that are told from 0, 10^-DECADES
PER_DECADE = 16  # nodes in each decade of the interval
LINEAR = 192  # nodes that are spread over the interval as those of Chebyshev
ACCURATE = (*range(9), 10, 12, 14, 16, 20, 24, 32)  # degrees of polynomials that are nearly exact
ROUGH = (40, 48, 64)
POLES = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 32)
DEGREE = 5  # of the polynomial beside poles
FIRST, LAST = (1.0, 5.0), (0.03, 0.06, 0.15)  # first pole in units of the lower end of the interval, and last pole
PINNED = 30.0  # weight of the node 1, so that constant images keep their value
CUT = 1e-12  # singular values of the least-squares problem below this, relative to the largest, are dropped


@dataclass(frozen=True, eq=False)
class RationalForm:
    """Functions ``sum_k a_k T_k(2 s - 1) + sum_j c_j t_j / (s + t_j)`` of s, T_k the polynomials of Chebyshev.

    Attributes:
        degree: of the polynomial.
        shifts: t, (J,) in float64, positive; the poles are at -t.
        nodes: points of the interval at which a function is evaluated, (n,) in float64, ascending; the last is 1.
        design: values of the terms at the nodes, (n, degree + 1 + J) in float64.
        inverse: computes coefficients from values at the nodes, (degree + 1 + J, n) in float64.
    """

    degree: int
    shifts: Tensor
    nodes: Tensor
    design: Tensor
    inverse: Tensor

    def coefficients(self, values: Tensor) -> Tensor:
        """Coefficients (B, degree + 1 + J) of functions with values (B, n) at the nodes, in float64; differentiable."""
        return values.double() @ self.inverse.mT.to(values.device)

    def error(self, values: Tensor, coefficients: Tensor, rounding: float) -> float:
        """Largest error at the nodes, relative to the largest value, with the effect of a relative ``rounding``."""
        values, coefficients = values.detach().double(), coefficients.detach()
        error = (coefficients @ self.design.mT.to(values.device) - values).abs().amax(1)
        error = error + rounding * coefficients.abs().sum(1)
        largest = values.abs().amax(1)
        return float((error / largest.clamp(min=torch.finfo(torch.float64).tiny)).where(largest > 0, error).max())


def interval_nodes(decades: int) -> Tensor:
    """Points of [10^-decades, 1], dense towards both ends and on the scale of logarithms."""
    with torch.inference_mode(False), torch.device("cpu"):
        logarithmic = torch.logspace(-decades, 0, PER_DECADE * decades + 1, dtype=torch.float64)
        angles = torch.linspace(0, math.pi, LINEAR, dtype=torch.float64)
        linear = (1 - torch.cos(angles)) / 2
        return torch.cat([logarithmic[:-1], linear[1:-1], linear.new_ones(1)]).sort().values


def rational_form(decades: int, degree: int, poles: int, first: float, last: float) -> RationalForm:
    """The form on [10^-decades, 1] with ``poles`` from ``first`` 10^-decades to ``last``; cached, unless it is fake."""
    return (_form if in_fake_mode() else _cached_form)(decades, degree, poles, first, last)


def _form(decades: int, degree: int, poles: int, first: float, last: float) -> RationalForm:
    nodes = interval_nodes(decades)
    with torch.inference_mode(False), torch.device("cpu"):
        lowest = min(first * 10.0**-decades, last) if poles > 1 else last
        shifts = torch.logspace(math.log10(lowest), math.log10(last), poles, dtype=torch.float64)
        angles = torch.acos((2 * nodes - 1).clamp(-1, 1))
        polynomials = torch.cos(angles.unsqueeze(1) * torch.arange(degree + 1))
        design = torch.cat([polynomials, shifts / (nodes.unsqueeze(1) + shifts)], dim=1)
        weights = torch.ones_like(nodes)
        if poles == 0:  # nodes of Chebyshev alone, for which the problem is well conditioned
            weights[nodes < _second_linear_node()] = 0.0
            weights[0] = 1.0
        weights[-1] = PINNED
        inverse = torch.linalg.pinv(weights.unsqueeze(1) * design, rtol=CUT) * weights
    return RationalForm(degree, shifts, nodes, design, inverse)


_cached_form = lru_cache(maxsize=512)(_form)


def _second_linear_node() -> float:
    return (1 - math.cos(math.pi / (LINEAR - 1))) / 2 * (1 - 1e-9)


def polynomial_forms(decades: int, degrees: tuple[int, ...]) -> list[RationalForm]:
    """Polynomials of these degrees, one after the other."""
    return [rational_form(decades, degree, 0, 1.0, 1.0) for degree in degrees]


def pole_forms(decades: int, poles: int) -> list[RationalForm]:
    """Forms with this number of poles in a few arrangements."""
    return [rational_form(decades, DEGREE, poles, first, last) for first in FIRST for last in LAST]


def best_form(values: Tensor, decades: int, tolerance: float, rounding: float) -> tuple[RationalForm, float] | None:
    """The cheapest form whose error is within the tolerance, and its error; None if there is none.

    Polynomials of low degree cost little and converge fast: they are taken only if they are nearly exact.

    Args:
        values: of functions at :func:`interval_nodes`, (B, n).
        decades: minus the decimal logarithm of the lower end of the interval.
        tolerance: of the error relative to the largest value.
        rounding: relative error of the terms.
    """
    strict = max(tolerance / 300, 8 * rounding)
    for form in polynomial_forms(decades, ACCURATE):
        error = form.error(values, form.coefficients(values), rounding)
        if error <= strict:
            return form, error
    for poles in POLES:
        errors = [(f.error(values, f.coefficients(values), rounding), f) for f in pole_forms(decades, poles)]
        error, form = min(errors, key=lambda pair: pair[0])
        if error <= tolerance:
            return form, error
    for form in polynomial_forms(decades, ROUGH):
        error = form.error(values, form.coefficients(values), rounding)
        if error <= tolerance:
            return form, error
    return None
