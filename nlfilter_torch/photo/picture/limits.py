"""Changes of luminance that clip nothing and keep the mean brightness and chroma of a picture.

A change is limited in each pixel by :func:`limit`. The limits shift the mean brightness and chroma of the picture,
which :func:`balance_of` measures and :func:`balanced` corrects.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from nlfilter_torch.core.precision import squarable
from nlfilter_torch.core.torch_internals import is_hidden
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.picture.colour import split_luminance
from nlfilter_torch.photo.picture.measuring import mean_of
from nlfilter_torch.photo.picture.pixels import Fitted, M
from nlfilter_torch.photo.picture.source import Source

HEADROOM_SHARE = 0.9  # share of its headroom towards white or black that a channel may use
LEVEL = 1 / 255  # distance kept from white and black, an 8-bit level, so that rounding does not clip
CHANNEL_WEIGHT = 0.25  # weight of the channel with the least headroom
MAX_SATURATION_GAIN = 2.0  # limit of the relative growth of saturation, as a multiple of that of luminance
MIN_LUMINANCE = 0.02  # lower limit of the luminance that the change of luminance is divided by
MAX_CHROMA_LOSS = 0.01  # share of the mean chroma that may be lost in some pixels and made up for in others
MAX_CURVE = 0.9  # limit of the parameter of the tone curve; 1 would make it flat at one end
EPSILON = 1e-9  # keeps quotients finite where a pixel has no headroom or chroma
Limits = Literal["soft", "none"]


@dataclass(frozen=True, eq=False)
class Balance:
    """Correction of a limited change of brightness, so that a picture keeps its mean brightness and chroma.

    Attributes:
        restraint: fraction in [0, 1] that is removed from the part of the change that costs chroma, (B, 1, 1, 1); the
            number 0 if the loss of chroma is small.
        curve: k of the tone curve ``y - k y (1 - y)`` applied after the change, in [0, 1], (B, 1 or C, 1, 1).
        colour: fraction in [0, 1] of the possible gain in saturation that is applied, (B, 1, 1, 1).
    """

    restraint: float | Tensor = 0.0
    curve: float | Tensor = 0.0
    colour: float | Tensor = 0.0


def limit(image: Tensor, change: Tensor) -> Tensor:
    """Limit a change of brightness so that nothing is clipped, and highlights and shadows keep their detail.

    A change d of luminance becomes ``h (1 - exp(-|d| / h))``, with h the headroom towards white (or black): small
    changes are added as they are, large ones end before white. The headroom is mostly that of luminance and to a
    quarter that of the channel with the least; with separate headroom for each channel, colours would lose 2 to 25 % of
    their chroma at a detail gain of 2. No channel uses more than nine tenths of its headroom, or the last 8-bit level.

    Args:
        image: (B, C, H, W) in [0, 1]; values outside only move inwards.
        change: change of luminance, (B, 1, H, W), or of each channel, (B, C, H, W).

    Returns:
        The limited change, in the shape of the change; 0 where that is 0. Differentiable in both.
    """
    before, up = _before(image, change), change >= 0
    room = _room(torch.where(up, 1 - before, before)).clamp(min=EPSILON)
    if change.shape[1] != image.shape[1]:
        nearest = torch.where(up, 1 - image.amax(1, keepdim=True), image.amin(1, keepdim=True))
        # At least a level: the root is steep at 0, and a channel at 0 beside one at 2 would show as an edge.
        least = _room(nearest).clamp(min=LEVEL).minimum(room)
        room = room.pow(1 - CHANNEL_WEIGHT) * least.pow(CHANNEL_WEIGHT)
    moved = -room * torch.expm1(-torch.where(up, change, -change) / room)
    return torch.where(up, moved, -moved)


def balanced(
    image: Tensor, moved: Tensor, balance: Balance | None = None, limits: Limits = "soft"
) -> tuple[Tensor, Tensor | None]:
    """Apply the balance of the picture, if any, to the result of :func:`limit`, and find the change of saturation.

    Chroma is kept as far as the headroom of the channels allows. If saturated colours would lose so much of it that the
    others cannot make up for that, :attr:`Balance.restraint` makes the change of these colours smaller.

    Returns:
        The change, in the same shape; and the relative change of saturation, (B, 1, H, W), or None for a change of each
        channel and without limits.
    """
    if limits == "none":
        return moved, None
    balance = Balance() if balance is None else balance
    moved = _bent(_before(image, moved), _restrained(image, moved, balance.restraint), balance.curve)
    if moved.shape[1] == image.shape[1]:
        return moved, None
    less, more = _saturation(image, moved)
    return moved, less + balance.colour * more


def move_luminance(image: Tensor, moved: Tensor, saturation: Tensor | None) -> Tensor:
    """Add the result of :func:`balanced` to an image (B, C, H, W).

    The result is bit-identical to the image where the change and the balance are 0. Differentiable.

    Example:
        >>> import torch
        >>> sky = torch.tensor([0.6, 0.8, 0.95]).view(1, 3, 1, 1)
        >>> move_luminance(sky, *balanced(sky, limit(sky, torch.full((1, 1, 1, 1), 0.1)))).flatten()
        tensor([0.6951, 0.8665, 0.9950])
    """
    return image + moved if saturation is None else image + moved + saturation * split_luminance(image)[1]


def clamped(image: Tensor, moved: Tensor, saturation: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Clamp the result of :func:`balanced` for another size of the picture to the limits of this one."""
    if saturation is None:
        return _inside(image, moved), None
    luminance, chroma = split_luminance(image)
    moved = _inside(luminance, moved)
    return moved, torch.minimum(saturation, _share(image, luminance, chroma, moved))


