"""Layers that filter an image, with a given operator or with one built from the image."""

from collections.abc import Collection, Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import (
    check_alpha,
    check_finite,
    check_fits,
    check_image,
    check_number,
    check_tensor,
    check_unit_range,
    check_values,
    described,
)
from nlfilter_torch.filtering.filters import filter_regions, polynomial_filter, weigh_layers
from nlfilter_torch.nn.affinity import AffinityOption, Hold, NonlocalAffinity
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import AUTO, Completion, FilterOptions, GuideChannels, Landmarks

SliderOption = Literal["alpha", "residual"]
LEARNABLE: tuple[SliderOption, ...] = ("alpha", "residual")
ALPHA: tuple[SliderOption] = ("alpha",)
BUILDING: tuple[AffinityOption, ...] = ("photometric_bandwidth", "spatial_bandwidth", "patch_weights")


class PolynomialSliders(nn.Module):
    """Layer that filters an image with a given operator by :func:`polynomial_filter`.

    Args:
        alpha: initial sliders, fine to coarse; ones leave the image unchanged. Paper: eq. (12). Rows of sliders, one
            per region, are for :class:`NonlocalFilter` with masks.
        residual: weight of the part that the eigenvectors do not capture; None means alpha_1. If it is learned, None
            starts from alpha_1.
        learn: the parameters to learn: any of ``"alpha"`` and ``"residual"``; the others are buffers. Pass none if a
            network computes ``alpha`` for every call.

    Attributes:
        alpha: (k+1,) or (K, k+1), parameter or buffer.
        residual: (1,), parameter or buffer, or None.

    Raises:
        TypeError, ValueError: if ``alpha`` has fewer than two finite entries, or ``learn`` has any other name.
    """

    alpha: Tensor
    residual: Tensor | None

    def __init__(
        self,
        alpha: Sequence[float] | Sequence[Sequence[float]] = (1.0, 1.0, 1.0, 1.0),
        *,
        residual: float | None = None,
        learn: SliderOption | Collection[SliderOption] = ALPHA,
    ) -> None:
        super().__init__()
        names = check_learn(learn, LEARNABLE)
        start = _sliders(alpha)
        check_alpha(start, dimensions=(1, 2))
        if residual is not None:
            check_values(residual, "residual", "finite")
        if residual is None and "residual" in names:
            weight: Tensor | None = start[..., 0].mean().reshape(1)
        else:
            weight = None if residual is None else torch.tensor([float(residual)])
        for name, value in (("alpha", start), ("residual", weight)):
            if value is not None and name in names:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    def forward(self, operator: NonlocalOperator, image: Tensor, alpha: Tensor | None = None) -> Tensor:
        """Filter an image: (B, C, H, W) in the image's dtype.

        Args:
            operator: W.
            image: (B, C, H, W).
            alpha: sliders that replace the layer's own in this call: (k+1,), (B, k+1) per image or (B, k+1, H, W) per
                pixel, of any order k.
        """
        return polynomial_filter(operator, image, self.alpha if alpha is None else alpha, residual=self.residual)

    def combine(self, layers: Tensor, alpha: Tensor | None = None) -> Tensor:
        """Filter given the layers (B, k+1, C, H, W) of :func:`detail_layers`; without a ``residual``."""
        if self.residual is not None:
            raise ValueError(
                "residual must be None to combine layers, which lack it, got a weight; call the layer with an operator"
            )
        check_tensor(layers, "layers")
        if layers.ndim not in (4, 5, 6):
            raise ValueError(
                f"layers must have shape (B, k+1, C, H, W), got {tuple(layers.shape)}; take them from detail_layers"
            )
        return weigh_layers(layers, self.alpha if alpha is None else alpha)

    def extra_repr(self) -> str:
        """The current sliders."""
        if self.alpha.is_meta:
            return f"alpha={tuple(self.alpha.shape)} without values"
        residual = None if self.residual is None else round(self.residual.item(), 4)
        alpha = self.alpha.double().mul(1e4).round().div(1e4).tolist()  # in double, so that 1.05 prints as such
        return f"alpha={alpha}, residual={residual}"


def _sliders(alpha: Any) -> Tensor:
    """Convert constructor sliders to a tensor of the default dtype."""
    if isinstance(alpha, Tensor) and alpha.is_complex():
        raise TypeError(f"alpha must be real, got {described(alpha)}; pass alpha.real")
    try:
        return torch.as_tensor(alpha, dtype=torch.get_default_dtype()).detach().clone()
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(
            f"alpha must be numbers or rows of numbers of equal length, got {described(alpha)}; "
            "pass (1.0, 1.0, 1.0, 1.0)"
        ) from None


