"""Masks of all pixels similar to a region. Paper: Sec. IV, eq. (15) to (17), Fig. 11; Sec. V-A."""

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import CACHED, block_length, for_planes, weighted
from nlfilter_torch.core.checks import check_fits, check_instance, check_positive, check_values
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.precision import full_precision, per_image
from nlfilter_torch.core.torch_internals import is_hidden
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.spectrum import Spectrum

FARTHEST = 60.0  # limit of the exponent; keeps masks positive, so that their products and ratios are defined
NARROWEST = 1e-12  # lower limit of the width, whose inverse square is a factor of the gradient
CAPTURED = 0.005  # captured share of a region's kernel below which its diffusion coordinates are nearly 0
CHECKED = 4096  # maximum number of pixels of a region that are compared with the landmarks
ITERATIONS = 20  # maximum iterations of k-means, which starts close to the solution


@full_precision
def diffusion_map(spectrum: Spectrum, *, time: float | Tensor) -> Tensor:
    """Compute diffusion coordinates, in which similar pixels are close together: eigenvectors scaled by ``lambda^t``.

    Paper: eq. (15), with eigenvectors of unit root mean square, ``sqrt(N) v``, so that distances do not shrink as the
    image grows; with unit-norm eigenvectors every mask would be 1 up to rounding. The constant eigenvector is omitted.

    Args:
        spectrum: of the operator.
        time: t > 0; larger values keep only coarse structure, so that edits extend further.

    Returns:
        (B, R-1, H, W), or (B, R-1) planes of another size. Differentiable, with the limits of
        :attr:`Spectrum.eigenvectors`.

    Raises:
        TypeError, ValueError: if ``time`` is not positive.
    """
    check_instance(spectrum, Spectrum, "spectrum", "take operator.spectrum()")
    check_positive(time, "time", spectrum.factor.shape[0])
    gain = spectrum.eigenvalues[:, 1:].pow(per_image(time, spectrum.factor, 2))
    root = per_image(spectrum.pixels, gain, 2 + len(spectrum.size)).sqrt()
    vectors = spectrum.eigenvectors[:, 1:]
    return for_planes(gain, vectors.ndim - 2) * vectors * root


@full_precision
def diffusion_mask(
    spectrum: Spectrum,
    region: Tensor,
    *,
    time: float | Tensor = 1.0,
    width: float | Tensor = 4.0,
    negative: Tensor | None = None,
) -> Tensor:
    """Compute a mask of the similarity of every pixel to a region: ``exp(-D_t^2 / width)``.

    Paper: eq. (16), (17), where the width is 1. D_t is the distance to the region's mean in :func:`diffusion_map`. Two
    groups of pixels that W does not connect have a squared distance of at least 4, for images of any size.

    Args:
        spectrum: of the operator.
        region: (B, K, H, W), non-negative weights of the pixels of K regions.
        time: diffusion time t > 0, a number or a tensor of shape () or (B,); with larger values masks extend further.
        width: squared distance at which the mask has fallen to 1/e, a number or a tensor of shape () or (B,).
        negative: (B, 1 or K, H, W), weights of the pixels of negative regions, which the mask avoids: the mask is
            halved at pixels as close to the negative region as to the region, and smaller at pixels closer to it. None
            means no negative regions.

    Returns:
        (B, K, H, W) in (0, 1], in the region's dtype (in float16 the smallest values round to 0). Without ``negative``
        the mask increases with time at every pixel. Differentiable in operator, regions, time and width, also if
        eigenvalues are equal.

    Raises:
        TypeError, ValueError: if a region does not fit, is negative or empty, or ``time`` or ``width`` is not positive.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> region = torch.zeros(1, 1, 24, 24)
        >>> region[..., 4:8, 4:8] = 1
        >>> mask = diffusion_mask(nonlocal_operator(image, num_landmarks=20).spectrum(), region)
        >>> mask.shape, bool(((mask > 0) & (mask <= 1)).all())
        (torch.Size([1, 1, 24, 24]), True)
    """
    check_instance(spectrum, Spectrum, "spectrum", "take operator.spectrum()")
    weights = region_weights(spectrum, region)  # (B, K, N)
    check_positive(time, "time", spectrum.factor.shape[0])
    check_positive(width, "width", max(spectrum.factor.shape[0], weights.shape[0]))
    _warn_of_unlike(spectrum, weights)
    exponent = per_image(spectrum.communicator.copy_to_group(time), spectrum.root, 2)
    others = None if negative is None else region_weights(spectrum, negative, name="negative")
    if others is not None:
        check_negative(others.shape[1], weights.shape[1])
        images = max(len(weights), len(others))
        weights = torch.cat([weights.expand(images, -1, -1), others.expand(images, -1, -1)], dim=1)
    # The constant eigenvector does not contribute to distances, so it is kept, and no eigenvectors need to be formed.
    distances = _distances_to_means(spectrum, spectrum.basis(lambda eigenvalues: eigenvalues.pow(exponent)), weights)
    pixels = per_image(spectrum.pixels, distances, 3)
    width = per_image(spectrum.communicator.copy_to_group(width), distances, 3)
    exponents = pixels / width.clamp(min=NARROWEST) * distances  # of the regions, then of negative ones
    inner, outer = exponents[:, : region.shape[1]], exponents[:, region.shape[1] :]
    mask = torch.exp(-inner.clamp(max=FARTHEST))
    mask = mask if negative is None else mask * torch.sigmoid((outer - inner).clamp(min=-20.0))
    return mask.unflatten(2, region.shape[2:]).to(region.dtype)


