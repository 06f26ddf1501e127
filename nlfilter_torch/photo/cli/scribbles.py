"""The options of a command that mark parts of a photograph, as marks on it."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor
from skimage.color import rgb2hsv
from torch import Tensor

from nlfilter_torch.photo.cli.options import parse_lengths, parse_sliders, split_region
from nlfilter_torch.photo.declared.declaration import Edit, MarkOption
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.declared.strokes import (
    SOFTNESS,
    WORDS,
    Mark,
    Region,
    ScribbleRole,
    Shape,
    is_rectangle,
    mark_of,
    noted,
)
from nlfilter_torch.photo.files.formats import check_depth
from nlfilter_torch.photo.files.rows import StoredPicture
from nlfilter_torch.photo.picture.drawn import Drawn, Painter, Size, drawn_by
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.painting import RowPainter, TensorPainter, plane_rows
from nlfilter_torch.photo.picture.pictures import LazyRows, Picture
from nlfilter_torch.photo.picture.pixels import M

Opener = Callable[[Path], StoredPicture]  # opens a picture of marks
DOT_SIZE = 0.03  # side of the square around a point, as a share of the short side
HUE_RANGE, NEUTRAL, VALUE_RANGE = 1 / 12, 0.2, 0.25  # of colours alike, in HSV: most primaries are 1/6 apart
OPAQUE = (
    "has no transparency, so every pixel would count as a scribble; "
    "draw on a transparent layer and save only that layer"
)


@dataclass(frozen=True)
class ScribbleOptions:
    """The options of a command that mark parts of a photograph, as they were typed.

    Attributes:
        region: regions of the objects.
        strokes: a picture of coloured scribbles, or an edit file with strokes.
        mask: a picture of the objects.
        rectangles: further regions, by their options.
        colour: of marks that do not say one.
        source: a colour, whose pixels are marked.
    """

    region: list[str] | None = None
    strokes: Path | None = None
    mask: Path | None = None
    rectangles: Mapping[str, list[str] | None] = field(default_factory=dict)
    colour: str | None = None
    source: str | None = None

    def of(self, edit: Edit, *roles: ScribbleRole) -> list[str]:
        """The regions of an edit's scribbles that have one of these roles and options of their own."""
        own = [option.name for scribble in edit.with_role(*roles) for option in scribble.options]
        return [text for name in own for text in self.rectangles.get(name) or []]

    def marks_objects(self, edit: Edit) -> bool:
        """Whether an object is marked, or its mask painted."""
        pictures = self.mask or self.strokes or self.source
        return bool(self.region or self.of(edit, *edit.object_roles)) or pictures is not None

    @property
    def called(self) -> str:
        """Name of the coloured scribbles in errors."""
        return "--region" if self.strokes is None else str(self.strokes)

    def on(self, edit: Edit, photograph: Rows, opener: Opener, alpha: tuple[float, ...] = ()) -> "MarkedPhotograph":
        """Mark a photograph for an edit.

        ``alpha`` are the sliders of regions without their own, if the edit takes regions that have sliders.

        Raises:
            ValueError: if an option does not fit the photograph, the edit or the other options.
        """
        self._check_region(edit)
        size = photograph.size
        reader = _Reader(edit, size, self.colour, alpha)
        marks, pictures = list[Mark](), dict[str, Picture]()
        if self.mask is not None:
            marks.append(reader.of_picture(self.mask, "mask"))
        if self.strokes is not None:
            is_edit = self.strokes.suffix.lower() == ".json"
            marks += reader.of_recipe(self.strokes) if is_edit else [reader.of_picture(self.strokes, "layer")]
        for mark in marks:
            if isinstance(mark, Region) and mark.file:
                pictures[mark.file] = _picture(mark, size, opener)
        if self.source is not None:
            name = f"--from {self.source}"
            marks.append(reader.of_picture(Path(name), "mask", name))
            pictures[name] = _colour_range(photograph, self.source, name)
        for option in (option for scribble in edit.scribbles for option in scribble.options):
            texts = self.region if option.scribble.role == "object" else self.rectangles.get(option.name)
            marks += [reader.of_text(text, option) for text in texts or []]
        if edit.requires_strokes and not edit.marks_object(marks):
            raise ValueError(next(scribble.advice for scribble in edit.with_role("object")))
        return MarkedPhotograph(edit, size, tuple(marks), pictures, alpha)

    def _check_region(self, edit: Edit) -> None:
        """Raise ValueError if an option limits a region that no other option marks."""
        if edit.regional is None or self.marks_objects(edit):
            return
        for option in edit.with_options:
            if self.rectangles.get(option.name):
                added = "".join(f", {other.option}" for other in edit.with_role("box", "added"))
                raise ValueError(
                    f"{option.name} must come with --region{added} or --mask, got none of them; mark the region to "
                    "edit, such as by --region 190,60,60,60"
                )


