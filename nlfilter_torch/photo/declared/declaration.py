"""Declaration of edits and their parameters, read by functions, commands, files, the editor and the documentation.

Does not import torch, so that the command line prints help and lists without delay.
"""

import reprlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import EllipsisType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeGuard, cast

from nlfilter_torch.photo.declared.json_values import Value, is_within
from nlfilter_torch.photo.declared.strokes import (
    WORDS,
    Mark,
    ScribbleRole,
    Shape,
    is_gradient,
    is_layer,
    is_rectangle,
    mark_of,
    meaning_of,
)

if TYPE_CHECKING:
    from torch import Tensor

# Values outside these ranges give no useful result, and numbers overflow.
GAINS = (-1e6, 1e6)  # sliders
USUAL_GAINS = (0.0, 10.0)  # beyond these, the command wants the user to insist
PHOTOMETRIC_RANGE = (0.01, 1e6)  # photometric bandwidths, in grey levels from 0 to 255
SPATIAL_RANGE = (0.01, 1e6)  # spatial bandwidths, in pixels
MAX_SLIDERS = 100
MAX_PATCH = 99  # pixels
MAX_LANDMARKS = 10_000
MAX_NODES = 65  # along each axis of a lattice of colours

#: Arguments of a function by their names, of the types that the declaration of an edit tells.
Arguments = dict[str, Any]
Kind = Literal["number", "count", "odd", "choice", "sliders", "lattice"]
Unit = Literal["", "levels", "lab", "px", "%", "gain"]
Domain = Literal[
    "positive", "not negative", "share", "up to 10", "below 1", "signed share", "stops", "finite", "count", "choice"
]

#: For each gradient: the label of its tool in the editor, the placeholder of its option, and its help.
GRADIENTS: dict[Shape, tuple[str, str, str]] = {
    "linear": (
        "Gradient",
        "X,Y,X,Y",
        "A gradient to add to the mask: a point up to which all is selected, and one from which on nothing is, in "
        "pixels or in %. May be repeated.",
    ),
    "radial": (
        "Oval",
        "X,Y,W,H[,SOFTNESS]",
        "An ellipse to add to the mask, in a rectangle in pixels or in %; it fades along a part of its radius, 50% "
        "unless another is given. May be repeated.",
    ),
}
#: Section in the help of a command for settings of the filter, which few users need.
FILTER_PANEL = "Filter"
#: For each unit: its name in errors, and the placeholder of a value in the help of a command.
UNIT_NAMES: dict[Unit, tuple[str, str | None]] = {
    "": ("", None),
    "levels": ("grey levels", "LEVELS"),
    "lab": ("units of CIE Lab", "LAB"),
    "px": ("pixels", "PIXELS"),
    "%": ("hundredths of the short side", "PERCENT"),
    "gain": ("", "GAIN"),
}


@dataclass(frozen=True)
class Slider:
    """A slider of the editor.

    Attributes:
        label: text beside the slider.
        low: lower end of its range, which may be narrower than that of the parameter.
        high: upper end of its range.
        step: difference between adjacent values.
        none: value that stands for None, if there is one.
        none_text: what the editor shows for it.
        live: whether the picture is updated while the slider moves, not only when it is released.
        knots: ascending values at which the preview computes an edit that is too slow to follow the slider; between
            them it interpolates. Empty for other edits.
    """

    label: str
    low: float
    high: float
    step: float
    none: float | None = None
    none_text: str = "as it is"
    live: bool = True
    knots: tuple[float, ...] = ()


