"""Functions shared by edits: change of luminance at constant chroma, chroma within gamut."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.operator.features import LUMINANCE, reduce_channels

LIGHTNESS = 0.3  # weight of lightness relative to hue and saturation: a fold in a red cloth is still red
CHUNK = 8192  # pixels converted at once by one thread
VECTOR_LENGTH = 64  # a multiple of the SIMD width in floats


def edit_luminance(image: Tensor, edit: Callable[[Tensor], Tensor]) -> Tensor:
    """Edit the luminance of an image and keep the two chroma channels of YCbCr.

    Since Cb and Cr are multiples of B - Y and R - Y, adding the change of Y to R, G and B keeps them. An edit that
    changes nothing then returns the image bit for bit, whatever its depth and RGB profile. The alternatives: Lab shifts
    hues as little, but is valid for sRGB only; a ratio of luminances changes the saturation two to three times as much
    (RMS change of chroma on four photographs).

    Args:
        image: (B, C, H, W); with C = 3 it is RGB, with any other C ``edit`` is applied to all channels.
        edit: function from luminance (B, 1, H, W) to luminance.

    Returns:
        (B, C, H, W); values may leave [0, 1], as those of ``edit`` do. Differentiable.

    Example:
        >>> import torch
        >>> red = torch.tensor([0.5, 0.1, 0.1]).view(1, 3, 1, 1)
        >>> edit_luminance(red, lambda y: y + 0.2).flatten()
        tensor([0.7000, 0.3000, 0.3000])
    """
    if image.shape[1] != 3:
        return edit(image)
    luminance = reduce_channels(image, "luminance")
    return image + (edit(luminance) - luminance)


MAX_COLOURS = 16
SAME_COLOUR = 0.05  # chroma difference in units of RGB below which strokes have the same colour
PIECE = 1 << 20  # pixels that are summed in float64 at once
MOST_COMPARED = 2048  # colours of strokes that are compared with each other; more are painted in photographs only


def split_luminance(image: Tensor) -> tuple[Tensor, Tensor]:
    """Split RGB into luminance (B, 1, H, W) and chroma ``image - luminance`` (B, 3, H, W), a multiple of YCbCr's."""
    luminance = reduce_channels(image, "luminance")
    return luminance, image - luminance


def with_green(chroma: Tensor) -> Tensor:
    """Complete chroma (B, 3, H, W) from its red and blue, (B, 2, H, W): its luminance is 0."""
    red, blue = chroma.split(1, dim=1)
    of_red, of_green, of_blue = LUMINANCE
    return torch.cat([red, (of_red * red + of_blue * blue) / -of_green, blue], dim=1)


def merge_luminance(luminance: Tensor, chroma: Tensor) -> Tensor:
    """Combine luminance and chroma to RGB (B, 3, H, W), with chroma scaled down where a channel would leave [0, 1].

    Clipping the channels would change luminance instead, which is more visible.
    """
    # Headroom towards white for the largest chroma, towards black for the smallest.
    up, down = chroma.amax(1, keepdim=True).clamp(min=1e-6), -chroma.amin(1, keepdim=True).clamp(max=-1e-6)
    scale = torch.minimum((1 - luminance).clamp(min=0.0) / up, luminance.clamp(min=0.0) / down).clamp(max=1.0)
    return torch.addcmul(luminance, scale, chroma)


def dot(a: Tensor, b: Tensor, dim: int = 1) -> Tensor:
    """Sum of products along a short dimension, kept with length 1, in half the time of ``mul`` and ``sum``."""
    (first_a, first_b), *rest = zip(a.split(1, dim), b.split(1, dim), strict=True)
    total = first_a * first_b
    for part_a, part_b in rest:
        total = torch.addcmul(total, part_a, part_b)
    return total


