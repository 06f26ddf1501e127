"""Functions of the spectrum and polynomials of an operator, for planes of a picture from any source."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.filtering.filters import residual_change, weigh_layers
from nlfilter_torch.operator.spectrum import Response
from nlfilter_torch.photo.picture.source import Operator, Planes


def synthesize(operator: Operator, response: Response, coefficients: Tensor) -> Planes:
    """Compute ``V f(S) V^T y`` for a response f and coefficients (B, C, M) of y."""
    total = coefficients @ operator.pairs.gain(response).mT
    return operator.each(lambda columns: spread(total.to(columns.factor), columns.factor, columns.scaling))


def polynomial(
    operator: Operator, planes: Planes, order: int, residual: float | Tensor | None
) -> Callable[..., Tensor]:
    """Prepare :func:`polynomial_filter` of planes of a picture.

    Returns a function of pixels, sliders and, optionally, a weight of the residual that replaces ``residual``.
    """
    layers = operator.layers(planes, order)
    if residual is None:
        return lambda pixels, alpha, _=None: weigh_layers(layers(pixels), alpha)
    captured = synthesize(operator, torch.ones_like, operator.coefficients(planes))
    share = operator.each(lambda columns: columns.remainder.unsqueeze(1))

    def filtered(pixels: Any, alpha: Tensor, weight: float | Tensor | None = None) -> Tensor:
        weight = residual if weight is None else weight
        change = residual_change(alpha, weight, planes(pixels) - captured(pixels), share(pixels))
        return weigh_layers(layers(pixels), alpha) + change

    return filtered
