"""Estimation of noise by scale, plane and brightness, from a photograph alone."""

import math
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import reflected
from nlfilter_torch.core.checks import check_image
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.torch_internals import cached_constants
from nlfilter_torch.nn.denoiser.noise import Noise, measured_noise, window_places
from nlfilter_torch.nn.denoiser.profile import KNOTS, NoiseProfile, split_colours
from nlfilter_torch.nn.denoiser.weights import read_weights

SIDE = 128  # of windows, in pixels; a multiple of the largest scale
MOST = 64  # windows; a larger picture is sampled
CELLS = {1: (16, 16), 2: (8, 8), 4: (8, 8), 8: (4, 2), 16: (4, 2)}  # size and spacing of cells by scale, in blocks
QUANTILES = (0.03, 0.1, 0.25, 0.5, 0.8)
KINDS = 4  # of differences of block means: of luminance, diagonal and straight, and of colour
LEAST = 0.05 / 255  # levels below this are the same
CLIPPED_SHARE = 0.1  # share of clipped pixels above which a cell does not count
NEARBY = 0.01  # weight of cells of other brightness, where those of the knot's own are lacking
FALL = 0.2  # by which it falls from one knot to the next
HARDLY = 1e-6  # weight of cells that do not count
SAMPLED_COLOURS = 4096
MIXTURE = 3.14159  # factor from channel to channel of a sum of them that tells colours apart
FEW_GREYS, FEW_COLOURS = 16, 256  # of the sampled pixels: those of a drawing, a scan or a dithered picture

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


def window_pixels(size: tuple[int, int]) -> Tensor:
    """Row-major indices (n, SIDE, SIDE) of the pixels of windows spread evenly over a picture (H, W).

    The set is the same for the picture flipped or rotated. Pictures smaller than a window are continued by reflection.
    """
    # Even numbers of windows: a middle one might lie half a pixel off the middle.
    counts = [2 * math.ceil(length / SIDE / 2) if length > SIDE else 1 for length in size]
    if counts[0] * counts[1] > MOST:
        ratio = math.sqrt(MOST / (counts[0] * counts[1]))
        counts = [min(MOST, max(1, 2 * int(count * ratio / 2))) for count in counts]
    down, across = (_axis(length, count) for length, count in zip(size, counts, strict=True))
    return (down[:, None, :, None] * size[1] + across[None, :, None, :]).flatten(0, 1)


def statistics_of(windows: Tensor) -> tuple[Tensor, Tensor]:
    """Statistics of the windows (n, 1 or 3, SIDE, SIDE) of one picture.

    Differences of neighbouring block means, times the block size, are averaged over cells of some blocks. They are
    straight or diagonal, of luminance or colour: for white noise, all have its level. Quantiles over cells that are
    hardly clipped tell the level in the flattest ones, and how much texture there is beside them.

    Returns:
        Logarithms of levels (K, S, KINDS, 2, Q): quantiles over cells near a brightness, and over all cells; and the
        share of cells (K, S) near each brightness, of those that count. It is 0 where none does.
    """
    planes = split_colours(windows)
    clipped = torch.logical_or(windows <= 0, windows >= 1).to(windows).mean(1, keepdim=True)
    table, shares = [], []
    for scale in NoiseProfile.SCALES:
        side, step = (scale * length for length in CELLS[scale])
        light = F.avg_pool2d(planes[:, :1], side, step).flatten().clamp(0, 1)
        counted = (F.avg_pool2d(clipped, side, step) <= CLIPPED_SHARE).to(light).flatten()
        levels = _cell_levels(planes, scale).transpose(0, 1).flatten(1)
        near = _nearness(light) * (counted[:, None] + HARDLY)
        reach = FALL ** (torch.arange(KNOTS)[:, None] - torch.arange(KNOTS)).abs()
        overall = (counted + HARDLY)[:, None]
        weights = near + NEARBY * near @ reach.to(near) + 1e-8 * overall
        whole = _quantiles(levels, overall).expand(-1, -1, KNOTS)
        table.append(torch.stack([_quantiles(levels, weights), whole], dim=1))
        total = counted.mean()
        shares.append(torch.where(total > 0, near.mean(0) / total.clamp(min=HARDLY), 0.0))
    return torch.stack(table).permute(4, 0, 1, 2, 3), torch.stack(shares, dim=1)


def has_few_colours(windows: Tensor) -> Tensor:
    """Whether pixels of windows (n, C, SIDE, SIDE) have so few colours that they were chosen from a palette."""
    pixels = windows.transpose(0, 1).flatten(1)
    pixels = pixels[:, :: max(1, pixels.shape[1] // SAMPLED_COLOURS)]
    factors = MIXTURE ** torch.arange(len(pixels), dtype=torch.float64, device=pixels.device)
    mixed = (pixels.double() * factors[:, None]).sum(0).sort().values
    return 1 + (mixed.diff() != 0).sum() <= (FEW_GREYS if len(pixels) == 1 else FEW_COLOURS)


def _axis(length: int, count: int) -> Tensor:
    """Indices (count, SIDE) of the pixels of windows along one axis, at distances that are the same from either end."""
    last = max(0, length - SIDE)
    order = torch.arange(count)
    first = order * last // max(1, count - 1)
    starts = torch.where(2 * order < count, first, last - first.flip(0))
    return reflected(starts[:, None] + torch.arange(SIDE), length)


def _cell_levels(planes: Tensor, scale: int) -> Tensor:
    """Logarithms of the levels (n, KINDS, h, w) of cells of planes (n, 3, SIDE, SIDE)."""
    size, spacing = CELLS[scale]
    means = F.avg_pool2d(planes, scale) * scale
    right, down = means[..., :, 1:] - means[..., :, :-1], means[..., 1:, :] - means[..., :-1, :]
    diagonal = F.avg_pool2d((right[..., 1:, :] - right[..., :-1, :]).square(), size - 1, spacing) / 4
    across = F.avg_pool2d(right.square(), (size, size - 1), spacing)
    straight = (across + F.avg_pool2d(down.square(), (size - 1, size), spacing)) / 4
    luminance, colour = ([energy[:, plane].mean(1) for energy in (diagonal, straight)] for plane in ([0], [1, 2]))
    return torch.stack([*luminance, *colour], dim=1).clamp(min=LEAST**2).log() / 2


def _nearness(light: Tensor) -> Tensor:
    """Weights (n, K) of brightnesses (n,) for the knots, as in linear interpolation."""
    return (1 - (light[:, None] * (KNOTS - 1) - torch.arange(KNOTS).to(light)).abs()).clamp(min=0)


def _quantiles(values: Tensor, weights: Tensor) -> Tensor:
    """Weighted quantiles (R, Q, K) of values (R, n), for several weights (n, K)."""
    ordered, order = values.sort(dim=1)
    sums = weights[order].cumsum(1).transpose(1, 2).contiguous()  # (R, K, n)
    wanted = sums[..., -1:] * torch.tensor(QUANTILES).to(sums)
    places = torch.searchsorted(sums, wanted).clamp(max=values.shape[1] - 1)
    return ordered[:, None].expand(-1, places.shape[1], -1).gather(2, places).transpose(1, 2)


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