@dataclass(frozen=True)
class Parameter:
    """A parameter of an edit.

    Commands, files and the editor use the same name, unit and range for it. Functions take images in [0, 1] and lengths
    in pixels; :meth:`argument_of` converts.

    Attributes:
        name: name in files, of the editor's slider and, with dashes, of the option.
        kind: kind of value.
        default: default in the command and in files, and in the function unless that defaults to :attr:`idle`.
        help: description for the user.
        low: smallest value.
        high: largest value.
        unit: unit of the value.
        domain: values that the function accepts, if these are more than the range; see :meth:`check_argument`.
        zero_meaning: effect of the value 0, for errors.
        optional: whether None is allowed.
        words: words allowed in place of a number.
        choices: possible values of a choice.
        idle: value that changes nothing; the edit has an effect only if at least one of its parameters that have such
            a value differs from it.
        argument: name of the function's argument, if it differs.
        share: for distances, the share of the short side that None stands for; 0 is no limit.
        min_pixels: minimum in pixels of a length given in hundredths of the short side.
        metavar: placeholder of a value in the help, if it is not that of the unit.
        slider: the editor's slider.
        is_option: whether the command has an option for it.
        is_argument: whether the function takes it under its name.
        length: length of a list; 0 is any.
        panel: title of its section in the help of the command; without one it is among the edit's main options.
        per_image: whether the function also takes a tensor with one value for each image.
        labels: what the editor calls the choices, if it offers them.
        usual: range of the command, which accepts values of :attr:`low` to :attr:`high` beyond it if the user insists.
        part: whether it is the share, from 0 to 1, of a part of what the edit changes, without which nothing changes.
    """

    name: str
    kind: Kind
    default: Value
    help: str
    low: float = 0.0
    high: float = 0.0
    unit: Unit = ""
    domain: Domain | None = None
    zero_meaning: str = ""
    optional: bool = False
    words: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    idle: Value | EllipsisType = ...
    argument: str = ""
    share: float = 0.0
    min_pixels: float = 0.0
    metavar: str | None = None
    slider: Slider | None = None
    is_option: bool = True
    is_argument: bool = True
    length: int = 0
    panel: str | None = None
    per_image: bool = False
    labels: tuple[str, ...] = ()
    usual: tuple[float, float] | None = None
    part: bool = False

    @property
    def keyword(self) -> str:
        """Name of the function's argument."""
        return self.argument or self.name

    @property
    def default_number(self) -> float:
        """The default of a number that has one."""
        return cast(float, self.default)

    @property
    def idle_number(self) -> float:
        """The number that changes nothing, for parameters that have one."""
        return cast(float, self.idle)

    @property
    def wanted(self) -> str:
        """Description of the valid values, for errors.

        >>> Parameter("tones", "count", None, "", 2, 64, optional=True).wanted
        'a whole number from 2 to 64, or null'
        """
        unit = UNIT_NAMES[self.unit][0]
        number = f"a {'positive ' if self.low > 0 else ''}number of {unit}," if unit else "a number"
        ends = [f"{end:.0f}" if abs(end) >= 1e5 else f"{end:g}" for end in (self.low, self.high)]
        span = f"from {ends[0]} to {ends[1]}"
        named = [f'"{choice}"' for choice in self.choices]
        text = {
            "number": f"{number} {span}",
            "count": f"a whole number {span}",
            "odd": f"an odd number {span}",
            "choice": f"{', '.join(named[:-1])} or {''.join(named[-1:])}",
            "sliders": f"a list of {self.length or f'2 to {MAX_SLIDERS}'} numbers {span}",
            "lattice": f"a list of 3 n^3 numbers, n from 2 to {MAX_NODES}",
        }[self.kind]
        alternatives = [f'"{word}"' for word in self.words] + ["null"] * self.optional
        return ", or ".join([text, *alternatives])

    def is_valid(self, value: object) -> TypeGuard[Value | list[float]]:
        """Whether a value read from JSON is valid for this parameter."""
        if value is None:
            return self.optional
        if isinstance(value, str):
            return value in self.words or value in self.choices
        if self.kind == "sliders":
            return (
                isinstance(value, list | tuple)
                and (self.length or 2) <= len(value) <= (self.length or MAX_SLIDERS)
                and all(is_within(v, *GAINS) for v in value)
            )
        if self.kind == "lattice":
            return (
                isinstance(value, list | tuple)
                and nodes_of(len(value)) is not None
                and all(is_within(v, *GAINS) for v in value)
            )
        if self.kind == "number":
            return is_within(value, self.low, self.high)
        return (
            isinstance(value, int) and is_within(value, self.low, self.high) and (self.kind != "odd" or value % 2 == 1)
        )

    def is_idle(self, value: Value) -> bool:
        """Whether a value, or all numbers of a list, equal :attr:`idle`; False for parameters without an idle value."""
        if isinstance(self.idle, tuple):
            return bool(value == self.idle)
        return all(v == self.idle for v in value) if isinstance(value, tuple) else bool(value == self.idle)

    def argument_of(self, value: Value, size: tuple[int, int], stride: float = 1) -> Value:
        """Convert a value to the function's argument: grey levels to [0, 1], and lengths to pixels.

        Args:
            value: valid value of this parameter.
            size: (height, width) of the image.
            stride: sampling step of the image relative to the photograph, in pixels along each axis.

        >>> Parameter("radius", "number", 2.5, "", 0.1, 20, "%").argument_of(2.5, (400, 600))
        10.0
        """
        if value is None or isinstance(value, str | tuple):
            return value
        if self.unit == "levels":
            return value / 255
        if self.unit == "lab":
            return value / 100
        if self.unit == "%":
            return max(value / 100 * min(size), self.min_pixels)
        return value / stride if self.unit == "px" and self.kind == "number" else value

    def pixels(self, value: float | None, size: tuple[int, int]) -> float:
        """Return a length in pixels for an image of that size: the one given to the function, or the default."""
        return cast(float, self.argument_of(self.default, size)) if value is None else float(value)

    def distance(
        self, value: "float | Tensor | Sequence[float | Tensor] | str | None", size: Sequence[int]
    ) -> "float | Tensor | None":
        """Return a distance in pixels for a picture (H, W): the function's argument, or for None :attr:`share` if any.

        It is relative so that a preview and the photograph agree. The word ``"none"`` gives None, for no limit.

        Raises:
            ValueError: if another word is given.
        """
        if isinstance(value, str) and self.words:
            from nlfilter_torch.core.checks import check_choice

            check_choice(value, self.keyword, self.words)
            return None
        if value is None and self.share:
            return self.share * min(size)
        return cast("float | Tensor | None", value)  # checks of the filter refuse a word where none is allowed

    def check_argument(self, value: object, batch: int | None = None) -> None:
        """Check that a function can take ``value``; with ``batch``, if :attr:`per_image`, also shape () or (batch,).

        Raises:
            TypeError, ValueError: if it cannot; the message names the argument.
        """
        from nlfilter_torch.core import checks

        name = self.keyword
        if value is None and (self.optional or self.unit == "%"):
            return
        if self.domain == "choice":
            checks.check_choice(value, name, self.choices)
        elif self.domain == "count":
            checks.check_count(value, name, least=int(self.low), most=int(self.high))
        else:
            batch = batch if self.per_image else None
            if batch is None:
                checks.check_number(value, name, "pass a float or None" if self.unit == "%" else "pass a float")
            if self.domain is not None:
                checks.check_values(value, name, self.domain, batch, self.zero_meaning)


