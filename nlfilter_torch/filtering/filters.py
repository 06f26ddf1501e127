"""Polynomial filters: layers and sliders. Paper: Sec. III, eq. (11) to (14)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import for_planes, shaped_as
from nlfilter_torch.core.checks import (
    check_alpha,
    check_dtype,
    check_eigenvalues,
    check_finite,
    check_fits,
    check_image,
    check_instance,
    check_same_size,
    check_shape,
    check_tensor,
    check_unit_range,
    check_values,
)
from nlfilter_torch.core.precision import full_precision, per_image, trainable
from nlfilter_torch.core.torch_internals import in_format_of
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.pixel_matrix import Columns


def detail_layers(operator: NonlocalOperator, image: Tensor, *, order: int = 3) -> Tensor:
    """Split an image into detail layers, fine to coarse, and the smooth layer that remains.

    Paper: eq. (11), Fig. 4: ``(I - W) y, W (I - W) y, ..., W^(k-1) (I - W) y, W^k y``. Given the layers, any sliders
    can be applied without further products with the operator: ``(alpha[:, None, None, None] * layers).sum(1)``, as
    ``PolynomialSliders.combine`` does.

    Args:
        operator: W.
        image: y, (B, C, H, W).
        order: k, at least 1.

    Returns:
        (B, k+1, C, H, W) in the image's dtype; the layers sum to the image, up to rounding. Differentiable in image and
        operator.

    Raises:
        TypeError, ValueError: if ``image`` does not fit the operator, or ``order`` is not a positive integer.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> layers = detail_layers(nonlocal_operator(image, num_landmarks=20), image, order=2)
        >>> layers.shape, bool((layers.sum(1) - image).abs().max() < 1e-5)
        (torch.Size([1, 3, 3, 24, 24]), True)
    """
    check_instance(operator, NonlocalOperator, "operator", "make it with nonlocal_operator")
    return _layers(operator, image, order).to(image.dtype)


def _layers(operator: NonlocalOperator, image: Tensor, order: int) -> Tensor:
    """Compute the layers in the operator's dtype, as differences of ``y, W y, ..., W^k y``."""
    powers = operator.powers(image, order)  # (B, k, C, H, W)
    first = image.to(powers).unsqueeze(1).expand(powers.shape[0], 1, *image.shape[1:])
    return layers_between(torch.cat([first, powers], dim=1))


def layers_between(smoothed: Tensor) -> Tensor:
    """Differences of consecutive images in ``y, W y, ..., W^k y`` (B, k+1, ...), followed by the last image."""
    return torch.cat([smoothed[:, :-1] - smoothed[:, 1:], smoothed[:, -1:]], dim=1)


def layers_of_columns(columns: Columns, coefficients: Tensor, image: Tensor) -> Tensor:
    """Detail layers (B, k+1, C, n) of some pixels with y = ``image``, (B, C, n).

    ``coefficients`` are the moments of ``y, W y, ..., W^(k-1) y`` over all pixels, (1, k, M, C).
    """
    return layers_between(torch.stack(columns.powers_of(image, columns.spread_each(coefficients)), dim=1))


def weigh_layers(layers: Tensor, alpha: Tensor) -> Tensor:
    """Weighted sum of layers, ``sum_i alpha_i y_i``. Paper: eq. (12).

    Args:
        layers: (B, k+1, C, H, W), or with any other dimensions of an image.
        alpha: (k+1,), (B, k+1) per image, or (B, k+1, H, W) per pixel; a batch of 1 on either side is broadcast.
    """
    check_alpha(alpha, dimensions=(1, 2, layers.ndim - 1))
    entries = alpha.shape[-1] if alpha.ndim <= 2 else alpha.shape[1]
    if entries != layers.shape[1]:
        raise ValueError(f"alpha must have one entry per layer, {layers.shape[1]}, got {entries}; add or drop some")
    _check_fit(alpha, layers.shape)
    return _weighted_sum(layers, alpha.to(layers))


