"""Rasterisation of marks, by one function: for a picture in memory, for some of its rows, and for a preview."""

import os
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.declared.strokes import Mark, Region, Stroke
from nlfilter_torch.photo.picture.drawn import Plane, Size, colour_of
from nlfilter_torch.photo.picture.pictures import LazyRows, Picture, mask_of, stored_as, transparency

Part = tuple[slice, slice]  # rows and columns of a picture
Open = Callable[[str], Picture]  # opens the picture of marks at a path
BRUSH_BORDER = 1.0  # width in pixels of the border of a brush that paints on a mask
SELECTED_FROM = 0.5  # brightness from which a mask selects a pixel: the borders of soft masks fade to 0 far outside


def opened_picture(path: str) -> Picture:
    """The picture in a file, all of it in memory; the last few are kept until their files change.

    Raises:
        ValueError: if there is none.
    """
    try:
        return _picture_of(path, os.stat(path).st_mtime_ns)
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} must be a picture of marks, got no file that can be read; save it as PNG") from error


@lru_cache(maxsize=4)
def _picture_of(path: str, changed: int) -> Picture:
    """The picture in a file that was last changed at a time."""
    try:
        from nlfilter_torch.photo.files.formats import read_channels
    except ImportError as error:
        raise ImportError(f"{path} is a picture, and reading it needs nlfilter-torch[cli]; install that") from error
    return Picture(read_channels(Path(path), bytes_per_pixel=0, memory=None).channels, path, hides=False)


def rasterised(
    shown: Sequence[Plane],
    size: Size,
    rows: slice | None = None,
    *,
    soft: bool = False,
    coloured: bool = False,
    opened: Open = opened_picture,
) -> Tensor:
    """Rasterise marks to K planes (1, K, H, W) from 0 to 1, or to rows (1, K, h, W) of them.

    Args:
        shown: for each plane its marks, of which later ones cover earlier ones.
        size: (H, W) of the picture.
        rows: of which the planes are wanted; None is all.
        soft: whether strokes have a border of one pixel, in which they cover a share of each pixel.
        coloured: whether the colours of marks come before their plane, of which there is one: (1, 4, H, W).
        opened: opens pictures of marks.

    Example:
        >>> brush, eraser = (Stroke(((0.5, 0.5),), 0.4, word) for word in ("add", "remove"))
        >>> orders = [((eraser, False), (brush, True)), ((brush, True), (eraser, False))]
        >>> [float(rasterised([order], (9, 9))[0, 0, 4, 4]) for order in orders]
        [1.0, 0.0]
    """
    rows = slice(0, size[0]) if rows is None else rows
    planes = torch.zeros(3 * coloured + len(shown), rows.stop - rows.start, size[1])
    for plane, marks in zip(planes[3 * coloured :], shown, strict=True):
        for mark, paints in marks:
            for (down, across), covered, colours in _covered(mark, size, rows, soft=soft, opened=opened):
                part = plane[down, across]
                part *= 1 - covered
                if not paints:
                    continue
                part += covered
                if coloured and colours is not None:
                    planes[:3, down, across] = torch.where(covered > 0, colours, planes[:3, down, across])
    return planes[None]


def cover(mark: Mark, size: Size, rows: slice | None = None) -> Tensor:
    """The pixels that a mark covers, (H, W) bool, or (h, W) for ``rows`` of a picture of that size.

    >>> cover(Stroke(((0.5, 0.5),), 0.1, "in"), (5, 5)).int()
    tensor([[0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 1, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0]], dtype=torch.int32)
    """
    return rasterised([((mark, True),)], size, rows)[0, 0] > 0


Covered = tuple[Part, Tensor, Tensor | None]  # a part, the shares (h, w) of its pixels that are covered, and colours


