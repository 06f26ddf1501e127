"""Estimation of noise by scale, plane and brightness, from a photograph alone."""

import math
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_image
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.torch_internals import cached_constants
from nlfilter_torch.nn.denoiser.noise import Noise, measured_noise, window_places
from nlfilter_torch.nn.denoiser.profile import KNOTS, NoiseProfile
from nlfilter_torch.nn.denoiser.statistics import (
    KINDS,
    QUANTILES,
    SIDE,
    has_few_colours,
    statistics_of,
    window_pixels,
)
from nlfilter_torch.nn.denoiser.weights import read_weights

TRAINED = Path(__file__).with_name("profile.safetensors")

SCALES, PLANES = len(NoiseProfile.SCALES), 2
INPUTS = SCALES * KINDS * 2 * len(QUANTILES) + SCALES + KNOTS
HIDDEN = 96
OUTPUTS = SCALES * PLANES + 1  # logarithms of levels, and one number that tells noise from texture
FAINTEST = 0.2  # grey levels that are added to levels before the logarithm
CERTAIN = -0.5, 0.5  # of the number: up to the first it is texture, from the second on it is noise
HIDING = 1.1, 1.4  # coarseness of noise from which the mask for white noise does not see it
AGREEING, DIFFERENT = 0.8, 0.65  # ratios to the level of white noise: it is white above the first, not below the second
SPREAD = 0.02  # weight of levels at the next brightness, where a picture has few pixels of its own
SHAPES = {
    "mean": (INPUTS,),
    "scale": (INPUTS,),
    "first.weight": (HIDDEN, INPUTS),
    "first.bias": (HIDDEN,),
    "second.weight": (HIDDEN, HIDDEN),
    "second.bias": (HIDDEN,),
    "last.weight": (OUTPUTS, HIDDEN),
    "last.bias": (OUTPUTS,),
}


@full_precision
def noise_profile(image: Tensor) -> NoiseProfile:
    """Estimate noise by scale, plane and brightness, as cameras make it; :func:`estimate_noise` is for white noise.

    A small network, trained on pairs of simulated cameras, is told quantiles over parts of the photograph of the
    contrast between neighbouring blocks of 1, 2, 4, 8 and 16 pixels. It tells levels, and whether the contrast is noise
    at all. If not, or if white noise explains it, the levels are those of white noise whose variance depends linearly
    on brightness, as :func:`estimate_noise` measures it. At most 64 windows of 128 x 128 pixels are looked at.

    Args:
        image: (B, C, H, W), in [0, 1] apart from the noise; with C = 3 it is RGB, otherwise channels are grey images.

    Returns:
        A :class:`NoiseProfile`: 0 where none can be told, which is in pictures smaller than 3x3, almost all black or
        white, or with few colours (drawings, dithered pictures). No gradient is propagated.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point (B, C, H, W) tensor.

    Example:
        >>> noise = torch.randn(1, 3, 128, 128, generator=torch.Generator().manual_seed(0))
        >>> profile = noise_profile(0.5 + 0.1 * noise)
        >>> profile.level.round(decimals=2), profile.coarseness.round(decimals=1)
        (tensor([0.1000]), tensor([1.]))
    """
    check_image(image, "image")
    size = image.shape[-2], image.shape[-1]
    pixels = image.detach().to(working_dtype(image)).flatten(2)
    return profile_of_measured(measured_profile(size, pixels[:, :, profile_places(size).to(image.device)]))


def profile_places(size: tuple[int, int]) -> Tensor:
    """Ascending row-major indices (n,) of the pixels from which the noise of a picture (H, W) is estimated.

    Pixels that are looked at several times occur as often.
    """
    return torch.cat([window_pixels(size).flatten(), window_places(size)]).sort().values


def profile_of_measured(measured: Tensor) -> NoiseProfile:
    """The noise, from :func:`measured_profile`."""
    return NoiseProfile(measured[:, 1:].unflatten(1, (SCALES, PLANES, KNOTS)), measured[:, 0])


def white_profile(noise: Noise, *, channels: int = 3) -> NoiseProfile:
    """White noise of a variance that is linear in brightness, as a profile."""
    light = torch.linspace(0, 1, KNOTS).to(noise.floor)
    levels = (noise.floor[:, None] + noise.gain[:, None] * light).sqrt()
    return replace(NoiseProfile.white(levels, channels=channels), light=noise.light)