def nodes_of(count: int) -> int | None:
    """Nodes n along each axis of a lattice of 3 n^3 numbers, from 2 to :data:`MAX_NODES`, or None.

    >>> nodes_of(3 * 9**3), nodes_of(100)
    (9, None)
    """
    nodes = round((count / 3) ** (1 / 3))
    return nodes if 2 <= nodes <= MAX_NODES and 3 * nodes**3 == count else None


ScribbleKind = Literal["colours", "mask", "sliders"]
PAINTED: tuple[ScribbleRole, ...] = ("added", "removed")  # roles of what is painted on masks by hand


class MarkOption(NamedTuple):
    """An option of a command that marks a part of the photograph; ``shape`` is that of its marks if it has only one."""

    name: str
    scribble: "Scribble"
    metavar: str = "X,Y,W,H"
    help: str = ""
    shape: Shape | None = None


@dataclass(frozen=True)
class Scribble:
    """A kind of scribbles that an edit takes.

    Commands, files and the editor offer what is declared here; the edit's object receives the scribbles under the name
    of the argument.

    Attributes:
        argument: name of the mask among the arguments of the edit's function.
        label: text of the brush in the editor.
        kind: ``"colours"`` are scribbles whose colours count, ``"mask"`` is a single mask, and ``"sliders"`` are masks
            of several regions that have sliders of their own.
        role: ``"object"`` marks what the edit changes, or keeps sharp; ``"background"`` marks what it leaves out.
            Scribbles on the object cover those on the background. ``"added"`` and ``"removed"`` are what a brush and
            an eraser paint on the mask that is computed from these, the later over the earlier. ``"box"`` is a
            rectangle that holds the object; one that says no colour or sliders holds all objects.
        needed: whether the edit has no effect without them, or without what is added.
        option: except for the object, the option of the command that takes a rectangle; without one, the command does
            not offer these scribbles.
        option_help: description of that option.
        advice: for objects that are needed, the error of the command if there are none.
        gradients: the shapes of gradients for which the command has options, and the editor tools.
    """

    argument: str
    label: str
    kind: ScribbleKind = "mask"
    role: ScribbleRole = "object"
    needed: bool = False
    option: str = ""
    option_help: str = ""
    advice: str = ""
    gradients: tuple[Shape, ...] = ()

    @property
    def word(self) -> str:
        """The paint of marks with its role, in which ``colour`` stands for any colour.

        >>> Scribble("keep", "Keep", role="background").word, Scribble("added", "Brush", "colours", "added").word
        ('out', 'add colour')
        """
        if self.kind != "colours":
            return WORDS[self.role]
        return "colour" if self.role == "object" else f"{WORDS[self.role]} colour"

    @property
    def tools(self) -> dict[str, str]:
        """The labels of the tools of the editor that draw them, by the paint of their marks, after a gradient's shape.

        >>> Scribble("added", "Brush", "colours", "added", gradients=("linear",)).tools
        {'add colour': 'Brush', 'linear: add colour': 'Gradient'}
        """
        own = {self.word: self.label}
        return own | {f"{shape}: {self.word}": GRADIENTS[shape][0] for shape in self.gradients}

    @property
    def options(self) -> tuple[MarkOption, ...]:
        """The options of the command for these scribbles."""
        own = MarkOption(self.option or "--region", self, help=self.option_help)
        return (own, *(MarkOption(f"--{shape}", self, *GRADIENTS[shape][1:], shape) for shape in self.gradients))


