"""Functions shared by edits: change of luminance at constant chroma, chroma within gamut, spatial bandwidths."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_choice
from nlfilter_torch.operator.features import reduce_channels

HEADROOM_SHARE = 0.9  # share of its headroom towards white or black that a channel may use
LEVEL = 1 / 255  # distance kept from white and black, an 8-bit level, so that rounding does not clip
CHANNEL_WEIGHT = 0.25  # weight of the channel with the least headroom
MAX_SATURATION_GAIN = 2.0  # limit of the relative growth of saturation, as a multiple of that of luminance
MIN_LUMINANCE = 0.02  # lower limit of the luminance that the change of luminance is divided by
MAX_CURVE = 0.9  # limit of the parameter of the tone curve; 1 would make it flat at one end
EPSILON = 1e-9
LIGHTNESS = 0.3  # weight of lightness relative to hue and saturation: a fold in a red cloth is still red
CHUNK = 8192  # pixels converted at once by one thread
STRIP = 1 << 17  # pixels computed at a time
VECTOR_LENGTH = 64  # a multiple of the SIMD width in floats
Limits = Literal["soft", "none"]


@dataclass(frozen=True, eq=False)
class Balance:
    """Correction of a limited change of brightness, so that a picture keeps its mean brightness and chroma.

    Attributes:
        curve: k of the tone curve ``y - k y (1 - y)`` applied after the change, (B, 1 or C, 1, 1).
        colour: fraction in [0, 1] of the possible gain in saturation that is applied, (B, 1, 1, 1).
    """

    curve: float | Tensor = 0.0
    colour: float | Tensor = 0.0


def change_luminance(image: Tensor, change: Tensor, limits: Limits = "soft", balance: Balance | None = None) -> Tensor:
    """Brighten and darken an image without clipping, so that highlights and shadows keep their detail.

    A change d of luminance becomes ``h (1 - exp(-|d| / h))``, with h the headroom towards white (or black): small
    changes are added as they are, large ones end before white. The headroom is mostly that of luminance and to a
    quarter that of the channel with the least; with separate headroom for each channel, colours would lose 2 to 25 % of
    their chroma at a detail gain of 2. Chroma is kept as far as the headroom of the channels allows. No channel uses
    more than nine tenths of its headroom, or the last 8-bit level.

    The remaining shift of the picture's mean is corrected by ``balance``, see :func:`balance_of`.

    Args:
        image: (B, C, H, W) in [0, 1]; values outside only move inwards.
        change: change of luminance, (B, 1, H, W), or of each channel, (B, C, H, W).
        limits: ``"none"`` adds the change as it is.
        balance: corrections for the whole picture, if any.

    Returns:
        (B, C, H, W), bit-identical to the image where the change and the balance are 0. Differentiable in both.

    Example:
        >>> import torch
        >>> sky = torch.tensor([0.6, 0.8, 0.95]).view(1, 3, 1, 1)
        >>> change_luminance(sky, torch.full((1, 1, 1, 1), 0.1)).flatten()
        tensor([0.6951, 0.8665, 0.9950])
    """
    moved, saturation = (change, None) if limits == "none" else limited_change(image, change, balance)
    return move_luminance(image, moved, saturation, limits)


def limited_change(image: Tensor, change: Tensor, balance: Balance | None = None) -> tuple[Tensor, Tensor | None]:
    """Limit a change as in :func:`change_luminance`.

    Returns:
        The limited change, in the shape of the change; and the relative change of saturation, (B, 1, H, W), or None for
        a change of each channel.
    """
    balance = Balance() if balance is None else balance
    moved = _curved(image, change, balance.curve)
    if change.shape[1] == image.shape[1]:
        return moved, None
    less, more = _saturation(image, moved)
    return moved, less + balance.colour * more


def move_luminance(image: Tensor, moved: Tensor, saturation: Tensor | None, limits: Limits = "soft") -> Tensor:
    """Add the result of :func:`limited_change` to an image, clamped to the limits of :func:`change_luminance`."""
    if limits == "none":
        return image + moved
    before = image if saturation is None else reduce_channels(image, "luminance")
    low, high = _ends(before)
    moved = torch.minimum(torch.maximum(moved, low - before), high - before)
    if saturation is None:
        return image + moved
    chroma = image - before
    return image + moved + torch.minimum(saturation, _share(image, moved)) * chroma


def balance_of(mean: Callable[[Callable[[Tensor, Tensor], Tensor]], Tensor], brighter: float | Tensor = 0.0) -> Balance:
    """Compute the balance of a picture under a change of brightness.

    Args:
        mean: returns the means (B, S, 1, 1) over the picture of a function of the image and its change; the function
            returns (B, S, H, W).
        brighter: intended relative change of the mean brightness, (B, 1, 1, 1).
    """

    def shifts(image: Tensor, change: Tensor) -> Tensor:
        return _shifts(_before(image, change), _limited(image, change))

    curve = _curve(mean(shifts), brighter)

    def chromas(image: Tensor, change: Tensor) -> Tensor:
        if change.shape[1] == image.shape[1]:
            return image.new_zeros(len(image), 2, *image.shape[2:])
        return _chromas(image, *_saturation(image, _curved(image, change, curve)))

    return Balance(curve, _colour(mean(chromas)))


def balanced_change(
    image: Tensor, change: Tensor, brighter: float | Tensor | None = 0.0
) -> tuple[Tensor, Tensor | None]:
    """:func:`limited_change` of a whole image (B, C, H, W) under its balance, with nothing computed twice.

    Without a balance if ``brighter`` is None.
    """
    if brighter is None:
        return limited_change(image, change)
    before, (moved,) = _before(image, change), in_strips(lambda *some: (_limited(*some),), image, change)
    curve = _curve(_shifts(before, moved).mean((2, 3), keepdim=True), brighter)
    moved = _bent(before, moved, curve)
    if change.shape[1] == image.shape[1]:
        return moved, None
    less, more = in_strips(_saturation, image, moved)
    return moved, less + _colour(_chromas(image, less, more).mean((2, 3), keepdim=True)) * more


def in_strips(function: Callable[..., tuple[Tensor, ...]], *planes: Tensor) -> tuple[Tensor, ...]:
    """Apply a pointwise function to some rows of images (B, C, H, W) at a time, so that temporaries stay in the cache.

    Faster by several times for megapixels.
    """
    rows = max(1, STRIP // planes[0].shape[3])
    parts = [function(*some) for some in zip(*(plane.split(rows, dim=2) for plane in planes), strict=True)]
    return tuple(torch.cat(part, dim=2) for part in zip(*parts, strict=True))


def _shifts(before: Tensor, moved: Tensor) -> Tensor:
    """Planes (B, 3S, H, W) whose means :func:`_curve` needs."""
    after = before + moved
    return torch.cat([moved, before, after * (1 - after)], dim=1)


def _curve(means: Tensor, brighter: float | Tensor) -> Tensor:
    """Parameter of the tone curve that corrects the mean brightness."""
    moved, before, room = means.chunk(3, dim=1)
    return ((moved - brighter * before) / room.clamp(min=EPSILON)).clamp(-MAX_CURVE, MAX_CURVE)


def _chromas(image: Tensor, less: Tensor, more: Tensor) -> Tensor:
    """Lost and possible gained chroma, (B, 2, H, W), whose means :func:`_colour` needs."""
    chroma = split_luminance(image)[1].square().sum(1, keepdim=True).clamp(min=EPSILON).sqrt()
    return torch.cat([-less * chroma, more * chroma], dim=1)


def _colour(means: Tensor) -> Tensor:
    """Fraction of the possible gain in saturation that makes up for what is lost."""
    lost, gained = means.chunk(2, dim=1)
    return (lost / gained.clamp(min=EPSILON)).clamp(max=1.0)


def _before(image: Tensor, change: Tensor) -> Tensor:
    """Return the planes that the change applies to: luminance, or all channels."""
    return image if change.shape[1] == image.shape[1] else reduce_channels(image, "luminance")


def _ends(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest values that planes may take."""
    low = torch.minimum(((1 - HEADROOM_SHARE) * planes).clamp(min=LEVEL), planes)
    high = 1 - torch.minimum(((1 - HEADROOM_SHARE) * (1 - planes)).clamp(min=LEVEL), 1 - planes)
    return low, torch.maximum(high, planes)


