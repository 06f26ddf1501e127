"""Edits of brightness at the size at which a picture is looked at, so that sliders mean the same at any resolution.

Patches are counted in pixels: in a photograph of 24 megapixels, one of 5x5 holds a sixteenth of what it holds in the
same photograph at 1.5, and the sliders would move only grain that nobody sees when the whole picture is on a screen. A
larger picture is therefore reduced to the viewing size, its change of brightness is worked out there, and enlarged. Of
the ways to make sliders independent of resolution this one costs least: patches and factor are those of the small
picture, whatever the size of the photograph.

Detail that is too fine for the viewing size is changed as the coarser detail around it: the slope of the change over
the brightness, by regression over 5x5 pixels of the small picture, times what the small picture lacks. Texture gets as
much stronger (or smoother) in its finest parts as in the others, and an edge, which is no detail, remains as sharp as
it is. What this adds to the small picture is worked out and taken away again, so that the result, once it is reduced,
is the small one: the editor, which shows that, shows what is saved.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.edits.colour import Balance, Limits, balance_of, change_luminance, limited_change, move_luminance
from nlfilter_torch.edits.pixels import Fitted, Pixels, Planes, corner
from nlfilter_torch.edits.resizing import interpolation, resized
from nlfilter_torch.operator.features import pad_border

MEGAPIXEL = 1_000_000
PASSED = 4  # pixels around one that its enlargement depends on once it is reduced again
RESTORED = 3  # terms of a Neumann series that undoes what enlarging and reducing again smooths
FAINT = (2 / 255) ** 2  # variance below which a slope over brightness is taken for 0


def viewed_size(size: tuple[int, int], megapixels: float) -> tuple[int, int]:
    """(H, W) of a picture reduced to so many megapixels; its own where it has no more, or for 0.

    >>> viewed_size((4000, 6000), 1.5), viewed_size((600, 800), 1.5)
    ((1000, 1500), (600, 800))
    """
    scale = math.sqrt(megapixels * MEGAPIXEL / (size[0] * size[1]))
    if megapixels == 0 or scale >= 1:
        return size
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


class Reducible(Protocol):
    """What is asked of a :class:`~nlfilter_torch.edits.source.Source`."""

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""

    @property
    def stride(self) -> float:
        """Every how many pixels of a photograph, each way, it has one."""

    def resized(self, size: tuple[int, int]) -> Any:
        """The picture in a smaller size."""

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes (B, C, h, w) of all its pixels in a smaller size."""

    def held(self, fitted: Fitted) -> Fitted:
        """An edit with the planes that it makes worked out, if there is room for them."""

    def mean_of(self, fitted: Fitted, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means (B, S, 1, 1) of what a function makes of the picture and of the planes of an edit."""


def fit_change(
    source: Reducible,
    change: Callable[[Any], Fitted],
    planes: Planes,
    size: float,
    limits: Limits,
    *,
    brighter: float | Tensor | None = 0.0,
) -> Fitted:
    """An edit of a picture from a change of its brightness at the viewing size.

    Args:
        source: the picture.
        change: fitted to a source, a change (B, 1 or C, h, w) of its planes.
        planes: what is changed, luminance or all channels.
        size: the viewing size in megapixels; 0 is that of the picture.
        limits: of :func:`change_luminance`.
        brighter: by what share the change is meant to raise the mean brightness, which is otherwise kept; None leaves
            it, and chroma, to the limits.
    """

    def balanced(of: Any, fitted: Fitted) -> tuple[Fitted, Balance | None]:
        if limits == "none" or brighter is None:
            return fitted, None
        held = of.held(fitted)
        return held, balance_of(lambda function: of.mean_of(held, function), brighter)

    small = viewed_size(source.size, size)
    reduced: Any = source if small == source.size else source.resized(small)
    fitted, balance = balanced(reduced, change(reduced))
    if small == source.size and source.stride == 1:
        if fitted.finish is None:
            return Fitted(lambda pixels: change_luminance(pixels.image, fitted.pixels(pixels), limits, balance))
        finish = fitted.finish
        return Fitted(
            fitted.pixels,
            lambda image, found: change_luminance(image, finish(image, found), limits, balance),
            fitted.margin,
        )
    before, after = reduced.all(Fitted(planes)), reduced.all(fitted)
    image = reduced.all(Fitted(lambda pixels: pixels.image)) if limits == "soft" else before
    coarse = Coarse.of(image, before, after, limits, balance)
    found = coarse.changes(source, planes)
    return Fitted(lambda pixels: coarse.change(pixels.image, *found(pixels)))


@dataclass(frozen=True, eq=False)
class Coarse:
    """A change of brightness at the viewing size.

    Attributes:
        planes: what is changed, its change, the slope of the change over it, and for ``soft`` limits of luminance the
            change of saturation, (B, S, h, w).
        count: channels of each of the first three.
        limits: of :func:`change_luminance`.
    """

    planes: Tensor
    count: int
    limits: Limits

    @staticmethod
    def of(image: Tensor, before: Tensor, change: Tensor, limits: Limits, balance: Balance | None) -> "Coarse":
        """The change of some planes of an image, as far as the limits allow it."""
        saturation = None
        if limits == "soft":
            change, saturation = limited_change(image, change, balance)
        parts = [before, change, slope(before, change), *([] if saturation is None else [saturation])]
        return Coarse(torch.cat(parts, dim=1), before.shape[1], limits)

    def changes(self, source: Reducible, planes: Planes) -> Callable[[Pixels], tuple[Tensor, Tensor]]:
        """What pixels of a picture, in which ``planes`` are changed, change by: these planes, and the saturation."""
        if source.size == (self.planes.shape[-2], self.planes.shape[-1]):
            return lambda pixels: self.left(planes(pixels), source.stride)
        finer = self._of_larger(source, planes)
        return lambda pixels: finer._moved(planes(pixels), finer._at(pixels, source.size))

    def change(self, image: Tensor, moved: Tensor, saturation: Tensor) -> Tensor:
        """Pixels of the picture under a change of its planes and of its saturation."""
        if self.limits == "none":
            return image + moved
        return move_luminance(image, moved, saturation if saturation.shape[1] else None)

    def left(self, planes: Tensor, stride: float) -> tuple[Tensor, Tensor]:
        """What is left of the changes at the viewing size where the picture was enlarged, changed and is reduced."""
        found = enlarged_and_reduced(self.planes, stride)
        changed = self.planes[:, self.count : 2 * self.count]
        blurred, _, steepness = found[:, : 3 * self.count].chunk(3, dim=1)
        beyond = steepness * (planes - blurred)
        moved = enlarged_and_reduced(_restored(changed - beyond, stride), stride) + beyond
        return moved, found[:, 3 * self.count :]

    def _of_larger(self, source: Reducible, planes: Planes) -> "Coarse":
        """With a change of which a larger picture, in which ``planes`` are changed, has the mean.

        The change of what the small picture lacks has a mean, too, which is taken away here.
        """
        size, count = (self.planes.shape[-2], self.planes.shape[-1]), self.count
        before, steepness = slice(0, count), slice(2 * count, 3 * count)

        def beyond(pixels: Pixels) -> Tensor:
            lacking = planes(pixels) - self._at(pixels, source.size, before)
            return self._at(pixels, source.size, steepness) * lacking

        parts = list(self.planes.split([count, count, self.planes.shape[1] - 2 * count], dim=1))
        stride = math.sqrt(source.size[0] * source.size[1] / (size[0] * size[1]))
        parts[1] = _restored(parts[1] - source.shrunk(beyond, size), stride)
        return replace(self, planes=torch.cat(parts, dim=1))

    def _at(self, pixels: Pixels, size: tuple[int, int], channels: slice = slice(None)) -> Tensor:
        """Some channels of :attr:`planes`, enlarged for some pixels of a picture (H, W)."""
        (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
        columns = None if width == pixels.width else range(left, left + width)
        return resized(
            lambda start, stop: self.planes[:, channels, start:stop],
            (self.planes.shape[-2], self.planes.shape[-1]),
            size,
            range(top, top + height),
            columns,
        )

    def _moved(self, planes: Tensor, found: Tensor) -> tuple[Tensor, Tensor]:
        """What some planes of the picture change by, from the part of :attr:`planes` that they see."""
        blurred, changed, steepness = found[:, : 3 * self.count].chunk(3, dim=1)
        return changed + steepness * (planes - blurred), found[:, 3 * self.count :]


def _restored(planes: Tensor, stride: float) -> Tensor:
    """Planes that are about the given ones once :func:`enlarged_and_reduced`."""
    found = planes
    for _ in range(RESTORED - 1):
        found = found + planes - enlarged_and_reduced(found, stride)
    return found


def enlarged_and_reduced(planes: Tensor, stride: float) -> Tensor:
    """Planes (B, C, H, W) as they are once they were made ``stride`` times as large, and resized back.

    At borders, and for a stride that is no integer, to an approximation.
    """
    kernel = _passed(stride).to(planes)
    reach = len(kernel) // 2
    padded = F.pad(planes, (reach,) * 4, mode="replicate").flatten(0, 1).unsqueeze(1)
    rows = F.conv2d(padded, kernel.view(1, 1, -1, 1))
    return F.conv2d(rows, kernel.view(1, 1, 1, -1)).view_as(planes)


@lru_cache(maxsize=8)
def _passed(stride: float) -> Tensor:
    """The weights (2 PASSED + 1,) of the pixels around one, along an axis, mean over the places in between."""
    length, places = 64, range(28, 36)
    large = round(length * stride)
    used, down = interpolation(places, large, length)
    rows = torch.stack([weights @ _up(used, length, large) for weights in down])  # (8, 64)
    around = [rows[i, place - PASSED : place + PASSED + 1] for i, place in enumerate(places)]
    found = torch.stack(around).mean(0)
    return (found + found.flip(0)) / (2 * found.sum())


def _up(used: slice, length: int, large: int) -> Tensor:
    """Weights (n, length) of the pixels of an axis for some places of its enlargement."""
    part, weights = interpolation(range(used.start, used.stop), length, large)
    return F.pad(weights, (part.start, length - part.stop))


def slope(before: Tensor, change: Tensor) -> Tensor:
    """Of a change over the planes (B, C, H, W) before it, by regression over 5x5 pixels; 0 where they are flat."""

    def mean(planes: Tensor) -> Tensor:
        return F.avg_pool2d(pad_border(planes, 2), 5, 1)

    together = mean(before * change) - mean(before) * mean(change)
    return together / ((mean(before.square()) - mean(before).square()).clamp(min=0.0) + FAINT)