def _check_fit(alpha: Tensor, shape: Sequence[int]) -> None:
    """Raise unless batch and size of sliders fit those of layers of a shape (B, k, C, H, W)."""
    if alpha.ndim > 1 and alpha.shape[0] != shape[0] and 1 not in (alpha.shape[0], shape[0]):
        raise ValueError(
            f"alpha must have the batch size of the layers, {shape[0]}, got {alpha.shape[0]}; pass one row per image"
        )
    if alpha.ndim > 2:
        check_same_size(alpha, tuple(shape[3:]), "alpha", "image")


def _weighted_sum(planes: Tensor, weights: Tensor) -> Tensor:
    """Sum of planes (B, k, C, H, W) with weights (k,), (B, k) or (B, k, H, W)."""
    dimensions = planes.ndim - 2
    weights = weights.unsqueeze(2) if weights.ndim > 2 else for_planes(weights, dimensions)
    return (weights * planes).sum(-1 - dimensions)


@full_precision
def polynomial_filter(
    operator: NonlocalOperator, image: Tensor, alpha: Tensor, *, residual: float | Tensor | None = None
) -> Tensor:
    """Filter an image with the sliders ``alpha``: detail, contrast and tone in one linear filter.

    Paper: eq. (12), (13), by k products with W and without eigenvectors.

    Args:
        operator: W.
        image: y, (B, C, H, W).
        alpha: weights of the layers, from fine to coarse, the last for the smooth layer: (k+1,), (B, k+1) per image, or
            (B, k+1, H, W) per pixel. Ones leave the image unchanged.
        residual: weight of the residual ``(1 - r) (y - V V^T y)``, which the eigenvectors do not capture and W does not
            keep; r is the operator's :attr:`~NonlocalOperator.diagonal_share` (zero without completion). None is
            exactly eq. (12), where the weight is f(r) of eq. (14), or alpha_1 without completion; 0.0 drops the
            residual, as in the paper's eq. (13) and Appendix B; 1.0 leaves it unchanged, which sharpens less noise. A
            number, or a tensor of shape () or (B,).

    Returns:
        (B, C, H, W) in the image's dtype. Linear in ``alpha``, ``residual`` and ``image``; differentiable in the three
        and in the operator.

    Raises:
        TypeError, ValueError: if ``image`` does not fit the operator, ``alpha`` has fewer than two entries or the wrong
            shape, or ``residual`` is not finite or has the wrong shape.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(image, num_landmarks=20)
        >>> crisp = polynomial_filter(operator, image, torch.tensor([3.0, 3.0, 4.0, 1.05]))
        >>> crisp.shape
        torch.Size([1, 3, 24, 24])
    """
    check_instance(operator, NonlocalOperator, "operator", "make it with nonlocal_operator")
    check_tensor(image, "image", "convert it with torch.as_tensor")
    check_alpha(alpha, dimensions=(1, 2, image.ndim) if image.ndim > 2 else (1, 2, 4))
    if residual is not None:
        batch = max(len(operator.factor), *(len(t) for t in (image, alpha) if t.ndim > 1), 1)
        check_values(residual, "residual", "finite", batch)
    order = (alpha.shape[0] if alpha.ndim == 1 else alpha.shape[1]) - 1
    alpha = alpha if alpha.ndim > 2 else operator.communicator.copy_to_group(alpha)
    powers, axis = operator.powers(image, order), min(alpha.ndim, 2) - 1
    _check_fit(alpha, powers.shape)
    # Summed by powers of W, whose weights are differences of the sliders: the layers are never formed.
    weights = trainable(alpha).to(powers)
    own = _weighted_sum(trainable(image).to(powers).unsqueeze(1), weights.narrow(axis, 0, 1))
    filtered = own + _weighted_sum(powers, weights.diff(dim=axis))
    if residual is not None and len(filtered):
        spectrum = operator.spectrum()
        captured = shaped_as(image, spectrum.synthesize(torch.ones_like, spectrum.coefficients(image.to(filtered))))
        weight = operator.communicator.copy_to_group(residual)
        share = shaped_as(image, operator.diagonal_share)
        filtered = filtered + residual_change(alpha, weight, image.to(filtered) - captured, share)
    return in_format_of(filtered, image)


