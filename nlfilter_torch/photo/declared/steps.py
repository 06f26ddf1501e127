"""A step of a recipe: the name of an edit, its parameters and strokes, all of them relative to the picture.

A step is an immutable value that does not depend on the photograph, so that one made on a preview also applies to the
original. Does not import torch.
"""

import copy
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from nlfilter_torch.photo.declared.declaration import Arguments, Edit
from nlfilter_torch.photo.declared.json_values import Value, is_within, shown, without_numpy
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.shared_parameters import FILTER_ARGUMENTS
from nlfilter_torch.photo.declared.strokes import Mark, ScribbleRole, sliders_of

VERSION = 1  # of files of steps
NONE = (1.0, 1.0, 1.0, 1.0)  # sliders that change nothing
MIXING = ("on", "opacity")  # entries of all steps, whether and how much they count


@dataclass(frozen=True, init=False)
class Step:
    """One step of an edit.

    Attributes:
        edit: name of the edit, one of :data:`~nlfilter_torch.photo.declared.parameters.EDITS`.
        strokes: strokes and regions marked for it.
        values: names and values of the parameters that differ from their defaults, in the order of declaration.
        on: whether it is applied.
        opacity: how much of its result is shown over the picture before it: 1 is all, 0 none.

    Example:
        >>> Step("abstract", edges=1.0)["power"], Step("abstract", power=0.3).values
        (0.3, ())
        >>> Step("tone").mixed(opacity=0.5).opacity, Step("tone").mixed(on=False).changes()
        (0.5, False)
    """

    edit: str
    strokes: tuple[Mark, ...]
    values: tuple[tuple[str, Value], ...]
    on: bool = True
    opacity: float = 1.0

    def __init__(self, edit: str, strokes: tuple[Mark, ...] = (), **values: Value) -> None:
        """Create a step; omitted parameters have their defaults."""
        declared = EDITS[edit]
        unknown = values.keys() - {parameter.name for parameter in declared}
        if unknown:
            raise TypeError(
                f"{edit} has no parameter {min(unknown)}; its parameters are {', '.join(p.name for p in declared)}"
            )
        values = {name: without_numpy(value) for name, value in values.items()}
        changed = [(p.name, values[p.name]) for p in declared if p.name in values and values[p.name] != p.default]
        attributes = {"edit": edit, "strokes": strokes, "values": tuple(changed), "on": True, "opacity": 1.0}
        for name, value in attributes.items():
            object.__setattr__(self, name, value)

    @staticmethod
    def idle(edit: str) -> "Step":
        """Return the step that changes nothing, from which the editor starts."""
        values: dict[str, Value] = {
            p.name: NONE if p.kind == "sliders" and p.idle == 1 else p.idle for p in EDITS[edit] if p.idle is not ...
        }
        return Step(edit, (), **values)

    def __getitem__(self, name: str) -> Any:
        """Return the value of a parameter."""
        return dict(self.values).get(name, EDITS[self.edit][name].default)

    def changed(self, *, strokes: tuple[Mark, ...] | None = None, **values: Value) -> "Step":
        """Return a copy with other strokes or parameters."""
        step = Step(self.edit, self.strokes if strokes is None else strokes, **{**dict(self.values), **values})
        return step.mixed(on=self.on, opacity=self.opacity)

    def mixed(self, *, on: bool | None = None, opacity: float | None = None) -> "Step":
        """Return a copy that is switched on or off, or has another opacity."""
        step = copy.copy(self)
        for name, value in (("on", on), ("opacity", opacity)):
            if value is not None:
                object.__setattr__(step, name, value)
        return step

    def switched_on(self) -> "Step":
        """Return a copy whose changes are seen: switched on, and at full opacity if it had none."""
        return self.mixed(on=True, opacity=self.opacity or 1.0)

    @property
    def declared(self) -> Edit:
        """Declaration of the edit."""
        return EDITS[self.edit]

    def painted_as(self, *roles: ScribbleRole) -> tuple[Mark, ...]:
        """Return the marks that have one of these roles."""
        return tuple(mark for mark in self.strokes if mark.role in roles)

    @property
    def objects(self) -> tuple[Mark, ...]:
        """The marks that say what the objects are, see :attr:`Edit.object_roles`."""
        return self.painted_as(*self.declared.object_roles)

    def marks_object(self) -> bool:
        """Whether a mark says what an object is."""
        return bool(self.objects)

    @property
    def sliders_inside(self) -> tuple[float, ...]:
        """Sliders inside the region; by default 1 for each layer."""
        inside: tuple[float, ...] | None = self["inside"]
        return inside or (1.0,) * len(self["alpha"])

    def has_region(self) -> bool:
        """Whether a region has sliders of its own."""
        return self.declared.regional is not None and self.marks_object()

    def is_drawn(self) -> bool:
        """Whether the edit uses strokes: it requires them, or a region has sliders of its own."""
        return self.declared.requires_strokes or self.has_region()

    def changes(self) -> bool:
        """Whether the step has any effect."""
        return self.on and self.opacity > 0 and self.would_change()

    def would_change(self) -> bool:
        """Whether the step has any effect when it is switched on."""
        if self.declared.requires_strokes:
            return self.marks_object() and self.values_act
        if self.declared.parts and not any(self[name] for name in self.declared.parts):
            return False
        regions = sliders_of(self.strokes, self.sliders_inside) if self.has_region() else ()
        return self.values_act or any(set(sliders) != {1} for sliders in regions)

    @property
    def values_act(self) -> bool:
        """Whether values differ from those that change nothing, or the edit has no such values."""
        acting = [p for p in self.declared if p.idle is not ...]
        return not acting or any(not p.is_idle(self[p.name]) for p in acting)

    def bytes_per_pixel(self, *, masked: bool = False) -> int:
        """Memory in bytes needed per pixel of an image; ``masked`` if a region is given by other means than strokes."""
        names = {parameter.name for parameter in self.declared}
        if "method" in names and self["method"] == "network":
            return working_bytes(0, 0)  # its tiles are small
        landmarks = self["landmarks"] if "landmarks" in names else 0
        # Patches of 3x3 in colour are as large as those of 5x5 in grey.
        patch_size = max(self["patch_size"], 5) if "patch_size" in names else 0
        return working_bytes(landmarks, patch_size, factors=2 if masked or self.has_region() else 1)

    def arguments(self, size: tuple[int, int], stride: float = 1) -> Arguments:
        """Return the arguments of the edit's function for an image of that size; see :meth:`Parameter.argument_of`."""
        return {p.keyword: p.argument_of(self[p.name], size, stride) for p in self.declared if p.is_argument}

    def filter_options(self, size: tuple[int, int]) -> Arguments:
        """Return the options of :func:`nonlocal_operator` for an image of size (H, W), the viewing size."""
        options = {name: value for name, value in self.arguments(size).items() if name in FILTER_ARGUMENTS}
        distance = self.declared["spatial_bandwidth"].distance(options["spatial_bandwidth"], size)
        return options | {"spatial_bandwidth": distance}

    def to_json(self, indent: str = "", *, complete: bool = False) -> str:
        """Format the step as a JSON object, with one line for each entry and each stroke.

        Args:
            indent: indentation of all lines.
            complete: whether to write defaults, too, so that they can be edited by hand.
        """
        entries = [("edit", json.dumps(self.edit))]
        if not self.on:
            entries.append(("on", "false"))
        if self.opacity != 1:
            entries.append(("opacity", json.dumps(self.opacity)))
        for parameter in self.declared:
            value = self[parameter.name]
            acts = parameter.idle is not ... and not parameter.is_idle(value)
            if value != parameter.default or acts or (complete and parameter.is_option):
                entries.append((parameter.name, json.dumps(value)))
        if self.strokes:
            strokes = ",\n".join(f"{indent}    {json.dumps(stroke.entries())}" for stroke in self.strokes)
            entries.append(("strokes", f"[\n{strokes}\n{indent}  ]"))
        lines = ",\n".join(f'{indent}  "{name}": {value}' for name, value in entries)
        return f"{indent}{{\n{lines}\n{indent}}}"

    @staticmethod
    def from_entries(edit: str, entries: dict[str, object], place: str) -> "Step":
        """Create a step from parsed JSON.

        Args:
            edit: name of the edit.
            entries: JSON object of the step, without the name of the edit.
            place: where the step stands, for errors, such as ``tone, step 2 in edit.json``.

        Raises:
            ValueError: if an entry is unknown or invalid.
        """
        declared, values = EDITS[edit], dict[str, Value]()
        parameters = {parameter.name: parameter for parameter in declared}
        strokes: tuple[Mark, ...] = ()
        on, opacity = _read_mixing(entries, place)
        for entry, value in entries.items():
            if entry in MIXING:
                continue
            if entry == "strokes" and declared.scribbles:
                strokes = _read_strokes(value, declared, place)
                continue
            if entry not in parameters:
                names = [*parameters, *(["strokes"] if declared.scribbles else []), *MIXING]
                raise ValueError(f"{place} must have no entries other than {', '.join(names)}, got {entry}; remove it")
            if not parameters[entry].is_valid(value):
                wanted = parameters[entry].wanted
                raise ValueError(f"{entry} of {place} must be {wanted}, got {shown(value)}; correct it")
            values[entry] = tuple(map(float, value)) if isinstance(value, list) else value
        step = Step(edit, strokes, **values)
        if declared.regional is not None and len(step.sliders_inside) != len(step["alpha"]):
            raise ValueError(f"inside of {place} must have as many numbers as alpha; add or drop some")
        notes = [mark.meaning.sliders for mark in strokes if mark.meaning.sliders is not None]
        if declared.regional is not None and any(len(sliders) != len(step["alpha"]) for sliders in notes):
            raise ValueError(f"sliders in paint of {place} must be as many numbers as alpha; add or drop some")
        return step.mixed(on=on, opacity=opacity)