@torch.no_grad()
def _warn_of_unlike(spectrum: Spectrum, weights: Tensor) -> None:
    """Warn if a region (B, K, N) is unlike all landmarks, since all such pixels have the diffusion coordinates 0."""
    if is_hidden(weights):
        return
    for columns, regions in zip(spectrum.factor, weights.expand(len(spectrum.factor), -1, -1), strict=True):
        for number, region in enumerate(regions):
            places = region.nonzero().squeeze(1)
            few = places[:: 1 + len(places) // CHECKED]
            if len(few) > 0 and columns[:, few].square().sum(0).mean() < CAPTURED:
                warn(
                    f"region {number} resembles no landmark, so its mask may include other pixels that resemble none; "
                    "raise num_landmarks or photometric_bandwidth"
                )


def check_negative(count: int, regions: int) -> None:
    """Raise unless there is one negative region for all regions, or one for each."""
    if count not in (1, regions):
        raise ValueError(
            f"negative must have 1 channel or as many as region ({regions}), got {count}; give one for all regions "
            "or one for each"
        )


def _distances_to_means(spectrum: Spectrum, basis: Tensor, weights: Tensor) -> Tensor:
    """Squared distances (B, K, N) of all pixels to the means of K regions in the coordinates ``basis @ F``.

    ``basis`` is (B, M, M) in float64; the weights of the regions, (B, K, N), have unit sum.
    """
    factor, scaling = spectrum.factor, spectrum.scaling.unsqueeze(1)
    centres = _sums(spectrum, basis, weights).mT.to(factor)  # (B, K, M)
    core, step = basis.to(factor), block_length(len(factor), factor.device, CACHED)
    blocks = zip(factor.split(step, dim=2), scaling.split(step, dim=2), strict=True)
    # In blocks, since the coordinates of all pixels take as much memory as the factor.
    return torch.cat([squared_distances((core @ columns) * scales, centres) for columns, scales in blocks], dim=2)


def squared_distances(coordinates: Tensor, centres: Tensor) -> Tensor:
    """Squared distances (B, K, N) of all pixels with coordinates (B, M, N) to centres (B, K, M)."""
    return torch.stack([(coordinates - c.unsqueeze(2)).square().sum(1) for c in centres.unbind(1)], dim=1)


def region_weights(spectrum: Spectrum, region: Tensor, *, name: str = "region") -> Tensor:
    """Check regions and scale each to unit sum over the pixels, (B, K, N), in the spectrum's dtype."""
    batch = len(spectrum.factor)
    check_fits(region, spectrum.size, name, "spectrum", spectrum.factor, batch=batch, empty=batch == 0)
    planes = region.flatten(2)
    largest = spectrum.communicator.max(planes.detach().abs().amax(2, keepdim=True))  # sums of huge values overflow
    flat = (planes / torch.where(largest > 0, largest, 1.0)).to(spectrum.factor)
    if not is_hidden(flat) and bool((flat < 0).any()):
        raise ValueError(f"{name} must be non-negative, got {flat.min().item():g}; clamp it at 0")
    total = spectrum.communicator.sum(weighted(flat, spectrum.weights).sum(2, keepdim=True))
    if not is_hidden(flat) and bool((total <= 0).any()):
        raise ValueError(
            f"{name} must hold a pixel of positive weight in every mask, got an empty one; paint or select some pixels"
        )
    return flat / total


@full_precision
def segment_mask(
    spectrum: Spectrum, regions: Tensor, *, time: float | Tensor = 1.0, temperature: float | Tensor = 0.0
) -> Tensor:
    """Partition an image into K segments by k-means in the diffusion map, initialised with the regions' centres.

    Paper: Sec. V-A, Figs. 14-16.

    Args:
        spectrum: of the operator.
        regions: (B, K, H, W), non-negative weights of the pixels of K regions.
        time: diffusion time t > 0; larger values give more weight to coarse structure.
        temperature: T >= 0, a number or a tensor of shape () or (B,). 0 gives a hard partition; otherwise the mask of
            a centre at diffusion distance D is the softmax of ``-D^2 / T`` over the centres.

    Returns:
        (B, K, H, W) in [0, 1], in the regions' dtype, with a sum of 1 in every pixel; at temperature 0 zeros and ones,
        which have no gradient. A cluster that loses all its pixels keeps its centre. For a positive temperature
        differentiable in time, temperature and spectrum, with the final clusters held fixed.

    Raises:
        TypeError, ValueError: if ``regions`` does not fit, is negative or has an empty region, ``time`` is not
            positive, or ``temperature`` is negative.
    """
    check_instance(spectrum, Spectrum, "spectrum", "take operator.spectrum()")
    check_positive(time, "time", spectrum.factor.shape[0])
    check_values(temperature, "temperature", "not negative", spectrum.factor.shape[0])
    hard = segment(spectrum, regions, time)
    if not isinstance(temperature, Tensor) and temperature == 0:
        return hard
    return _soft(spectrum, hard, regions, time, temperature)


def _soft(
    spectrum: Spectrum, hard: Tensor, regions: Tensor, time: float | Tensor, temperature: float | Tensor
) -> Tensor:
    """The softmax over the centres of clusters, in the regions' dtype, given the clusters (B, K, H, W)."""
    members = hard.flatten(2).to(spectrum.factor)
    weights = region_weights(spectrum, regions, name="regions").expand(len(spectrum.factor), -1, -1)
    sizes = spectrum.communicator.sum(weighted(members, spectrum.weights).sum(2, dtype=torch.float64)).unsqueeze(1)
    exponent = per_image(time, spectrum.root, 2)
    basis = spectrum.basis(lambda eigenvalues: eigenvalues.pow(exponent))
    means = _sums(spectrum, basis, members) / sizes.clamp(min=1e-12)
    centres = torch.where(sizes == 0, _sums(spectrum, basis, weights), means)
    score = 2 * per_image(spectrum.pixels, spectrum.factor, 3) * _closeness(spectrum, basis, centres)
    memberships = (score / per_image(temperature, score, 3).clamp(min=NARROWEST)).softmax(1)
    return memberships.unflatten(2, hard.shape[2:]).to(regions.dtype)


def segment(spectrum: Spectrum, regions: Tensor, time: float | Tensor, valid: Tensor | None = None) -> Tensor:
    """:func:`segment_mask` at temperature 0; regions that are not ``valid`` (B, K) get no pixels."""
    exponent = per_image(time, spectrum.root, 2)
    with torch.no_grad():
        weights = region_weights(spectrum, regions, name="regions").expand(len(spectrum.factor), -1, -1)  # (B, K, N)
        basis = spectrum.basis(lambda eigenvalues: eigenvalues.pow(exponent))  # to coordinates, (B, M, M)
        centres = _sums(spectrum, basis, weights)
        assignment = _nearest(spectrum, basis, centres, valid)
        for _ in range(ITERATIONS):
            members = torch.zeros_like(weights).scatter_(1, assignment.unsqueeze(1), 1.0)
            counts = weighted(members, spectrum.weights).sum(2, dtype=torch.float64)
            sizes = spectrum.communicator.sum(counts).unsqueeze(1)  # (B, 1, K)
            empty = sizes == 0
            centres = torch.where(empty, centres, _sums(spectrum, basis, members) / torch.where(empty, 1.0, sizes))
            previous, assignment = assignment, _nearest(spectrum, basis, centres, valid)
            if is_hidden(members):  # a comparison would wait for the device
                continue
            if not spectrum.communicator.max((previous != assignment).any().to(members)):
                break
        mask = torch.zeros_like(weights).scatter_(1, assignment.unsqueeze(1), 1.0)
    return mask.unflatten(2, regions.shape[2:]).to(regions.dtype)


def _sums(spectrum: Spectrum, basis: Tensor, weights: Tensor) -> Tensor:
    """Weighted sums (B, M, K) of the coordinates ``basis @ F`` of all pixels, with weights (B, K, N); float64."""
    return basis @ spectrum.communicator.sum(moment(spectrum.factor, spectrum.mass.unsqueeze(1) * weights))


def _closeness(spectrum: Spectrum, basis: Tensor, centres: Tensor) -> Tensor:
    """Half the squared distances (B, K, N) to centres (B, M, K), negative and without the square of the coordinates."""
    inner = spread((centres.mT @ basis).to(spectrum.factor), spectrum.factor, spectrum.scaling)
    return inner - 0.5 * centres.square().sum(1).to(inner).unsqueeze(2)


def _nearest(spectrum: Spectrum, basis: Tensor, centres: Tensor, valid: Tensor | None) -> Tensor:
    """Index (B, N) of the nearest valid centre (B, M, K) for every pixel, in the coordinates ``basis @ F``."""
    score = _closeness(spectrum, basis, centres)
    if valid is not None:
        score = score.masked_fill(~valid.unsqueeze(2), -torch.inf)
    return score.max(1).indices  # ten times as fast as argmax