def residual_change(alpha: Tensor, weight: float | Tensor, residual: Tensor, remainder: Tensor) -> Tensor:
    """Compute the change of a filtered image that gives the residual y - V V^T y the given weight.

    F maps the residual to zero, so W multiplies it by r, and the sliders give it the weight f(r). The share r of the
    residual keeps this weight: W preserves a pixel unlike all others, although no eigenvector captures it.

    Args:
        alpha: the sliders, of any shape that :func:`weigh_layers` accepts.
        weight: weight of the residual.
        residual: (B, C, H, W).
        remainder: r, (B, 1, H, W).
    """
    entries = alpha.shape[0] if alpha.ndim == 1 else alpha.shape[1]
    powers = torch.stack([remainder.pow(i) for i in range(entries)], dim=1)  # (B, k+1, 1, H, W)
    gain = weigh_layers(layers_between(powers), alpha)
    return (per_image(weight, residual, residual.ndim) - gain) * (1 - remainder) * residual


@full_precision
def compose_alpha(masks: Tensor, alpha: Tensor) -> Tensor:
    """Compute per-pixel sliders from per-region sliders: a region's own inside its mask, ones outside all masks.

    Paper: Figs. 12, 13, where eq. (12) acts inside a propagated mask. The result can be passed to
    :func:`polynomial_filter` as ``alpha``; with one region this blends the filtered image by the mask.

    Args:
        masks: (B, K, H, W) in [0, 1] of K regions, soft or hard; normalised where their sum exceeds 1.
        alpha: (K, k+1), or (B, K, k+1) per image; fine to coarse.

    Returns:
        (B, k+1, H, W), ``1 + sum_K masks (alpha - 1)``, in the masks' dtype. Differentiable in masks and sliders.

    Raises:
        TypeError, ValueError: if ``masks`` is not such a tensor or exceeds [0, 1], or ``alpha`` has a different number
            of regions.

    Example:
        >>> masks = torch.tensor([1.0, 0.0, 0.5]).view(1, 1, 1, 3)
        >>> compose_alpha(masks, torch.tensor([[3.0, 1.0]]))[0, :, 0]
        tensor([[3., 1., 2.],
                [1., 1., 1.]])
    """
    check_image(masks, "masks", empty=True, dimensions=(4, 5, 3))
    check_unit_range(masks, "masks")
    check_tensor(alpha, "alpha")
    check_dtype(alpha, "alpha", "write 1.0 instead of 1")
    if alpha.ndim not in (2, 3) or alpha.shape[-2] != masks.shape[1] or alpha.shape[-1] < 2:
        raise ValueError(
            f"alpha must have shape ({masks.shape[1]}, k+1) or (B, {masks.shape[1]}, k+1), a row of sliders for every "
            f"mask, got {tuple(alpha.shape)}; reshape it"
        )
    if alpha.ndim == 3 and len(alpha) != len(masks) and 1 not in (len(alpha), len(masks)):
        raise ValueError(
            f"alpha must have the batch of masks, {len(masks)}, or 1, got {len(alpha)}; give a row for each"
        )
    check_finite(alpha, "alpha")
    shares = masks / masks.sum(1, keepdim=True).clamp(min=1.0)
    change = alpha.to(masks) - 1.0
    batch = len(change) if change.ndim == 3 and len(masks) == 1 else len(masks)
    sums = torch.einsum("bkn,bkl->bln", shares.flatten(2).expand(batch, -1, -1), change.expand(batch, -1, -1))
    return 1.0 + sums.unflatten(2, masks.shape[2:])


