"""Operator and image to filtered image, as a layer."""

from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_alpha, check_tensor, check_weight, described
from nlfilter_torch.filtering.filters import polynomial_filter, weigh_layers
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.operator.operator import NonlocalOperator

LEARNABLE = ("alpha", "residual")


class PolynomialSliders(nn.Module):
    """Operator and image to filtered image, a layer around :func:`polynomial_filter`.

    Args:
        alpha: start of the sliders, fine to coarse; ones leave the image as it is. Paper: eq. (12). Rows of them, one
            for each region, are for :class:`NonlocalFilter` with masks.
        residual: weight of what the eigenvectors do not explain; None is alpha_1, and where it is to be learned the
            start is the start of alpha_1.
        learn: what trains, any of ``"alpha"`` and ``"residual"``; the others are buffers. Give none of them where a
            network finds ``alpha`` for every call.

    Attributes:
        alpha: (k+1,) or (K, k+1), parameter or buffer.
        residual: (), parameter or buffer, or None.

    Raises:
        TypeError, ValueError: if ``alpha`` has fewer than two finite entries, or ``learn`` another name.
    """

    alpha: Tensor
    residual: Tensor | None

    def __init__(
        self,
        alpha: Sequence[float] | Sequence[Sequence[float]] = (1.0, 1.0, 1.0, 1.0),
        *,
        residual: float | None = None,
        learn: Collection[str] = ("alpha",),
    ) -> None:
        super().__init__()
        names = check_learn(learn, LEARNABLE)
        start = _sliders(alpha)
        check_alpha(start, dimensions=(1, 2))
        if residual is not None:
            check_weight(residual, "residual")
        if residual is None and "residual" in names:
            residual = float(start[..., 0].mean())
        weight = None if residual is None else torch.tensor(float(residual))
        for name, value in (("alpha", start), ("residual", weight)):
            if value is not None and name in names:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    def forward(self, operator: NonlocalOperator, image: Tensor, alpha: Tensor | None = None) -> Tensor:
        """Filtered image (B, C, H, W) in the image's dtype.

        Args:
            operator: W.
            image: (B, C, H, W).
            alpha: sliders of this call in place of the layer's own: (k+1,), (B, k+1) per image or (B, k+1, H, W) per
                pixel, of any order k.
        """
        return polynomial_filter(operator, image, self.alpha if alpha is None else alpha, residual=self.residual)

    def combine(self, layers: Tensor, alpha: Tensor | None = None) -> Tensor:
        """The same, with ``residual`` alpha_1, from layers (B, k+1, C, H, W) of :func:`detail_layers` that are held."""
        check_tensor(layers, "layers")
        if layers.ndim != 5:
            raise ValueError(
                f"layers must have shape (B, k+1, C, H, W), got {tuple(layers.shape)}; take them from detail_layers"
            )
        return weigh_layers(layers, self.alpha if alpha is None else alpha)

    def extra_repr(self) -> str:
        """The sliders as they are now."""
        residual = None if self.residual is None else round(self.residual.item(), 4)
        alpha = self.alpha.double().mul(1e4).round().div(1e4).tolist()  # in double: 1.05 has no tail of digits there
        return f"alpha={alpha}, residual={residual}"


def _sliders(alpha: Any) -> Tensor:
    """The sliders of a constructor as a tensor of the default dtype."""
    try:
        return torch.as_tensor(alpha, dtype=torch.get_default_dtype()).detach().clone()
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(
            f"alpha must be numbers or rows of equal length of them, got {described(alpha)}; pass (1.0, 1.0, 1.0, 1.0)"
        ) from None