def group_colours(chroma: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Group the pixels of strokes by colour.

    Args:
        chroma: (B, 3, H, W), read where painted.
        weights: (B, 1, H, W), above 0 where painted.

    Returns:
        Regions (B, K, H, W), the weights of the pixels of each of K colours; the mean chroma (B, K, 3) of the regions;
        and which of them are valid, (B, K) bool, since an image with fewer colours than others repeats its first one.
        At most 16 colours; further ones join the nearest. Differentiable in chroma and weights at a fixed grouping.
    """
    with torch.no_grad():
        labels = torch.stack([_label(c.flatten(1), w.flatten() > 0) for c, w in zip(chroma, weights, strict=True)])
        numbers = torch.arange(int(labels.max()) + 1, device=labels.device)
        counts = numbers <= labels.amax(1, keepdim=True)  # (B, K)
        members = labels.unsqueeze(1) == torch.where(counts, numbers, 0).unsqueeze(2)  # (B, K, N)
    regions = (members * weights.flatten(2)).unflatten(2, chroma.shape[-2:])
    return regions, region_means(chroma, regions), counts


def region_means(image: Tensor, regions: Tensor) -> Tensor:
    """Weighted means (B, K, C) of an image (B, C, H, W) over regions (B, K, H, W), summed in float64.

    In float32, sums over megapixels would differ in the fifth digit from those over the painted pixels alone.
    """
    pieces = zip(regions.flatten(2).split(PIECE, 2), image.flatten(2).split(PIECE, 2), strict=True)
    sums = [(w.double() @ part.double().mT, w.sum(2, keepdim=True, dtype=torch.float64)) for w, part in pieces]
    products, weights = (torch.stack(parts).sum(0) for parts in zip(*sums, strict=True))
    return (products / weights).to(image)


def _label(chroma: Tensor, painted: Tensor) -> Tensor:
    """Colour index (N,) of each painted pixel of chroma (3, N), -1 for the others.

    The groups depend on the painted colours alone, not on their places, so that they turn with the picture: each
    leader is the colour around which most pixels are left, and every pixel belongs to the nearest leader.
    """
    paint = chroma[:, painted]  # (3, n)
    cell = torch.zeros_like(paint[0], dtype=torch.long)
    for channel in paint:  # one after the other takes a fraction of the memory
        values, number = (channel.double() / (SAME_COLOUR / 2)).round_().unique(return_inverse=True)
        cell = (cell * len(values) + number).unique(return_inverse=True)[1]
    counts = cell.bincount()
    sums = counts.new_zeros(3, len(counts), dtype=torch.float64)
    for numbers, part in zip(cell.split(PIECE), paint.split(PIECE, dim=1), strict=True):
        sums.index_add_(1, numbers, part.double())
    means = sums / counts
    common = counts.argsort(descending=True, stable=True)[:MOST_COMPARED]
    leaders = means[:, common[_densest(means[:, common], counts[common])]]
    nearest = (means.unsqueeze(2) - leaders.unsqueeze(1)).norm(dim=0).argmin(1)
    return torch.full_like(painted, -1, dtype=torch.long).masked_scatter(painted, nearest[cell])


def _densest(colours: Tensor, counts: Tensor) -> list[int]:
    """Indices of up to 16 colours (3, c) with the most pixels, by counts (c,), of about the same colour.

    Pixels of about the same colour as an earlier one count no more.
    """
    colour, similar = ((colours.unsqueeze(2) - colours.unsqueeze(1)).norm(dim=0) < SAME_COLOUR).nonzero(as_tuple=True)
    left, leaders = counts, list[int]()
    while len(leaders) < MAX_COLOURS and bool((left > 0).any()):
        sums = torch.zeros_like(left).index_add(0, colour, left[similar])
        leaders.append(int(torch.where(left > 0, sums, -1).argmax()))
        left = left.index_fill(0, similar[colour == leaders[-1]], 0)
    return leaders


def colour_guide(image: Tensor) -> Tensor:
    """CIE Lab of an RGB image in hundredths, (B, 3, H, W), with less weight for lightness than for colour.

    The result of a pixel is bit-identical wherever it is in the tensor, so that a picture read by rows has the same
    landmarks.
    """
    from kornia.color import rgb_to_lab  # kornia takes half a second to import

    # Powers round differently in the scalar remainder at the end of a tensor, or of a thread's part of it.
    parts = []
    for part in image.clamp(0.0, 1.0).flatten(2).split(CHUNK, dim=2):
        full = F.pad(part, (0, -part.shape[2] % VECTOR_LENGTH)).unsqueeze(2).contiguous()
        parts.append(rgb_to_lab(full)[..., 0, : part.shape[2]])
    lab = torch.cat(parts, dim=2).unflatten(2, image.shape[-2:])
    return lab / 100 * lab.new_tensor([LIGHTNESS, 1.0, 1.0]).view(1, 3, 1, 1)


def hundredths_of_lab(image: Tensor) -> Tensor:
    """CIE Lab in hundredths, (B, 3, H, W), of a colour or grey image."""
    weighted = colour_guide(image.expand(-1, 3, -1, -1) if image.shape[1] == 1 else image)
    return torch.cat([weighted[:, :1] / LIGHTNESS, weighted[:, 1:]], dim=1)
