"""How a photograph is developed before the steps of an edit: exposure, white balance, straightening and crop.

A recipe holds it once, beside its steps. The strokes of all steps are stored in coordinates of the original picture,
and :class:`Frame` is the one place that maps them to the developed picture and back. Does not import torch.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from nlfilter_torch.photo.declared.declaration import Edit, Parameter, Slider
from nlfilter_torch.photo.declared.json_values import is_within, shown
from nlfilter_torch.photo.declared.strokes import Mark, Point

Crop = tuple[float, float, float, float]
WHOLE_CROP: Crop = (0.0, 0.0, 1.0, 1.0)
ROUNDING = 1e-9  # pixels, within which an edge is that of a pixel
SAME = 0.01  # pixels, by which the sides of a crop that was moved may differ

#: Declared as an edit is, though it is no step: it comes first, and once.
DEVELOP = Edit(
    "develop",
    """Develop a photograph: exposure and white balance in linear light, then straighten and crop.

    Example: `nlfilter-torch develop in.jpg out.jpg --exposure 0.5 --temperature 0.1 --straighten 1.5`

    Cut a tenth off at the left and at the bottom: `nlfilter-torch develop in.jpg out.jpg --crop 10%,0%,90%,90%`
    """,
    (
        Parameter(
            "exposure",
            "number",
            0.0,
            "Brightness in stops: 1 doubles the light, -1 halves it, 0 leaves it.",
            -5,
            5,
            idle=0.0,
            metavar="STOPS",
            slider=Slider("Exposure", -3, 3, 0.05),
        ),
        Parameter(
            "temperature",
            "number",
            0.0,
            "White balance from blue, -1, to amber, 1: values above 0 make a cold photograph warmer. Grey photographs "
            "stay grey.",
            -1,
            1,
            idle=0.0,
            slider=Slider("Temperature", -1, 1, 0.01),
        ),
        Parameter(
            "tint",
            "number",
            0.0,
            "White balance from green, -1, to magenta, 1: a greenish photograph becomes neutral above 0.",
            -1,
            1,
            idle=0.0,
            slider=Slider("Tint", -1, 1, 0.01),
        ),
        Parameter(
            "straighten",
            "number",
            0.0,
            "Degrees by which the photograph is turned, clockwise above 0, counter-clockwise below. Empty corners are "
            "cut off, and the proportions kept.",
            -45,
            45,
            idle=0.0,
            metavar="DEGREES",
            slider=Slider("Straighten", -15, 15, 0.1),
        ),
        Parameter(
            "crop",
            "sliders",
            WHOLE_CROP,
            "What is kept of the straightened photograph: left, top, right and bottom edge, as shares of its width and "
            "height from 0 to 1. It shrinks about its middle if it has empty corners.",
            0,
            1,
            idle=WHOLE_CROP,
            length=4,
            is_option=False,  # the command takes pixels
        ),
    ),
    hint="Comes before all steps. Strokes stay where they are on the photograph.",
)


def check_value(name: str, value: object, place: str = "") -> None:
    """Raise ValueError unless a value is valid; ``place`` says in the message where it stands."""
    called = f"{name}{place}"
    if name == "crop":
        edges = value if isinstance(value, list | tuple) and len(value) == 4 else ()
        numbers = [edge for edge in edges if is_within(edge, 0, 1)]
        if len(numbers) != 4 or not (numbers[0] < numbers[2] and numbers[1] < numbers[3]):
            raise ValueError(
                f"{called} must be the left, top, right and bottom edge as shares from 0 to 1, left below right and "
                f"top below bottom, got {shown(list(value) if isinstance(value, tuple) else value)}; correct it"
            )
    elif not DEVELOP[name].is_valid(value):
        raise ValueError(f"{called} must be {DEVELOP[name].wanted}, got {shown(value)}; correct it")


@dataclass(frozen=True)
class Development:
    """Exposure, white balance, straightening and crop of a photograph; by default nothing changes.

    Attributes:
        exposure: stops, -5 to 5; 1 doubles the light.
        temperature: -1 (blue) to 1 (amber).
        tint: -1 (green) to 1 (magenta).
        straighten: degrees, -45 to 45, by which the picture is rotated clockwise about its middle.
        crop: left, top, right and bottom edge as shares of the rotated picture, which keeps its size. A crop with empty
            corners is shrunk about its middle until it has none.

    Raises:
        ValueError: if a value is out of range.

    Example:
        >>> Development(straighten=10.0).frame((100, 150)).size
        (80, 120)
    """

    exposure: float = DEVELOP["exposure"].default_number
    temperature: float = DEVELOP["temperature"].default_number
    tint: float = DEVELOP["tint"].default_number
    straighten: float = DEVELOP["straighten"].default_number
    crop: Crop = WHOLE_CROP

    def __post_init__(self) -> None:
        """Check all values, and make them numbers of the declared type."""
        for name, value in vars(self).items():
            check_value(name, value)
            object.__setattr__(self, name, tuple(map(float, value)) if name == "crop" else float(value))

    @property
    def is_idle(self) -> bool:
        """Whether nothing changes."""
        return self == AS_IT_IS

    @property
    def balances(self) -> bool:
        """Whether the white balance changes."""
        return bool(self.temperature or self.tint)

    @property
    def changes_tones(self) -> bool:
        """Whether exposure or white balance change."""
        return bool(self.exposure) or self.balances

    @property
    def geometry(self) -> "Development":
        """Straightening and crop alone."""
        return Development(straighten=self.straighten, crop=self.crop)

    def frame(self, size: tuple[int, int]) -> "Frame":
        """Where the developed picture lies in a picture (H, W).

        Raises:
            ValueError: if the middle of the crop is outside the rotated picture.
        """
        height, width = size
        left, top, right, bottom = self.crop
        if self.straighten == 0:
            first = min(round(left * width), width - 1), min(round(top * height), height - 1)
            last = max(round(right * width), first[0] + 1), max(round(bottom * height), first[1] + 1)
            return Frame(size, 0.0, first[1], first[0], last[1] - first[1], last[0] - first[0])
        angle = math.radians(self.straighten)
        middle = (left + right - 1) / 2 * width, (top + bottom - 1) / 2 * height  # from that of the picture
        half = (right - left) / 2 * width, (bottom - top) / 2 * height
        share = min(1.0, *(_reach(middle, (x * half[0], y * half[1]), angle, size) for x in (-1, 1) for y in (-1, 1)))
        if share <= 0:
            raise ValueError(
                f"crop must have its middle within the photograph turned by {self.straighten:g} degrees, got "
                f"{', '.join(f'{edge:g}' for edge in self.crop)}; move it inwards"
            )
        columns, rows = (_inside(m + n / 2, share * h) for m, n, h in zip(middle, (width, height), half, strict=True))
        if not (columns and rows):
            columns, rows = _thin(columns, rows, middle, angle, size)
        return Frame(size, angle, rows.start, columns.start, len(rows), len(columns))

    def to_json(self, indent: str = "", *, complete: bool = False) -> str:
        """Format it as a JSON object, without defaults unless ``complete``."""
        entries = {n: v for n, v in vars(self).items() if complete or v != getattr(AS_IT_IS, n)}
        lines = ",\n".join(f'{indent}  "{name}": {json.dumps(value)}' for name, value in entries.items())
        return f"{{\n{lines}\n{indent}}}"

    @staticmethod
    def from_entries(entries: object, place: str) -> "Development":
        """Create it from parsed JSON; ``place`` is the file's name in errors.

        Raises:
            ValueError: if an entry is unknown or invalid.
        """
        if not isinstance(entries, Mapping):
            raise ValueError(f"develop in {place} must be an object, got {shown(entries)}; correct it")
        names = [parameter.name for parameter in DEVELOP]
        for name, value in entries.items():
            if name not in names:
                raise ValueError(
                    f"develop in {place} must have no entries other than {', '.join(names)}, got {name}; remove it"
                )
            check_value(name, value, f" of develop in {place}")
        return Development(**entries)


AS_IT_IS = Development()


@dataclass(frozen=True)
class Frame:
    """Where a developed picture lies in its original: a rectangle of the original rotated about its middle.

    Attributes:
        original: (H, W) of the original.
        angle: of the turn, clockwise, in radians.
        top: first row of the rectangle, in pixels.
        left: its first column.
        height: its height.
        width: its width.
    """

    original: tuple[int, int]
    angle: float
    top: int
    left: int
    height: int
    width: int

    @property
    def size(self) -> tuple[int, int]:
        """(h, w) of the developed picture."""
        return self.height, self.width

    @property
    def edges(self) -> Crop:
        """The crop that gives this rectangle.

        >>> Development(crop=(0.52, 0.0, 1.0, 1.0)).frame((10, 20)).edges
        (0.5, 0.0, 1.0, 1.0)
        """
        height, width = self.original
        bottom, right = self.top + self.height, self.left + self.width
        return self.left / width, self.top / height, right / width, bottom / height

    def placed(self, crop: Crop) -> Crop:
        """A crop moved to whole pixels if its size is that of this frame, so that no pixel is lost; others as they are.

        >>> AS_IT_IS.frame((10, 20)).trimmed(1.0).placed((0.13, 0.0, 0.63, 1.0))
        (0.15, 0.0, 0.65, 1.0)
        """
        height, width = self.original
        left, top, right, bottom = crop
        if max(abs((right - left) * width - self.width), abs((bottom - top) * height - self.height)) > SAME:
            return crop
        column = min(round(left * width), width - self.width)
        row = min(round(top * height), height - self.height)
        return replace(self, left=column, top=row).edges

    def trimmed(self, aspect: float) -> "Frame":
        """The largest frame within it, about its middle, whose width is ``aspect`` times its height.

        It is itself if it has that aspect but for the rounding to whole pixels.

        >>> AS_IT_IS.frame((100, 150)).trimmed(1.0).edges
        (0.16666666666666666, 0.0, 0.8333333333333334, 1.0)
        """
        if self.width == round(self.height * aspect) or self.height == round(self.width / aspect):
            return self
        width = min(self.width, max(1, round(self.height * aspect)))
        height = min(self.height, max(1, round(width / aspect)))
        top, left = self.top + (self.height - height) // 2, self.left + (self.width - width) // 2
        return replace(self, top=top, left=left, height=height, width=width)

    @property
    def is_whole(self) -> bool:
        """Whether it is the original itself."""
        return self.angle == 0 and self.size == self.original

    @property
    def scale(self) -> float:
        """What the radius of a brush, a share of the short side, is multiplied by in the developed picture."""
        return min(self.original) / min(self.size)

    def inward(self, x: float, y: float) -> tuple[float, float]:
        """Where a point of the original is in the developed picture, both as shares of width and height.

        >>> Development(crop=(0.5, 0.0, 1.0, 1.0)).frame((10, 20)).inward(0.75, 0.5)
        (0.5, 0.5)
        """
        if self.is_whole:
            return x, y
        height, width = self.original
        column, row = rotated((x - 0.5) * width, (y - 0.5) * height, self.angle)
        return (column + width / 2 - self.left) / self.width, (row + height / 2 - self.top) / self.height

    def outward(self, x: float, y: float) -> tuple[float, float]:
        """Where a point of the developed picture is in the original, the inverse of :meth:`inward`."""
        if self.is_whole:
            return x, y
        height, width = self.original
        column, row = self.left + x * self.width - width / 2, self.top + y * self.height - height / 2
        column, row = rotated(column, row, -self.angle)
        return column / width + 0.5, row / height + 0.5

    def mark_inward(self, mark: Mark) -> Mark:
        """A mark in coordinates of the original, in those of the developed picture."""
        return mark.mapped(self.inward, self.scale)

    def mark_outward(self, mark: Mark) -> Mark:
        """A mark in coordinates of the developed picture, in those of the original."""
        return mark.mapped(self.outward, 1 / self.scale)


def rotated(x: float, y: float, angle: float) -> tuple[float, float]:
    """A point, y downwards, rotated clockwise about the origin by an angle in radians."""
    return x * math.cos(angle) - y * math.sin(angle), x * math.sin(angle) + y * math.cos(angle)


def _reach(middle: tuple[float, float], corner: tuple[float, float], angle: float, size: tuple[int, int]) -> float:
    """The share of the way from the middle of a crop to its corner that is within the rotated picture (H, W).

    Both are (x, y), ``middle`` from that of the picture and ``corner`` from that of the crop. Not positive if the
    middle is outside.
    """
    starts, ways = rotated(*middle, -angle), rotated(*corner, -angle)
    shares = []
    for start, way, length in zip(starts, ways, (size[1], size[0]), strict=True):
        room = length / 2 - (start if way > 0 else -start)
        shares.append(room / abs(way) if way else math.copysign(math.inf, length / 2 - abs(start)))
    return min(shares)


def _inside(middle: float, half: float) -> range:
    """The whole pixels between the ends of an interval."""
    return range(math.ceil(middle - half - ROUNDING), math.floor(middle + half + ROUNDING))


def _thin(columns: range, rows: range, middle: Point, angle: float, size: tuple[int, int]) -> tuple[range, range]:
    """Columns and rows of a crop that holds no whole pixel on one axis or on both, but has one there.

    It has no empty corners, or is a single pixel whose centre is within the rotated picture (H, W). ``middle`` is that
    of the crop, from that of the picture.
    """
    height, width = size
    x, y = middle
    if rows:
        column = math.floor(x + width / 2)
        rows = _kept(rows, column - width / 2, height, ((1, 0), (0, 1)), angle, size)
        if rows:
            return range(column, column + 1), rows
    elif columns:
        row = math.floor(y + height / 2)
        columns = _kept(columns, row - height / 2, width, ((0, 1), (1, 0)), angle, size)
        if columns:
            return columns, range(row, row + 1)
    steps = math.ceil(2 * math.hypot(x, y)) + 1
    for step in range(steps + 1):  # to the middle of the picture, around which all pixels are within
        share = 1 - step / steps
        column, row = math.floor(share * x + width / 2), math.floor(share * y + height / 2)
        across, down = rotated(column + 0.5 - width / 2, row + 0.5 - height / 2, -angle)
        if abs(across) < width / 2 - ROUNDING and abs(down) < height / 2 - ROUNDING:
            break
    return range(column, column + 1), range(row, row + 1)


def _kept(
    pixels: range, first: float, length: int, axes: tuple[Point, Point], angle: float, size: tuple[int, int]
) -> range:
    """The pixels of a line, one pixel wide and ``first`` its border, that are within the rotated picture (H, W).

    ``axes`` are the direction across the line and that along it, ``length`` that of the picture along it.
    """
    across, along = (rotated(*axis, -angle) for axis in axes)
    low, high = -math.inf, math.inf
    for border in (first, first + 1):
        for a, b, side in zip(across, along, size[::-1], strict=True):
            ends = sorted((sign * side / 2 - a * border) / b for sign in (-1, 1))
            low, high = max(low, ends[0]), min(high, ends[1])
    start = max(pixels.start, math.ceil(low + length / 2 + ROUNDING)) if low < length else pixels.stop
    stop = min(pixels.stop, math.floor(high + length / 2 - ROUNDING)) if high > -length else pixels.start
    return range(start, max(start, stop))
