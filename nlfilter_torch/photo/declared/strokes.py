"""Marks on a picture: brush strokes, and regions such as rectangles; the paint of a mark says what it means.

Text of the command line, entries of files and strokes drawn on the page all become these. Coordinates are relative to
the picture, so that a mark covers the same part of a preview and of the photograph. Does not import torch.
"""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal, NamedTuple, TypeGuard, cast, get_args

from nlfilter_torch.photo.declared.json_values import is_within, shown

ScribbleRole = Literal["object", "background", "added", "removed", "box"]
#: The word for each role in the paint of a mark, the same for all edits.
WORDS: dict[ScribbleRole, str] = {
    "object": "in",
    "background": "out",
    "added": "add",
    "removed": "remove",
    "box": "box",
}
NOTED: tuple[ScribbleRole, ...] = ("object", "added", "box")  # roles whose marks may say a colour or sliders

COLOUR = re.compile("#[0-9a-f]{6}", re.IGNORECASE)
MIN_RADIUS = 0.75  # minimum radius in pixels, at which a dot always covers a pixel
TO_CENTRE = 0.71  # pixels from any point of a picture to the nearest centre of a pixel, at most: half of a diagonal
ELLIPSE_SIDES = 64  # of the polygon that stands for an ellipse where only its extent matters
Point = tuple[float, float]
#: What a region is: all of a parallelogram, the ellipse in it, a polygon, the white parts of a picture in a file
#: (``"mask"``), or the opaque ones, with their colours (``"layer"``); or a gradient, whose weights fall smoothly from 1
#: to 0: from one line to a parallel one (``"linear"``), or in an ellipse from halfway to its border (``"radial"``).
Shape = Literal["rectangle", "ellipse", "polygon", "mask", "layer", "linear", "radial"]
SOFTNESS = 0.5  # share of the radius of a radial gradient along which it falls from 1 to 0


class Meaning(NamedTuple):
    """What a paint says: the role of a mark, and what its object becomes, if it says so: a colour or sliders."""

    role: ScribbleRole
    colour: str | None = None
    sliders: tuple[float, ...] | None = None


@lru_cache(maxsize=1024)
def meaning_of(paint: str) -> Meaning | None:
    """The meaning of a paint, or None if it has none.

    It is one of the words in, out, add, remove and box; after in, add and box, a colour or sliders may follow. A colour
    alone stands for an object of that colour.

    >>> meaning_of("add #2040e0"), meaning_of("in 3,2,1").sliders, meaning_of("blue")
    (Meaning(role='added', colour='#2040e0', sliders=None), (3.0, 2.0, 1.0), None)
    """
    if COLOUR.fullmatch(paint):
        return Meaning("object", paint)
    word, space, note = paint.partition(" ")
    role = next((role for role, name in WORDS.items() if name == word.lower()), None)
    if role is None or not space:
        return None if role is None else Meaning(role)
    if role not in NOTED:
        return None
    if COLOUR.fullmatch(note):
        return Meaning(role, note)
    try:
        sliders = tuple(map(float, note.split(",")))
    except ValueError:
        return None
    return Meaning(role, None, sliders) if len(sliders) > 1 and all(map(math.isfinite, sliders)) else None


class Marking:
    """What the paint of a mark says."""

    paint: str

    @property
    def meaning(self) -> Meaning:
        """The meaning of its paint, see :func:`meaning_of`.

        Raises:
            ValueError: if it has none.
        """
        meaning = meaning_of(self.paint)
        if meaning is None:
            raise ValueError(
                f"paint of a mark must be {', '.join(WORDS.values())} or a colour, got {self.paint!r}; correct it"
            )
        return meaning

    @property
    def role(self) -> ScribbleRole:
        """What is marked: an object, its background, an addition to its mask, what is removed from it, or a box."""
        return self.meaning.role

    @property
    def colour(self) -> str | None:
        """The colour ``#rrggbb`` in its meaning, or None."""
        return self.meaning.colour


