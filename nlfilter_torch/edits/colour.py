"""What edits share: luminance edited with the colours kept, chroma in gamut, the default of spatial bandwidths."""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_choice
from nlfilter_torch.operator.features import reduce_channels

ROOM = 0.9  # share of the room towards white or black that a channel may take, so that rounding does not clip it
LIGHTNESS = 0.3  # weight of lightness beside hue and saturation: a fold in a red cloth is still red
CONVERTED = 8192  # pixels that one thread converts at once
VECTOR = 64  # a multiple of the floats that a processor works on at once
Limits = Literal["soft", "none"]


def change_luminance(image: Tensor, change: Tensor, limits: Limits = "soft") -> Tensor:
    """Brighten and darken an image without clipping it: highlights and shadows keep what they show.

    A change d of brightness becomes ``h (1 - exp(-|d| / h))`` in every channel, with h nine tenths of its room towards
    white (or black): small changes are added as they are, which keeps the chroma channels of YCbCr, and large ones end
    before the channel does. A change in proportion, ``x y' / y``, would keep hues exactly, but lose chroma wherever a
    picture becomes darker and wherever it becomes brighter: 13 % where this loses 9 % (mean of four photographs at a
    detail gain of 2).

    Args:
        image: (B, C, H, W) in [0, 1]; what is outside moves inwards only.
        change: of luminance, (B, 1, H, W), or of every channel by itself, (B, C, H, W).
        limits: ``"none"`` adds the change.

    Returns:
        (B, C, H, W); the image to the last bit where the change is 0. Differentiable in both.

    Example:
        >>> import torch
        >>> sky = torch.tensor([0.6, 0.8, 0.95]).view(1, 3, 1, 1)
        >>> change_luminance(sky, torch.full((1, 1, 1, 1), 0.1)).flatten()
        tensor([0.6873, 0.8767, 0.9901])
    """
    if limits == "none":
        return image + change
    up = change >= 0
    room = (ROOM * torch.where(up, 1 - image, image)).clamp(min=1e-6)
    moved = -room * torch.expm1(-torch.where(up, change, -change) / room)
    return image + torch.where(up, moved, -moved)


def edit_luminance(image: Tensor, edit: Callable[[Tensor], Tensor]) -> Tensor:
    """Put ``image`` under another luminance, with the two chroma channels of YCbCr kept.

    Since Cb and Cr are multiples of B - Y and R - Y, adding the change of Y to R, G and B keeps them. Done so, an edit
    that changes nothing gives the image back to the last bit, whatever its depth and RGB profile. The alternatives: Lab
    shifts hues as little, but holds for sRGB only; a ratio of luminances moves the saturation two to three times as
    much (RMS change of chroma on four photographs).

    Args:
        image: (B, C, H, W); with C = 3 it is RGB, with any other C all channels go through ``edit``.
        edit: from luminance (B, 1, H, W) to luminance.

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
ALIKE = 0.05  # strokes whose chroma differs by less, in units of RGB, are one colour


def split_luminance(image: Tensor) -> tuple[Tensor, Tensor]:
    """Luminance (B, 1, H, W) and chroma ``image - luminance`` (B, 3, H, W), a multiple of YCbCr's, of an RGB image."""
    luminance = reduce_channels(image, "luminance")
    return luminance, image - luminance


def with_green(chroma: Tensor) -> Tensor:
    """Chroma (B, 3, H, W) from its red and blue, (B, 2, H, W): it has no luminance."""
    red, blue = chroma.split(1, dim=1)
    return torch.cat([red, (0.299 * red + 0.114 * blue) / -0.587, blue], dim=1)


def merge_luminance(luminance: Tensor, chroma: Tensor) -> Tensor:
    """RGB (B, 3, H, W) of that luminance, chroma scaled down where a channel would leave [0, 1].

    Clipping the channels would change luminance instead, which the eye sees first.
    """
    # Room towards white where a channel goes up, towards black where it goes down.
    room = torch.where(chroma > 0, 1 - luminance, luminance).clamp(min=0.0)
    scale = (room / chroma.abs().clamp(min=1e-6)).amin(1, keepdim=True).clamp(max=1.0)
    return luminance + scale * chroma


