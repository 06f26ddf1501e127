"""Edits of brightness at the size at which a picture is looked at, so that sliders mean the same at any resolution.

Patches are counted in pixels: in a photograph of 24 megapixels, one of 5x5 holds a sixteenth of what it holds in the
same photograph at 1.5, and the sliders would move only grain that nobody sees when the whole picture is on a screen. A
larger picture is therefore reduced to the viewing size, its change of brightness is worked out there, and enlarged. Of
the ways to make sliders independent of resolution this one costs least: patches and factor are those of the small
picture, whatever the size of the photograph.

Detail that is too fine for the viewing size is changed as the coarser detail around it: the slope of the change over
the brightness, by regression over 5x5 pixels of the small picture, times what the small picture lacks. Texture gets as
much stronger (or smoother) in its finest parts as in the others, and an edge, which is no detail, remains as sharp as
it is. The average of the result over a pixel of the small picture is the small result.
"""

import math
from collections.abc import Callable
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.edits.colour import Balance, Limits, balance_of, change_luminance, limited_change, move_luminance
from nlfilter_torch.edits.pixels import Fitted, Pixels, Planes, corner
from nlfilter_torch.edits.resizing import resized
from nlfilter_torch.operator.features import pad_border

MEGAPIXEL = 1_000_000
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

    def resized(self, size: tuple[int, int]) -> Any:
        """The picture in a smaller size."""

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
    if small == source.size:
        fitted, balance = balanced(source, change(source))
        if fitted.finish is None:
            return Fitted(lambda pixels: change_luminance(pixels.image, fitted.pixels(pixels), limits, balance))
        finish = fitted.finish
        return Fitted(
            fitted.pixels,
            lambda image, found: change_luminance(image, finish(image, found), limits, balance),
            fitted.margin,
        )
    reduced = source.resized(small)
    fitted, balance = balanced(reduced, change(reduced))
    before, after = reduced.all(Fitted(planes)), reduced.all(fitted)
    saturation = None
    if limits == "soft":
        image = reduced.all(Fitted(lambda pixels: pixels.image))
        after, saturation = limited_change(image, after, balance)
    parts = [before, after, slope(before, after), *([] if saturation is None else [saturation])]
    coarse = torch.cat(parts, dim=1)
    count = before.shape[1]

    def edit(pixels: Pixels) -> Tensor:
        (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
        columns = None if width == pixels.width else range(left, left + width)
        found = resized(
            lambda start, stop: coarse[:, :, start:stop], small, source.size, range(top, top + height), columns
        )
        blurred, changed, steepness = found[:, : 3 * count].chunk(3, dim=1)
        moved = changed + steepness * (planes(pixels) - blurred)
        if limits == "none":
            return pixels.image + moved
        return move_luminance(pixels.image, moved, None if saturation is None else found[:, 3 * count :])

    return Fitted(edit)


def slope(before: Tensor, change: Tensor) -> Tensor:
    """Of a change over the planes (B, C, H, W) before it, by regression over 5x5 pixels; 0 where they are flat."""

    def mean(planes: Tensor) -> Tensor:
        return F.avg_pool2d(pad_border(planes, 2), 5, 1)

    together = mean(before * change) - mean(before) * mean(change)
    return together / ((mean(before.square()) - mean(before).square()).clamp(min=0.0) + FAINT)