@dataclass(frozen=True)
class Stroke(Marking):
    """A line drawn with a round brush.

    Attributes:
        points: at least one (x, y), as shares of the picture's width and height.
        radius: radius of the brush, as a share of the picture's short side.
        paint: its meaning: in, out, add or remove; after in and add, a colour or sliders may follow.

    Example:
        >>> [Stroke(((x, 0.5),), 0.1, "in").reaches((100, 100)) for x in (-0.05, -0.15)]
        [True, False]
    """

    points: tuple[Point, ...]
    radius: float
    paint: str

    def entries(self) -> dict[str, object]:
        """Return the stroke as a JSON object."""
        return {"paint": self.paint, "radius": self.radius, "points": [list(point) for point in self.points]}

    def mapped(self, place: Callable[[float, float], Point], scale: float) -> "Stroke":
        """The stroke where each of its points is at another place, with its radius multiplied by a scale."""
        return replace(self, points=tuple(place(*point) for point in self.points), radius=self.radius * scale)

    def pixels(self, size: tuple[int, int]) -> float:
        """The radius on a picture (H, W)."""
        return max(self.radius * min(size), MIN_RADIUS)

    def reaches(self, size: tuple[int, int]) -> bool:
        """Whether it is sure to cover a pixel of a picture (H, W)."""
        height, width = size
        reach = self.pixels(size) - TO_CENTRE
        points = [(x * width, y * height) for x, y in self.points]
        lines = pairwise(points if len(points) > 1 else points * 2)
        return any(_crosses(*line, (width, height)) or _is_near(*line, (width, height), reach) for line in lines)


@dataclass(frozen=True)
class Region(Marking):
    """A part of a picture with sharp borders, or the part that a picture in a file marks.

    Attributes:
        points: corners of a polygon; for a linear gradient, the points on its axis where it is 1 and where it is 0; for
            other shapes those at the upper left, the upper right and the lower left of the parallelogram that they
            fill.
        shape: what it is.
        paint: its meaning: in, out, add, remove or box; after in, add and box, a colour or sliders may follow.
        file: path of the picture in a file.
        softness: of a radial gradient: share of its radius along which it falls to 0; 1 falls from the middle.
    """

    points: tuple[Point, ...]
    shape: Shape
    paint: str
    file: str = ""
    softness: float = SOFTNESS

    @staticmethod
    def upright(box: Sequence[float], shape: Shape, paint: str, file: str = "") -> "Region":
        """A region that fills a rectangle: its left and upper edge, width and height, as shares of the picture's.

        >>> Region.upright((0.25, 0.5, 0.5, 0.25), "rectangle", "in").entries()
        {'paint': 'in', 'rectangle': [0.25, 0.5, 0.5, 0.25]}
        """
        left, top, width, height = box
        return Region(((left, top), (left + width, top), (left, top + height)), shape, paint, file)

    @staticmethod
    def dragged(start: Point, end: Point, shape: Shape, paint: str) -> "Region":
        """The region that is drawn by dragging from a point to another: the ends of a linear gradient, or corners."""
        if shape == "linear":
            return Region((start, end), shape, paint)
        (left, right), (top, bottom) = (sorted(places) for places in zip(start, end, strict=True))
        return Region.upright((left, top, right - left, bottom - top), shape, paint)

    @staticmethod
    def of_file(path: str, shape: Shape, paint: str) -> "Region":
        """The region that a picture of the photograph marks."""
        return Region.upright((0.0, 0.0, 1.0, 1.0), shape, paint, path)

    @property
    def outline(self) -> tuple[Point, ...]:
        """Corners of a polygon that has about its extent."""
        if self.shape in ("polygon", "linear"):
            return self.points
        origin, right, lower = self.points
        across, down = ((corner[0] - origin[0], corner[1] - origin[1]) for corner in (right, lower))
        places = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        if self.shape in ("ellipse", "radial"):
            angles = [2 * math.pi * k / ELLIPSE_SIDES for k in range(ELLIPSE_SIDES)]
            places = [((1 + math.cos(angle)) / 2, (1 + math.sin(angle)) / 2) for angle in angles]
        return tuple(
            (origin[0] + u * across[0] + v * down[0], origin[1] + u * across[1] + v * down[1]) for u, v in places
        )

    def entries(self) -> dict[str, object]:
        """Return the region as a JSON object."""
        if self.file:
            return {"paint": self.paint, self.shape: self.file}
        places: list[object] = [list(point) for point in self.points]
        if self.shape not in ("polygon", "linear"):
            (left, top), (right, upper), (first, bottom) = self.points
            if (upper, first) == (top, left):
                # Of decimal numbers, the difference is rounded; the shortest number that gives the same edge is meant.
                places = [left, top, *(_length(start, end) for start, end in ((left, right), (top, bottom)))]
        softness = {"softness": self.softness} if self.shape == "radial" and self.softness != SOFTNESS else {}
        return {"paint": self.paint, self.shape: places, **softness}

    def mapped(self, place: Callable[[float, float], Point], scale: float) -> "Region":
        """The region where each of its points is at another place; lengths follow."""
        return replace(self, points=tuple(place(*point) for point in self.points))

    def reaches(self, size: tuple[int, int]) -> bool:
        """Whether its outline meets or holds the centres of pixels of a picture (H, W)."""
        height, width = size
        if self.shape == "linear":
            (x0, y0), (x1, y1) = ((x * width, y * height) for x, y in self.points)
            corners = [(x, y) for x in (0.5, width - 0.5) for y in (0.5, height - 0.5)]
            return any((x - x1) * (x0 - x1) + (y - y1) * (y0 - y1) > 0 for x, y in corners)
        corners = [(x * width - 0.5, y * height - 0.5) for x, y in self.outline]
        sides = list(pairwise([*corners, corners[0]]))
        return any(_crosses(*side, (width - 1, height - 1)) for side in sides) or _holds(sides, (0.0, 0.0))

    def text(self, size: tuple[int, int]) -> str:
        """``X,Y,W,H`` in pixels of a picture (H, W), or the corners of a polygon or the ends of a linear gradient."""
        lengths = size[1], size[0]
        corners = [tuple(round(share * length) for share, length in zip(p, lengths, strict=True)) for p in self.points]
        if self.shape in ("polygon", "linear"):
            return ",".join(f"{x},{y}" for x, y in corners)
        (left, top), (right, _), (_, bottom) = corners
        return f"{'ellipse:' if self.shape == 'ellipse' else ''}{left},{top},{right - left},{bottom - top}"


