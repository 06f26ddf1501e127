"""Less noise, with sliders that every pixel sets from the noise level. Paper: Sec. III, Fig. 6(c), (d); Sec. V."""

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_image, check_photograph
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.edits.colour import nearby
from nlfilter_torch.edits.parameters import DENOISE
from nlfilter_torch.filtering.filters import detail_layers, weigh_layers
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import pad_border
from nlfilter_torch.operator.operator import NonlocalOperator

GUIDE_BLUR = 0.7  # pixels; the guide's own noise would link pixels by it
ORDER = 2
QUIET = 0.1 / 255  # a noise level below what eight bits resolve: nothing to do
MEDIAN = 0.6745  # of the absolute value of a normal variable


@full_precision
def denoise(
    image: Tensor,
    *,
    noise_level: float | Tensor | None = DENOISE.defaults["noise_level"],
    photometric_bandwidth: float | Tensor | None = None,
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = DENOISE.defaults["patch_size"],
    num_landmarks: int = DENOISE.defaults["num_landmarks"],
    **options: Any,
) -> Tensor:
    """Remove noise of known or estimated strength.

    The sliders of eq. (12) are set for every pixel: a detail layer is kept by the share of its local energy that noise
    does not explain. The energy is averaged by W, over similar patches wherever they are.

    Args:
        image: (B, C, H, W).
        noise_level: standard deviation of white noise, in units of the image, a number or a tensor of shape () or (B,);
            None estimates it by :func:`estimate_noise`.
        photometric_bandwidth: h_y; None is the noise level.
        spatial_bandwidth: h_x in pixels; None is 0.2 of the short side.
        patch_size: of the patches that are compared.
        num_landmarks: M; more keep more of what is rare.
        **options: further ones of :func:`nonlocal_operator`.

    Returns:
        (B, C, H, W) of the same mean, to rounding, as far as sliders agree; ``image`` itself where the noise level is
        less than a tenth of a grey level. Differentiable in image and noise level.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or ``noise_level`` is negative.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> clean = torch.linspace(0, 1, 32).expand(1, 1, 32, 32)
        >>> noisy = clean + 0.1 * torch.randn(1, 1, 32, 32, generator=generator)
        >>> round(float((noisy - clean).std()), 2), bool((denoise(noisy) - clean).std() < 0.06)
        (0.1, True)
    """
    check_photograph(image, "image")
    check_count(num_landmarks, "num_landmarks")
    DENOISE["noise_level"].check_argument(noise_level, image.shape[0])
    pixels = image.to(working_dtype(image))
    level = estimate_noise(pixels) if noise_level is None else torch.as_tensor(noise_level).to(pixels).reshape(-1)

    heard = level.clamp(min=QUIET)
    operator = nonlocal_operator(
        soften(pixels, GUIDE_BLUR),
        photometric_bandwidth=heard if photometric_bandwidth is None else photometric_bandwidth,
        spatial_bandwidth=nearby(spatial_bandwidth, DENOISE["spatial_bandwidth"].share, pixels.shape[-2:]),
        patch_size=patch_size,
        num_landmarks=min(num_landmarks, pixels.shape[-2] * pixels.shape[-1]),
        guide_channels="all",
        **options,
    )
    layers = detail_layers(operator, pixels, order=ORDER)  # (B, ORDER+1, C, H, W)
    energy = operator @ layers[:, :-1].square().mean(2)  # (B, ORDER, H, W)
    noise = heard.square().reshape(-1, 1) * _passed_noise(operator)  # (B, ORDER)
    kept = (1 - noise[..., None, None] / energy.clamp(min=1e-12)).clamp(0.0, 1.0)
    cleaned = weigh_layers(layers, torch.cat([kept, torch.ones_like(kept[:, :1])], dim=1))
    return torch.where((level < QUIET).reshape(-1, 1, 1, 1), pixels, cleaned).to(image.dtype)


@full_precision
def estimate_noise(image: Tensor) -> Tensor:
    """Standard deviation of white noise: the median response to Immerkaer's mask, mean over channels.

    The mask (Immerkaer, "Fast Noise Variance Estimation", 1996) is blind to whatever is linear in rows or columns, and
    a median does not hear edges. Fine texture counts as noise: expect one or two grey levels too many on photographs,
    and ten on grass.

    Args:
        image: (B, C, H, W), at least 3x3.

    Returns:
        (B,), in units of the image; 0 for an image smaller than 3x3. Constant, as no gradient passes.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point (B, C, H, W) tensor.

    Example:
        >>> noise = torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> estimate_noise(0.5 + 0.1 * noise).round(decimals=2)
        tensor([0.1000])
    """
    check_image(image, "image")
    if min(image.shape[-2:]) < 3:
        return image.new_zeros(image.shape[0])
    second = torch.tensor([1.0, -2.0, 1.0], device=image.device, dtype=working_dtype(image))
    mask = torch.outer(second, second)[None, None] / 6  # of unit norm
    planes = image.detach().to(mask.dtype).flatten(0, 1).unsqueeze(1)
    response = F.conv2d(planes, mask).flatten(1).abs()
    return (response.median(1).values / MEDIAN).unflatten(0, image.shape[:2]).mean(1)


def soften(image: Tensor, sigma: float) -> Tensor:
    """Blur an image (B, C, H, W) of any size by a Gaussian."""
    from kornia.filters import gaussian_blur2d  # kornia takes half a second to import: only who needs it waits

    reach = math.ceil(2.5 * sigma)
    size = 2 * reach + 1
    padded = pad_border(image, reach)
    return gaussian_blur2d(padded, (size, size), (sigma, sigma))[..., reach:-reach, reach:-reach]


def _passed_noise(operator: NonlocalOperator) -> Tensor:
    """Variance (B, ORDER) that unit white noise has in each detail layer ``W^i (I - W)``, mean over pixels.

    Off the eigenvectors W is nearly its diagonal part r, which gives the rest of the trace.
    """
    spectrum = operator.spectrum()
    inside = spectrum.eigenvalues  # (B, R)
    counted = spectrum.support[:, : inside.shape[1]]  # the others are padding, in a batch of different ranks
    outside = operator.diagonal_share.flatten(1)  # (B, N)
    pixels = outside.shape[1]
    share = 1 - counted.sum(1) / pixels  # (B,)

    def gain(eigenvalues: Tensor, order: int) -> Tensor:
        return (eigenvalues**order * (1 - eigenvalues)).square()

    traces = [(gain(inside, i) * counted).sum(1) / pixels + share * gain(outside, i).mean(1) for i in range(ORDER)]
    return torch.stack(traces, dim=1)
