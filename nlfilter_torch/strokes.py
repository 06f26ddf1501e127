"""Spectrum and strokes to values for every pixel, by regression in the eigenbasis. Goes past the paper's Sec. V-A.

Values on strokes are taken for noisy samples of a random image that varies like a walk over similar pixels: with ``g =
W + s W^2 + s^2 W^3 + ... = W (I - s W)^-1``, s the reach, its covariance is ``diag(1/d) g diag(1/d)``. At s = 0 that is
the kernel K itself; larger s adds longer walks, so that values carry further where nothing nearer was painted. The
weights of W alone would not do: they let rare pixels vary much and common ones hardly. As ``W = diag(d) U^T U diag(d)``
on the span of the factor, the covariance of two pixels is ``u_i^T X u_j`` with the core X of :meth:`Spectrum.gain`, and
the best estimate is one m x m solve, with no choice of eigenvectors in it.
"""

import torch
from torch import Tensor

from nlfilter_torch.blocks import moment
from nlfilter_torch.checks import check_image, check_positive, check_same_size, check_unit_range
from nlfilter_torch.precision import full_precision
from nlfilter_torch.sharding import Shard, reduce_max, reduce_sum, replicate
from nlfilter_torch.spectrum import Spectrum

SPOT = 25 / 38400  # share of the image that a dab of a brush covers: 5x5 pixels of 160x240
NOISE = 0.08  # variance of the values of one dab, as a share of the variance of the image


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
    """Extend values that are known on strokes to the whole image, alike where the image is alike.

    Args:
        spectrum: of the operator. Coordinates in its features (``spatial_bandwidth``) make values local as well.
        strokes: c, (B, C, H, W), any values, such as chroma, selection or depth; read where painted only.
        stroke_mask: (B, 1, H, W) in [0, 1], how much a pixel counts.
        strength: in [0, 1], a number or a tensor of shape () or (B,): how much of the strokes' mean goes to pixels that
            resemble none of them. At 1 every pixel gets a value, at 0 values fade to 0 away from their likes.
        reach: in [0, 1), likewise: how likely a walk over similar pixels goes on after each step.
        smoothness: positive, likewise. Smaller follows the strokes more closely, larger evens them out.

    Returns:
        (B, C, H, W) in the dtype of ``strokes``. Linear in ``strokes``; at strength 1 a constant comes back as itself.
        Differentiable in operator, strokes, mask and parameters, also where eigenvalues meet.

    Raises:
        TypeError, ValueError: if sizes or batches differ, ``stroke_mask`` leaves [0, 1] or is empty, or a parameter
            leaves its range.

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
    shard = spectrum.shard
    batch = spectrum.factor.shape[0]
    images = max(batch, strokes.shape[0], stroke_mask.shape[0])
    for tensor, name, channels in ((strokes, "strokes", None), (stroke_mask, "stroke_mask", 1)):
        check_image(tensor, name, channels=channels, batch=images)
        check_same_size(tensor, spectrum.size, name, "spectrum")
    check_painted(stroke_mask, shard=shard)
    check_share(strength, "strength")
    check_share(reach, "reach", below=True)
    check_positive(smoothness, "smoothness")

    strength, reach, smoothness = (replicate(value, shard) for value in (strength, reach, smoothness))
    factor = spectrum.factor
    weights = stroke_mask.to(factor).flatten(2)  # (B or 1, 1, N)
    values = strokes.to(factor).flatten(2)  # (B or 1, C, N)
    if not weights.requires_grad:  # the weight of an unpainted pixel has a derivative, but no effect
        painted = (weights > 0).any(0).squeeze(0).nonzero().squeeze(1)
        factor, weights, values = factor[:, :, painted], weights[:, :, painted], values[:, :, painted]
    walk = _per_image(reach, spectrum.root).squeeze(2)  # (B or 1, 1)
    core = spectrum.gain(lambda eigenvalues: eigenvalues / (1 - walk * eigenvalues))  # (B, M, M), float64

    spot = SPOT * spectrum.pixels
    weights = _raise_dots(factor, weights, core, spot, shard)
    gram = moment(factor * weights, factor, shard) @ core
    painted_weight = reduce_sum(weights.double().sum((1, 2)), shard)
    variance = gram.diagonal(dim1=1, dim2=2).sum(1) / painted_weight  # of a painted pixel, on average
    noise = _per_image(smoothness, gram) * (NOISE * spot * variance).reshape(-1, 1, 1)
    known = torch.cat([values, torch.ones_like(values[:, :1])], dim=1).expand(images, -1, -1)
    target = moment(factor.expand(images, -1, -1), weights * known, shard)  # (B, M, C+1)
    solution = core @ torch.linalg.solve(gram + noise * torch.eye(gram.shape[1]).to(gram), target)

    # The last column extends a stroke of ones: how far each pixel is reached at all. Generalised least squares tells
    # the mean from what both leave unexplained on the strokes, and unreached pixels get their part of it.
    sums = reduce_sum((weights * known).double().sum(2), shard)
    unexplained = sums - (target[:, :, -1:].mT @ solution).squeeze(1)  # (B, C+1)
    mean = unexplained[:, :-1] / unexplained[:, -1:]
    share = _per_image(strength, solution) * mean.unsqueeze(1)  # (B, 1, C)
    weights_of_pixels = (solution[:, :, :-1] - solution[:, :, -1:] * share).mT.to(factor)  # (B, C, M)
    spread = weights_of_pixels @ spectrum.factor + share.mT.to(factor)
    return spread.unflatten(2, spectrum.size).to(strokes.dtype)


def check_painted(stroke_mask: Tensor, name: str = "stroke_mask", *, shard: Shard | None = None) -> None:
    """Raise unless every image of ``stroke_mask`` (B, 1, H, W) holds a painted pixel and all values are in [0, 1]."""
    check_unit_range(stroke_mask, name)
    empty = reduce_max(stroke_mask.detach().amax((1, 2, 3)), shard) <= 0
    if bool(empty.any()):
        raise ValueError(
            f"{name} must hold a painted pixel in every image, got none in image(s) "
            f"{empty.nonzero().squeeze(1).tolist()}; paint at least one"
        )


def check_share(value: float | Tensor, name: str, *, below: bool = False) -> None:
    """Raise unless ``value`` (a number, or a tensor on the CPU) is in [0, 1], or in [0, 1) where ``below``."""
    values = torch.as_tensor(value).detach()
    if values.device.type != "cpu":
        return
    inside = (values >= 0) & ((values < 1) if below else (values <= 1))
    if not bool(inside.all()):
        raise ValueError(f"{name} must be in [0, 1{')' if below else ']'}, got {values.tolist()}; clamp it")


def _raise_dots(factor: Tensor, weights: Tensor, core: Tensor, spot: float, shard: Shard | None) -> Tensor:
    """Weights (B, 1, n) under which painted pixels that few others resemble count like a whole spot.

    A dot that someone sets with care must not drown among broad strokes, nor in a large photograph.
    """
    if spot <= 1:
        return weights
    gram = core @ moment(factor * weights, factor, shard) @ core
    variance = (factor * (core.to(factor) @ factor)).sum(1, keepdim=True)  # (B, 1, n)
    typical = reduce_sum((weights * variance).sum(2, keepdim=True), shard) / reduce_sum(
        weights.sum(2, keepdim=True), shard
    )
    likes = (factor * (gram.to(factor) @ factor)).sum(1, keepdim=True) / (
        variance * typical
    )  # sum of squared correlations
    return weights * (spot / likes.clamp(min=1.0)).clamp(min=1.0)


def _per_image(value: float | Tensor, like: Tensor) -> Tensor:
    """A number or a tensor of shape () or (B,) as (1 or B, 1, 1) in the dtype of ``like``."""
    return torch.as_tensor(value).to(like).reshape(-1, 1, 1)
