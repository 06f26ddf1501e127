"""Functions of the spectrum and polynomials of an operator, for planes of a picture from any source."""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.filtering.filters import residual_change, weigh_layers
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import Response
from nlfilter_torch.photo.picture.source import Operator, Pixels, Planes


def synthesize(operator: Operator, response: Response, coefficients: Tensor) -> Planes:
    """Compute ``V f(S) V^T y`` for a response f and coefficients (B, C, M) of y."""
    total = coefficients @ operator.pairs.gain(response).mT
    return operator.of_columns(partial(_spread, total))


def _spread(total: Tensor, columns: Columns) -> Tensor:
    return spread(total.to(columns.factor), columns.factor, columns.scaling)


@dataclass(frozen=True, eq=False)
class Polynomial:
    """:func:`polynomial_filter` of planes of a picture, for any sliders.

    Attributes:
        planes: what is filtered.
        layers: its detail layers.
        residual: default weight of the residual; None is that of eq. 12.
        captured: the planes, projected on the eigenvectors; None if ``residual`` is.
        share: remainder r of the diagonal of W; None if ``residual`` is.
    """

    planes: Planes
    layers: Planes
    residual: float | Tensor | None = None
    captured: Planes | None = None
    share: Planes | None = None

    @staticmethod
    def of(operator: Operator, planes: Planes, order: int, residual: float | Tensor | None) -> "Polynomial":
        """Prepare the filter of planes of a picture."""
        layers = operator.layers(planes, order)
        if residual is None:
            return Polynomial(planes, layers)
        captured = synthesize(operator, torch.ones_like, operator.coefficients(planes))
        return Polynomial(planes, layers, residual, captured, operator.of_columns(remainder))

    def __call__(self, pixels: Pixels, alpha: Tensor, weight: float | Tensor | None = None) -> Tensor:
        """Filter pixels by sliders; ``weight`` of the residual, if given, replaces :attr:`residual`."""
        filtered = weigh_layers(self.layers(pixels), alpha)
        if self.residual is None or self.captured is None or self.share is None:
            return filtered
        weight = self.residual if weight is None else weight
        change = residual_change(alpha, weight, self.planes(pixels) - self.captured(pixels), self.share(pixels))
        return filtered + change


def remainder(columns: Columns) -> Tensor:
    """Part r of the diagonal of W that the factor lacks, (B, 1, n)."""
    return columns.remainder.unsqueeze(1)