def _covered(mark: Mark, size: Size, rows: slice, *, soft: bool, opened: Open) -> Iterator[Covered]:
    """Yield what a mark covers of some rows of a picture; rows of a part are counted from the first of them."""
    colours = None if mark.colour is None else colour_of(mark.colour).view(3, 1, 1)
    if isinstance(mark, Stroke):
        part, covered = _stroke_part(mark, size, rows, soft=soft)
    elif mark.file:
        part = slice(0, rows.stop - rows.start), slice(0, size[1])
        covered, own = _read(mark, size, rows, opened(mark.file))
        colours = own if colours is None else colours
    else:
        part, covered = _linear(mark, size, rows) if mark.shape == "linear" else _region_part(mark, size, rows)
    if covered.numel():
        yield part, covered, colours


def _stroke_part(stroke: Stroke, size: Size, rows: slice, *, soft: bool) -> tuple[Part, Tensor]:
    """The part of some rows that holds all of a stroke, and the shares of its pixels that are covered.

    A pixel is covered if its centre is, or with a soft border, of :data:`BRUSH_BORDER`, by a share.
    """
    radius = stroke.pixels(size) + BRUSH_BORDER / 2 * soft
    lines = list(_squared_distances(stroke, size, rows, radius))
    if not lines:
        return (slice(0, 0), slice(0, 0)), torch.zeros(0, 0)
    top, left = (min(part[axis].start for part, _ in lines) for axis in (0, 1))
    bottom, right = (max(part[axis].stop for part, _ in lines) for axis in (0, 1))
    covered = torch.zeros(bottom - top, right - left)
    for (down, across), squared in lines:
        near = covered[down.start - top : down.stop - top, across.start - left : across.stop - left]
        share = ((radius - squared.sqrt()) / BRUSH_BORDER).clamp(0.0, 1.0) if soft else squared <= radius * radius
        near.copy_(near.maximum(share.to(near)))
    return (slice(top, bottom), slice(left, right)), covered


def _squared_distances(stroke: Stroke, size: Size, rows: slice, reach: float) -> Iterator[tuple[Part, Tensor]]:
    """Yield squared distances of pixels from each line of a stroke, for parts that hold all pixels within ``reach``."""
    (height, width), first = size, rows.start
    # The origin is the centre of the first pixel.
    points = [(x * width - 0.5, y * height - 0.5) for x, y in stroke.points]
    for (x0, y0), (x1, y1) in pairwise(points if len(points) > 1 else points * 2):
        top, bottom = _span(y0, y1, reach, first, rows.stop)
        left, right = _span(x0, x1, reach, 0, width)
        if top >= bottom or left >= right:
            continue
        y = torch.arange(top, bottom, dtype=torch.float32).unsqueeze(1) - y0
        x = torch.arange(left, right, dtype=torch.float32) - x0
        dx, dy = x1 - x0, y1 - y0
        along = ((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12)).clamp(0, 1)  # nearest point of the line
        part = slice(top - first, bottom - first), slice(left, right)
        yield part, (x - along * dx).square() + (y - along * dy).square()


def _span(a: float, b: float, radius: float, first: int, last: int) -> tuple[int, int]:
    """Range of the pixels in [first, last) that a line from a to b may cover."""
    return max(first, int(min(a, b) - radius)), min(last, int(max(a, b) + radius) + 2)


