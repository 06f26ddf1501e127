"""Brush strokes as lines with a width, and their rasterisation.

Coordinates are relative to the picture, so that strokes cover the same part of a preview and of the photograph.
"""

import re
import reprlib
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.edits.declaration import is_within, shown

COLOUR = re.compile(r"#[0-9a-f]{6}", re.IGNORECASE)
MIN_RADIUS = 0.75  # minimum radius in pixels, at which a dot always covers a pixel


@dataclass(frozen=True)
class Stroke:
    """A line drawn with a round brush.

    Attributes:
        points: at least one (x, y), as shares of the picture's width and height.
        radius: radius of the brush, as a share of the picture's short side.
        paint: meaning of the stroke: a colour ``#rrggbb``, or a word that the edit declares.
    """

    points: tuple[tuple[float, float], ...]
    radius: float
    paint: str

    def entries(self) -> dict[str, Any]:
        """Return the stroke as a JSON object."""
        return {"paint": self.paint, "radius": self.radius, "points": [list(point) for point in self.points]}

    @staticmethod
    def from_entries(value: Any, words: tuple[str, ...], place: str) -> "Stroke":
        """Create a stroke from a JSON value; ``words`` are the allowed paints, of which ``colour`` allows any colour.

        Raises:
            ValueError: if ``value`` is no stroke; ``place`` says in the message where it was found.
        """
        if not isinstance(value, dict) or set(value) != {"points", "radius", "paint"}:
            raise ValueError(
                f"strokes of {place} must have the entries points, radius and paint, got {shown(value)}; correct it"
            )
        points, radius, paint = value["points"], value["radius"], value["paint"]
        if not (isinstance(points, list) and points and all(map(_is_point, points))):
            raise ValueError(
                f"points of a stroke in {place} must be pairs of numbers, shares of width and height from -2 to 2, got "
                f"{shown(points)}; correct them"
            )
        if not (is_within(radius, 0, 1) and radius > 0):
            raise ValueError(f"radius of a stroke in {place} must be in (0, 1], got {shown(radius)}; correct it")
        is_colour = "colour" in words and isinstance(paint, str) and COLOUR.fullmatch(paint)
        if not is_colour and (paint not in words or paint == "colour"):
            wanted = ", ".join("a colour such as #c04020" if word == "colour" else word for word in words)
            raise ValueError(
                f"paint of a stroke in {place} must be one of {wanted}, got {reprlib.repr(paint)}; correct it"
            )
        return Stroke(tuple((float(x), float(y)) for x, y in points), float(radius), paint)


def _is_point(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(is_within(v, -2, 2) for v in value)


def cover(stroke: Stroke, size: tuple[int, int], rows: slice | None = None) -> Tensor:
    """Rasterise a stroke: the pixels that it covers, (H, W) bool, or (h, W) for ``rows`` of a picture of that size.

    >>> cover(Stroke(((0.5, 0.5),), 0.1, "in"), (5, 5)).int()
    tensor([[0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 1, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0]], dtype=torch.int32)
    """
    height, width = size
    radius = max(stroke.radius * min(size), MIN_RADIUS)
    first = 0 if rows is None else rows.start
    covered = torch.zeros(_shape(size, rows), dtype=torch.bool)
    # The origin is the centre of the first pixel.
    points = [(x * width - 0.5, y * height - 0.5) for x, y in stroke.points]
    for (x0, y0), (x1, y1) in pairwise(points if len(points) > 1 else points * 2):
        top, bottom = _span(y0, y1, radius, first, first + len(covered))
        left, right = _span(x0, x1, radius, 0, width)
        if top >= bottom or left >= right:
            continue
        y = torch.arange(top, bottom, dtype=torch.float32).unsqueeze(1) - y0
        x = torch.arange(left, right, dtype=torch.float32) - x0
        dx, dy = x1 - x0, y1 - y0
        along = ((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12)).clamp(0, 1)  # nearest point of the line
        near = (x - along * dx).square() + (y - along * dy).square() <= radius * radius
        covered[top - first : bottom - first, left:right] |= near
    return covered


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
    for covered, some in ((visible, strokes), (hidden, above)):
        for stroke in some:
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


def _shape(size: tuple[int, int], rows: slice | None) -> tuple[int, int]:
    return size if rows is None else (rows.stop - rows.start, size[1])


def colour_of(paint: str) -> Tensor:
    """Parse ``#rrggbb`` to RGB (3,) in [0, 1].

    >>> colour_of("#ff0033")
    tensor([1.0000, 0.0000, 0.2000])
    """
    return torch.tensor([int(paint[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def thin(points: Iterable[tuple[float, float]], spacing: float) -> tuple[tuple[float, float], ...]:
    """Drop points that are closer than ``spacing`` to the previous point kept; the last is always kept.

    >>> thin([(0.0, 0.0), (0.01, 0.0), (0.1, 0.0), (0.11, 0.0)], 0.05)
    ((0.0, 0.0), (0.1, 0.0), (0.11, 0.0))
    """
    kept: list[tuple[float, float]] = []
    last = None
    for point in points:
        last = (round(point[0], 4), round(point[1], 4))
        if not kept or max(abs(last[0] - kept[-1][0]), abs(last[1] - kept[-1][1])) >= spacing:
            kept.append(last)
    if last is not None and kept[-1] != last:
        kept.append(last)
    return tuple(kept)