class NonlocalFilter(nn.Module):
    """Layer that filters an image: :class:`NonlocalAffinity` and :class:`PolynomialSliders` combined.

    Paper: eq. (12), (13). Every call builds the operator from its guide. To try several sliders on one image, keep the
    operator or the detail layers, and call ``affinity`` and ``sliders`` separately.

    Args:
        alpha: initial sliders, fine to coarse; ones leave the image unchanged. For K regions, K rows of sliders, one
            for each mask.
        residual: weight of the part that the eigenvectors do not capture; None means alpha_1.
        learn: the parameters to learn: any of ``"alpha"``, ``"residual"``, ``"photometric_bandwidth"``,
            ``"spatial_bandwidth"`` and ``"patch_weights"``; see the two layers. Gradients with respect to image and
            guide are always available.
        patch_size: as for :class:`NonlocalAffinity`.
        photometric_bandwidth: a positive number in units of the guide, or ``"auto"``.
        spatial_bandwidth: a positive number of pixels, or None.
        num_landmarks: as for :class:`NonlocalAffinity`.
        landmarks: as for :class:`NonlocalAffinity`.
        completion: as for :class:`NonlocalAffinity`.
        guide_channels: ``"luminance"`` or ``"all"``, as for :func:`nonlocal_operator`; None compares all channels of a
            guide that is passed to the layer, and the luminance of an image that is its own guide.
        patch_weights: as for :class:`NonlocalAffinity`.
        tolerance: as for :class:`NonlocalAffinity`.
        generator: as for :class:`NonlocalAffinity`.
        group: as for :class:`NonlocalAffinity`.
        hold: which landmarks are kept from call to call, ``"assignment"``, ``"features"`` or None, as for
            :class:`NonlocalAffinity`; gradients then describe what the next call does.

    Raises:
        TypeError, ValueError: if ``learn`` has any other name, or ``alpha``, ``residual`` or an option is invalid.

    Example:
        >>> layer = NonlocalFilter(alpha=(3, 3, 4, 1.05), photometric_bandwidth=0.1, num_landmarks=30)
        >>> layer(torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))).shape
        torch.Size([2, 3, 32, 32])
        >>> list(layer.state_dict())
        ['sliders.alpha']
        >>> layer = NonlocalFilter(learn=("alpha", "photometric_bandwidth"), photometric_bandwidth=0.1)
        >>> list(layer.state_dict())
        ['affinity.log_photometric_bandwidth', 'sliders.alpha']
    """

    @property
    def alpha(self) -> Tensor:
        """Sliders (k+1,) or (K, k+1), parameter or buffer."""
        return self.sliders.alpha

    @alpha.setter
    def alpha(self, value: Tensor | Sequence[float] | Sequence[Sequence[float]]) -> None:
        _assign(self.sliders.alpha, value, "alpha")

    @property
    def residual(self) -> Tensor | None:
        """Weight of the part that the eigenvectors do not capture, (1,), or None for alpha_1."""
        return self.sliders.residual

    @residual.setter
    def residual(self, value: Tensor | float) -> None:
        _assign(self.sliders.residual, value, "residual")

    @property
    def photometric_bandwidth(self) -> float | Literal["auto"] | Tensor:
        """Number or ``"auto"``; a tensor of shape () if it is learned."""
        return self.affinity.photometric_bandwidth

    @photometric_bandwidth.setter
    def photometric_bandwidth(self, value: float | Literal["auto"]) -> None:
        self.affinity.photometric_bandwidth = value

    @property
    def spatial_bandwidth(self) -> float | Tensor | None:
        """Number of pixels or None; a tensor of shape () if it is learned."""
        return self.affinity.spatial_bandwidth

    @spatial_bandwidth.setter
    def spatial_bandwidth(self, value: float | None) -> None:
        self.affinity.spatial_bandwidth = value

    def __init__(
        self,
        alpha: Sequence[float] | Sequence[Sequence[float]] = (1.0, 1.0, 1.0, 1.0),
        *,
        residual: float | None = None,
        learn: SliderOption | AffinityOption | Collection[SliderOption | AffinityOption] = ALPHA,
        patch_size: int = FilterOptions.patch_size,
        photometric_bandwidth: float | Literal["auto"] = AUTO,
        spatial_bandwidth: float | None = None,
        num_landmarks: int = FilterOptions.num_landmarks,
        landmarks: Landmarks = FilterOptions.landmarks,
        completion: Completion = FilterOptions.completion,
        guide_channels: GuideChannels | None = None,
        patch_weights: Tensor | None = FilterOptions.patch_weights,
        tolerance: float | None = FilterOptions.tolerance,
        generator: torch.Generator | None = FilterOptions.generator,
        group: Any = FilterOptions.group,
        hold: Hold | None = None,
    ) -> None:
        arguments = locals()
        super().__init__()
        names = check_learn(learn, (*LEARNABLE, *BUILDING))
        own = {name: value for name, value in arguments.items() if name in vars(FilterOptions())}
        self.affinity = NonlocalAffinity(hold=hold, learn=[name for name in BUILDING if name in names], **own)
        self.sliders = PolynomialSliders(alpha, residual=residual, learn=[name for name in LEARNABLE if name in names])

    def renew(
        self,
        guide: Tensor | None = None,
        weights: Tensor | None = None,
        guide_channels: GuideChannels | None = None,
    ) -> None:
        """Choose the landmarks that are held anew; see :meth:`NonlocalAffinity.renew`.

        With ``guide_channels="all"`` for guides of three channels that are passed to the layer beside images.
        """
        self.affinity.renew(guide, weights, guide_channels)

    def forward(
        self,
        image: Tensor,
        guide: Tensor | None = None,
        mask: Tensor | None = None,
        alpha: Tensor | None = None,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Filter an image.

        Args:
            image: (B, C, H, W), or one image (C, H, W); then guide, mask and alpha are also those of one image.
            guide: (B, C', H, W) of the image's height and width, from which the operator is built; None means the image
                itself. All of its channels count, unless the layer was made with ``guide_channels``.
            mask: (B, K, H, W) in [0, 1]: 1 where the image is filtered, 0 where it is unchanged; None means 1
                everywhere.
            alpha: sliders that replace the layer's own in this call, for example computed by a network: (k+1,),
                (B, k+1) per image or (B, k+1, H, W) per pixel; for K > 1 masks (K, k+1) or (B, K, k+1).
            weights: (B, 1, H, W), how much each pixel counts, 0 for padding, as for :func:`nonlocal_operator`.

        Returns:
            (B, C, H, W) in the image's dtype, or (C, H, W) for one image.

        Raises:
            TypeError, ValueError: if a tensor does not fit, or there are sliders for K regions but not K masks.
        """
        if isinstance(image, Tensor) and image.ndim == 3:
            guide, mask, weights = _as_batch(guide), _as_batch(mask), _as_batch(weights)
            of_regions = mask is not None and mask.shape[1] > 1  # then a 3-dimensional alpha is (B, K, k+1)
            alpha = alpha if of_regions else _as_batch(alpha)
            return self(image.unsqueeze(0), guide, mask, alpha, weights).squeeze(0)
        if isinstance(guide, NonlocalOperator):
            raise TypeError(
                "guide must be a torch.Tensor, from which the layer builds an operator, got a NonlocalOperator; "
                "call layer.sliders(operator, image)"
            )
        check_image(image, "image", empty=True, dimensions=(4, 5))
        if guide is None:
            operator = self.affinity(image, weights)
        else:
            check_fits(guide, tuple(image.shape[2:]), "guide", "image", image, empty=len(image) == 0)
            operator = self.affinity(guide, weights, "all")
        if mask is not None:
            batch = max(image.shape[0], operator.factor.shape[0])
            check_fits(mask, tuple(image.shape[2:]), "mask", "image", batch=batch, empty=len(image) == 0)
            check_unit_range(mask, "mask")
        rows = self.sliders.alpha if alpha is None else alpha
        own_rows = alpha is None and rows.ndim == 2
        if own_rows and mask is None:
            raise ValueError(f"mask must have {len(rows)} channels, one for each row of sliders, got None; pass masks")
        if mask is not None and (own_rows or mask.shape[1] > 1):
            rows = rows.expand(mask.shape[1], -1) if rows.ndim == 1 else rows
            return filter_regions(operator, image, mask, rows, residual=self.sliders.residual)
        filtered: Tensor = self.sliders(operator, image, alpha)
        if mask is None:
            return filtered
        return torch.lerp(image, filtered, mask.to(image))


def _assign(parameter: Tensor | None, value: object, name: str) -> None:
    """Copy values into a parameter or buffer of a layer's sliders."""
    if parameter is None:
        raise ValueError(
            f"{name} must be a number in the constructor to be changed later, got None there; "
            f"construct the layer with {name}=1.0, for example"
        )
    values = _sliders(value).to(parameter) if name == "alpha" else _number(value).to(parameter)
    if values.shape != parameter.shape:
        raise ValueError(
            f"{name} must keep its shape, {tuple(parameter.shape)}, got {tuple(values.shape)}; "
            f"construct a layer with other sliders, or pass alpha= in the call"
        )
    check_finite(values, name)
    with torch.no_grad():
        parameter.copy_(values)


def _number(value: object) -> Tensor:
    """The weight of the residual, (1,)."""
    if not isinstance(value, Tensor):
        check_number(value, "residual")
    return torch.as_tensor(value, dtype=torch.float64).detach().reshape(-1)


def _as_batch(tensor: Tensor | None) -> Tensor | None:
    """Add a batch dimension to a tensor of three dimensions, which belongs to one image; return others unchanged."""
    return tensor.unsqueeze(0) if isinstance(tensor, Tensor) and tensor.ndim == 3 else tensor