def _limited(image: Tensor, change: Tensor) -> Tensor:
    """Limit the change to the headroom."""
    before = _before(image, change)
    up = change >= 0
    low, high = _ends(before)
    room = torch.where(up, high - before, before - low).clamp(min=EPSILON)
    if change.shape[1] != image.shape[1]:
        low, high = _ends(image)
        least = torch.where(up, (high - image).amin(1, keepdim=True), (image - low).amin(1, keepdim=True))
        # At least a level: the root is steep at 0, and a channel at 0 beside one at 2 would show as an edge.
        room = room.pow(1 - CHANNEL_WEIGHT) * least.clamp(min=LEVEL).minimum(room).pow(CHANNEL_WEIGHT)
    moved = -room * torch.expm1(-torch.where(up, change, -change) / room)
    return torch.where(up, moved, -moved)


def _curved(image: Tensor, change: Tensor, curve: float | Tensor) -> Tensor:
    """Limit the change, and apply the tone curve after it."""
    return _bent(_before(image, change), _limited(image, change), curve)


def _bent(before: Tensor, moved: Tensor, curve: float | Tensor) -> Tensor:
    """Apply the tone curve after a change."""
    after = before + moved
    return moved - curve * after * (1 - after)


def _saturation(image: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Required and possible relative changes of chroma for the channels to stay within their limits.

    Args:
        image: RGB (B, 3, H, W).
        moved: its change of luminance (B, 1, H, W).

    Returns:
        The required decrease, from -1 to 0, and the possible increase, from 0 to 1, both (B, 1, H, W).
    """
    share, luminance = _share(image, moved), reduce_channels(image, "luminance")
    relative = MAX_SATURATION_GAIN * (moved.abs() / luminance.clamp(min=MIN_LUMINANCE)).clamp(
        max=1 / MAX_SATURATION_GAIN
    )
    return share.clamp(max=0.0), torch.minimum(share.clamp(min=0.0), relative)


def _share(image: Tensor, moved: Tensor) -> Tensor:
    """Largest relative change of chroma, at least -1, at which all channels stay within their limits, (B, 1, H, W)."""
    luminance, chroma = split_luminance(image)
    after, (low, high) = luminance + moved, _ends(image)
    room = torch.where(chroma > 0, high - after, after - low).clamp(min=0.0)
    share = (room / chroma.abs().clamp(min=EPSILON)).amin(1, keepdim=True) - 1
    return torch.where(moved == 0, torch.zeros_like(share), share)


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


def split_luminance(image: Tensor) -> tuple[Tensor, Tensor]:
    """Split RGB into luminance (B, 1, H, W) and chroma ``image - luminance`` (B, 3, H, W), a multiple of YCbCr's."""
    luminance = reduce_channels(image, "luminance")
    return luminance, image - luminance


def with_green(chroma: Tensor) -> Tensor:
    """Complete chroma (B, 3, H, W) from its red and blue, (B, 2, H, W): its luminance is 0."""
    red, blue = chroma.split(1, dim=1)
    return torch.cat([red, (0.299 * red + 0.114 * blue) / -0.587, blue], dim=1)


def merge_luminance(luminance: Tensor, chroma: Tensor) -> Tensor:
    """Combine luminance and chroma to RGB (B, 3, H, W), with chroma scaled down where a channel would leave [0, 1].

    Clipping the channels would change luminance instead, which is more visible.
    """
    # Headroom towards white where chroma is positive, towards black where it is negative.
    room = torch.where(chroma > 0, 1 - luminance, luminance).clamp(min=0.0)
    scale = (room / chroma.abs().clamp(min=1e-6)).amin(1, keepdim=True).clamp(max=1.0)
    return luminance + scale * chroma


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
    weights = regions.flatten(2).double()
    return (weights @ image.flatten(2).double().mT / weights.sum(2, keepdim=True)).to(image)


def _label(chroma: Tensor, painted: Tensor) -> Tensor:
    """Colour index (N,) of each painted pixel of chroma (3, N), -1 for the others."""
    paint = chroma[:, painted]  # (3, n)
    numbers = torch.full_like(paint[0], -1, dtype=torch.long)
    leaders: list[Tensor] = []
    while len(leaders) < MAX_COLOURS and bool((numbers < 0).any()):
        leader = paint[:, (numbers < 0).nonzero()[0]]  # (3, 1)
        numbers[(numbers < 0) & ((paint - leader).norm(dim=0) < SAME_COLOUR)] = len(leaders)
        leaders.append(leader)
    left = numbers < 0
    if bool(left.any()):
        distance = (paint[:, left].unsqueeze(2) - torch.cat(leaders, 1).unsqueeze(1)).norm(dim=0)
        numbers[left] = distance.argmin(1)
    return torch.full_like(painted, -1, dtype=torch.long).masked_scatter(painted, numbers)


def nearby_or_far(given: float | Tensor | str | None, share: float, size: Sequence[int]) -> float | Tensor | None:
    """Return :func:`nearby`, or None, for no spatial bandwidth, if ``"none"`` is given.

    Raises:
        ValueError: if another word is given.
    """
    if isinstance(given, str):
        check_choice(given, "spatial_bandwidth", ("none",))
        return None
    return nearby(given, share, size)


def nearby(given: float | Tensor | None, share: float, size: Sequence[int]) -> float | Tensor:
    """Return a spatial bandwidth in pixels: the one given, or for None a share of the short side of a picture (H, W).

    It is relative so that a preview and the photograph agree.
    """
    return share * min(size) if given is None else given


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
    return lab / 100 * image.new_tensor([LIGHTNESS, 1.0, 1.0]).view(1, 3, 1, 1)


def hundredths_of_lab(image: Tensor) -> Tensor:
    """CIE Lab in hundredths, (B, 3, H, W), of a colour or grey image."""
    weighted = colour_guide(image.expand(-1, 3, -1, -1) if image.shape[1] == 1 else image)
    return torch.cat([weighted[:, :1] / LIGHTNESS, weighted[:, 1:]], dim=1)
