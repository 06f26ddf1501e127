"""Denoising by the trained network around the filter, or by sliders set per pixel from the noise level.

Paper: Sec. III, Fig. 6(c), (d); Sec. V.
"""

from typing import Any, Literal

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count
from nlfilter_torch.core.inner import Inner
from nlfilter_torch.core.precision import per_image
from nlfilter_torch.core.values import cached_constants
from nlfilter_torch.filtering.filters import weigh_layers
from nlfilter_torch.nn.denoiser.network import NonlocalDenoiser
from nlfilter_torch.nn.denoiser.noise import Noise, noise_map
from nlfilter_torch.nn.denoiser.tiles import STEP
from nlfilter_torch.photo.declared.parameters import DENOISE
from nlfilter_torch.photo.edits.noise import noise_of
from nlfilter_torch.photo.picture.in_memory import edit_of
from nlfilter_torch.photo.picture.source import Fitted, Guide, Operator, Pixels, Source

Method = Literal["network", "rule"]

GUIDE_BLUR = 0.7  # pixels; without the blur, pixels would be similar by their noise
ORDER = 2
NEGLIGIBLE_NOISE = 0.1 / 255  # noise level below what 8 bits resolve; the image is returned unchanged


@edit_of("image")
def denoise(
    source: Source,
    /,
    *,
    noise_level: float | Tensor | None = DENOISE.defaults["noise_level"],
    strength: float | Tensor = DENOISE.defaults["strength"],
    method: Method = DENOISE.defaults["method"],
    photometric_bandwidth: float | Tensor | None = None,
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = DENOISE.defaults["patch_size"],
    num_landmarks: int = DENOISE.defaults["num_landmarks"],
    **options: Any,
) -> Fitted:
    """Remove noise of known or estimated level.

    The network is :meth:`NonlocalDenoiser.trained`. With ``method="rule"`` nothing is learned: the sliders of eq. (12)
    are set for each pixel, to the share of a detail layer's energy that is not due to noise. W averages this energy
    over similar patches in the whole image.

    Args:
        image: (B, C, H, W); with C = 3 it is RGB.
        noise_level: standard deviation of white noise, in units of the image, a number or a tensor of shape () or (B,);
            for the network also a map (B, 1 or C, H, W). None estimates it, and its growth with brightness.
        strength: factor of the noise level, a number or a tensor of shape () or (B,): 0 changes nothing, more than 1
            smooths more. For the network, more than 100/255 counts as 100/255 of noise.
        method: ``"network"`` or ``"rule"``. All further arguments are for the rule.
        photometric_bandwidth: h_y; None is the noise level.
        spatial_bandwidth: h_x in pixels; None is 0.2 of the short side.
        patch_size: width of the compared patches.
        num_landmarks: M; more keep more rare detail.
        **options: further options of :func:`nonlocal_operator`.

    Returns:
        (B, C, H, W), equal to ``image`` where the noise level is less than a tenth of a grey level. Differentiable in
        image and noise level; an estimated level counts as a constant.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or ``noise_level`` is negative.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> clean = torch.linspace(0, 1, 32).expand(1, 1, 32, 32)
        >>> noisy = clean + 0.1 * torch.randn(1, 1, 32, 32, generator=generator)
        >>> bool((denoise(noisy) - clean).std() < 0.03), bool((denoise(noisy, method="rule") - clean).std() < 0.06)
        (True, True)
    """
    DENOISE.check(source.batch, strength=strength, method=method)
    check_count(num_landmarks, "num_landmarks")
    is_map = isinstance(noise_level, Tensor) and noise_level.ndim == 4
    if not isinstance(noise_level, Noise) and not is_map:  # commands pass the noise that they have estimated
        DENOISE.check(source.batch, noise_level=noise_level)
    noise: float | Tensor | Noise = noise_of(source) if noise_level is None else noise_level
    if method == "network":
        return _by_network(source, noise, strength)
    if is_map:
        raise ValueError(
            "noise_level must be a number or have shape (B,) for method rule, got a map; use method network"
        )
    level = noise.level if isinstance(noise, Noise) else torch.as_tensor(noise, dtype=source.dtype)
    level = level.reshape(-1) * torch.as_tensor(strength, dtype=source.dtype).reshape(-1)
    return _by_rule(
        source,
        level,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        num_landmarks=num_landmarks,
        **options,
    )