#: What is drawn on a picture.
Mark = Stroke | Region


def noted(mark: Mark, note: str) -> Mark:
    """A mark whose role is one of :data:`NOTED`, with a colour or sliders in its meaning."""
    return replace(mark, paint=f"{WORDS[mark.role]} {note}")


def _length(start: float, end: float) -> float:
    """The shortest decimal number that, added to a start, gives an end."""
    exact = end - start
    return next((n for n in (round(exact, digits) for digits in range(1, 17)) if start + n == end), exact)


def sliders_of(marks: Sequence[Mark], inside: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    """The sliders of each region that marks make up: those of the marks, or ``inside`` where they say none.

    A box that says none makes up a region only where no other mark does; it belongs to all of them.
    """
    own = [mark.meaning.sliders or inside for role in ("object", "added") for mark in marks if mark.role == role]
    boxes = [mark.meaning.sliders for mark in marks if mark.role == "box"]
    own += [sliders for sliders in boxes if sliders is not None]
    return tuple(dict.fromkeys(own or [inside] * len(boxes)))


def is_rectangle(mark: Mark) -> TypeGuard[Region]:
    """Whether a mark is a rectangle, which may be turned, as the paint of a box requires."""
    return isinstance(mark, Region) and mark.shape == "rectangle"


def box_in(mark: Region, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Left, top, right and bottom edge, in pixels of a picture (H, W), of the upright rectangle around a region.

    It is limited to the picture, in which it is at least a pixel wide and high.

    Raises:
        ValueError: if it lies outside the picture.

    >>> box_in(Region.upright((0.25, 0.5, 0.5, 0.75), "rectangle", "box"), (40, 80))
    (20.0, 20.0, 60.0, 40.0)
    """
    edges = []
    for axis, length in enumerate((size[1], size[0])):
        places = [point[axis] * length for point in mark.outline]
        if min(places) >= length or max(places) <= 0:
            raise ValueError(f"a box must meet the photograph, got one outside it, {mark.text(size)}; move it")
        first, last = max(min(places), 0.0), min(max(places), float(length))
        first = min(first - max(1 - (last - first), 0.0) / 2, length - 1.0)
        edges.append((max(first, 0.0), max(last, max(first, 0.0) + 1)))
    (left, right), (top, bottom) = edges
    return left, top, right, bottom


def mark_of(value: object, place: str) -> Mark:
    """Create a mark, whose paint may have no meaning yet, from a JSON value.

    Raises:
        ValueError: if ``value`` is no stroke or region; ``place`` says in the message where it was found.
    """
    entries = value if isinstance(value, dict) else {}
    shapes = [shape for shape in get_args(Shape) if shape in entries]
    further = {"softness"} if shapes == ["radial"] else set[str]()
    if set(entries) != {"points", "radius", "paint"} and (
        len(shapes) != 1 or set(entries) - further != {"paint", shapes[0]}
    ):
        raise ValueError(
            f"strokes of {place} must have the entries points, radius and paint, or paint and one of "
            f"{', '.join(get_args(Shape))}, got {shown(value)}; correct it"
        )
    return _region_of(entries, shapes[0], place) if shapes else _stroke_of(entries, place)


def is_gradient(mark: Mark) -> bool:
    """Whether a mark is a gradient, which is painted on a mask, but marks no object."""
    return isinstance(mark, Region) and mark.shape in ("linear", "radial")


def is_layer(mark: Mark) -> bool:
    """Whether a mark is a picture, which has colours of its own."""
    return isinstance(mark, Region) and mark.shape == "layer"


def _stroke_of(entries: dict[str, object], place: str) -> Stroke:
    """Create a stroke from its entries, whose paint may have no meaning yet."""
    points, radius = entries["points"], entries["radius"]
    if not (isinstance(points, list) and points and all(map(_is_point, points))):
        raise ValueError(
            f"points of a stroke in {place} must be pairs of numbers, shares of width and height from -2 to 2, got "
            f"{shown(points)}; correct them"
        )
    if not (is_within(radius, 0, 1) and radius > 0):
        raise ValueError(f"radius of a stroke in {place} must be in (0, 1], got {shown(radius)}; correct it")
    return Stroke(tuple((float(x), float(y)) for x, y in points), float(radius), cast(str, entries["paint"]))


def _region_of(entries: dict[str, object], shape: Shape, place: str) -> Region:
    """Create a region from its entries, whose paint may have no meaning yet."""
    value, paint = entries[shape], cast(str, entries["paint"])
    if shape in ("mask", "layer"):
        if not isinstance(value, str) or not value:
            raise ValueError(f"{shape} of a stroke in {place} must be the path of a file, got {shown(value)}; name one")
        return Region.of_file(value, shape, paint)
    softness = entries.get("softness", SOFTNESS)
    if not (is_within(softness, 0, 1) and softness > 0):
        raise ValueError(f"softness of a stroke in {place} must be in (0, 1], got {shown(softness)}; correct it")
    points = value if isinstance(value, list) else []
    if shape not in ("polygon", "linear") and len(points) == 4 and all(is_within(v, -2, 2) for v in points):
        box = [float(number) for number in points]
        if min(box[2:]) > 0:
            return replace(Region.upright(box, shape, paint), softness=float(softness))
    least, most, wanted = {
        "polygon": (3, math.inf, "three or more corners"),
        "linear": (2, 2, "two different points, where it is 1 and where it is 0"),
    }.get(shape, (3, 3, "left and upper edge, width and height"))
    valid = least <= len(points) <= most and all(map(_is_point, points))
    if not valid or (shape == "linear" and points[0] == points[1]):
        raise ValueError(
            f"{shape} of a stroke in {place} must be {wanted}, in shares of width and height from -2 to 2, got "
            f"{shown(value)}; correct it"
        )
    return Region(tuple((float(x), float(y)) for x, y in points), shape, paint, softness=float(softness))


def _holds(sides: Sequence[tuple[Point, Point]], point: Point) -> bool:
    """Whether a polygon holds a point: a ray from there meets an odd number of its sides."""
    x, y = point
    crossed = [x < a + (y - b) * (c - a) / (d - b) for (a, b), (c, d) in sides if (b > y) != (d > y)]
    return sum(crossed) % 2 == 1


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
