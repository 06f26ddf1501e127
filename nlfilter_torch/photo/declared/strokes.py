"""Brush strokes as lines with a width.

Coordinates are relative to the picture, so that strokes cover the same part of a preview and of the photograph. Does
not import torch.
"""

import math
import re
import reprlib
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeGuard

from nlfilter_torch.photo.declared.json_values import is_within, shown

COLOUR = "#[0-9a-f]{6}"
MIN_RADIUS = 0.75  # minimum radius in pixels, at which a dot always covers a pixel
TO_CENTRE = 0.71  # pixels from any point of a picture to the nearest centre of a pixel, at most
Point = tuple[float, float]


@dataclass(frozen=True)
class Stroke:
    """A line drawn with a round brush.

    Attributes:
        points: at least one (x, y), as shares of the picture's width and height.
        radius: radius of the brush, as a share of the picture's short side.
        paint: meaning of the stroke: a word that the edit declares, with a colour ``#rrggbb`` in place of ``colour``.
    """

    points: tuple[tuple[float, float], ...]
    radius: float
    paint: str

    def means(self, word: str) -> bool:
        """Whether the stroke has the meaning of a word, in which ``colour`` stands for any colour.

        >>> Stroke(((0.5, 0.5),), 0.1, "add #2040e0").means("add colour")
        True
        """
        pattern = re.escape(word).replace("colour", COLOUR)
        return re.fullmatch(pattern, self.paint, re.IGNORECASE) is not None

    @property
    def colour(self) -> str | None:
        """The colour ``#rrggbb`` in its meaning, or None."""
        at = self.paint.find("#")
        return None if at < 0 else self.paint[at:]

    def entries(self) -> dict[str, object]:
        """Return the stroke as a JSON object."""
        return {"paint": self.paint, "radius": self.radius, "points": [list(point) for point in self.points]}

    @staticmethod
    def from_entries(value: object, words: tuple[str, ...], place: str) -> "Stroke":
        """Create a stroke from a JSON value; ``words`` are the allowed paints, see :meth:`means`.

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
        lines = tuple((float(x), float(y)) for x, y in points)
        stroke = Stroke(lines, float(radius), paint) if isinstance(paint, str) else None
        if stroke is None or not any(map(stroke.means, words)):
            wanted = ", ".join(map(_described, words))
            raise ValueError(
                f"paint of a stroke in {place} must be one of {wanted}, got {reprlib.repr(paint)}; correct it"
            )
        return stroke


def radius_in_pixels(stroke: Stroke, size: tuple[int, int]) -> float:
    """The radius of a stroke on a picture (H, W)."""
    return max(stroke.radius * min(size), MIN_RADIUS)


def reaches(stroke: Stroke, size: tuple[int, int]) -> bool:
    """Whether a stroke is sure to cover a pixel of a picture (H, W); one that grazes its border from outside is not.

    >>> [reaches(Stroke(((x, 0.5),), 0.1, "in"), (100, 100)) for x in (-0.05, -0.15)]
    [True, False]
    """
    height, width = size
    reach = radius_in_pixels(stroke, size) - TO_CENTRE
    points = [(x * width, y * height) for x, y in stroke.points]
    lines = pairwise(points if len(points) > 1 else points * 2)
    return any(_crosses(*line, (width, height)) or _is_near(*line, (width, height), reach) for line in lines)


def _is_near(start: Point, end: Point, corner: Point, reach: float) -> bool:
    """Whether a line outside a picture comes within ``reach`` of the rectangle of its pixels' centres."""
    sides = [(0.5, most - 0.5) for most in corner]
    nearest = [
        math.dist(point, [min(max(v, low), high) for v, (low, high) in zip(point, sides, strict=True)])
        for point in (start, end)
    ]
    corners = [(x, y) for x in sides[0] for y in sides[1]]
    return min(*nearest, *(_distance(point, start, end) for point in corners)) <= reach


def _crosses(start: Point, end: Point, corner: Point) -> bool:
    """Whether a line meets a picture, whose last corner is given."""
    first, last = 0.0, 1.0  # shares of the line between which it is within
    for a, b, most in zip(start, end, corner, strict=True):
        if a == b:
            if not 0 <= a <= most:
                return False
            continue
        there = sorted((-a / (b - a), (most - a) / (b - a)))
        first, last = max(first, there[0]), min(last, there[1])
    return first <= last


def _distance(point: Point, start: Point, end: Point) -> float:
    """The distance of a point from a line."""
    (x, y), (dx, dy) = (point[0] - start[0], point[1] - start[1]), (end[0] - start[0], end[1] - start[1])
    along = min(max((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12), 0), 1)
    return math.hypot(x - along * dx, y - along * dy)


def _described(word: str) -> str:
    """A meaning of strokes, for errors."""
    before, colour, _ = word.partition("colour")
    return f"{before}{'with ' if before else ''}a colour such as {before}#c04020" if colour else word


def _is_point(value: object) -> TypeGuard[list[float]]:
    return isinstance(value, list) and len(value) == 2 and all(is_within(v, -2, 2) for v in value)


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
