"""Statistics of windows of a photograph by scale, plane and brightness, from which its noise is estimated."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import reflected
from nlfilter_torch.nn.denoiser.colours import split_colours
from nlfilter_torch.nn.denoiser.profile import KNOTS, NoiseProfile

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
        levels = _levels(planes, scale).transpose(0, 1).flatten(1)
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


def _levels(planes: Tensor, scale: int) -> Tensor:
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