def balance_of(source: Source[M], change: Fitted, brighter: float | Tensor = 0.0) -> Balance:
    """Compute the balance of a picture under a change of brightness.

    Args:
        source: the picture.
        change: of its brightness, limited by :func:`limit`.
        brighter: intended relative change of the mean brightness, (B, 1, 1, 1).
    """
    restraint: float | Tensor = 0.0
    curve = _curve(source, change, restraint, brighter)
    lost, gained, chroma = mean_of(source, change, _chroma, restraint, curve).chunk(3, dim=1)
    allowed = MAX_CHROMA_LOSS * chroma
    if is_hidden(lost) or bool((lost > allowed).any()):
        # With a constant curve, the loss is proportional to 1 - restraint.
        restraint = (1 - allowed / lost.clamp(min=EPSILON)).clamp(min=0.0)
        curve = _curve(source, change, restraint, brighter)
        lost, gained, _ = mean_of(source, change, _chroma, restraint, curve).chunk(3, dim=1)
    return Balance(restraint, curve, (lost / gained.clamp(min=EPSILON)).clamp(max=1.0))


def _curve(source: Source[M], change: Fitted, restraint: float | Tensor, brighter: float | Tensor) -> Tensor:
    """:attr:`Balance.curve`, for a restraint."""
    shift, before, room = mean_of(source, change, _brightness, restraint).chunk(3, dim=1)
    return ((shift - brighter * before) / room.clamp(min=EPSILON)).clamp(-MAX_CURVE, MAX_CURVE)


def _brightness(image: Tensor, moved: Tensor, restraint: float | Tensor) -> Tensor:
    """Change of brightness under a restraint, the brightness before, and the change of the result by the tone curve."""
    before, moved = _before(image, moved), _restrained(image, moved, restraint)
    return torch.cat([moved, before, _bow(before + moved)], dim=1)


def _chroma(image: Tensor, moved: Tensor, restraint: float | Tensor, curve: Tensor) -> Tensor:
    """Lost chroma, chroma that can be gained, and chroma of pixels; 0 for a change of each channel."""
    if moved.shape[1] == image.shape[1]:
        return image.new_zeros(len(image), 3, *image.shape[2:])
    less, more = _saturation(image, _bent(_before(image, moved), _restrained(image, moved, restraint), curve))
    colours = squarable(split_luminance(image)[1])
    chroma = colours.square().sum(1, keepdim=True).clamp(min=EPSILON).sqrt()
    return torch.cat([-less * chroma, more * chroma, chroma], dim=1)


def _before(image: Tensor, change: Tensor) -> Tensor:
    """Return the planes that the change applies to: luminance, or all channels."""
    return image if change.shape[1] == image.shape[1] else reduce_channels(image, "luminance")


def _kept(distance: Tensor) -> Tensor:
    """Least distance from white or black that a value must keep, given its distance before a change."""
    return torch.minimum(((1 - HEADROOM_SHARE) * distance).clamp(min=LEVEL), distance)


def _room(distance: Tensor) -> Tensor:
    """Headroom of a value at a distance from white or black."""
    return distance - _kept(distance)


def _inside(before: Tensor, moved: Tensor) -> Tensor:
    """Clamp a change to the headroom."""
    return torch.minimum(torch.maximum(moved, -_room(before)), _room(1 - before))


def _restrained(image: Tensor, moved: Tensor, restraint: float | Tensor) -> Tensor:
    """Reduce the part of a change of luminance for which the channel with the least headroom leaves no room.

    In saturated colours, it is this part that costs chroma. Other colours have none.
    """
    if isinstance(restraint, float) or moved.shape[1] == image.shape[1]:
        return moved
    up = moved >= 0
    nearest = torch.where(up, 1 - image.amax(1, keepdim=True), image.amin(1, keepdim=True))
    removed = restraint * (moved.abs() - _room(nearest)).clamp(min=0.0)
    return torch.where(up, moved - removed, moved + removed)


def _bent(before: Tensor, moved: Tensor, curve: float | Tensor) -> Tensor:
    """Apply the tone curve after a change, within the headroom."""
    return _inside(before, moved - curve * _bow(before + moved))


def _bow(values: Tensor) -> Tensor:
    """``y (1 - y)``, by which the tone curve bends; 0 outside [0, 1]."""
    inside = values.clamp(0.0, 1.0)
    return inside * (1 - inside)


def _saturation(image: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Required and possible relative changes of chroma for the channels of RGB to stay within their limits.

    For a change ``moved`` of luminance: the required decrease, from -1 to 0, and the possible increase, from 0 to 1,
    all (B, 1, H, W).
    """
    luminance, chroma = split_luminance(image)
    share = _share(image, luminance, chroma, moved)
    relative = MAX_SATURATION_GAIN * (moved.abs() / luminance.clamp(min=MIN_LUMINANCE)).clamp(
        max=1 / MAX_SATURATION_GAIN
    )
    return share.clamp(max=0.0), torch.minimum(share.clamp(min=0.0), relative)


def _share(image: Tensor, luminance: Tensor, chroma: Tensor, moved: Tensor) -> Tensor:
    """Largest relative change of chroma, at least -1, at which all channels stay within their limits, (B, 1, H, W)."""
    after, up = luminance + moved, chroma > 0
    room = (torch.where(up, 1 - after, after) - _kept(torch.where(up, 1 - image, image))).clamp(min=0.0)
    share = (room / chroma.abs().clamp(min=EPSILON)).amin(1, keepdim=True) - 1
    return torch.where(moved == 0, torch.zeros_like(share), share)