@dataclass(frozen=True)
class MarkedPhotograph:
    """What options mark on a photograph.

    Attributes:
        edit: that the marks are for.
        size: (H, W) of the photograph.
        marks: on it.
        pictures: of marks, by their paths.
        alpha: sliders of regions without their own.
    """

    edit: Edit
    size: Size
    marks: tuple[Mark, ...]
    pictures: Mapping[str, Picture]
    alpha: tuple[float, ...] = ()

    def rows(self) -> Drawn[RowSource]:
        """Masks and colours as rows, which are computed when they are read."""
        return self._by(RowPainter(self.pictures.__getitem__))

    def tensors(self) -> Drawn[Tensor]:
        """Masks and colours in memory."""
        return self._by(TensorPainter(self.pictures.__getitem__))

    def _by(self, painter: Painter[M]) -> Drawn[M]:
        drawn = drawn_by(self.edit, self.marks, self.size, painter, self.alpha)
        for scribble in self.edit.with_role("background"):
            if scribble.argument not in drawn.masks and any(mark.role == "background" for mark in self.marks):
                raise ValueError(
                    f"{scribble.option} must hold a painted pixel outside the scribbles on the object, got only pixels "
                    "under them; paint outside them, or omit it"
                )
        return drawn

    def drawn_regions(self) -> Iterator[tuple[str, Region]]:
        """Yield the regions of objects and of their background that are not pictures, with their options."""
        for scribble in self.edit.with_role("object", "background"):
            for mark in self.marks:
                if mark.role == scribble.role and isinstance(mark, Region) and not mark.file:
                    yield scribble.option or "--region", mark


@dataclass(frozen=True)
class _Reader:
    """Reads marks on a photograph (H, W) for an edit, with a colour or sliders where they say none."""

    edit: Edit
    size: Size
    colour: str | None
    alpha: tuple[float, ...]

    def of_text(self, text: str, marking: MarkOption) -> Mark:
        """The region of a text, which an option of the edit takes."""
        option, scribble = marking.name, marking.scribble
        region, note = parse_region(text, option, self.size, WORDS[scribble.role], marking.shape)
        if scribble.role == "box" and (not is_rectangle(region) or split_region(text)[1].count(",") != 3):
            raise ValueError(f"{option} must be a rectangle X,Y,W,H around the object, got {text!r}; give four numbers")
        if scribble.kind == "mask":
            if note is not None:
                raise ValueError(f"{option} must be X,Y,W,H only, got {text!r}; drop the colon and what follows it")
            return region
        if scribble.kind == "colours":
            if scribble.role == "box" and note is None and self.colour is None:
                return region
            if note is None and self.colour is None:
                raise ValueError(f"{option} must end in a colour, such as {text}:red, got {text!r}")
            return noted(region, self._default if note is None else _colour(note, option, text))
        if scribble.role == "box" and note is None:
            return region  # that holds all regions
        own = self.alpha if note is None else parse_sliders(note, option)
        if len(own) != len(self.alpha):
            raise ValueError(
                f"{option} must have as many sliders as --alpha, {len(self.alpha)}, got {len(own)} in {text!r}; "
                "add or drop some"
            )
        return noted(region, _listed(own))

    def of_picture(self, path: Path, shape: Shape, option: str = "--mask") -> Mark:
        """The region of the objects that a picture shows, which comes from an option."""
        region = Region.of_file(str(path), shape, WORDS["object"])
        if shape == "layer" and self.colour is None:
            return self._with_sliders(region)
        return self._with_note(region, option)

    def of_recipe(self, path: Path) -> list[Mark]:
        """The strokes of a step in a file, whatever edit they were drawn for."""
        steps = [step for step in Recipe.from_file(path.read_bytes(), str(path)).steps if step.strokes]
        steps = [step for step in steps if step.edit == self.edit.name] or steps
        if len(steps) != 1:
            raise ValueError(
                f"{path} must hold one step with strokes, or one of {self.edit.name}, got {len(steps)}; keep one"
            )
        marks = [self._with_note(mark, f"strokes in {path}") for mark in steps[0].strokes]
        for mark in marks:
            self.edit.check_mark(mark, f"strokes in {path}")
        return marks

    def _with_note(self, mark: Mark, name: str) -> Mark:
        """A mark with a colour if the edit needs one and it says none, or with sliders."""
        takes_colour = any(scribble.kind == "colours" for scribble in self.edit.with_role(mark.role))
        if takes_colour and mark.colour is None and (mark.role != "box" or self.colour is not None):
            if self.colour is None:
                raise ValueError(f"{name} must come with --colour, such as --colour red, got none; add it")
            return noted(mark, self._default)
        return self._with_sliders(mark)

    def _with_sliders(self, mark: Mark) -> Mark:
        """A mark with the sliders of the command if the edit has sliders for regions, and it says none that fit."""
        if not any(scribble.kind == "sliders" for scribble in self.edit.with_role(mark.role)):
            return mark
        own = mark.meaning.sliders
        if own is not None and len(own) == len(self.alpha):
            return mark
        return replace(mark, paint=WORDS["box"]) if mark.role == "box" else noted(mark, _listed(self.alpha))

    @property
    def _default(self) -> str:
        """The colour of marks that do not say one."""
        return _colour(self.colour or "", "--colour", self.colour or "")


