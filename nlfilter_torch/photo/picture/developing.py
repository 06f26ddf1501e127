"""Developing a picture: exposure and white balance in linear light, straightening and crop.

Geometry comes first, then light. A picture is rotated in blocks of fixed places, so that one that is read in parts
becomes the same, bit for bit, as one in memory.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_dtype, check_tensor
from nlfilter_torch.core.workers import divided_among, threads_for
from nlfilter_torch.photo.declared.development import Development, Frame, rotated
from nlfilter_torch.photo.picture.pixels import STRIP

BLOCK = 256  # side in pixels of the squares that are rotated at once
MARGIN = 2  # pixels around a point that bicubic interpolation reads
BLUE_TO_AMBER = 0.75  # stops that temperature 1 adds to red and takes from blue
GREEN_TO_MAGENTA = 0.5  # stops that tint 1 takes from green
#: The tone curve of sRGB: a line up to a value, and a power beyond it.
LINEAR, SLOPE, OFFSET, GAMMA = 0.04045, 12.92, 0.055, 2.4
DARK = 1e-3  # light in which nobody sees colours
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of red, green and blue in linear light

ReadPart = Callable[[range, range], Tensor]  # returns rows and columns (B, C, h, w) of a picture


def develop_image(image: Tensor, development: Development) -> Tensor:
    """Develop a picture.

    A picture with values outside [0, 1] keeps all values; in others they are limited to [0, 1].

    Args:
        image: (B, C, H, W), C = 1 or 3, with the tone curve of sRGB. White balance leaves grey pictures as they are.
        development: how.

    Returns:
        (B, C, h, w); the image itself if nothing changes. Differentiable.

    Raises:
        TypeError: if ``image`` is not a floating-point tensor.
        ValueError: if it has another shape, or the middle of the crop is outside the rotated picture.

    Example:
        >>> grey = torch.full((1, 1, 4, 6), 0.5)
        >>> brighter = develop_image(grey, Development(exposure=1.0, crop=(0.5, 0.0, 1.0, 1.0)))
        >>> brighter.shape, round(float(brighter.mean()), 3)
        (torch.Size([1, 1, 4, 3]), 0.686)
    """
    if development.is_idle:
        return image
    check_tensor(image, "image", "convert it with torch.as_tensor")
    check_dtype(image, "image", "divide integer pixels by the value of white, such as 255")
    if image.ndim != 4 or image.shape[1] not in (1, 3):
        raise ValueError(
            f"image must have shape (B, C, H, W) with 1 or 3 channels, got {tuple(image.shape)}; pass grey or RGB"
        )
    least, most = limits_of(image)
    framed = develop_planes(image, development.frame((image.shape[-2], image.shape[-1])))
    return in_light(framed.clamp(least, most), development, (least, most))


def limits_of(image: Tensor) -> tuple[Tensor, Tensor]:
    """The range (B, 1, 1, 1) of an image (B, C, H, W), enlarged to hold 0 and 1."""
    values = image.detach()
    least, most = values.amin((1, 2, 3), keepdim=True), values.amax((1, 2, 3), keepdim=True)
    return least.clamp(max=0), most.clamp(min=1)


def develop_planes(planes: Tensor, frame: Frame) -> Tensor:
    """Straighten and crop planes (B, C, H, W); values may leave their range where they are rotated."""
    rows, columns = range(frame.top, frame.top + frame.height), range(frame.left, frame.left + frame.width)
    if frame.angle == 0:
        return part_of_planes(planes, rows, columns)
    read = partial(part_of_planes, planes)
    return torch.cat(list(divided_among(threads_for(planes), turned_band, bands_of(frame), read, frame)), dim=2)


def reframed(planes: Tensor, frame: Frame, other: Frame, size: tuple[int, int]) -> Tensor:
    """What planes (B, C, h, w) of a developed picture show in another frame of the same original, at a size (h, w).

    Values are interpolated linearly; beyond the picture they are those of its border.
    """
    corners = [frame.inward(*other.outward(x, y)) for x, y in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))]
    first, right, down = planes.new_tensor(corners)
    to_planes = torch.stack([right - first, down - first, right + down - 1], dim=1)  # of places from -1 to 1
    grid = F.affine_grid(to_planes.expand(len(planes), -1, -1), [len(planes), 1, *size], align_corners=False)
    return F.grid_sample(planes, grid, padding_mode="border", align_corners=False)


def turned_canvas(image: Tensor, development: Development) -> Tensor:
    """An image (B, C, H, W) in [0, 1] that is rotated within its own size, without a crop; empty corners are black."""
    height, width = size = image.shape[-2], image.shape[-1]
    frame = Frame(size, math.radians(development.straighten), 0, 0, *size)
    x, y = torch.arange(width) + (0.5 - width / 2), torch.arange(height)[:, None] + (0.5 - height / 2)
    cosine, sine = math.cos(frame.angle), math.sin(frame.angle)
    inside = ((x * cosine + y * sine).abs() <= width / 2) & ((y * cosine - x * sine).abs() <= height / 2)
    return develop_planes(image, frame).clamp(0, 1) * inside.to(image)


def part_of_planes(planes: Tensor, rows: range, columns: range) -> Tensor:
    """A part of planes (B, C, H, W)."""
    return planes[..., rows.start : rows.stop, columns.start : columns.stop]


def bands_of(frame: Frame) -> list[range]:
    """The rows of a developed picture that are rotated at once."""
    return [range(top, min(top + BLOCK, frame.height)) for top in range(0, frame.height, BLOCK)]


def turned_band(rows: range, read: ReadPart, frame: Frame) -> Tensor:
    """Rows (B, C, h, W) of a developed picture that is rotated."""
    lefts = range(0, frame.width, BLOCK)
    parts = [turned_part(read, frame, rows, range(left, min(left + BLOCK, frame.width))) for left in lefts]
    return torch.cat(parts, dim=3)


def turned_part(read: ReadPart, frame: Frame, rows: range, columns: range) -> Tensor:
    """A part (B, C, h, w) of a developed picture that is rotated, by bicubic interpolation.

    Pixels beyond the border of the picture have the colours of those at the border.
    """
    from kornia.geometry import warp_affine  # kornia takes half a second to import

    height, width = frame.original
    corners = [_source_of(frame, x, y) for x in (columns.start, columns.stop - 1) for y in (rows.start, rows.stop - 1)]
    across, down = (
        range(math.floor(min(v)) - MARGIN, math.ceil(max(v)) + MARGIN + 1) for v in zip(*corners, strict=True)
    )
    inner_columns, inner_rows = _within(across, width), _within(down, height)
    pads = _pads(across, inner_columns) + _pads(down, inner_rows)
    source = F.pad(read(inner_rows, inner_columns), pads, mode="replicate")
    # Where the first pixel of the part read is in the part returned, both counted from the middles of pixels.
    x, y = rotated(across.start + 0.5 - width / 2, down.start + 0.5 - height / 2, frame.angle)
    x, y = x + width / 2 - frame.left - columns.start - 0.5, y + height / 2 - frame.top - rows.start - 0.5
    cosine, sine = math.cos(frame.angle), math.sin(frame.angle)
    matrix = source.new_tensor([[[cosine, -sine, x], [sine, cosine, y]]]).expand(len(source), -1, -1)
    size = (len(rows), len(columns))
    return warp_affine(source, matrix, size, mode="bicubic", padding_mode="border", align_corners=True)


def finished(planes: Tensor, colours: int, limits: tuple[float, float], nodata: float | None = None) -> Tensor:
    """Planes (1, S, h, w) that were rotated, within their ranges.

    Args:
        planes: colours, and one of transparency if there are more.
        colours: 1 or 3.
        limits: of the colours.
        nodata: the value of pixels without data, which the last plane then marks by 0, or None.
    """
    image, opacity = planes[:, :colours].clamp(*limits), planes[:, colours:].clamp(0, 1)
    if nodata is None:
        return torch.cat([image, opacity], dim=1)
    opacity = opacity.round()
    return torch.cat([torch.where(opacity > 0, image, nodata), opacity], dim=1)


def _source_of(frame: Frame, column: int, row: int) -> tuple[float, float]:
    """The column and row of the original, counted from the middles of pixels, that a pixel is taken from."""
    height, width = frame.original
    x, y = rotated(frame.left + column + 0.5 - width / 2, frame.top + row + 0.5 - height / 2, -frame.angle)
    return x + width / 2 - 0.5, y + height / 2 - 0.5


def _within(places: range, length: int) -> range:
    """The places on an axis of that length, at least one of them."""
    first = min(max(places.start, 0), length - 1)
    return range(first, max(min(places.stop, length), first + 1))


def _pads(places: range, inner: range) -> list[int]:
    """How many places there are before and after those of ``inner``."""
    return [max(inner.start - places.start, 0), max(places.stop - inner.stop, 0)]


def in_light(image: Tensor, development: Development, limits: tuple[Tensor, Tensor]) -> Tensor:
    """Change exposure and white balance of an image (B, C, H, W) in linear light.

    ``limits`` are those of the picture before, see :func:`limits_of`; beyond [0, 1] they are not kept.
    """
    if not development.changes_tones:
        return image
    gains = gains_of(development, coloured=image.shape[1] == 3)[: image.shape[1]]
    strips = image.split(max(1, STRIP // image.shape[3]), dim=2)
    return torch.cat(list(divided_among(threads_for(image), _times, strips, gains, limits)), dim=2)


def _times(image: Tensor, gains: Sequence[float], limits: tuple[Tensor, Tensor]) -> Tensor:
    """Multiply the linear light of an image (B, C, H, W), and keep to [0, 1] if the picture did.

    The power of the tone curve cancels: where light before and after is beyond its linear part, values are multiplied,
    and powers are needed for the few that go from one part to the other.
    """
    light = image.new_tensor(gains).view(1, -1, 1, 1)
    edited = torch.where(image > LINEAR, (image + OFFSET) * light ** (1 / GAMMA) - OFFSET, image * light)
    crossing = torch.nonzero((image > LINEAR) != (edited > LINEAR), as_tuple=True)
    if len(crossing[0]):
        before, factors = image[crossing].double(), light.expand_as(image)[crossing].double()  # rounded alike anywhere
        values = _linear(before) * factors
        curved = (1 + OFFSET) * values.clamp(min=LINEAR / SLOPE) ** (1 / GAMMA) - OFFSET
        edited = edited.index_put(crossing, torch.where(before > LINEAR, SLOPE * values, curved).to(edited))
    is_wide = (limits[0] < 0) | (limits[1] > 1)
    return torch.where(is_wide, edited, edited.clamp(0, 1))


def _linear(values: Tensor) -> Tensor:
    """The linear light of values with the tone curve of sRGB."""
    return torch.where(values > LINEAR, ((values.clamp(min=LINEAR) + OFFSET) / (1 + OFFSET)) ** GAMMA, values / SLOPE)


def gains_of(development: Development, *, coloured: bool = True) -> list[float]:
    """What red, green and blue are multiplied by in linear light; white balance keeps the luminance of grey.

    >>> gains_of(Development(exposure=1.0)), gains_of(Development(tint=1.0), coloured=False)
    ([2.0, 2.0, 2.0], [1.0, 1.0, 1.0])
    """
    warmer, redder = (development.temperature, development.tint) if coloured else (0.0, 0.0)
    gains = [2.0 ** (BLUE_TO_AMBER * warmer), 2.0 ** (-GREEN_TO_MAGENTA * redder), 2.0 ** (-BLUE_TO_AMBER * warmer)]
    luminance = sum(weight * gain for weight, gain in zip(LUMINANCE, gains, strict=True))
    light = 2.0**development.exposure
    return [light * gain / luminance if coloured else light for gain in gains]


def balance_of(part: Tensor) -> tuple[float, float]:
    """The temperature and tint that make a part (1, C, h, w) of a picture grey, on average, within their ranges.

    Raises:
        ValueError: if the picture has no colours, or the part no light in one of them.

    Example:
        >>> balance_of(develop_image(torch.full((1, 3, 1, 1), 0.5), Development(temperature=-0.4, tint=0.2)))
        (0.4, -0.2)
    """
    if part.shape[1] != 3 or part.numel() == 0:
        raise ValueError("the photograph must have colours to balance, got a grey one; choose another")
    light = _linear(part.double()).mean((0, 2, 3))
    if float(light.min()) < DARK:
        raise ValueError(
            "a grey point must have red, green and blue light, got one that is nearly black; choose another"
        )
    red, green, blue = light.log2().tolist()
    temperature = (blue - red) / (2 * BLUE_TO_AMBER)
    tint = (green - (red + blue) / 2) / GREEN_TO_MAGENTA
    return round(min(max(temperature, -1.0), 1.0), 3), round(min(max(tint, -1.0), 1.0), 3)
