"""Less noise, with sliders that every pixel sets from the noise level. Paper: Sec. III, Fig. 6(c), (d); Sec. V."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_image, check_photograph
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.edits.colour import nearby
from nlfilter_torch.edits.parameters import DENOISE
from nlfilter_torch.edits.source import Fitted, Guide, InMemory, Operator, Pixels, Source, edited
from nlfilter_torch.filtering.filters import weigh_layers

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
    return edited(
        image,
        fit_denoise,
        noise_level=noise_level,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        num_landmarks=num_landmarks,
        **options,
    )


def fit_denoise(
    source: Source,
    *,
    noise_level: float | Tensor | None,
    photometric_bandwidth: float | Tensor | None,
    **options: Any,
) -> Fitted:
    """:func:`denoise` for any source."""
    check_count(options["num_landmarks"], "num_landmarks")
    DENOISE["noise_level"].check_argument(noise_level, source.batch)
    level = noise_of(source) if noise_level is None else torch.as_tensor(noise_level, dtype=source.dtype).reshape(-1)
    assumed = level.clamp(min=QUIET)
    options |= {
        "photometric_bandwidth": assumed if photometric_bandwidth is None else photometric_bandwidth,
        "spatial_bandwidth": nearby(options["spatial_bandwidth"], DENOISE["spatial_bandwidth"].share, source.size),
        "num_landmarks": min(options["num_landmarks"], source.size[0] * source.size[1]),
        "guide_channels": "all",
    }
    operator = source.operator(Guide(options, blur=GUIDE_BLUR))
    layers = operator.layers(lambda pixels: pixels.image, ORDER)  # (B, ORDER+1, C, H, W)
    energy = operator.layers(lambda pixels: layers(pixels)[:, :-1].square().mean(2), 1)  # of (B, ORDER, H, W)
    noise = assumed.square().reshape(-1, 1) * _passed_noise(operator, source.size[0] * source.size[1])  # (B, ORDER)

    def cleaned(pixels: Pixels) -> Tensor:
        kept = (1 - noise[..., None, None].to(pixels.image) / energy(pixels)[:, -1].clamp(min=1e-12)).clamp(0.0, 1.0)
        weighed = weigh_layers(layers(pixels), torch.cat([kept, torch.ones_like(kept[:, :1])], dim=1))
        return torch.where((level < QUIET).reshape(-1, 1, 1, 1), pixels.image, weighed)

    return Fitted(cleaned)


@full_precision
def estimate_noise(image: Tensor) -> Tensor:
    """Standard deviation of white noise: the median response to Immerkaer's mask, mean over channels.

    The mask (Immerkaer, "Fast Noise Variance Estimation", 1996) is blind to whatever is linear in rows or columns, and
    the median ignores edges, which are few. Fine texture counts as noise: expect one or two grey levels too many on
    photographs, and ten on grass.

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
    return noise_of(InMemory(image.detach().to(working_dtype(image))))


def noise_of(source: Source) -> Tensor:
    """:func:`estimate_noise` for any source."""
    if min(source.size) < 3:
        return torch.zeros(source.batch, dtype=source.dtype)
    return source.medians(_response, 1).mean(1) / MEDIAN


@torch.no_grad()
def _response(image: Tensor) -> Tensor:
    """Absolute response (B, C, H-2, W-2) to Immerkaer's mask."""
    second = torch.tensor([1.0, -2.0, 1.0], device=image.device, dtype=image.dtype)
    mask = torch.outer(second, second)[None, None] / 6  # of unit norm
    return (
        F.conv2d(image.flatten(0, 1).unsqueeze(1), mask).abs().view(*image.shape[:2], *(n - 2 for n in image.shape[2:]))
    )


def _passed_noise(operator: Operator, pixels: int) -> Tensor:
    """Variance (B, ORDER) that unit white noise has in each detail layer ``W^i (I - W)``, mean over pixels.

    Off the eigenvectors W is nearly its diagonal part r, which gives the rest of the trace.
    """

    def gain(eigenvalues: Tensor, order: int) -> Tensor:
        return (eigenvalues**order * (1 - eigenvalues)).square()

    ritz, support = operator.pairs.ritz, operator.pairs.support
    inside = [ritz.apply(lambda s, i=i: gain(s.clamp(0.0, 1.0), i), support) for i in range(ORDER)]  # type: ignore[misc]
    traces = torch.stack([matrix.diagonal(dim1=1, dim2=2).sum(1) for matrix in inside], dim=1) / pixels
    share = operator.each(lambda columns: columns.remainder.unsqueeze(1))
    outside = operator.mean(lambda some: torch.cat([gain(share(some), i) for i in range(ORDER)], dim=1))
    return traces.to(outside) + (1 - support.sum(1, keepdim=True) / pixels) * outside
