"""How a photograph is developed before the steps of an edit: light, white balance, colours, turning and crop.

A recipe holds it once, beside its steps. The strokes of all steps are stored in coordinates of the original picture,
and :class:`Frame` is the one place that maps them to the developed picture and back. Does not import torch.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from nlfilter_torch.photo.declared.declaration import Edit, Parameter, Slider
from nlfilter_torch.photo.declared.json_values import is_within, shown
from nlfilter_torch.photo.declared.strokes import Mark, Point

if TYPE_CHECKING:
    from torch import Tensor

Crop = tuple[float, float, float, float]
WHOLE_CROP: Crop = (0.0, 0.0, 1.0, 1.0)
ROUNDING = 1e-9  # pixels, within which an edge is that of a pixel
SAME = 0.01  # pixels, by which the sides of a crop that was moved may differ

TURNS = (0, 90, 180, 270)  # degrees
EVEN_CURVE: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)  # the curve that changes nothing
NEUTRAL = 6500.0  # kelvin of the light for which a file is balanced
AUTO_BALANCE = "auto"


def _amount(name: str, help: str) -> Parameter:
    """A number from -1 to 1 that changes nothing at 0."""
    slider = Slider(name.capitalize(), -1, 1, 0.01)
    return Parameter(name, "number", 0.0, help, -1, 1, domain="signed share", idle=0.0, slider=slider, per_image=True)


#: How light, white balance, tones and colours change, of all of a photograph or of a part of it.
LIGHT_PARAMETERS = (
    Parameter(
        "exposure",
        "number",
        0.0,
        "Brightness in stops: 1 doubles the light, -1 halves it, 0 leaves it.",
        -5,
        5,
        domain="stops",
        idle=0.0,
        per_image=True,
        metavar="STOPS",
        slider=Slider("Exposure", -3, 3, 0.05),
    ),
    _amount("contrast", "Difference of light and dark, by a curve about middle grey: 1 is strong, -1 is flat."),
    _amount(
        "highlights",
        "Brightness of light areas, from -1 to 1: below 0 skies get darker. Detail and edges stay as they are.",
    ),
    _amount(
        "shadows",
        "Brightness of dark areas, from -1 to 1: above 0 they get lighter. Detail and edges stay as they are.",
    ),
    _amount("whites", "Brightness of the lightest tones, up to white: above 0 more become white."),
    _amount("blacks", "Brightness of the darkest tones, down to black: below 0 more become black."),
    Parameter(
        "temperature",
        "number",
        None,
        "White balance in kelvin, the colour temperature of the light that the photograph was taken in: below 6500 "
        "it becomes bluer, above it more amber. auto estimates the light. Default: as it is.",
        2000,
        15000,
        optional=True,
        idle=None,
        words=(AUTO_BALANCE,),
        metavar="KELVIN",
        slider=Slider("Temperature", 2000, 12000, 50, none=NEUTRAL),
    ),
    _amount(
        "warmth",
        "White balance from blue, -1, to amber, 1, added to temperature: values above 0 make a cold photograph "
        "warmer. Grey photographs stay grey.",
    ),
    _amount("tint", "White balance from green, -1, to magenta, 1: a greenish photograph becomes neutral above 0."),
    _amount("vibrance", "Strength of pale colours, from -1 to 1; strong colours change little."),
    _amount("saturation", "Strength of all colours: -1 is grey, 1 is twice as strong. Brightness stays."),
    Parameter(
        "curve",
        "sliders",
        EVEN_CURVE,
        "Tone curve: the brightness that evenly spaced tones from black to white become, each from 0 to 1, such as "
        "0,0.2,0.5,0.8,1.",
        0,
        1,
        idle=EVEN_CURVE,
    ),
)
#: Declared as an edit is, though it is no step: it comes first, and once.
DEVELOP = Edit(
    "develop",
    """Develop a photograph: turn and crop it, and set its light, white balance and colours.

    Example: `nlfilter-torch develop in.jpg out.jpg --exposure 0.5 --highlights -0.6 --shadows 0.4 --straighten 1.5`

    By lamplight: `nlfilter-torch develop in.jpg out.jpg --temperature 4000`, or `--temperature auto`

    Cut a tenth off at the left and at the bottom: `nlfilter-torch develop in.jpg out.jpg --crop 10%,0%,90%,90%`

    A part of a photograph: `nlfilter-torch light --help`
    """,
    (
        *LIGHT_PARAMETERS,
        Parameter(
            "rotate",
            "count",
            0,
            "Degrees by which the photograph is turned clockwise: 90, 180 or 270.",
            0,
            270,
            idle=0,
            metavar="DEGREES",
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
            "What is kept of the turned photograph: left, top, right and bottom edge, as shares of its width and "
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
    elif name == "rotate" and (isinstance(value, bool) or value not in TURNS):
        raise ValueError(f"{called} must be 0, 90, 180 or 270 degrees, got {shown(value)}; see straighten for others")
    elif not DEVELOP[name].is_valid(value) or (
        isinstance(value, list | tuple) and not all(is_within(number, 0, 1) for number in value)
    ):
        raise ValueError(f"{called} must be {DEVELOP[name].wanted}, got {shown(value)}; correct it")


@dataclass(frozen=True, kw_only=True)
class LightValues:
    """Light, white balance, tones and colours: numbers, or tensors that broadcast with a picture (B, C, H, W).

    Highlights and shadows come first, on the light that the photograph has; then exposure and white balance, the tones
    from blacks to curve, and the colours. A tensor counts as a value that changes something.

    Attributes:
        exposure: stops, -5 to 5; 1 doubles the light.
        warmth: white balance, -1 (blue) to 1 (amber).
        tint: -1 (green) to 1 (magenta).
        temperature: kelvin of the light that the photograph was taken in, 2000 to 15000; None is 6500, which changes
            nothing, and ``"auto"`` estimates the light from the picture.
        contrast: -1 to 1, of all tones about middle grey.
        highlights: -1 to 1, of areas that are light, without changing their detail.
        shadows: -1 to 1, of areas that are dark.
        whites: -1 to 1, of the lightest tones.
        blacks: -1 to 1, of the darkest tones.
        curve: what 2 to 100 evenly spaced tones from 0 to 1 become, from 0 to 1.
        vibrance: -1 to 1, of pale colours.
        saturation: -1 (grey) to 1 (twice), of all colours.
    """

    exposure: "float | Tensor" = DEVELOP.defaults["exposure"]
    warmth: "float | Tensor" = DEVELOP.defaults["warmth"]
    tint: "float | Tensor" = DEVELOP.defaults["tint"]
    temperature: float | str | None = None
    contrast: "float | Tensor" = DEVELOP.defaults["contrast"]
    highlights: "float | Tensor" = DEVELOP.defaults["highlights"]
    shadows: "float | Tensor" = DEVELOP.defaults["shadows"]
    whites: "float | Tensor" = DEVELOP.defaults["whites"]
    blacks: "float | Tensor" = DEVELOP.defaults["blacks"]
    curve: tuple[float, ...] = EVEN_CURVE
    vibrance: "float | Tensor" = DEVELOP.defaults["vibrance"]
    saturation: "float | Tensor" = DEVELOP.defaults["saturation"]

    def _any(self, *names: str) -> bool:
        """Whether one of these values is not 0."""
        values = [getattr(self, name) for name in names]
        return any(not isinstance(value, int | float) or value != 0 for value in values)

    @property
    def exposes(self) -> bool:
        """Whether the light of all colours changes alike."""
        return self._any("exposure")

    @property
    def balances(self) -> bool:
        """Whether the white balance changes."""
        return self._any("warmth", "tint") or self.temperature not in (None, NEUTRAL)

    @property
    def colours(self) -> bool:
        """Whether the strength of colours changes."""
        return self._any("vibrance", "saturation")

    @property
    def bends(self) -> bool:
        """Whether tones change by a curve, the same for all pixels."""
        return self._any("contrast", "whites", "blacks") or self.curve != EVEN_CURVE

    @property
    def shades(self) -> bool:
        """Whether light or dark areas change."""
        return self._any("highlights", "shadows")


@dataclass(frozen=True, kw_only=True)
class Development(LightValues):
    """Light, turning and crop of a photograph, with numbers for all values; by default nothing changes.

    Attributes:
        straighten: degrees, -45 to 45, by which the picture is rotated clockwise about its middle.
        crop: left, top, right and bottom edge as shares of the turned picture, which keeps its size. A crop with empty
            corners is shrunk about its middle until it has none.
        rotate: 0, 90, 180 or 270 degrees, clockwise, before it is straightened.

    Raises:
        ValueError: if a value is out of range.

    Example:
        >>> Development(straighten=10.0).frame((100, 150)).size, Development(rotate=90).frame((100, 150)).size
        ((80, 120), (150, 100))
    """

    straighten: float = DEVELOP["straighten"].default_number
    crop: Crop = WHOLE_CROP
    rotate: int = 0

    def __post_init__(self) -> None:
        """Check all values, and make them numbers of the declared type."""
        for name, value in vars(self).items():
            check_value(name, value)
            if isinstance(value, list | tuple):
                object.__setattr__(self, name, tuple(map(float, value)))
            elif value is not None and not isinstance(value, str):
                object.__setattr__(self, name, int(value) if name == "rotate" else float(value))

    @property
    def is_idle(self) -> bool:
        """Whether nothing changes."""
        return self == AS_IT_IS

    @property
    def changes_light(self) -> bool:
        """Whether anything but the geometry changes."""
        return self != self.geometry

    @property
    def geometry(self) -> "Development":
        """Turning, straightening and crop alone."""
        return Development(rotate=self.rotate, straighten=self.straighten, crop=self.crop)

    def frame(self, size: tuple[int, int]) -> "Frame":
        """Where the developed picture lies in a picture (H, W).

        Raises:
            ValueError: if the middle of the crop is outside the rotated picture.
        """
        quarters = self.rotate // 90
        height, width = turned = size[::-1] if quarters % 2 else size
        left, top, right, bottom = self.crop
        if self.straighten == 0:
            first = min(round(left * width), width - 1), min(round(top * height), height - 1)
            last = max(round(right * width), first[0] + 1), max(round(bottom * height), first[1] + 1)
            return Frame(size, 0.0, first[1], first[0], last[1] - first[1], last[0] - first[0], quarters)
        angle = math.radians(self.straighten)
        middle = (left + right - 1) / 2 * width, (top + bottom - 1) / 2 * height  # from that of the picture
        half = (right - left) / 2 * width, (bottom - top) / 2 * height
        share = min(1.0, *(_reach(middle, (x * half[0], y * half[1]), angle, turned) for x in (-1, 1) for y in (-1, 1)))
        if share <= 0:
            raise ValueError(
                f"crop must have its middle within the photograph turned by {self.straighten:g} degrees, got "
                f"{', '.join(f'{edge:g}' for edge in self.crop)}; move it inwards"
            )
        columns, rows = (_inside(m + n / 2, share * h) for m, n, h in zip(middle, (width, height), half, strict=True))
        if not (columns and rows):
            columns, rows = _thin(columns, rows, middle, angle, turned)
        return Frame(size, angle, rows.start, columns.start, len(rows), len(columns), quarters)

    def quartered(self, quarters: int) -> "Development":
        """The same, turned clockwise by more quarters of a circle, with the crop that shows the same.

        >>> turned = Development(crop=(0.0, 0.25, 1.0, 1.0)).quartered(1)
        >>> turned.rotate, turned.crop
        (90, (0.0, 0.0, 0.75, 1.0))
        """
        left, top, right, bottom = self.crop
        for _ in range(quarters % 4):
            left, top, right, bottom = 1 - bottom, left, 1 - top, right
        return replace(self, rotate=(self.rotate + 90 * quarters) % 360, crop=(left, top, right, bottom))

    def to_json(self, indent: str = "", *, complete: bool = False) -> str:
        """Format it as a JSON object, without defaults unless ``complete``."""
        entries = {p.name: getattr(self, p.name) for p in DEVELOP}
        entries = {n: v for n, v in entries.items() if complete or v != getattr(AS_IT_IS, n)}
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

    The original is turned by quarters first; what follows counts in the turned picture.

    Attributes:
        original: (H, W) of the original.
        angle: of the turn, clockwise, in radians.
        top: first row of the rectangle, in pixels.
        left: its first column.
        height: its height.
        width: its width.
        quarters: of a circle by which the original is turned clockwise before, 0 to 3.
    """

    original: tuple[int, int]
    angle: float
    top: int
    left: int
    height: int
    width: int
    quarters: int = 0

    @property
    def turned(self) -> tuple[int, int]:
        """(H, W) of the original after the quarters."""
        return self.original[::-1] if self.quarters % 2 else self.original

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
        height, width = self.turned
        bottom, right = self.top + self.height, self.left + self.width
        return self.left / width, self.top / height, right / width, bottom / height

    def placed(self, crop: Crop) -> Crop:
        """A crop moved to whole pixels if its size is that of this frame, so that no pixel is lost; others as they are.

        >>> AS_IT_IS.frame((10, 20)).trimmed(1.0).placed((0.13, 0.0, 0.63, 1.0))
        (0.15, 0.0, 0.65, 1.0)
        """
        height, width = self.turned
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
        return self.angle == self.quarters == 0 and self.size == self.original

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
        height, width = self.turned
        for _ in range(self.quarters):
            x, y = 1 - y, x
        column, row = rotated((x - 0.5) * width, (y - 0.5) * height, self.angle)
        return (column + width / 2 - self.left) / self.width, (row + height / 2 - self.top) / self.height

    def outward(self, x: float, y: float) -> tuple[float, float]:
        """Where a point of the developed picture is in the original, the inverse of :meth:`inward`."""
        if self.is_whole:
            return x, y
        height, width = self.turned
        column, row = self.left + x * self.width - width / 2, self.top + y * self.height - height / 2
        column, row = rotated(column, row, -self.angle)
        x, y = column / width + 0.5, row / height + 0.5
        for _ in range(self.quarters):
            x, y = y, 1 - x
        return x, y

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
