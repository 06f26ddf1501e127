"""Filters fitted to one image and applied to others: frames of a film, sets of photographs, tiles of a large picture.

The effect of W on a pixel depends on the pixel's own patch and on a few vectors of length M, which are sums over all
pixels of the image that W was made from. With these vectors fixed, equal patches are edited equally in every frame, so
an edit does not flicker. On the image it was fitted to, the fitted filter equals the original filter.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.checks import (
    check_alpha,
    check_fits,
    check_image,
    check_instance,
    check_order,
    check_pair,
    check_same_size,
    check_tensor,
    check_values,
)
from nlfilter_torch.core.containers import Target, loadable, moved
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.filtering.filters import layers_of_columns, residual_change, weigh_layers
from nlfilter_torch.operator.operator import Kernel, NonlocalOperator
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.scaling import PixelScaling


@dataclass(frozen=True, eq=False)
class FittedFilter:
    """Filter for any image, with the landmarks, balancing and coefficients of the image it was fitted to.

    Made by :func:`fit_filter`.

    Attributes:
        kernel: landmarks, bandwidths and window.
        balancing: computes the scaling of a pixel.
        moments: moments of the images ``y, W y, ..., W^(k-1) y``, (1, k, M, C).
        captured: coefficients of the part of the image that the eigenvectors capture, (1, M, C).
    """

    kernel: Kernel
    balancing: PixelScaling
    moments: Tensor
    captured: Tensor

    def to(self, target: Target, dtype: torch.dtype | None = None) -> "FittedFilter":
        """Move the filter to another device or precision, as :meth:`NonlocalOperator.to`."""
        return moved(self, target, dtype)

    @full_precision
    def layers(
        self,
        image: Tensor,
        guide: Tensor | None = None,
        *,
        origin: tuple[int, int] = (0, 0),
        halo: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """Compute detail layers (B, k+1, C, H, W) of an image of any size; like :func:`detail_layers`, they sum to it.

        Args:
            image: (B, C, H, W), with as many channels as the fitted image.
            guide: (B, C', H, W), with as many channels as the fitted guide; None means the image.
            origin: row and column of the first pixel, for tiles of the fitted image.
            halo: numbers of rows at the top and at the bottom of a tile that are read by patches but not part of the
                result: half a patch, or fewer at the border of the picture.

        Raises:
            TypeError, ValueError: if ``image`` or ``guide`` is not a finite floating-point tensor, or they do not fit.
        """
        return self._planes(image, guide, origin, halo, with_residual=False).to(image.dtype)

    @full_precision
    def __call__(
        self,
        image: Tensor,
        alpha: Tensor,
        guide: Tensor | None = None,
        *,
        residual: float | Tensor | None = None,
        origin: tuple[int, int] = (0, 0),
        halo: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """Filter an image with the sliders ``alpha`` as :func:`polynomial_filter`; arguments as for :meth:`layers`."""
        check_tensor(image, "image", "convert it with torch.as_tensor")
        check_alpha(alpha)
        if residual is not None:
            check_values(residual, "residual", "finite", max([1, *(len(t) for t in (image, alpha) if t.ndim > 1)]))
        planes = self._planes(image, guide, origin, halo, with_residual=residual is not None)
        count = self.moments.shape[1] + 1
        filtered = weigh_layers(planes[:, :count], alpha)
        if residual is not None:
            filtered = filtered + residual_change(alpha, residual, planes[:, count], planes[:, count + 1, :1])
        return filtered.to(image.dtype)

    def _planes(
        self,
        image: Tensor,
        guide: Tensor | None,
        origin: tuple[int, int],
        halo: tuple[int, int],
        *,
        with_residual: bool,
    ) -> Tensor:
        """Layers (B, k+1, C, H, W), followed by residual and r if ``with_residual``, in the kernel's dtype."""
        channels = self.moments.shape[3]
        features = self.kernel.features
        axes = 2 if features is None else features.patch_weights.ndim
        check_image(image, "image", channels=channels, dimensions=(2 + axes,))
        size = tuple(image.shape[2:])
        check_same_size(image, size, "image", "filter", self.moments)
        check_pair(origin, "origin")
        check_pair(halo, "halo")
        if sum(halo) >= size[0]:
            raise ValueError(
                f"halo must leave at least one of the image's {size[0]} rows, got {tuple(halo)}; pass a taller tile"
            )
        if guide is not None:
            check_image(guide, "guide", batch=image.shape[0], dimensions=(2 + axes,))
            guide = guide.expand(image.shape[0], *guide.shape[1:])
            check_same_size(guide, size, "guide", "image", image)
        factor, diagonal = self.kernel.columns(image if guide is None else guide, origin=origin, halo=halo)
        columns = Columns(factor, *self.balancing(factor, diagonal))
        pixels = image[:, :, halo[0] : size[0] - halo[1]].to(factor).flatten(2)
        planes = layers_of_columns(columns, self.moments, pixels)
        if with_residual:
            captured = spread(self.captured.to(factor).mT, factor, columns.scaling)
            share = columns.remainder.unsqueeze(1).expand_as(pixels)
            planes = torch.cat([planes, torch.stack([pixels - captured, share], dim=1)], dim=1)
        return planes.unflatten(-1, (-1, *size[1:]))


loadable(FittedFilter)


@full_precision
def fit_filter(operator: NonlocalOperator, image: Tensor, *, order: int = 3) -> FittedFilter:
    """Fit a filter to an image, for application to other images.

    Args:
        operator: W, of one image.
        image: y, (1, C, H, W): the image that the operator was made from, or another of the same size.
        order: k, the number of detail layers.

    Returns:
        The fitted filter. For ``image`` and its guide it gives the same layers as :func:`detail_layers`. Differentiable
        in operator and image.

    Raises:
        TypeError, ValueError: if ``image`` does not fit the operator, or either is a batch.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> fitted = fit_filter(nonlocal_operator(image, num_landmarks=20), image)
        >>> fitted.layers(image.roll(3, -1)[..., :10]).shape
        torch.Size([1, 4, 1, 24, 10])
    """
    check_instance(operator, NonlocalOperator, "operator", "make it with nonlocal_operator")
    check_order(order)
    check_fits(image, operator.size, "image", "operator", operator.factor)
    if operator.factor.shape[0] != 1 or image.shape[0] != 1:
        raise ValueError(
            f"image and operator must have batch size 1, got {image.shape[0]} and {operator.factor.shape[0]}; "
            "fit one filter per image"
        )
    powers = operator.powers(image, order)[0]  # (k, C, H, W)
    before = torch.cat([image.to(powers), powers[:-1]]).flatten(2)  # y, ..., W^(k-1) y: (k, C, N)
    scaling = weighted(operator.scaling, operator.weights).unsqueeze(1)  # (1, 1, N)
    factor, communicator = operator.factor, operator.communicator
    moments = torch.stack([communicator.sum(moment(factor, scaling * y)) for y in before.unsqueeze(1)], dim=1)
    captured = operator.spectrum().gain(torch.ones_like) @ moments[:, 0]
    return FittedFilter(operator.kernel, operator.differentiable_balancing(), moments, captured)
