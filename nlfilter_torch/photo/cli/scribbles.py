"""Scribbles, masks and rectangles on a photograph, from the options of a command, as rows."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import ImageColor
from torch import Tensor

from nlfilter_torch.photo.cli.options import parse_sliders
from nlfilter_torch.photo.declared.declaration import Edit, Scribble, ScribbleRole
from nlfilter_torch.photo.files.formats import check_depth
from nlfilter_torch.photo.files.rows import StoredPicture
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.pictures import LazyRows, Picture, mask_of, transparency

Size = tuple[int, int]  # (height, width) of the photograph
Open = Callable[[Path], StoredPicture]  # opens a picture of scribbles or a mask
Floats = NDArray[np.float32]
SELECTED = 0.5  # brightness from which a mask selects a pixel: the borders of soft masks fade to 0 far outside
DOT_SIZE = 0.03  # side of the square around a point, as a share of the short side


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in a photograph, and the text after its colon."""

    rows: slice
    columns: slice
    note: str | None

    @staticmethod
    def parse(text: str, option: str, size: tuple[int, int]) -> "Rectangle":
        """Parse ``X,Y,W,H``, or ``X,Y`` for a small square around a point, both optionally with ``:NOTE``.

        Numbers are in pixels, or with a percent sign relative to the width (X, W) or height (Y, H) in ``size``.

        >>> Rectangle.parse("2,3,4,5:red", "--region", (20, 30))
        Rectangle(rows=slice(3, 8, None), columns=slice(2, 6, None), note='red')
        >>> str(Rectangle.parse("50%,25%,4,10%", "--region", (20, 30))), str(Rectangle.parse("50%,0%", "", (90, 120)))
        ('15,5,4,2', '59,0,3,3')
        """
        numbers, colon, note = text.partition(":")
        try:
            lengths = [size[1 - i % 2] for i in range(4)]
            parts = numbers.split(",")
            values = [_pixels(part, length) for part, length in zip(parts, lengths[: len(parts)], strict=True)]
            point = values if len(values) == 2 else [0]
            if len(values) == 2:
                side = max(1, round(DOT_SIZE * min(size)))
                values = [min(max(int(at) - side // 2, 0), n - side) for at, n in zip(values, lengths, strict=False)]
                values += [side, side]
            x, y, width, height = (math.floor(value) for value in values)
        except ValueError:
            raise ValueError(
                f"{option} must be four whole numbers X,Y,W,H, such as 40,60,20,20, got {text!r}; percentages "
                "such as 25% and a point X,Y are accepted too"
            ) from None
        if not all(0 <= at <= length for at, length in zip(point, lengths, strict=False)):
            raise ValueError(
                f"{option} must be a point in the photograph, which is {size[1]} pixels wide and {size[0]} high, got "
                f"{text!r}; move it"
            )
        if width < 1 or height < 1:
            raise ValueError(f"{option} must be at least 1 pixel wide and high, got {width}x{height} in {text!r}")
        if x < 0 or y < 0 or x + width > size[1] or y + height > size[0]:
            raise ValueError(
                f"{option} must lie within the photograph, which is {size[1]} pixels wide and {size[0]} high, got "
                f"columns {x} to {x + width - 1} and rows {y} to {y + height - 1} in {text!r}; move or shrink it"
            )
        return Rectangle(slice(y, y + height), slice(x, x + width), note if colon else None)

    def __str__(self) -> str:
        """``X,Y,W,H`` in pixels."""
        rows, columns = self.rows, self.columns
        return f"{columns.start},{rows.start},{columns.stop - columns.start},{rows.stop - rows.start}"


def _pixels(text: str, length: int) -> float:
    """Parse a number of pixels or a percentage of a length."""
    text = text.strip()
    if not text.endswith("%"):
        return int(text)
    value = float(text[:-1]) * length / 100  # in this order, whole numbers of pixels are exact
    if not math.isfinite(value):
        raise ValueError(text)
    return value


Mark = tuple[Rectangle, slice, list[float]]  # with the channels that a rectangle sets, and their values


@dataclass(frozen=True)
class Overlay(ABC):
    """Scribbles or masks over a photograph, as rows (h, W, S): a picture of its size, and rectangles on top.

    Attributes:
        shape: (H, W, S).
        picture: the picture, or None.
        rectangles: with the channels that a rectangle sets, and their values.
    """

    shape: tuple[int, int, int]
    picture: Picture | None
    rectangles: list[Mark]
    dtype = np.dtype(np.float32)
    marked: ClassVar[int]  # channel that is above 0 where something is marked
    empty: ClassVar[str]  # end of the error for a picture in which nothing is marked

    @abstractmethod
    def _of_picture(self, rows: slice, picture: Picture) -> Floats:
        """Rows of the picture without the rectangles."""

    def __getitem__(self, rows: slice) -> Floats:
        """The rows from ``rows.start`` to ``rows.stop``."""
        overlay = np.zeros((rows.stop - rows.start, *self.shape[1:]), self.dtype)
        if self.picture is not None:
            overlay = self._of_picture(rows, self.picture)
        for rectangle, channels, values in self.rectangles:
            top, bottom = (max(row - rows.start, 0) for row in (rectangle.rows.start, rectangle.rows.stop))
            overlay[top:bottom, rectangle.columns, channels] = values
        return overlay

    def checked(self) -> Self:
        """Return this overlay; raise ValueError if nothing is marked in its picture."""
        if self.picture is not None and not self._any(lambda weights: weights != 0):
            raise ValueError(f"{self.picture.name} is {self.empty}")
        return self

    def _any(self, holds: Callable[[Floats], NDArray[np.bool_]]) -> bool:
        """Whether a condition holds for the mark of a pixel of the picture."""
        picture = self.picture
        assert picture is not None  # for mypy
        return LazyRows(self.shape[:2], lambda rows: holds(self._of_picture(rows, picture)[..., self.marked])).any()

    def planes(self, rows: slice) -> Tensor:
        """Some rows, as planes (1, S, h, W)."""
        return torch.from_numpy(self[rows]).permute(2, 0, 1)[None]

    def at_once(self) -> Tensor:
        """All rows, as planes (1, S, H, W)."""
        return self.planes(slice(0, self.shape[0])).contiguous()


class Regions(Overlay):
    """Masks of regions; the picture is the first of them."""

    marked, empty = 0, "darker than middle grey everywhere; paint the selected area white"

    def _of_picture(self, rows: slice, picture: Picture) -> Floats:
        weights = np.zeros((rows.stop - rows.start, *self.shape[1:]), self.dtype)
        tile = picture.tile(rows.start, rows.stop, 0)
        painted = mask_of(tile)[0, 0].float().numpy()
        weights[..., 0] = np.where(painted < SELECTED, 0, painted)
        return weights


class Strokes(Overlay):
    """Coloured scribbles: RGB and their mask, in four channels."""

    marked, empty = 3, "transparent everywhere; draw at least one scribble"
    opaque: ClassVar[str] = (
        "has no transparency, so every pixel would count as a scribble; "
        "draw on a transparent layer and save only that layer"
    )

    def checked(self) -> Self:
        """Return these scribbles; raise ValueError if their picture has none, or they cover all of it."""
        super().checked()
        if self.picture is not None and not self._any(lambda opacity: opacity == 0):
            raise ValueError(f"{self.picture.name} {self.opaque}")
        return self

    def _of_picture(self, rows: slice, picture: Picture) -> Floats:
        tile = picture.tile(rows.start, rows.stop, 0)
        colours = tile.pixels[0].expand(3, -1, -1).permute(1, 2, 0)  # a grey picture has one channel
        return np.concatenate([colours.to(torch.float32), transparency(tile, "float32")], axis=2)


@dataclass(frozen=True)
class ScribbleOptions:
    """The options of a command that mark parts of a photograph.

    Attributes:
        region: rectangles on the objects.
        strokes: a picture of coloured scribbles.
        mask: a picture of the objects.
        rectangles: further ones, by their options.
    """

    region: list[str] | None = None
    strokes: Path | None = None
    mask: Path | None = None
    rectangles: Mapping[str, list[str] | None] = field(default_factory=dict)

    def of(self, edit: Edit, *roles: ScribbleRole) -> list[str]:
        """The rectangles of an edit's scribbles that have one of these roles and options of their own."""
        return [text for scribble in edit.with_role(*roles) for text in self.rectangles.get(scribble.option) or []]

    def marks_objects(self, edit: Edit) -> bool:
        """Whether an object is marked, or its mask painted."""
        return bool(self.region or self.of(edit, "added")) or self.mask is not None or self.strokes is not None

    @property
    def called(self) -> str:
        """Name of the coloured scribbles in errors."""
        return "--region" if self.strokes is None else str(self.strokes)


def of_edit(
    edit: Edit, alpha: tuple[float, ...] | None, size: Size, options: ScribbleOptions, read: Open
) -> Drawn[Overlay]:
    """Read the scribbles and masks of an edit from options, as rows.

    ``alpha`` are the sliders of regions without their own, if the edit takes regions that have sliders.
    """
    _check_region(edit, options)
    masks: dict[str, Overlay | None] = {}
    colours, sliders = None, SliderRegions(size, alpha or ())
    is_added = bool(options.of(edit, "added"))
    for scribble in edit.scribbles:
        is_object = scribble.role == "object"
        texts = options.region if is_object else options.rectangles.get(scribble.option)
        option, path = scribble.option or "--region", options.mask if is_object else None
        if scribble.kind == "colours" and is_object:
            needed = scribble.needed and not is_added
            colours = _strokes(size, options.strokes, texts, option, read, needed=needed)
        elif scribble.kind == "colours":
            masks[scribble.argument] = _strokes(size, None, texts, option, read, needed=False)
        elif scribble.kind == "sliders":
            sliders.add(scribble.argument, texts, option, _picture(size, path, read))
        else:
            masks[scribble.argument] = selection(size, path, texts, option, read)
            if is_object and scribble.needed and not is_added and masks[scribble.argument] is None:
                raise ValueError(scribble.advice)
    drawn = Drawn.of(masks | sliders.masks(), colours)
    return replace(drawn, sliders=sliders.rows)


def _check_region(edit: Edit, options: ScribbleOptions) -> None:
    """Raise ValueError if an option limits a region that no other option marks."""
    if edit.regional is None or options.marks_objects(edit):
        return
    for scribble in edit.with_options:
        if options.rectangles.get(scribble.option):
            added = "".join(f", {other.option}" for other in edit.with_role("added"))
            raise ValueError(
                f"{scribble.option} must come with --region{added} or --mask, got none of them; mark the region to "
                "edit, such as by --region 190,60,60,60"
            )


def at_once(edit: Edit, drawn: Drawn[Overlay]) -> Drawn[Tensor]:
    """Convert scribbles to tensors."""
    masks, colours = {name: overlay.at_once() for name, overlay in drawn.masks.items()}, None
    if drawn.colours is not None:
        colours, mask = drawn.colours.at_once().split([3, 1], dim=1)
        masks |= {scribble.argument: mask for scribble in edit.with_role("object") if scribble.kind == "colours"}
    return Drawn(masks, colours, drawn.sliders)


def overlays(edit: Edit, drawn: Drawn[Overlay]) -> Iterator[tuple[Scribble, str, Overlay]]:
    """Yield the scribbles of an edit with their option and overlay."""
    for scribble in edit.scribbles:
        option = scribble.option or "--region"
        if scribble.kind == "colours" and scribble.role == "object" and drawn.colours is not None:
            yield scribble, option, drawn.colours
        if scribble.argument in drawn.masks:
            yield scribble, option, drawn.masks[scribble.argument]


def _strokes(
    size: Size, path: Path | None, texts: list[str] | None, option: str, read: Open, *, needed: bool
) -> Strokes | None:
    """Read coloured scribbles from ``--strokes`` and an option for rectangles; None if there are none."""
    if path is None and not texts:
        if needed:
            raise ValueError("give --strokes FILE or --region X,Y,W,H:COLOUR, such as --region 40,60,20,20:red")
        return None
    rectangles = []
    for text in texts or []:
        rectangle = Rectangle.parse(text, option, size)
        if rectangle.note is None:
            raise ValueError(f"{option} must end in a colour, such as {text}:red, got {text!r}")
        try:
            *colour, opacity = (*ImageColor.getrgb(rectangle.note), 255)[:4]
            if max(*colour, opacity) > 255:
                raise ValueError(rectangle.note)
        except ValueError:
            raise ValueError(
                f"{option} must end in a colour, such as red, #c04020 or rgb(192,64,32), "
                f"got {rectangle.note!r} in {text!r}"
            ) from None
        if opacity < 255:
            raise ValueError(
                f"{option} must end in an opaque colour, got {rectangle.note!r} in {text!r}; leave out its last part"
            )
        rectangles.append((rectangle, slice(None), [*(torch.tensor(colour) / 255).tolist(), 1.0]))
    return Strokes((*size, 4), _picture(size, path, read, transparent=True), rectangles).checked()


def selection(size: Size, path: Path | None, texts: list[str] | None, option: str, read: Open) -> Regions | None:
    """Read a single region from a mask file and the rectangles of an option, or return None without either."""
    rectangles = []
    for text in texts or []:
        rectangle = Rectangle.parse(text, option, size)
        if rectangle.note is not None:
            raise ValueError(f"{option} must be X,Y,W,H only, got {text!r}; drop the colon and what follows it")
        rectangles.append((rectangle, slice(None), [1.0]))
    if path is None and not rectangles:
        return None
    return Regions((*size, 1), _picture(size, path, read), rectangles).checked()


@dataclass
class SliderRegions:
    """K regions of a photograph of a size that have sliders.

    A mask, and rectangles without their own sliders, have the sliders ``alpha``. All that has the same sliders is one
    region, as in the editor and in other commands, so that the time does not grow with the number of rectangles.
    """

    size: Size
    alpha: tuple[float, ...]
    _sliders: list[tuple[float, ...]] = field(default_factory=list)
    _marks: dict[str, tuple[Picture | None, list[Mark]]] = field(default_factory=dict)

    def add(self, argument: str, texts: list[str] | None, option: str, picture: Picture | None) -> None:
        """Read rectangles of an option, and a mask; ``argument`` is that of the edit's function."""
        if picture is None and not texts:
            return
        if picture is not None:
            self._sliders.append(self.alpha)
        rectangles = []
        for text in texts or []:
            rectangle = Rectangle.parse(text, option, self.size)
            own = self.alpha if rectangle.note is None else parse_sliders(rectangle.note, option)
            if len(own) != len(self.alpha):
                raise ValueError(
                    f"{option} must have as many sliders as --alpha, {len(self.alpha)}, got {len(own)} in {text!r}; "
                    "add or drop some"
                )
            if own not in self._sliders:
                self._sliders.append(own)
            number = self._sliders.index(own)
            rectangles.append((rectangle, slice(number, number + 1), [1.0]))
        self._marks[argument] = picture, rectangles

    @property
    def rows(self) -> Tensor | None:
        """The sliders (K, k+1) of the regions; None if there are none."""
        return torch.tensor(self._sliders) if self._sliders else None

    def masks(self) -> dict[str, Regions]:
        """What was read, by the arguments of the edit's function."""
        shape = (*self.size, len(self._sliders))
        return {name: Regions(shape, *marks).checked() for name, marks in self._marks.items()}


def _picture(size: Size, path: Path | None, read: Open, *, transparent: bool = False) -> Picture | None:
    """Open a picture over a photograph; raise ValueError unless it has its size and, if needed, transparency."""
    if path is None:
        return None
    stored = read(path)
    check_depth(path, stored.rows.dtype)
    height, width = stored.shape[:2]
    if (height, width) != size:
        raise ValueError(
            f"{path} must be as large as the photograph, {size[1]}x{size[0]}, but is {width}x{height}; resize it"
        )
    if transparent and not stored.alpha:
        raise ValueError(f"{path} {Strokes.opaque}")
    return Picture(stored.rows, str(path), hides=False)
