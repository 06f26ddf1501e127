"""Values for every pixel from scribbles, by regression in the eigenbasis. Goes beyond the paper's Sec. V-A.

The values on scribbles are treated as noisy samples of a Gaussian process whose covariance comes from random walks over
similar pixels: ``diag(1/d) g diag(1/d)`` with ``g = W + s W^2 + s^2 W^3 + ... = W (I - s W)^-1`` and s the reach. At
s = 0 it is the kernel K; larger s adds longer walks, so values extend further where no scribble is closer. (With g
itself as covariance, rare pixels would have a large variance and common pixels a small one.) Since
``W = diag(d) U^T U diag(d)`` on the span of the factor, the covariance of two pixels is ``u_i^T X u_j`` with the core X
of :meth:`Spectrum.gain`, and the best estimate takes one M x M solve and no choice of eigenvectors.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.checks import (
    check_fits,
    check_instance,
    check_positive,
    check_unit_range,
    check_values,
)
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.precision import full_precision, per_image
from nlfilter_torch.core.torch_internals import are_derived, is_hidden
from nlfilter_torch.operator.spectrum import RitzPairs, Spectrum

DAB = 25 / 38400  # area of a brush dab, relative to the image: 5x5 pixels of 160x240
NOISE = 0.08  # noise variance of the values of one dab, relative to the variance of the image
FLOOR = 1e-12  # lower bound of eigenvalues; keeps the derivative of their square root finite

ScribbledBlocks = Callable[[], Iterable[tuple[Tensor, Tensor, Tensor]]]


@full_precision
def propagate_strokes(
    spectrum: Spectrum,
    strokes: Tensor,
    stroke_mask: Tensor,
    *,
    strength: float | Tensor = 1.0,
    reach: float | Tensor = 0.9,
    smoothness: float | Tensor = 1.0,
) -> Tensor:
    """Extend values given on scribbles to the whole image, with similar values for similar pixels.

    Args:
        spectrum: of the operator. Coordinates in its features (``spatial_bandwidth``) make values local as well.
        strokes: c, (B, C, H, W), any values, such as chroma, selection or depth; read under the mask only.
        stroke_mask: (B, 1, H, W) in [0, 1], the weight of each pixel.
        strength: in [0, 1], a number or a tensor of shape () or (B,): the share of the scribbles' mean that is assigned
            to pixels similar to no scribble. At 1 every pixel gets a value, at 0 values fade to 0 with decreasing
            similarity.
        reach: in [0, 1), a number or a tensor of shape () or (B,): probability that a walk over similar pixels
            continues after a step.
        smoothness: positive, a number or a tensor of shape () or (B,). Smaller values follow the scribbles more
            closely, larger values average them more.

    Returns:
        (B, C, H, W) in the dtype of ``strokes``. Linear in ``strokes``; at strength 1 constant scribbles give the same
        constant. Differentiable in operator, strokes, mask and parameters, also if eigenvalues are equal.

    Raises:
        TypeError, ValueError: if sizes or batches differ, ``stroke_mask`` exceeds [0, 1] or is empty, or a parameter
            is out of range.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> halves = torch.full((1, 1, 16, 16), 0.2)
        >>> halves[..., 8:] = 0.8
        >>> strokes, painted = torch.zeros(1, 1, 16, 16), torch.zeros(1, 1, 16, 16)
        >>> painted[..., 4, 3] = painted[..., 9, 12] = strokes[..., 9, 12] = 1
        >>> spectrum = nonlocal_operator(halves, photometric_bandwidth=0.1, num_landmarks=20).spectrum()
        >>> propagate_strokes(spectrum, strokes, painted)[0, 0, 2, ::5].round(decimals=1).abs()
        tensor([0., 0., 1., 1.])
    """
    check_instance(spectrum, Spectrum, "spectrum", "take operator.spectrum()")
    communicator = spectrum.communicator
    batch = spectrum.factor.shape[0]
    for tensor, name in ((strokes, "strokes"), (stroke_mask, "stroke_mask")):
        check_fits(tensor, spectrum.size, name, "spectrum", spectrum.factor)
    images = batch if batch > 1 else max(strokes.shape[0], stroke_mask.shape[0])
    for tensor, name, channels in ((strokes, "strokes", None), (stroke_mask, "stroke_mask", 1)):
        check_fits(tensor, spectrum.size, name, "spectrum", spectrum.factor, channels=channels, batch=images)
    check_painted(stroke_mask, communicator=communicator)
    check_values(strength, "strength", "share", images)
    check_values(reach, "reach", "below 1", batch)
    check_positive(smoothness, "smoothness", images)

    strength, reach, smoothness = (communicator.copy_to_group(value) for value in (strength, reach, smoothness))
    factor = spectrum.factor
    weights = weighted(stroke_mask.to(factor).flatten(2), spectrum.weights)  # (B or 1, 1, N)
    if spectrum.weights is not None:
        check_painted(weights.clamp(max=1.0).unsqueeze(3), communicator=communicator)
    values = strokes.to(factor).flatten(2)  # (B or 1, C, N)
    if not are_derived([weights]):  # pixels of weight 0 matter only for the gradient of the weights
        painted = (weights > 0).any(0).squeeze(0).nonzero().squeeze(1)
        factor, weights, values = factor[:, :, painted], weights[:, :, painted], values[:, :, painted]
    fitted = fit_strokes(
        lambda: [(factor, weights, values)],
        spectrum,
        spectrum.pixels,
        strength=strength,
        reach=reach,
        smoothness=smoothness,
        communicator=communicator,
    )
    return fitted(spectrum.factor).unflatten(2, strokes.shape[2:]).to(strokes.dtype)


@dataclass(frozen=True, eq=False)
class FittedStrokes:
    """Fitted regression that gives the values of any pixel from its column of the factor.

    Attributes:
        coefficients: (B, C, M), float64.
        share: (B, C, 1), the share of the scribbles' mean that is assigned to pixels similar to no scribble.
    """

    coefficients: Tensor
    share: Tensor

    def __call__(self, factor: Tensor) -> Tensor:
        """Compute values (B, C, n) of pixels with columns (B, M, n) of the unscaled factor."""
        rows = self.coefficients.to(factor)
        return spread(rows, factor.expand(len(rows), -1, -1)) + self.share.to(factor)


def fit_strokes(
    painted: ScribbledBlocks,
    pairs: RitzPairs,
    pixels: float | Tensor,
    *,
    strength: float | Tensor,
    reach: float | Tensor,
    smoothness: float | Tensor,
    communicator: Communicator = ALONE,
) -> FittedStrokes:
    """Fit the regression of :func:`propagate_strokes`, from sums over the scribbled pixels.

    ``painted`` is called more than once and returns an iterable over all scribbled pixels, in blocks of columns of the
    factor (B, M, n), weights (B, 1, n) and values (B, C, n). ``pixels`` is the number N of pixels of the whole image,
    or (B,), whose rows are distributed over the ranks of ``communicator``.
    """
    walk = per_image(reach, pairs.root, 2)  # s, (B or 1, 1)
    basis = pairs.basis(lambda eigenvalues: (eigenvalues.clamp(min=FLOOR) / (1 - walk * eigenvalues)).sqrt())
    half = basis.mT  # R, where X = R R^T
    effective_weights = EffectiveWeights.of(painted, half, _dab(pixels), communicator)

    gram, target, sums = torch.zeros(()), torch.zeros(()), torch.zeros(())
    for factor, weights, values in painted():
        effective = effective_weights(factor, weights)
        images = max(len(factor), len(effective), len(values))
        known = torch.cat([values, torch.ones_like(values[:, :1])], dim=1).expand(images, -1, -1)
        gram = gram + moment(factor * effective, factor)  # (B, M, M)
        target = target + moment(factor.expand(images, -1, -1), effective * known)  # (B, M, C+1)
        sums = sums + (effective * known).double().sum(2)  # (B, C+1)
    gram, target, sums = (communicator.sum(total) for total in (gram, target, sums))

    # X (G X + v)^-1 = R (R^T G R + v)^-1 R^T, where the inverted matrix is symmetric and positive definite.
    inner = half.mT @ gram @ half
    # Noise variance of a single pixel of a dab.
    noise = per_image(smoothness, gram, 3) * effective_weights.dab * effective_weights.noise
    identity = torch.eye(inner.shape[1]).to(inner)
    lower = torch.linalg.cholesky_ex(inner + noise * identity).L
    solution = half @ torch.cholesky_solve(half.mT @ target, lower)  # (B, M, C+1)

    # The last column extends scribbles of ones, and tells how far the scribbles determine each pixel. Generalised least
    # squares computes the mean from the residuals of both; pixels that are not determined get a share of the mean.
    residual = sums - (target[:, :, -1:].mT @ solution).squeeze(1)  # (B, C+1)
    mean = residual[:, :-1] / residual[:, -1:]
    share = per_image(strength, solution, 3) * mean.unsqueeze(1)  # (B, 1, C)
    return FittedStrokes((solution[:, :, :-1] - solution[:, :, -1:] * share).mT, share.mT)


@dataclass(frozen=True, eq=False)
class EffectiveWeights:
    """Effective weights of scribbled pixels.

    Pixels similar to few other scribbled pixels count for up to a whole dab, so that broad scribbles or a large
    photograph do not outweigh a single dot. The part of a pixel that the landmarks do not capture carries no
    information about other pixels, so pixels unlike all others have little weight.

    Attributes:
        core: X, (B, M, M).
        gram: ``X G X / v`` with G the sum over the scribbled pixels and v their mean captured variance, (B, M, M).
        dab: number of pixels in a brush dab, one for all images or (B, 1, 1).
        noise: variance of the values of a dab, (B, 1, 1).
    """

    core: Tensor
    gram: Tensor
    dab: float | Tensor
    noise: Tensor

    @staticmethod
    def of(
        painted: ScribbledBlocks, half: Tensor, dab: float | Tensor, communicator: Communicator
    ) -> "EffectiveWeights":
        """Compute the attributes from sums over the scribbled pixels."""
        gram, residual, total = torch.zeros(()), torch.zeros(()), torch.zeros(())
        for factor, weights, _ in painted():
            gram = gram + moment(factor * weights, factor)
            residual = residual + (weights * diagonal_residual(factor)).double().sum((1, 2))
            total = total + weights.double().sum((1, 2))
        gram, residual, total = (communicator.sum(part) for part in (gram, residual, total))
        core = half @ half.mT
        variance = (half.mT @ gram @ half).diagonal(dim1=1, dim2=2).sum(1) / total  # mean of u^T X u
        noise = NOISE * (variance + residual / total).reshape(-1, 1, 1)
        return EffectiveWeights(core, core @ gram @ core / variance.reshape(-1, 1, 1), dab, noise)

    def __call__(self, factor: Tensor, weights: Tensor) -> Tensor:
        """Compute the effective weights (B, 1, n) of pixels with columns (B, M, n)."""
        dab = self.dab.to(weights) if isinstance(self.dab, Tensor) else self.dab
        at_most_1 = dab.clamp(max=1.0) if isinstance(dab, Tensor) else min(dab, 1.0)
        noise, own = self.noise.to(weights), diagonal_residual(factor) / at_most_1
        weights = weights * noise / (noise + own)
        if not isinstance(dab, Tensor) and dab <= 1:
            return weights
        variance = (factor * (self.core.to(factor) @ factor)).sum(1, keepdim=True)  # (B, 1, n)
        # Sum of squared correlations with the scribbled pixels.
        similar = (factor * (self.gram.to(factor) @ factor)).sum(1, keepdim=True)
        similar = similar / variance.clamp(min=torch.finfo(variance.dtype).tiny)  # 0 at isolated pixels, as both are
        return weights * (dab / similar.clamp(min=1.0)).clamp(min=1.0)


def _dab(pixels: float | Tensor) -> float | Tensor:
    """Number of pixels in a brush dab."""
    return DAB * pixels.reshape(-1, 1, 1) if isinstance(pixels, Tensor) else DAB * pixels


def diagonal_residual(factor: Tensor) -> Tensor:
    """Residual of columns (B, M, n) on the kernel's unit diagonal, (B, 1, n): 1 for a pixel unlike all landmarks."""
    return (1 - factor.square().sum(1, keepdim=True)).clamp(min=0.0)


def check_painted(stroke_mask: Tensor, name: str = "stroke_mask", *, communicator: Communicator = ALONE) -> None:
    """Raise unless every image of ``stroke_mask`` (B, 1, H, W) has a scribbled pixel and all values are in [0, 1]."""
    check_unit_range(stroke_mask, name)
    if is_hidden(stroke_mask):
        return
    empty = communicator.max(stroke_mask.detach().flatten(1).amax(1)) <= 0
    if bool(empty.any()):
        raise ValueError(
            f"{name} must hold a painted pixel in every image, got none in image(s) "
            f"{empty.nonzero().squeeze(1).tolist()}; paint at least one"
        )
