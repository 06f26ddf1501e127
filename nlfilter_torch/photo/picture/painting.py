"""Rasterisation of brush strokes to masks and colours."""

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor

from nlfilter_torch.photo.declared.strokes import Stroke, radius_in_pixels

BORDER = 1.0  # width in pixels of the border of a brush that paints on a mask


def cover(stroke: Stroke, size: tuple[int, int], rows: slice | None = None) -> Tensor:
    """Rasterise a stroke: the pixels that it covers, (H, W) bool, or (h, W) for ``rows`` of a picture of that size.

    >>> cover(Stroke(((0.5, 0.5),), 0.1, "in"), (5, 5)).int()
    tensor([[0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 1, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0]], dtype=torch.int32)
    """
    radius = radius_in_pixels(stroke, size)
    covered = torch.zeros(_shape(size, rows), dtype=torch.bool)
    for part, squared in _squared_distances(stroke, size, rows, radius):
        covered[part] |= squared <= radius * radius
    return covered


def _soft_part(stroke: Stroke, size: tuple[int, int], rows: slice | None) -> tuple[tuple[slice, slice], Tensor]:
    """The part of a picture that holds all of a stroke, and the share of each of its pixels that the stroke covers.

    The share is 1 inside and 0 outside, with a border of one pixel. ``rows`` as in :func:`cover`.
    """
    radius = radius_in_pixels(stroke, size) + BORDER / 2
    lines = list(_squared_distances(stroke, size, rows, radius))
    if not lines:
        return (slice(0, 0), slice(0, 0)), torch.zeros(0, 0)
    top, left = (min(part[axis].start for part, _ in lines) for axis in (0, 1))
    bottom, right = (max(part[axis].stop for part, _ in lines) for axis in (0, 1))
    covered = torch.zeros(bottom - top, right - left)
    for (down, across), squared in lines:
        near = covered[down.start - top : down.stop - top, across.start - left : across.stop - left]
        near.copy_(near.maximum(((radius - squared.sqrt()) / BORDER).clamp(0.0, 1.0)))
    return (slice(top, bottom), slice(left, right)), covered


def _squared_distances(
    stroke: Stroke, size: tuple[int, int], rows: slice | None, reach: float
) -> Iterator[tuple[tuple[slice, slice], Tensor]]:
    """Yield squared distances of pixels from each line of a stroke, for parts that hold all pixels within ``reach``."""
    (height, width), first = size, 0 if rows is None else rows.start
    # The origin is the centre of the first pixel.
    points = [(x * width - 0.5, y * height - 0.5) for x, y in stroke.points]
    for (x0, y0), (x1, y1) in pairwise(points if len(points) > 1 else points * 2):
        top, bottom = _span(y0, y1, reach, first, first + _shape(size, rows)[0])
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


def mask_of(
    strokes: Iterable[Stroke], size: tuple[int, int], rows: slice | None = None, *, above: Iterable[Stroke] = ()
) -> Tensor:
    """Rasterise strokes to a mask (1, 1, H, W), float32, of zeros and ones; ``rows`` as in :func:`cover`.

    It is 0 where the strokes ``above`` cover them.
    """
    visible, hidden = torch.zeros(2, *_shape(size, rows), dtype=torch.bool)
    for covered, drawn in ((visible, strokes), (hidden, above)):
        for stroke in drawn:
            covered |= cover(stroke, size, rows)
    return (visible & ~hidden)[None, None].float()


def paint(strokes: Iterable[Stroke], size: tuple[int, int], rows: slice | None = None) -> tuple[Tensor, Tensor]:
    """Rasterise strokes to colours (1, 3, H, W) and a mask (1, 1, H, W); later strokes cover earlier ones."""
    shape = _shape(size, rows)
    colours, painted = torch.zeros(3, *shape), torch.zeros(shape, dtype=torch.bool)
    for stroke in strokes:
        covered = cover(stroke, size, rows)
        colours[:, covered] = colour_of(stroke.paint).unsqueeze(1)
        painted |= covered
    return colours[None], painted[None, None].float()


def painted_on_mask(strokes: Iterable[Stroke], word: str, size: tuple[int, int], rows: slice | None = None) -> Tensor:
    """What strokes of a meaning set on a mask, where later strokes of any meaning cover earlier ones: (1, 1, H, W).

    If the meaning holds a colour, there are four planes: RGB, and these. ``rows`` as in :func:`cover`.

    >>> brush, eraser = (Stroke(((0.5, 0.5),), 0.4, word) for word in ("add", "remove"))
    >>> [float(painted_on_mask(drawn, "add", (9, 9))[0, 0, 4, 4]) for drawn in ([eraser, brush], [brush, eraser])]
    [1.0, 0.0]
    """
    shape = _shape(size, rows)
    planes = torch.zeros(4 if "colour" in word else 1, *shape)
    for stroke in strokes:
        (down, across), covered = _soft_part(stroke, size, rows)
        part = planes[:, down, across]
        part[-1] *= 1 - covered
        if stroke.means(word):
            part[-1] += covered
            if stroke.colour is not None:
                part[:3, covered > 0] = colour_of(stroke.colour).unsqueeze(1)
    return planes[None]


def _shape(size: tuple[int, int], rows: slice | None) -> tuple[int, int]:
    return size if rows is None else (rows.stop - rows.start, size[1])


def colour_of(paint: str) -> Tensor:
    """Parse ``#rrggbb`` to RGB (3,) in [0, 1].

    >>> colour_of("#ff0033")
    tensor([1.0000, 0.0000, 0.2000])
    """
    return torch.tensor([int(paint[i : i + 2], 16) for i in (1, 3, 5)]) / 255


class TensorPainter:
    """Rasterises strokes to tensors; the last few are cached."""

    def __init__(self) -> None:
        self._paint, self._mask = lru_cache(maxsize=1)(paint), lru_cache(maxsize=2)(mask_of)
        self._on_mask = lru_cache(maxsize=2)(painted_on_mask)

    def mask(self, strokes: Sequence[Stroke], size: tuple[int, int], *, above: Sequence[Stroke] = ()) -> Tensor:
        """Return :func:`mask_of` strokes, (1, 1, H, W)."""
        return self._mask(tuple(strokes), size, above=tuple(above))

    def colours(self, strokes: Sequence[Stroke], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Colours (1, 3, H, W) and their mask (1, 1, H, W), see :func:`paint`."""
        return self._paint(tuple(strokes), size)

    def on_mask(self, strokes: Sequence[Stroke], word: str, size: tuple[int, int]) -> Tensor:
        """Return :func:`painted_on_mask`, (1, 1 or 4, H, W)."""
        return self._on_mask(tuple(strokes), word, size)

    def covers(self, marks: Tensor) -> bool:
        """Whether a mask or colours cover a pixel."""
        return bool(marks.any())