def filter_regions(
    operator: NonlocalOperator,
    image: Tensor,
    masks: Tensor,
    alpha: Tensor,
    *,
    residual: float | Tensor | None = None,
) -> Tensor:
    """Filter every region with its own sliders and leave the rest of the image unchanged.

    Paper: eq. (12), (13) inside masks, Figs. 12, 13. With one region the filtered image is blended by the mask.

    Args:
        operator: W.
        image: (B, C, H, W).
        masks: (B, K, H, W) in [0, 1], soft or hard; normalised where their sum exceeds 1.
        alpha: (K, k+1), or (B, K, k+1) per image; fine to coarse.
        residual: as for :func:`polynomial_filter`, for all regions.

    Returns:
        (B, C, H, W) in the image's dtype, equal to the image where all masks are 0. Differentiable in all tensors.

    Raises:
        TypeError, ValueError: if ``image`` does not fit the operator, ``masks`` exceed [0, 1], or ``masks`` and
            ``alpha`` do not fit the image or each other.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 1, 12, 12, generator=torch.Generator().manual_seed(0))
        >>> mask = torch.zeros(1, 1, 12, 12)
        >>> mask[..., :6] = 1
        >>> edited = filter_regions(nonlocal_operator(image, num_landmarks=20), image, mask, torch.tensor([[3.0, 1.0]]))
        >>> torch.equal(edited[..., 6:], image[..., 6:]), torch.equal(edited[..., :6], image[..., :6])
        (True, False)
    """
    check_instance(operator, NonlocalOperator, "operator", "make it with nonlocal_operator")
    check_fits(image, operator.size, "image", "operator", operator.factor, empty=True)
    batch = max(operator.factor.shape[0], image.shape[0])
    check_image(masks, "masks", batch=batch, empty=len(image) == 0, dimensions=(image.ndim,))
    check_unit_range(masks, "masks")
    check_same_size(masks, tuple(image.shape[2:]), "masks", "image", operator.factor)
    masks = masks.to(operator.factor)
    total = masks.sum(1, keepdim=True)
    outside = total == 0
    # Averaged over the regions with the masks as weights, (B, k+1, H, W). Outside all regions they are 1, but depend on
    # the masks, and so does the filtered image, from which the result has its gradient there.
    weights = masks / torch.where(outside, 1.0, total)
    sliders = compose_alpha(weights, operator.communicator.copy_to_group(alpha))
    filtered = polynomial_filter(operator, image, sliders, residual=residual)
    edited = torch.lerp(image, filtered, torch.where(outside, 1.0, total.clamp(max=1.0)).to(image))
    return torch.where(outside, image.detach() + (edited - edited.detach()), edited)


def polynomial_response(eigenvalues: Tensor, alpha: Tensor) -> Tensor:
    """Compute the gain of every eigenvalue under the sliders ``alpha``: f(0) = alpha_1 and f(1) = alpha_{k+1}.

    Paper: eq. (14), in the form ``sum_i alpha_i lambda^(i-1) (1 - lambda) + alpha_{k+1} lambda^k``.

    Args:
        eigenvalues: (..., R), usually in [0, 1].
        alpha: (k+1,) or (B, k+1) with ``eigenvalues`` (B, R); fine to coarse, at least two entries.

    Returns:
        (..., R), differentiable in eigenvalues and sliders.

    Raises:
        TypeError, ValueError: if ``alpha`` is not a floating-point tensor of such a shape with at least two entries.

    Example:
        >>> import torch
        >>> polynomial_response(torch.tensor([0.0, 0.5, 1.0]), torch.tensor([3.0, 1.0, 1.0, 1.5]))
        tensor([3.0000, 2.0625, 1.5000])
    """
    check_eigenvalues(eigenvalues)
    check_alpha(alpha, dimensions=(1, 2))
    if alpha.ndim == 2 and alpha.shape[0] != 1:
        rows = eigenvalues.shape[0] if eigenvalues.ndim else 1
        check_shape(alpha, (rows, alpha.shape[1]), "alpha", "give a row for each row of eigenvalues")
        if eigenvalues.ndim > 2:
            raise ValueError(
                f"eigenvalues must have shape (B, R) for sliders of shape (B, k+1), got {tuple(eigenvalues.shape)}; "
                "flatten the other dimensions"
            )
    weights = alpha.to(eigenvalues)
    gain = weights[..., -1:]  # Horner's scheme from the coarsest layer down
    for i in range(weights.shape[-1] - 2, -1, -1):
        gain = weights[..., i : i + 1] + eigenvalues * (gain - weights[..., i : i + 1])
    return gain