def acting_steps(steps: Iterable[Step]) -> tuple[Step, ...]:
    """The steps that have an effect."""
    return tuple(step for step in steps if step.changes())


def json_of(steps: Iterable[Step], develop: str = "", *, complete: bool = False) -> str:
    """Format steps as JSON, see :meth:`~nlfilter_torch.photo.declared.presets.Recipe.to_json`.

    ``develop`` is the object of that entry, or nothing.
    """
    text = ",\n".join(step.to_json("    ", complete=complete) for step in steps)
    listed = f"[\n{text}\n  ]" if text else "[]"
    before = f'  "develop": {develop},\n' if develop else ""
    return f'{{\n  "version": {VERSION},\n{before}  "steps": {listed}\n}}\n'


def working_bytes(landmarks: int, patch_size: int, *, factors: int = 1) -> int:
    """Bytes of memory that an edit needs per pixel, slightly more than measured on two megapixels.

    Args:
        landmarks: M, the number of floats of the factor per pixel.
        patch_size: p; two copies of the patches exist while they are weighted.
        factors: number of arrays of the factor's size at once: 1 for filtering, 5 for diagnostics.
    """
    return 4 * (factors * landmarks + 2 * patch_size**2 + 40)


def _read_mixing(entries: dict[str, object], place: str) -> tuple[bool, float]:
    """Whether a step is on, and its opacity."""
    on, opacity = entries.get("on", True), entries.get("opacity", 1.0)
    if not isinstance(on, bool):
        raise ValueError(f"on of {place} must be true or false, got {shown(on)}; correct it")
    if not is_within(opacity, 0, 1):
        raise ValueError(f"opacity of {place} must be a number from 0 to 1, got {shown(opacity)}; correct it")
    return on, float(opacity)


def _read_strokes(value: object, declared: Edit, place: str) -> tuple[Mark, ...]:
    if not isinstance(value, list):
        raise ValueError(f"strokes of {place} must be a list, got {shown(value)}; correct them")
    return tuple(declared.mark_of(stroke, place) for stroke in value)