def _region_part(region: Region, size: Size, rows: slice) -> tuple[Part, Tensor]:
    """The part of some rows that holds all of a region, and the weights of its pixels: 1 for those with centres in it.

    A region between the centres of pixels covers the pixel that holds its middle, so that it does not vanish in a
    preview.
    """
    xs, ys = ([point[axis] * size[1 - axis] for point in region.outline] for axis in (0, 1))
    top, bottom = (int(np.clip(edge, 0, size[0])) for edge in (np.floor(min(ys)), np.ceil(max(ys))))
    left, right = (int(np.clip(edge, 0, size[1])) for edge in (np.floor(min(xs)), np.ceil(max(xs))))
    narrow = min(bottom - top, right - left) <= 2
    if narrow and not bool(_inside(region, size, slice(top, bottom), slice(left, right)).any()):
        row, column = int(sum(ys) // len(ys)), int(sum(xs) // len(xs))
        if not (rows.start <= row < rows.stop and 0 <= column < size[1]):
            return (slice(0, 0), slice(0, 0)), torch.zeros(0, 0)
        return (slice(row - rows.start, row - rows.start + 1), slice(column, column + 1)), torch.ones(1, 1)
    first, last = max(top, rows.start), min(bottom, rows.stop)
    if first >= last or left >= right:
        return (slice(0, 0), slice(0, 0)), torch.zeros(0, 0)
    inside = _inside(region, size, slice(first, last), slice(left, right))
    return (slice(first - rows.start, last - rows.start), slice(left, right)), inside.float()


def _linear(region: Region, size: Size, rows: slice) -> tuple[Part, Tensor]:
    """All of some rows, and their weights in a linear gradient: 1 before its axis begins, and 0 after its end."""
    (x0, y0), (x1, y1) = ((x * size[1], y * size[0]) for x, y in region.points)
    y, x = _centres(size, rows, slice(0, size[1]))
    dx, dy = x1 - x0, y1 - y0
    along = ((x * size[1] - x0) * dx + (y * size[0] - y0) * dy) / max(dx * dx + dy * dy, 1e-12)
    return (slice(0, rows.stop - rows.start), slice(0, size[1])), _falling(along).float()


def _falling(along: Tensor) -> Tensor:
    """Weights that fall from 1 at 0 to 0 at 1, without a kink at either end."""
    left = 1 - along.clamp(0, 1)
    return left.square() * (3 - 2 * left)


def _inside(region: Region, size: Size, down: slice, across: slice) -> Tensor:
    """Which pixels of a part of a picture have their centre in a region, (h, w); for a gradient, their weights."""
    if region.shape == "polygon":
        y, x = _centres(size, down, across)
        inside = torch.zeros(y.shape[0], x.shape[1], dtype=torch.bool)
        for (x0, y0), (x1, y1) in pairwise([*region.points, region.points[0]]):
            if y0 != y1:  # a ray to the right meets the side
                inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        return inside
    u, v = _in_parallelogram(region, size, down, across)
    if region.shape in ("ellipse", "radial"):
        squared = (2 * u - 1).square() + (2 * v - 1).square()
        return squared <= 1 if region.shape == "ellipse" else _falling(1 + (squared.sqrt() - 1) / region.softness)
    return (u >= 0) & (u < 1) & (v >= 0) & (v < 1)


def _centres(size: Size, down: slice, across: slice) -> tuple[Tensor, Tensor]:
    """Places (h, 1) and (1, w) of the centres of pixels, as shares of the height and width of a picture."""
    y, x = (
        (torch.arange(part.start, part.stop, dtype=torch.float64) + 0.5) / length
        for part, length in zip((down, across), size, strict=True)
    )
    return y.unsqueeze(1), x.unsqueeze(0)


def _in_parallelogram(region: Region, size: Size, down: slice, across: slice) -> tuple[Tensor, Tensor]:
    """Places (h, w) of the centres of pixels along the upper and left side of a region, from 0 to 1 within it."""
    (left, top), right, lower = region.points
    a, b, c, d = right[0] - left, right[1] - top, lower[0] - left, lower[1] - top
    area = a * d - b * c
    y, x = _centres(size, down, across)
    y, x = y - top, x - left
    if area == 0:  # a line, which has no inside
        return torch.full_like(y + x, -1.0), torch.full_like(y + x, -1.0)
    return (d * x - c * y) / area, (a * y - b * x) / area


def _read(region: Region, size: Size, rows: slice, picture: Picture) -> tuple[Tensor, Tensor | None]:
    """Weights (h, W) of some rows that a picture marks, and for a layer its colours (3, h, W).

    The picture may be larger or smaller, or turned: that of its pixels counts which holds the centre of a pixel.
    """
    height, width = picture.size
    upright = Region.of_file(region.file, region.shape, region.paint).points
    if picture.size == size and region.points == upright:
        return _marked(region, picture, rows.start, rows.stop)
    u, v = _in_parallelogram(region, size, rows, slice(0, size[1]))
    column, row = (u * width).floor().long(), (v * height).floor().long()
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    if not bool(inside.any()):
        return torch.zeros(0, 0), None
    first, last = int(row[inside].min()), int(row[inside].max()) + 1
    weights, colours = _marked(region, picture, first, last)
    row, column = (row - first).clamp(0, last - first - 1), column.clamp(0, width - 1)
    return weights[row, column] * inside, None if colours is None else colours[:, row, column]


def _marked(region: Region, picture: Picture, start: int, stop: int) -> tuple[Tensor, Tensor | None]:
    """Weights (h, W) of rows of a picture of marks, and for a layer its colours (3, h, W)."""
    tile = picture.tile(start, stop, 0)
    if region.shape == "mask":
        weights = mask_of(tile)[0, 0].float()
        return torch.where(weights < SELECTED_FROM, 0.0, weights), None
    opacity = torch.from_numpy(transparency(tile, "float32")).prod(2)
    return opacity, tile.pixels[0].expand(3, -1, -1).float()  # a grey picture has one channel


def _rasterised_once(
    _: tuple[int, ...], shown: Sequence[Plane], size: Size, *, soft: bool, coloured: bool, opened: Open
) -> Tensor:
    """:func:`rasterised` marks, whose files were last changed at some times."""
    return rasterised(shown, size, soft=soft, coloured=coloured, opened=opened)


class TensorPainter:
    """Rasterises marks to tensors (1, K, H, W); the last few are kept. ``opened`` as for :func:`rasterised`."""

    def __init__(self, opened: Open = opened_picture) -> None:
        self._opened = opened
        self._rasterised = lru_cache(maxsize=4)(_rasterised_once)  # one for each kind of scribbles

    def planes(self, shown: Sequence[Plane], size: Size, *, soft: bool = False, coloured: bool = False) -> Tensor:
        """Return :func:`rasterised` marks, anew once a file of theirs has changed."""
        files = [mark.file for marks in shown for mark, _ in marks if isinstance(mark, Region) and mark.file]
        changed = tuple(os.stat(file).st_mtime_ns for file in files if os.path.exists(file))
        return self._rasterised(changed, tuple(shown), size, soft=soft, coloured=coloured, opened=self._opened)

    def covers(self, planes: Tensor) -> bool:
        """Whether masks or colours cover a pixel."""
        return bool(planes.any())


class RowPainter:
    """Rasterises marks as they are read: to rows (H, W, K), of which only a few are in memory at once."""

    def __init__(self, opened: Open = opened_picture) -> None:
        self._opened = opened

    def planes(self, shown: Sequence[Plane], size: Size, *, soft: bool = False, coloured: bool = False) -> RowSource:
        """Return :func:`rasterised` marks."""
        read = partial(_rasterised_rows, tuple(shown), size, soft=soft, coloured=coloured, opened=self._opened)
        return LazyRows((*size, 3 * coloured + len(shown)), read)

    def covers(self, planes: RowSource) -> bool:
        """Whether masks or colours cover a pixel."""
        return LazyRows(tuple(planes.shape), partial(plane_rows, planes), planes.dtype).any()


def _rasterised_rows(
    shown: Sequence[Plane], size: Size, rows: slice, *, soft: bool, coloured: bool, opened: Open
) -> NDArray[np.generic]:
    planes = rasterised(shown, size, rows, soft=soft, coloured=coloured, opened=opened)
    return stored_as(planes, "float32")


def plane_rows(planes: RowSource, rows: slice) -> NDArray[np.generic]:
    """Some rows (h, W, K) of planes."""
    return np.asarray(planes[rows])