@torch.no_grad()
def measured_profile(size: tuple[int, int], colours: Tensor) -> Tensor:
    """Estimate brightness and levels (B, 1 + S * 2 * K) of a picture of size (H, W) as one tensor.

    ``colours`` (B, C, n) are those of its pixels at :func:`profile_places`.
    """
    places = profile_places(size).to(colours.device)
    windows = colours[:, :, torch.searchsorted(places, window_pixels(size).to(colours.device))]
    light = windows.mean((1, 2, 3, 4))
    if min(size) < 3:
        return F.pad(light[:, None], (0, SCALES * PLANES * KNOTS))
    white_places = torch.searchsorted(places, window_places(size).to(colours.device))
    noise = Noise(*measured_noise(size, colours[:, :, white_places], "all"))
    white = white_profile(noise, channels=colours.shape[1])
    rows = []
    for picture, levels in zip(windows, white.levels[:, 0], strict=True):
        # Channels other than red, green and blue count as grey pictures: their windows are those of one picture.
        channels = picture.transpose(0, 1) if len(picture) == 3 else picture.flatten(0, 1).unsqueeze(1)
        rows.append(_levels(channels.reshape(-1, channels.shape[1], SIDE, SIDE), levels))
    return torch.cat([light[:, None], torch.stack(rows).flatten(1)], dim=1)


def network(weights: dict[str, Tensor], inputs: Tensor) -> tuple[Tensor, Tensor]:
    """The network: logarithms of levels in grey levels (..., S, 2), and the number that tells noise from texture.

    Args:
        weights: of :data:`SHAPES`.
        inputs: (..., INPUTS), of :func:`inputs_of`.
    """
    features = (inputs - weights["mean"]) / weights["scale"]
    for name in ("first", "second"):
        features = F.silu(F.linear(features, weights[f"{name}.weight"], weights[f"{name}.bias"]))
    levels, number = F.linear(features, weights["last.weight"], weights["last.bias"]).split(
        [SCALES * PLANES, 1], dim=-1
    )
    return levels.unflatten(-1, (SCALES, PLANES)), number.squeeze(-1)


def inputs_of(statistics: Tensor, shares: Tensor) -> Tensor:
    """Inputs (..., K, INPUTS) of the network, from statistics (..., K, S, KINDS, 2, Q) and shares (..., K, S)."""
    knots = torch.eye(KNOTS).to(statistics).expand(*statistics.shape[:-5], -1, -1)
    logarithms = (statistics.flatten(-4) + math.log(255)) / 2
    return torch.cat([logarithms, shares.sqrt(), knots], dim=-1)


def _levels(windows: Tensor, white: Tensor) -> Tensor:
    """Levels (S, 2, K) of one picture from its windows (n, 1 or 3, SIDE, SIDE), and those of white noise (2, K)."""
    statistics, shares = statistics_of(windows)
    logarithms, numbers = network(_trained(windows.device, windows.dtype), inputs_of(statistics, shares))
    share = shares.mean(1)
    levels = (logarithms.exp() - FAINTEST).clamp(min=0).permute(1, 2, 0) / 255
    if windows.shape[1] == 1:
        levels = levels * levels.new_tensor([1, 0])[:, None]
    levels = _spread(levels, share)
    # White noise is measured more exactly by its own rule, whose mask hardly responds to coarser noise.
    fine, coarse = (_deviation(values, share).clamp(min=1e-12) for values in (levels[0], levels[2]))
    different = _rising(-_deviation(white, share) / fine, (-AGREEING, -DIFFERENT))
    # Noise that is hardly coarser than white noise would show in that rule: what does not show is texture.
    hidden = _rising(coarse / fine, HIDING)
    certain = _rising((numbers * share).sum(), CERTAIN)
    levels = torch.lerp(white.expand_as(levels), levels, different * hidden * certain)
    return torch.where((share.sum() > 0) & ~has_few_colours(windows), levels, 0.0)


def _rising(value: Tensor, limits: tuple[float, float]) -> Tensor:
    """0 up to the first limit, 1 from the second on."""
    return ((value - limits[0]) / (limits[1] - limits[0])).clamp(0, 1)


def _deviation(levels: Tensor, share: Tensor) -> Tensor:
    """Root mean square of a pixel's channels, from levels (2, K) and the share (K,) of the picture at each knot."""
    return (levels.square() @ share * levels.new_tensor([1, 2 / 3])).sum().sqrt()


def _spread(levels: Tensor, share: Tensor) -> Tensor:
    """Levels (S, 2, K), at brightnesses of which the picture has few pixels those of the nearest others."""
    weights = share * SPREAD ** (torch.arange(KNOTS)[:, None] - torch.arange(KNOTS)).abs().to(share)
    return (levels.square() @ (weights / weights.sum(1, keepdim=True).clamp(min=1e-12)).mT).sqrt()


@cached_constants
def _trained(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """The weights of the package."""
    return {name: value.to(device, dtype) for name, value in read_weights(TRAINED, SHAPES).items()}