def group_colours(chroma: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tell the colours of strokes apart.

    Args:
        chroma: (B, 3, H, W), read where painted.
        weights: (B, 1, H, W), above 0 where painted.

    Returns:
        Regions (B, K, H, W), the weights divided among the K colours; their mean chroma (B, K, 3); and which of them
        count, (B, K) bool, since an image of fewer colours than others repeats its first one. At most 16 colours:
        further ones join the nearest. Differentiable in chroma and weights with the grouping held.
    """
    with torch.no_grad():
        labels = torch.stack([_label(c.flatten(1), w.flatten() > 0) for c, w in zip(chroma, weights, strict=True)])
        numbers = torch.arange(int(labels.max()) + 1, device=labels.device)
        counts = numbers <= labels.amax(1, keepdim=True)  # (B, K)
        members = labels.unsqueeze(1) == torch.where(counts, numbers, 0).unsqueeze(2)  # (B, K, N)
    regions = (members * weights.flatten(2)).unflatten(2, chroma.shape[-2:])
    return regions, region_means(chroma, regions), counts


def region_means(image: Tensor, regions: Tensor) -> Tensor:
    """Means (B, K, C) of an image (B, C, H, W) over regions (B, K, H, W) of weights; summed up in float64.

    In float32 the sums over megapixels would differ in the fifth digit from those over the painted pixels alone.
    """
    weights = regions.flatten(2).double()
    return (weights @ image.flatten(2).double().mT / weights.sum(2, keepdim=True)).to(image)


def _label(chroma: Tensor, painted: Tensor) -> Tensor:
    """Number (N,) of the colour of every painted pixel of chroma (3, N), -1 for the others."""
    paint = chroma[:, painted]  # (3, n)
    numbers = torch.full_like(paint[0], -1, dtype=torch.long)
    leaders: list[Tensor] = []
    while len(leaders) < MAX_COLOURS and bool((numbers < 0).any()):
        leader = paint[:, (numbers < 0).nonzero()[0]]  # (3, 1)
        numbers[(numbers < 0) & ((paint - leader).norm(dim=0) < ALIKE)] = len(leaders)
        leaders.append(leader)
    left = numbers < 0
    if bool(left.any()):
        distance = (paint[:, left].unsqueeze(2) - torch.cat(leaders, 1).unsqueeze(1)).norm(dim=0)
        numbers[left] = distance.argmin(1)
    return torch.full_like(painted, -1, dtype=torch.long).masked_scatter(painted, numbers)


def nearby_or_far(given: float | Tensor | str | None, share: float, size: Sequence[int]) -> float | Tensor | None:
    """The same, and None, for no spatial bandwidth, where ``"none"`` is given.

    Raises:
        ValueError: if another word is given.
    """
    if isinstance(given, str):
        check_choice(given, "spatial_bandwidth", ("none",))
        return None
    return nearby(given, share, size)


def nearby(given: float | Tensor | None, share: float, size: Sequence[int]) -> float | Tensor:
    """A spatial bandwidth in pixels: the one given, or for None a share of the short side of a picture (H, W).

    A share, so that a preview and the photograph agree.
    """
    return share * min(size) if given is None else given


def colour_guide(image: Tensor) -> Tensor:
    """CIE Lab of an RGB image in hundredths, (B, 3, H, W), lightness first and with less weight than colour.

    To the last bit the same for a pixel wherever it stands, so that landmarks are the same for a picture read by rows.
    """
    from kornia.color import rgb_to_lab  # kornia takes half a second to import

    # Powers round differently in the odd pixels that are left over at the end of a tensor, or of a thread's part of it.
    parts = []
    for part in image.clamp(0.0, 1.0).flatten(2).split(CONVERTED, dim=2):
        full = F.pad(part, (0, -part.shape[2] % VECTOR)).unsqueeze(2).contiguous()
        parts.append(rgb_to_lab(full)[..., 0, : part.shape[2]])
    lab = torch.cat(parts, dim=2).unflatten(2, image.shape[-2:])
    return lab / 100 * image.new_tensor([LIGHTNESS, 1.0, 1.0]).view(1, 3, 1, 1)
