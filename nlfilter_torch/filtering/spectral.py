"""Filters by any response to the eigenvalues. Paper: Sec. III, eq. (7), (10), (13); Appendix A, eq. (19)."""

from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import fold_batch, shaped_as, weighted
from nlfilter_torch.core.checks import (
    check_finite,
    check_fits,
    check_instance,
    check_shape,
    check_tensor,
    check_values,
    checked_response,
)
from nlfilter_torch.core.precision import full_precision, per_image, working_dtype
from nlfilter_torch.core.torch_internals import in_format_of
from nlfilter_torch.filtering.matrix_function import TOLERANCE, apply_function
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.spectrum import Response, Spectrum


@full_precision
def spectral_filter(
    operator: NonlocalOperator | Spectrum,
    image: Tensor,
    response: Response,
    *,
    residual: float | Tensor | None = None,
    coefficients: Tensor | None = None,
    tolerance: float = TOLERANCE,
) -> Tensor:
    """Filter an image with any response f: ``f(W) y``, or ``V f(S) V^T y`` with a spectrum.

    Paper: eq. (7), (10), (13), and Sec. V-D, where f is a fractional power. With an operator it is f(W) itself, see
    :func:`apply_function`. With a spectrum it is f on the span of the eigenvectors, in one or two reads of the factor,
    and ``residual`` times the rest ``y - V V^T y``. W equals ``V S V^T`` only if W has no diagonal part r
    (``completion="none"``), or on images that the eigenvectors span: pixels unlike all others are not spanned.

    Args:
        operator: W, or its spectrum.
        image: y, (B, C, H, W).
        response: f, an elementwise function (B, R) to (B, R) of eigenvalues in [0, 1], in the image's dtype (at least
            float32), differentiable in torch; may have parameters.
        residual: weight of ``y - V V^T y`` with a spectrum: a number or a tensor of shape () or the spectrum's (B,).
            None is f(r), which a pixel unlike all others receives from f(W), so that it keeps its value if f(1) = 1;
            0.0 is the paper's eq. (10), which turns such pixels black.
        coefficients: ``spectrum.coefficients(image)``, if already computed; a further response then reads the factor
            once instead of twice. None computes them.
        tolerance: of the error with an operator, relative to the largest gain.

    Returns:
        (B, C, H, W) in the image's dtype. Differentiable in image, operator, residual and the parameters of
        ``response``, with a finite gradient also if eigenvalues are equal.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor of the operator's size,
            ``coefficients`` do not have the shape of those of ``image``, ``response`` does not return a finite gain for
            every eigenvalue, ``residual`` is not finite or has the wrong shape, or an operator comes with ``residual``
            or ``coefficients``.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(image, num_landmarks=20)
        >>> bool((spectral_filter(operator, image, lambda s: s) - operator @ image).abs().max() < 1e-5)
        True
        >>> spectrum = operator.spectrum()
        >>> cached = spectrum.coefficients(image)
        >>> for power in (0.1, 0.5, 2.0):
        ...     filtered = spectral_filter(spectrum, image, lambda s: s**power, coefficients=cached)
        >>> filtered.shape
        torch.Size([1, 1, 24, 24])
    """
    if isinstance(operator, NonlocalOperator):
        for value, name in ((residual, "residual"), (coefficients, "coefficients")):
            if value is not None:
                raise ValueError(
                    f"{name} must be None with an operator, whose whole f(W) is computed, got "
                    f"{type(value).__name__}; pass operator.spectrum() to use it"
                )
        return apply_function(operator, image, response, tolerance=tolerance).image
    check_instance(operator, Spectrum, "operator", "make it with nonlocal_operator, or take its spectrum()")
    check_tensor(image, "image", "convert it with torch.as_tensor")
    response = checked_response(response, operator.support, working_dtype(image))
    if residual is not None:
        check_values(residual, "residual", "finite", operator.factor.shape[0])
    if image.ndim > 2 and len(image) == 0:
        check_fits(image, operator.size, "image", "spectrum", operator.factor, empty=True)
        fold_batch(image, operator.factor.shape[0])  # checks the batch
        return image.clone()
    coefficients = _coefficients(operator, image, coefficients)
    if residual is None:
        return in_format_of(_with_remainder(operator, image, response, coefficients), image)
    if isinstance(residual, int | float) and residual == 0:
        return in_format_of(shaped_as(image, operator.synthesize(response, coefficients)), image)
    rho = per_image(operator.communicator.copy_to_group(residual), operator.root, 2)
    # V f V^T y + rho (y - V V^T y) = V (f - rho) V^T y + rho y, still in two passes over the factor.
    filtered = shaped_as(image, operator.synthesize(partial(_less, response, rho), coefficients))
    return in_format_of(filtered + per_image(rho, filtered, image.ndim) * image.to(filtered), image)


def _less(response: Response, weight: Tensor, eigenvalues: Tensor) -> Tensor:
    gains = response(eigenvalues)
    return gains - weight.to(gains)


def _coefficients(spectrum: Spectrum, image: Tensor, coefficients: Tensor | None) -> Tensor:
    """Those of an image, or the same if they are known and fit it."""
    if coefficients is None:
        return spectrum.coefficients(image)
    check_fits(image, spectrum.size, "image", "spectrum", spectrum.factor)
    batch, landmarks, _ = spectrum.factor.shape
    shape = (max(batch, image.shape[0]), image.shape[1], landmarks)
    check_shape(coefficients, shape, "coefficients", "use spectrum.coefficients(image)")
    return coefficients


def _with_remainder(spectrum: Spectrum, image: Tensor, response: Response, coefficients: Tensor) -> Tensor:
    """``V f(S) V^T y + f(r) (y - V V^T y)``: W multiplies by r what the factor maps to 0."""
    parts = spectrum.synthesize_each((torch.ones_like, response), coefficients)
    captured, filtered = (shaped_as(image, part) for part in parts)
    remainder = torch.zeros_like(spectrum.scaling) if spectrum.remainder is None else spectrum.remainder
    gain = response(remainder.clamp(0.0, 1.0)).unflatten(1, image.shape[2:]).unsqueeze(1)
    check_finite(gain, "response")
    return filtered + gain.to(filtered) * (image.to(filtered) - captured)


@full_precision
def captured_energy(spectrum: Spectrum, image: Tensor) -> Tensor:
    """Compute the share of the image's energy in the span of the eigenvectors, ``|V^T y|^2 / |y|^2``.

    Paper: eq. (19). Near 1 if bandwidth and landmarks suit the image.

    Args:
        spectrum: of the operator.
        image: y, (B, C, H, W).

    Returns:
        beta, (B,), in [0, 1] up to rounding; 1 for a black image. Differentiable in image and operator.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor of the spectrum's size.
    """
    check_instance(spectrum, Spectrum, "spectrum", "take operator.spectrum()")
    check_fits(image, spectrum.size, "image", "spectrum", spectrum.factor)
    captured = spectral_filter(spectrum, image.to(spectrum.factor.dtype), torch.ones_like, residual=0.0)
    exact = image.double()
    energy, inner = (  # |y|^2 and y^T V V^T y, in the sum over weighted points; in float32 they might overflow
        spectrum.communicator.sum(weighted((planes * exact).flatten(2).sum(1), spectrum.weights).sum(1))
        for planes in (exact, captured)
    )
    share = torch.where(energy > 0, inner / energy.clamp(min=torch.finfo(energy.dtype).tiny), 1.0)
    return share.to(spectrum.factor)
