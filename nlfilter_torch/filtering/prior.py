"""Proximal maps of W as a prior of images, by one Gram matrix and two products with the factor, without iteration.

Source: Romano, Elad and Milanfar, "The little engine that could: regularization by denoising (RED)", 2017, for the
energy ``x^T (I - W) x / 2``; Venkatakrishnan, Bouman and Wohlberg, "Plug-and-play priors for model based
reconstruction", 2013, for the prior whose proximal map is the filter itself.

Both maps are functions of W with the denominator ``a + b W``, a + b = 1. With ``W = F^T F + R`` and the diagonal matrix
``P = a + b R``, the identity of Woodbury gives ``(a + b W)^-1 = P^-1 - b P^-1 F^T C^-1 F P^-1``, where
``C = I + b F P^-1 F^T`` is M x M. The maps themselves are sums of positive parts, in which nothing cancels::

    (I + g (I - W))^-1   = P^-1   + g P^-1 F^T C^-1 F P^-1      a = 1 + g,  b = -g
    W ((1 - g) W + g)^-1 = P^-1 R + g P^-1 F^T C^-1 F P^-1      a = g,      b = 1 - g

The derivative of both with respect to W is ``g (a + b W)^-1 dW (a + b W)^-1``, and that with respect to g is
``-(a + b W)^-1 (I - W) f(W)``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import fold_batch, root_weighted, unfold_batch, weighted
from nlfilter_torch.core.checks import check_fits, check_values
from nlfilter_torch.core.kernels.tall_skinny import compute_grams
from nlfilter_torch.core.precision import Gradients, full_precision, per_image, trainable, uncompiled
from nlfilter_torch.core.torch_internals import in_format_of, is_hidden
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.pixel_matrix import PixelMatrix, sums_exactly

Form = Literal["red", "plug-and-play"]
Kept = tuple[NonlocalOperator, bool, list[float], Tensor]  # C^-1, and what it is of
LARGEST = {torch.float32: 1e5, torch.float64: 1e12}  # g, with which rounding errors of W are as large as W


@dataclass(frozen=True, eq=False)
class _Proximal:
    """The proximal map of W for one g per image, with its derivatives.

    Attributes:
        red: whether the energy is ``x^T (I - W) x / 2``; otherwise W is the map for g = 1.
        inverse: C^-1, (B, M, M) in float64.
    """

    red: bool
    inverse: Tensor

    def value(self, matrix: PixelMatrix, planes: Tensor, gains: Tensor) -> Tensor:
        """The map of planes (B, C, N); gains are g, (B,)."""
        pivots = _pivots(matrix, gains, self.red).unsqueeze(1)
        own = planes if self.red else matrix.remainder.unsqueeze(1) * planes
        return (own + gains[:, None, None] * self._linked(matrix, planes / pivots)) / pivots

    def resolvent(self, matrix: PixelMatrix, planes: Tensor, gains: Tensor) -> Tensor:
        """``(a + b W)^-1 y``."""
        pivots = _pivots(matrix, gains, self.red).unsqueeze(1)
        return (planes - _slope(gains, self.red)[:, None, None] * self._linked(matrix, planes / pivots)) / pivots

    def _linked(self, matrix: PixelMatrix, planes: Tensor) -> Tensor:
        return matrix.spread(self.inverse @ matrix.sums(planes))

    def gradients(
        self, matrix: PixelMatrix, planes: Tensor, gains: Tensor, grad: Tensor, needed: Sequence[bool]
    ) -> Gradients:
        """Those of W, of the planes and of g."""
        adjoint = self.resolvent(matrix.transpose, grad, gains)
        grads: Gradients = (None, None, None)
        if any(needed[:3]):
            grads = matrix.gradient(gains[:, None, None] * adjoint, self.resolvent(matrix, planes, gains))
        grad_planes = self.value(matrix.transpose, grad, gains) if needed[3] else None
        grad_gains = None
        if needed[4]:
            filtered = self.value(matrix, planes, gains)
            grad_gains = -(adjoint * (filtered - matrix.product(filtered))).sum((1, 2))
        return *grads, grad_planes, grad_gains


def _slope(gains: Tensor, red: bool) -> Tensor:
    """b, (B,)."""
    return -gains if red else 1 - gains


def _pivots(matrix: PixelMatrix, gains: Tensor, red: bool) -> Tensor:
    """P, (B, N); positive, since r is in [0, 1]."""
    g, r = gains.unsqueeze(1), matrix.remainder
    return 1 + g * (1 - r) if red else torch.lerp(r, torch.ones_like(r), g)


@torch.no_grad()
def _capacitance_inverse(matrix: PixelMatrix, gains: Tensor, red: bool) -> Tensor:
    """C^-1, (B, M, M) in float64.

    Raises:
        ValueError: if C is not positive definite.
    """
    scaling = root_weighted(matrix.scaling, matrix.weights) * _pivots(matrix, gains, red).rsqrt()
    exact = sums_exactly(matrix.factor.dtype, matrix.factor.shape[2])
    gram = matrix.communicator.sum(compute_grams(matrix.factor, scaling, None, 1, exact=exact)[:, 0])
    unit = torch.eye(gram.shape[1], dtype=gram.dtype, device=gram.device)
    triangle, failure = torch.linalg.cholesky_ex(unit + _slope(gains, red).to(gram)[:, None, None] * gram)
    if not is_hidden(triangle) and bool(failure.any()):
        worst = float(gains[failure != 0].max())
        raise ValueError(
            f"g must be below 1 / (l - 1) for the largest eigenvalue l of W, which exceeds 1 by rounding, got "
            f"{worst:.3g}; lower it, or use float64"
        )
    return torch.cholesky_inverse(triangle)


@uncompiled
@full_precision
def proximal_map(operator: NonlocalOperator, image: Tensor, g: float | Tensor, form: Form, kept: list[Kept]) -> Tensor:
    """:meth:`NonlocalPrior.prox` for an operator W, whose arguments but the form are checked here.

    The matrix of the last g is ``kept``, in a list of at most one, since most methods take every step with the same g.
    """
    check_fits(image, operator.size, "x", "operator", operator.factor, empty=True)
    batch = max(image.shape[0], len(operator)) if len(image) else len(operator)
    check_values(g, "g", "not negative", batch, "0 is the identity")
    largest = torch.as_tensor(g).detach().max()
    if not is_hidden(largest) and float(largest) > LARGEST[operator.dtype]:
        raise ValueError(
            f"g must be at most {LARGEST[operator.dtype]:.0e} in {operator.dtype}, in which the eigenvalues of W have "
            f"rounding errors, got {float(largest):.3g}; lower it, or use float64"
        )
    if image.numel() == 0:
        return image.clone()
    gains = operator.communicator.copy_to_group(per_image(g, operator.factor, 1))
    matrix = operator.matrix
    if len(gains) > len(operator):  # one operator for images with a g of their own
        factor, scaling, remainder = (t.expand(len(gains), *t.shape[1:]) for t in matrix.parts[:3])
        weights = None if matrix.weights is None else matrix.weights.expand(len(gains), -1)
        matrix = replace(matrix, factor=factor, scaling=scaling, remainder=remainder, weights=weights)
    gains = gains.expand(len(matrix.factor))
    planes = fold_batch(trainable(image).to(operator.factor), len(gains))
    red = form == "red"
    moved = gains > 0
    positive = torch.where(moved, gains, 1.0)  # where g is 0 the map is the identity, in place of R^-1 R
    # Reading g would make an accelerator wait.
    key = (operator, red, gains.tolist()) if gains.device.type == "cpu" and not is_hidden(gains) else None
    if key is not None and kept and kept[0][0] is operator and kept[0][1:3] == key[1:]:
        inverse = kept[0][3]
    else:
        inverse = _capacitance_inverse(matrix, positive.detach(), red)
        kept[:] = [] if key is None else [(*key, inverse)]
    proximal = _Proximal(red, inverse)
    if matrix.needs_gradient or (torch.is_grad_enabled() and gains.requires_grad):
        result = matrix.apply(proximal, planes, positive)
    else:
        result = proximal.value(matrix, planes, positive)
    result = torch.where(moved[:, None, None], result, planes)
    return in_format_of(unfold_batch(result.unsqueeze(1), image.shape[0], image.shape[2:])[:, 0], image)


@full_precision
def energy(operator: NonlocalOperator, image: Tensor) -> Tensor:
    """``x^T (I - W) x / 2``, (B,), in the product of the operator's weights if it has any."""
    filtered = operator @ image
    products = ((image - filtered) * image).to(operator.factor).flatten(2).sum(1, keepdim=True)  # (B, 1, N)
    return operator.communicator.sum(weighted(products, operator.weights).sum((1, 2)).double()).to(image.dtype) / 2