@dataclass(frozen=True)
class Condition:
    """A value of another parameter without which a parameter has no effect.

    Attributes:
        name: the other parameter.
        value: its value.
        note: what the command says after the name of an option that has no effect.
    """

    name: str
    value: str
    note: str


@dataclass(frozen=True)
class Edit:
    """What an edit is called, takes and offers; :mod:`nlfilter_torch.photo.edits` holds what it does.

    Attributes:
        name: name of its command, and of its steps in files.
        help: help text of the command.
        parameters: parameters of the edit itself, then those of its filter.
        function: public name of its function, if that is not ``name``.
        hint: sentence shown in the editor.
        scribbles: the kinds of scribbles that it takes, the one on the object first.
        coloured: whether the edit turns a grey photograph into a colour one.
        map_help: description of the option ``--map``, if the edit can draw a map of what it estimates.
        error_help: description of the option ``--error-map``, if the edit can tell the errors of its pixels.
        presets: names of the edits, besides this one, of which the command takes a single step as a preset; without any
            it takes no presets.
        filter_condition: when the parameters of the filter have an effect; None is always.
    """

    name: str
    help: str
    parameters: tuple[Parameter, ...]
    function: str = ""
    hint: str = ""
    scribbles: tuple[Scribble, ...] = ()
    coloured: bool = False
    map_help: str = ""
    error_help: str = ""
    presets: tuple[str, ...] = ()
    filter_condition: Condition | None = None

    def __iter__(self) -> Iterator[Parameter]:
        """Iterate over the parameters."""
        return iter(self.parameters)

    def __getitem__(self, name: str) -> Parameter:
        """Return the parameter with that name, or with that name of the function's argument."""
        return next(p for p in self if name in (p.name, p.keyword))

    @cached_property
    def defaults(self) -> Arguments:
        """Defaults of the function's arguments, in its units; None for lengths that depend on the image."""
        return {p.keyword: None if p.unit == "%" else p.argument_of(p.default, (0, 0)) for p in self}

    def check(self, batch: int | None = None, **arguments: object) -> None:
        """Check arguments of the function, in the order given; see :meth:`Parameter.check_argument`."""
        for name, value in arguments.items():
            self[name].check_argument(value, batch)

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """Names of the parameters that are shares of parts of the change; if all of them are 0, nothing changes."""
        return tuple(p.name for p in self if p.part)

    @property
    def words(self) -> tuple[str, ...]:
        """The paints that marks can have."""
        return tuple(scribble.word for scribble in self.scribbles)

    @property
    def requires_strokes(self) -> bool:
        """Whether the edit has no effect without strokes."""
        return any(scribble.needed for scribble in self.scribbles)

    @property
    def with_options(self) -> tuple[MarkOption, ...]:
        """The options of the command for scribbles, but for the one on objects."""
        return tuple(option for scribble in self.scribbles if scribble.option for option in scribble.options)

    def with_role(self, *roles: ScribbleRole) -> tuple[Scribble, ...]:
        """The scribbles that have one of these roles."""
        return tuple(scribble for scribble in self.scribbles if scribble.role in roles)

    def mark_of(self, value: object, place: str) -> Mark:
        """Create a mark from a JSON value, see :func:`~nlfilter_torch.photo.declared.strokes.mark_of`.

        Raises:
            ValueError: if it is none that the edit takes; ``place`` says in the message where it was found.
        """
        mark = mark_of(value, place)
        self.check_mark(mark, f"a stroke in {place}")
        return mark

    def check_mark(self, mark: Mark, place: str) -> None:
        """Raise ValueError unless the edit takes marks with such a meaning: their role, with a colour if it needs one.

        A colour or sliders that were meant for another edit mean nothing to an edit that has no use for them.
        """
        meaning = meaning_of(mark.paint) if isinstance(mark.paint, str) else None
        kinds = set() if meaning is None else {scribble.kind for scribble in self.with_role(meaning.role)}
        coloured = is_layer(mark) or (meaning is not None and meaning.colour is not None)
        sliders = None if meaning is None else meaning.sliders
        is_box = meaning is not None and meaning.role == "box"
        if is_box and not is_rectangle(mark):
            kind = getattr(mark, "shape", "line")
            raise ValueError(
                f"paint of {place} must be box for rectangles only, got a different shape, {kind}; correct it"
            )
        if is_gradient(mark) and meaning is not None and meaning.role not in PAINTED:
            raise ValueError(f"paint of {place} must be add or remove for gradients, got {mark.paint}; correct it")
        if "mask" in kinds or ("colours" in kinds and (coloured or is_box)):
            return
        if "sliders" in kinds and (sliders is None or self["alpha"].is_valid(sliders)):
            return
        wanted = ", ".join(map(_described, self.words))
        raise ValueError(f"paint of {place} must be one of {wanted}, got {reprlib.repr(mark.paint)}; correct it")

    @property
    def object_roles(self) -> tuple[ScribbleRole, ...]:
        """The roles of marks that say what an object is: additions and boxes, too, if the edit computes masks."""
        return ("object", "added", "box") if self.with_role("added") else ("object",)

    def marks_object(self, marks: Iterable[Mark]) -> bool:
        """Whether one of the marks says what an object is."""
        return any(mark.role in self.object_roles for mark in marks)

    @property
    def regional(self) -> Scribble | None:
        """The scribbles on regions that have sliders of their own, if the edit takes such."""
        return next((scribble for scribble in self.scribbles if scribble.kind == "sliders"), None)


def _described(word: str) -> str:
    """A meaning of marks, for errors."""
    before, colour, _ = word.partition("colour")
    return f"{before}{'with ' if before else ''}a colour such as {before}#c04020" if colour else word