@cached_constants
def _network(device: torch.device, dtype: torch.dtype) -> NonlocalDenoiser:
    """Return the trained network with frozen weights."""
    return NonlocalDenoiser.trained(device=device, dtype=dtype).requires_grad_(False)


def _by_network(source: Source, noise: float | Tensor | Noise, strength: float | Tensor) -> Fitted:
    """Fit denoising by the network, with tiles at the same positions in memory and for a picture read by rows."""
    if isinstance(noise, Tensor) and noise.ndim == 4 and not source.whole:
        raise ValueError(
            "noise_level must be a number for a picture processed in tiles, got a map; denoise it in memory"
        )

    def finish(image: Tensor, _: Tensor, inner: Inner) -> Tensor:
        level = noise.at(image) if isinstance(noise, Noise) else noise_map(noise, image, "noise_level")
        level = level * per_image(strength, level, 4)
        level = torch.where(level < NEGLIGIBLE_NOISE, torch.zeros_like(level), level)
        return image - _network(image.device, image.dtype).estimate_in_tiles(image, level, turns=1, inner=inner)

    return Fitted(lambda pixels: pixels.image[:, :1], finish, margin=2 * STEP, step=STEP)


def _by_rule(source: Source, level: Tensor, *, photometric_bandwidth: float | Tensor | None, **options: Any) -> Fitted:
    assumed = level.clamp(min=NEGLIGIBLE_NOISE)
    options = {"guide_channels": "all"} | options
    options |= {
        "photometric_bandwidth": assumed if photometric_bandwidth is None else photometric_bandwidth,
        "spatial_bandwidth": DENOISE["spatial_bandwidth"].distance(options["spatial_bandwidth"], source.size),
        "num_landmarks": min(options["num_landmarks"], source.size[0] * source.size[1]),
    }
    operator = source.operator(Guide(options, blur=GUIDE_BLUR))
    layers = operator.layers(lambda pixels: pixels.image, ORDER)  # (B, ORDER+1, C, H, W)
    energy = operator.layers(lambda pixels: layers(pixels)[:, :-1].square().mean(2), 1)  # of planes (B, ORDER, H, W)
    noise = assumed.square().reshape(-1, 1) * _noise_in_layers(operator, source.size[0] * source.size[1])  # (B, ORDER)

    def cleaned(pixels: Pixels) -> Tensor:
        kept = (1 - noise[..., None, None].to(pixels.image) / energy(pixels)[:, -1].clamp(min=1e-12)).clamp(0.0, 1.0)
        weighed = weigh_layers(layers(pixels), torch.cat([kept, torch.ones_like(kept[:, :1])], dim=1))
        return torch.where((level < NEGLIGIBLE_NOISE).reshape(-1, 1, 1, 1), pixels.image, weighed)

    return Fitted(cleaned)


def _noise_in_layers(operator: Operator, pixels: int) -> Tensor:
    """Variance (B, ORDER) of unit white noise in each detail layer ``W^i (I - W)``, mean over pixels.

    Outside the span of the eigenvectors W is nearly its diagonal part r, which gives the rest of the trace.
    """

    def gain(eigenvalues: Tensor, order: int) -> Tensor:
        return (eigenvalues**order * (1 - eigenvalues)).square()

    ritz, support = operator.pairs.ritz, operator.pairs.support
    inside = [ritz.apply(lambda s, i=i: gain(s.clamp(0.0, 1.0), i), support) for i in range(ORDER)]  # type: ignore[misc]
    traces = torch.stack([matrix.diagonal(dim1=1, dim2=2).sum(1) for matrix in inside], dim=1) / pixels
    share = operator.each(lambda columns: columns.remainder.unsqueeze(1))
    outside = operator.mean(lambda some: torch.cat([gain(share(some), i) for i in range(ORDER)], dim=1))
    return traces.to(outside) + (1 - support.sum(1, keepdim=True) / pixels) * outside
