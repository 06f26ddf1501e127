"""Spectrum and regions to masks that reach every similar pixel. Paper: Sec. IV, eq. (15) to (17), Fig. 11; Sec. V-A."""

import torch
from torch import Tensor

from nlfilter_torch.checks import check_image, check_positive, check_same_size
from nlfilter_torch.landmarks import assign, cluster_means
from nlfilter_torch.precision import full_precision
from nlfilter_torch.spectrum import Spectrum

ITERATIONS = 20  # of k-means, which starts close to its end


@full_precision
def diffusion_map(spectrum: Spectrum, *, time: float | Tensor) -> Tensor:
    """Coordinates in which similar pixels lie close together: eigenvectors scaled by ``lambda^t``.

    Paper: eq. (15), with eigenvectors of unit root mean square, ``sqrt(N) v``, so that distances do not shrink as the
        image
    grows; with unit-norm ones every mask is 1 to rounding. The constant eigenvector is left out.

    Args:
        spectrum: of the operator.
        time: t > 0; larger values keep only the coarse structure, so that edits reach further.

    Returns:
        (B, R-1, H, W). Differentiable, with the limits of :attr:`Spectrum.eigenvectors`.

    Raises:
        TypeError, ValueError: if ``time`` is not positive.
    """
    check_positive(time, "time")
    gain = spectrum.eigenvalues[:, 1:].pow(torch.as_tensor(time).to(spectrum.factor).reshape(-1, 1))
    return gain[:, :, None, None] * spectrum.eigenvectors[:, 1:] * spectrum.scaling.shape[1] ** 0.5


@full_precision
def diffusion_mask(
    spectrum: Spectrum, region: Tensor, *, time: float | Tensor = 1.0, width: float | Tensor = 4.0
) -> Tensor:
    """How similar every pixel is to a region: ``exp(-D_t^2 / width^2)``.

    Paper: eq. (16), (17), with D_t the distance to the region's mean in :func:`diffusion_map`.

    Args:
        spectrum: of the operator.
        region: (B, K, H, W), non-negative weights of the pixels of K regions.
        time: diffusion time t > 0, a number or a tensor of shape () or (B,); larger reaches further.
        width: distance at which the mask has fallen to 1/e, likewise; 4 gives useful masks.

    Returns:
        (B, K, H, W) in (0, 1], in the region's dtype. Differentiable in operator, region, time and width, also where
        eigenvalues meet.

    Raises:
        TypeError, ValueError: if ``region`` does not fit, is negative or empty, or ``time`` or ``width`` is not
        positive.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> region = torch.zeros(1, 1, 24, 24)
        >>> region[..., 4:8, 4:8] = 1
        >>> mask = diffusion_mask(nonlocal_operator(image, num_landmarks=20).spectrum(), region)
        >>> mask.shape, bool(((mask > 0) & (mask <= 1)).all())
        (torch.Size([1, 1, 24, 24]), True)
    """
    check_positive(time, "time")
    check_positive(width, "width")
    weights = region_weights(spectrum, region)  # (B, K, N)
    exponent = torch.as_tensor(time).to(spectrum.root).reshape(-1, 1)
    # The constant eigenvector has no differences, so it may stay: distances need no choice of eigenvectors.
    coordinates = spectrum.diffusion_basis(lambda eigenvalues: eigenvalues.pow(exponent))  # (B, M, N)
    centres = weights @ coordinates.mT  # (B, K, M)
    squared = torch.stack([(coordinates - c.unsqueeze(2)).square().sum(1) for c in centres.unbind(1)], dim=1)
    scale = coordinates.shape[2] / torch.as_tensor(width).to(squared).reshape(-1, 1, 1).square()
    # Far pixels would underflow to 0, where a product of masks loses what it stands for.
    mask = torch.exp((-scale * squared).clamp(min=-60.0))
    return mask.unflatten(2, spectrum.size).to(region.dtype)


def region_weights(spectrum: Spectrum, region: Tensor, *, name: str = "region") -> Tensor:
    """Check regions (B, K, H, W) and scale each to unit sum, (B, K, N), in the spectrum's dtype."""
    check_image(region, name, batch=spectrum.factor.shape[0])
    check_same_size(region, spectrum.size, name, "spectrum")
    flat = region.to(spectrum.factor).flatten(2)
    if bool((flat < 0).any()):
        raise ValueError(f"{name} must be non-negative, got {flat.min().item():g}; clamp it at 0")
    total = flat.sum(2, keepdim=True)
    if bool((total <= 0).any()):
        raise ValueError(
            f"{name} must each hold a pixel of positive weight, got an empty one; paint or select some pixels"
        )
    return flat / total


@full_precision
def segment_mask(spectrum: Spectrum, regions: Tensor, *, time: float | Tensor = 1.0) -> Tensor:
    """Divide the image among K regions by k-means in the diffusion map, started from the regions' centres.

    Paper: Sec. V-A, Figs. 14-16.

    Args:
        spectrum: of the operator.
        regions: (B, K, H, W), non-negative weights of the pixels of K regions.
        time: diffusion time t > 0; larger values weigh coarse structure more.

    Returns:
        (B, K, H, W) of zeros and ones, in the regions' dtype, with a single one for every pixel. A cluster that loses
        all its pixels keeps its centre. Not differentiable, as any assignment.

    Raises:
        TypeError, ValueError: if ``regions`` does not fit, is negative or holds an empty one, or ``time`` is not
        positive.
    """
    check_positive(time, "time")
    exponent = torch.as_tensor(time).to(spectrum.root).reshape(-1, 1)
    with torch.no_grad():
        weights = region_weights(spectrum, regions, name="regions")  # (B, K, N)
        coordinates = spectrum.diffusion_basis(lambda eigenvalues: eigenvalues.pow(exponent))  # (B, M, N)
        centres = (weights @ coordinates.mT).mT  # (B, M, K)
        assignment = assign(coordinates, centres)
        for _ in range(ITERATIONS):
            centres = cluster_means(coordinates, assignment, centres)
            previous, assignment = assignment, assign(coordinates, centres)
            if coordinates.device.type == "cpu" and torch.equal(previous, assignment):
                break
        mask = torch.zeros_like(weights).scatter_(1, assignment.unsqueeze(1), 1.0)
    return mask.unflatten(2, spectrum.size).to(regions.dtype)
