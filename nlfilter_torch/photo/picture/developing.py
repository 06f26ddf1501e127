"""The geometry of a developed picture: turning, straightening and crop.

It comes before light, see :mod:`nlfilter_torch.photo.picture.light`. A picture is rotated in blocks of fixed places, so
that one that is read in parts becomes the same, bit for bit, as one in memory.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.workers import divided_among, threads_for
from nlfilter_torch.photo.declared.development import Development, Frame, rotated

BLOCK = 256  # side in pixels of the squares that are rotated at once
MARGIN = 2  # pixels around a point that bicubic interpolation reads

ReadPart = Callable[[range, range], Tensor]  # returns rows and columns (B, C, h, w) of a picture


def limits_of(image: Tensor) -> tuple[Tensor, Tensor]:
    """The range (B, 1, 1, 1) of an image (B, C, H, W), enlarged to hold 0 and 1."""
    values = image.detach()
    least, most = values.amin((1, 2, 3), keepdim=True), values.amax((1, 2, 3), keepdim=True)
    return least.clamp(max=0), most.clamp(min=1)


def develop_planes(planes: Tensor, frame: Frame) -> Tensor:
    """Turn, straighten and crop planes (B, C, H, W); values may leave their range where they are rotated."""
    planes = planes.rot90(-frame.quarters, (2, 3))
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
    image = image.rot90(-development.rotate // 90, (2, 3))
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
    """Rows (B, C, h, W) of a developed picture that is turned; ``read`` as in :func:`turned_part`."""
    if frame.angle == 0:
        columns = range(frame.left, frame.left + frame.width)
        return read(range(frame.top + rows.start, frame.top + rows.stop), columns)
    lefts = range(0, frame.width, BLOCK)
    parts = [turned_part(read, frame, rows, range(left, min(left + BLOCK, frame.width))) for left in lefts]
    return torch.cat(parts, dim=3)


def turned_part(read: ReadPart, frame: Frame, rows: range, columns: range) -> Tensor:
    """A part (B, C, h, w) of a developed picture that is rotated, by bicubic interpolation.

    ``read`` returns parts of the picture after the quarters of a turn. Pixels beyond the border of the picture have the
    colours of those at the border.
    """
    from kornia.geometry import warp_affine  # kornia takes half a second to import

    height, width = frame.turned
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
    height, width = frame.turned
    x, y = rotated(frame.left + column + 0.5 - width / 2, frame.top + row + 0.5 - height / 2, -frame.angle)
    return x + width / 2 - 0.5, y + height / 2 - 0.5


def _within(places: range, length: int) -> range:
    """The places on an axis of that length, at least one of them."""
    first = min(max(places.start, 0), length - 1)
    return range(first, max(min(places.stop, length), first + 1))


def _pads(places: range, inner: range) -> list[int]:
    """How many places there are before and after those of ``inner``."""
    return [max(inner.start - places.start, 0), max(places.stop - inner.stop, 0)]
