"""The scribbles of an edit as a source takes them, and the one way from marks on a picture to these."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.strokes import Mark, Region, ScribbleRole, box_in, sliders_of
from nlfilter_torch.photo.picture.pixels import Box
from nlfilter_torch.photo.picture.pixels import M as M

M_co = TypeVar("M_co", covariant=True)  # as M, of values that are only read

Size = tuple[int, int]  # (H, W)
#: What is shown of marks in a plane, from the lowest to the topmost: marks, and whether they paint or erase.
Plane = tuple[tuple[Mark, bool], ...]


@dataclass(frozen=True, eq=False)
class Drawn(Generic[M_co]):
    """The scribbles of an edit.

    Attributes:
        masks: by the name of the argument of the edit's function.
        colours: of the scribbles that have colours, RGB; or with their mask as a fourth channel, in place of an entry
            of ``masks``.
        sliders: (K, k+1), a row for each region that has sliders of its own; None if none has.
        outside: sliders (k+1,) outside these regions; None leaves the other pixels unchanged.
        box: a rectangle that holds the objects, (left, top, right, bottom) in pixels, or a tensor (B, K, 4) with one
            for each.
        colour: RGB (3,) that an object without scribbles takes, which only a box marks.
    """

    masks: Mapping[str, M_co] = field(default_factory=dict)
    colours: M_co | None = None
    sliders: Tensor | None = None
    outside: Tensor | None = None
    box: Box | None = None
    colour: Tensor | None = None

    @staticmethod
    def of(masks: Mapping[str, M | None], colours: M | None = None, box: Box | None = None) -> "Drawn[M]":
        """Scribbles of which some may be None, where there are none."""
        return Drawn({name: mask for name, mask in masks.items() if mask is not None}, colours, box=box)


class Painter(Protocol[M]):
    """Rasterises marks to masks and colours as a source takes them."""

    def planes(self, shown: Sequence[Plane], size: Size, *, soft: bool = False, coloured: bool = False) -> M:
        """See :func:`~nlfilter_torch.photo.picture.painting.rasterised`."""

    def covers(self, planes: M) -> bool:
        """Whether masks or colours cover a pixel of the picture."""


def drawn_by(
    edit: Edit, marks: Sequence[Mark], size: Size, painter: Painter[M], inside: tuple[float, ...] = ()
) -> Drawn[M]:
    """What marks on a picture (H, W) are for an edit.

    Marks on objects cover those on the background, of which nothing may be left. Of what is added to masks and removed
    from them, the later covers the earlier. ``inside`` are the sliders of regions whose marks say none, if the edit
    takes such.

    Raises:
        ValueError: if the edit does not take a mark, there are several boxes for an object, or those of objects are
            needed and cover no pixel.
    """
    for mark in marks:
        edit.check_mark(mark, f"strokes of {edit.name}")
    _check_covered(edit, not edit.requires_strokes or edit.marks_object(marks))
    masks: dict[str, M] = {}
    colours: M | None = None
    sliders = sliders_of(marks, inside) if inside else ()
    for scribble in edit.scribbles:
        role, coloured = scribble.role, scribble.kind == "colours"
        own = [mark for mark in marks if mark.role == role]
        if not own or role == "box":
            continue
        groups = [own]
        if scribble.kind == "sliders":
            groups = [[mark for mark in own if (mark.meaning.sliders or inside) == row] for row in sliders]
        shown = [_plane(group, role, marks) for group in groups]
        planes = painter.planes(shown, size, soft=role in ("added", "removed"), coloured=coloured)
        if role == "object":
            _check_covered(edit, painter.covers(planes))
        if role == "object" and coloured:
            colours = planes
        elif role != "background" or painter.covers(planes):
            masks[scribble.argument] = planes
    box = _boxes(edit, marks, size, sliders, inside)
    return Drawn(masks, colours, torch.tensor(sliders) if sliders else None, box=box, colour=_colour(edit, marks))


def _boxes(
    edit: Edit, marks: Sequence[Mark], size: Size, sliders: Sequence[tuple[float, ...]], inside: tuple[float, ...]
) -> Tensor | None:
    """Boxes (1, K, 4) in pixels of a picture (H, W), of the regions with these sliders, or of the only object.

    Those without sliders hold the regions that have none of their own; there may be one of either. A region without a
    box has one that is the whole picture.
    """
    boxes = [mark for mark in marks if mark.role == "box" and isinstance(mark, Region)]
    if not boxes:
        return None
    own = {row: [mark for mark in boxes if mark.meaning.sliders == row] for row in sliders}
    others = [mark for mark in boxes if mark.meaning.sliders not in own]
    if any(len(alike) > 1 for alike in (*own.values(), others)):
        raise ValueError(
            f"strokes of {edit.name} must hold one box for each object, got {len(boxes)}; keep the one that holds it"
        )
    scribbled = {mark.meaning.sliders or inside for mark in marks if mark.role == "object"}
    whole = (0.0, 0.0, float(size[1]), float(size[0]))
    rows = []
    for row in sliders or (inside,):
        held = own.get(row) or (others if row in scribbled or not scribbled or not sliders else [])
        rows.append(box_in(held[0], size) if held else whole)
    return torch.tensor([rows])


def _colour(edit: Edit, marks: Sequence[Mark]) -> Tensor | None:
    """The colour of an object that only a box marks, for edits whose objects take colours.

    Raises:
        ValueError: if it says none, and no other mark does.
    """
    roles = {mark.role for mark in marks}
    takes_colours = any(scribble.kind == "colours" for scribble in edit.with_role("box"))
    if not takes_colours or "box" not in roles or "object" in roles:
        return None
    colour = next(mark.colour for mark in marks if mark.role == "box")
    if colour is None and "added" not in roles:
        raise ValueError(
            f"strokes of {edit.name} must be in a colour, or its box must say one, got neither; choose a colour, such "
            "as --box 40,60,20,20:green"
        )
    return None if colour is None else colour_of(colour)


def _check_covered(edit: Edit, covered: bool) -> None:
    if not covered:
        raise ValueError(f"strokes of {edit.name} must cover a pixel of the photograph, got none that do; move them")


def _plane(group: Sequence[Mark], role: ScribbleRole, marks: Sequence[Mark]) -> Plane:
    """What is shown of a group of marks with a role, among all marks of an edit."""
    if role == "object":
        return tuple((mark, True) for mark in group)
    if role == "background":
        return (*((mark, True) for mark in group), *((mark, False) for mark in marks if mark.role == "object"))
    others = ("removed",) if role == "added" else ("added",)
    return tuple((mark, mark.role == role) for mark in marks if mark in group or mark.role in others)


def colour_of(paint: str) -> Tensor:
    """Parse ``#rrggbb`` to RGB (3,) in [0, 1].

    >>> colour_of("#ff0033")
    tensor([1.0000, 0.0000, 0.2000])
    """
    return torch.tensor([int(paint[i : i + 2], 16) for i in (1, 3, 5)]) / 255