def parse_region(
    text: str, option: str, size: Size, paint: str, gradient: Shape | None = None
) -> tuple[Region, str | None]:
    """Parse a region of a photograph (H, W), or a gradient, and the note after its colon.

    It is ``X,Y,W,H``, or ``X,Y`` for a small square around a point; ``ellipse:X,Y,W,H`` is the ellipse in a rectangle,
    and six numbers or more are the corners of a polygon. Numbers are in pixels, or with a percent sign relative to the
    width (X, W) or height (Y, H).

    >>> region, note = parse_region("2,3,4,5:red", "--region", (20, 30), "in")
    >>> region.text((20, 30)), note
    ('2,3,4,5', 'red')
    >>> [parse_region(text, "", (90, 120), "in")[0].text((90, 120)) for text in ("50%,25%,4,10%", "50%,0%")]
    ['60,22,4,9', '59,0,3,3']
    """
    shape, numbers, note = split_region(text)
    lengths = size[1], size[0]
    if gradient is not None:
        return _gradient(numbers, option, size, paint, gradient), note
    try:
        values = parse_lengths(numbers.split(","), lengths)
        if len(values) % 2 or (shape == "ellipse" and len(values) != 4):
            raise ValueError(text)
    except ValueError:
        raise ValueError(
            f"{option} must be four whole numbers X,Y,W,H, such as 40,60,20,20, got {text!r}; percentages "
            "such as 25%, a point X,Y, an ellipse:X,Y,W,H and the corners X,Y,X,Y,X,Y of a polygon are accepted too"
        ) from None
    if len(values) != 4:
        _check_points(values, option, size, text)
    if len(values) > 4:
        corners = zip(values[::2], values[1::2], strict=True)
        return Region(tuple((x / size[1], y / size[0]) for x, y in corners), "polygon", paint), note
    if len(values) == 2:
        side = max(1, round(DOT_SIZE * min(size)))
        values = [min(max(int(at) - side // 2, 0), n - side) for at, n in zip(values, lengths, strict=True)]
        values += [side, side]
    x, y, width, height = (math.floor(value) for value in values)
    if width < 1 or height < 1:
        raise ValueError(f"{option} must be at least 1 pixel wide and high, got {width}x{height} in {text!r}")
    if x < 0 or y < 0 or x + width > size[1] or y + height > size[0]:
        raise ValueError(
            f"{option} must lie within the photograph, which is {size[1]} pixels wide and {size[0]} high, got "
            f"columns {x} to {x + width - 1} and rows {y} to {y + height - 1} in {text!r}; move or shrink it"
        )
    box = [number / lengths[i % 2] for i, number in enumerate((x, y, width, height))]
    return Region.upright(box, shape, paint), note


def _gradient(text: str, option: str, size: Size, paint: str, shape: Shape) -> Region:
    """Parse a gradient on a photograph (H, W), which may begin or end outside it."""
    *parts, last = text.split(",")
    softness, wanted = SOFTNESS, "X,Y,X,Y, two different points, such as 0,0,0,40%"
    try:
        if shape == "radial":
            wanted = "X,Y,W,H,SOFTNESS, a rectangle and a share of its radius up to 100%, such as 30%,20%,40%,50%,50%"
            if len(parts) == 4:
                softness, (*parts, last) = float(last.removesuffix("%")) / 100, parts
        lengths = parse_lengths([*parts, last], (size[1], size[0]))
        x, y, *others = (length / size[1 - i % 2] for i, length in enumerate(lengths))
        entries = {"paint": paint, shape: [x, y, *others]} | ({"softness": softness} if shape == "radial" else {})
        if shape == "linear":
            entries[shape] = [[x, y], others]
        region = mark_of(entries, option)
    except ValueError:
        raise ValueError(f"{option} must be {wanted}, in pixels or percent, got {text!r}; correct it") from None
    assert isinstance(region, Region)  # for mypy
    return region


def _check_points(values: Sequence[float], option: str, size: Size, text: str) -> None:
    """Raise ValueError if a point x, y, or several, are outside a photograph (H, W)."""
    if not all(0 <= value <= size[1 - i % 2] for i, value in enumerate(values)):
        raise ValueError(
            f"{option} must be a point in the photograph, which is {size[1]} pixels wide and {size[0]} high, got "
            f"{text!r}; move it"
        )


def _colour(name: str, option: str, text: str) -> str:
    """The colour ``#rrggbb`` of that name."""
    try:
        *colour, opacity = (*ImageColor.getrgb(name), 255)[:4]
        if max(*colour, opacity) > 255:
            raise ValueError(name)
    except ValueError:
        raise ValueError(
            f"{option} must end in a colour, such as red, #c04020 or rgb(192,64,32), got {name!r} in {text!r}"
        ) from None
    if opacity < 255:
        raise ValueError(f"{option} must end in an opaque colour, got {name!r} in {text!r}; leave out its last part")
    return "#" + "".join(f"{part:02x}" for part in colour)


def _listed(sliders: Sequence[float]) -> str:
    """Sliders as the paint of a mark holds them."""
    return ",".join(map(repr, sliders))


def _picture(region: Region, size: Size, opener: Opener) -> Picture:
    """The picture of a region over a photograph (H, W).

    Raises:
        ValueError: unless it has the photograph's size and, as a layer, transparency, and marks something.
    """
    path = Path(region.file)
    stored = opener(path)
    check_depth(path, stored.rows.dtype)
    height, width = stored.shape[:2]
    if (height, width) != size:
        raise ValueError(
            f"{path} must be as large as the photograph, {size[1]}x{size[0]}, but is {width}x{height}; resize it"
        )
    if region.shape == "layer" and not stored.alpha:
        raise ValueError(f"{path} {OPAQUE}")
    picture = Picture(stored.rows, str(path), hides=False)
    if not _any(region, picture, lambda weights: weights != 0):
        empty = (
            "transparent everywhere; draw at least one scribble"
            if region.shape == "layer"
            else "darker than middle grey everywhere; paint the selected area white"
        )
        raise ValueError(f"{path} is {empty}")
    if region.shape == "layer" and not _any(region, picture, lambda weights: weights == 0):
        raise ValueError(f"{path} {OPAQUE}")
    return picture


def _colour_range(photograph: Rows, colour: str, name: str) -> Picture:
    """A mask of the pixels of a photograph that have the hue of a colour and half its saturation, or its grey.

    Raises:
        ValueError: if there is none, or the photograph is grey.
    """
    wanted = rgb2hsv(np.array(ImageColor.getrgb(_colour(colour, "--from", colour)))[:3] / 255)
    if photograph.channels != 3:
        raise ValueError(f"{name} must be used with a photograph in colour, got a grey one; mark parts by --region")
    mask = LazyRows(photograph.size, lambda rows: _similar_in_hue(photograph.read(rows)[0], wanted))
    if not mask.any():
        raise ValueError(f"{name} must be a colour of the photograph, which has none like it; mark a part by --region")
    return Picture(mask, name, hides=False)


def _similar_in_hue(pixels: Tensor, wanted: NDArray[np.generic]) -> NDArray[np.float32]:
    """Which pixels (3, H, W) resemble a colour in hue, saturation and value, (H, W) of 0 and 1."""
    hue, saturation, value = np.moveaxis(rgb2hsv(pixels.movedim(0, -1).numpy()), -1, 0)
    if wanted[1] < NEUTRAL:
        chosen = (saturation < NEUTRAL) & (abs(value - wanted[2]) < VALUE_RANGE)
    else:
        apart = abs((hue - wanted[0] + 0.5) % 1 - 0.5)
        chosen = (apart < HUE_RANGE) & (saturation >= max(NEUTRAL, wanted[1] / 2)) & (value >= NEUTRAL)
    return np.asarray(chosen, np.float32)


def _any(region: Region, picture: Picture, holds: Callable[[NDArray[np.generic]], NDArray[np.bool_]]) -> bool:
    """Whether a condition holds for what a picture marks of a pixel."""
    weights = RowPainter(lambda _: picture).planes([((region, True),)], picture.size)
    return LazyRows(picture.size, lambda rows: holds(plane_rows(weights, rows)[..., 0])).any()
