"""What a parameter of an edit is: declared once, read by functions, commands, files, the editor and the documentation.

Imports no torch, so that help and lists of the command line appear at once.
"""

import json
import reprlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

GAINS = (-1e6, 1e6)  # of sliders; beyond these and the following ranges nothing useful is left, and numbers overflow
BANDWIDTHS = (0.01, 1e6)  # photometric, in grey levels of 255
DISTANCES = (0.01, 1e6)  # spatial bandwidths, in pixels
MAX_SLIDERS = 100
MAX_PATCH = 99  # pixels
MAX_LANDMARKS = 10_000

Kind = Literal["number", "count", "odd", "choice", "sliders"]
Unit = Literal["", "levels", "lab", "px", "%", "gain"]
Domain = Literal["positive", "not negative", "share", "below 1", "finite", "count", "choice"]

#: Of a unit: how errors call a number of it, and what stands for a value in the help of a command.
UNITS: dict[Unit, tuple[str, str | None]] = {
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
        label: what the user reads.
        low: end of its range, which may be narrower than that of the parameter.
        high: likewise.
        step: between values.
        none: value that stands for None, or None.
        live: whether the picture follows while the slider moves; else when it is released.
    """

    label: str
    low: float
    high: float
    step: float
    none: float | None = None
    live: bool = True


@dataclass(frozen=True)
class Parameter:
    """A parameter of an edit.

    Commands, files and the editor have one name, unit and range for it. Functions take images in [0, 1] and lengths in
    pixels: :meth:`argument_of` converts.

    Attributes:
        name: in files, of the editor's slider, and with dashes of the option.
        kind: of value.
        default: of the command and of files, and of the function too, but for parameters that are :attr:`idle` there.
        help: what it does.
        low: smallest value.
        high: largest value.
        unit: of the value.
        domain: what the function accepts, where that is more than the range; see :meth:`check_argument`.
        zero: what 0 does, for errors.
        optional: whether None is a value.
        words: that may stand in place of a number.
        choices: of a choice.
        idle: the value that changes nothing, for parameters of which at least one must differ for the edit to change
            anything.
        argument: name of the function's argument, if it is another one.
        share: of the short side that None stands for, for distances; 0 is no limit.
        least: pixels that a length in hundredths of the short side has at least.
        former: other names in files, and what values under them are multiplied by, or a function that converts them;
            those of the same unit are names of the option, too.
        metavar: stands for a value in the help, where it is not that of the unit.
        slider: of the editor.
        is_option: whether the command takes it, beside files.
        length: of a list; 0 is any.
    """

    name: str
    kind: Kind
    default: Any
    help: str
    low: float = 0.0
    high: float = 0.0
    unit: Unit = ""
    domain: Domain | None = None
    zero: str = ""
    optional: bool = False
    words: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    idle: Any = ...
    argument: str = ""
    share: float = 0.0
    least: float = 0.0
    former: tuple[tuple[str, float | Callable[[float], float]], ...] = ()
    metavar: str | None = None
    slider: Slider | None = None
    is_option: bool = True
    length: int = 0

    @property
    def keyword(self) -> str:
        """Name of the function's argument."""
        return self.argument or self.name

    @property
    def wanted(self) -> str:
        """What a value must be, in words.

        >>> Parameter("tones", "count", None, "", 2, 64, optional=True).wanted
        'a whole number from 2 to 64, or null'
        """
        unit = UNITS[self.unit][0]
        number = f"a {'positive ' if self.low > 0 else ''}number of {unit}," if unit else "a number"
        ends = [f"{end:.0f}" if abs(end) >= 1e5 else f"{end:g}" for end in (self.low, self.high)]
        span = f"from {ends[0]} to {ends[1]}"
        named = [f'"{choice}"' for choice in self.choices]
        text = {
            "number": f"{number} {span}",
            "count": f"a whole number {span}",
            "odd": f"an odd number {span}",
            "choice": f"{', '.join(named[:-1])} or {''.join(named[-1:])}",
            "sliders": f"a list of {self.length or f'2 to {MAX_SLIDERS}'} numbers, none beyond {GAINS[1]:.0f}",
        }[self.kind]
        alternatives = [f'"{word}"' for word in self.words] + ["null"] * self.optional
        return ", or ".join([text, *alternatives])

    def is_valid(self, value: Any) -> bool:
        """Whether a value of JSON is one of this parameter."""
        if value is None:
            return self.optional
        if isinstance(value, str):
            return value in self.words or value in self.choices
        if self.kind == "sliders":
            return (
                isinstance(value, list | tuple)
                and (len(value) == self.length or (not self.length and 2 <= len(value) <= MAX_SLIDERS))
                and all(is_within(v, *GAINS) for v in value)
            )
        if self.kind == "number":
            return is_within(value, self.low, self.high)
        return (
            isinstance(value, int) and is_within(value, self.low, self.high) and (self.kind != "odd" or value % 2 == 1)
        )

    def is_idle(self, value: Any) -> bool:
        """Whether the edit changes nothing as far as this value goes; False for parameters without an idle value."""
        if isinstance(self.idle, tuple):
            return bool(value == self.idle)
        return all(v == self.idle for v in value) if isinstance(value, tuple) else bool(value == self.idle)

    def argument_of(self, value: Any, size: tuple[int, int], stride: float = 1) -> Any:
        """The function's argument for a value: grey levels become those of [0, 1], and lengths become pixels.

        Args:
            value: one of this parameter.
            size: (height, width) of the image.
            stride: every how many pixels of the photograph the image has one.

        >>> Parameter("radius", "number", 2.5, "", 0.1, 20, "%").argument_of(2.5, (400, 600))
        10.0
        """
        if value is None or isinstance(value, str):
            return value
        if self.unit == "levels":
            return value / 255
        if self.unit == "lab":
            return value / 100
        if self.unit == "%":
            return max(value / 100 * min(size), self.least)
        return value / stride if self.unit == "px" and self.kind == "number" else value

    def pixels(self, given: float | None, size: tuple[int, int]) -> float:
        """A length for an image of that size: the one given to the function, or the default."""
        return float(self.argument_of(self.default, size) if given is None else given)

    def check_argument(self, value: Any, batch: int | None = None) -> None:
        """Raise unless a function can take ``value``; with ``batch``, tensors of shape () or (batch,) are numbers too.

        Raises:
            TypeError, ValueError: with a sentence that names the argument.
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
            if batch is None:
                checks.check_number(value, name, "pass a float or None" if self.unit == "%" else "pass a float")
            if self.domain is not None:
                checks.check_values(value, name, self.domain, batch, self.zero)


@dataclass(frozen=True)
class Edit:
    """An edit and its parameters.

    Attributes:
        name: of its command, and of its steps in files.
        help: text of the command.
        parameters: those of the edit itself, then those of its filter.
        hint: a sentence for the editor.
        brushes: what strokes may say, and how the editor calls it; ``colour`` is any colour.
        needs: that without strokes it changes nothing.
        coloured: that it gives colours to a grey photograph.
    """

    name: str
    help: str
    parameters: tuple[Parameter, ...]
    hint: str = ""
    brushes: tuple[tuple[str, str], ...] = ()
    needs: bool = False
    coloured: bool = False

    def __iter__(self) -> Iterator[Parameter]:
        """Its parameters."""
        return iter(self.parameters)

    def __getitem__(self, name: str) -> Parameter:
        """The parameter of that name, or of that name in the function."""
        return next(p for p in self if name in (p.name, p.keyword))

    @cached_property
    def defaults(self) -> dict[str, Any]:
        """The defaults of the function's arguments, in its units; None for lengths that depend on the image."""
        return {p.keyword: None if p.unit == "%" else p.argument_of(p.default, (0, 0)) for p in self}

    @property
    def words(self) -> tuple[str, ...]:
        """What strokes may say."""
        return tuple(word for word, _ in self.brushes)


def parse_json(text: str, name: str, remedy: str) -> Any:
    """What the text of the file ``name`` holds.

    Raises:
        ValueError: if it is not JSON, or nested deeper than Python can follow.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else f"it is not JSON ({error})"
        raise ValueError(f"{name} is no preset: {reason}; {remedy}") from error


def shown(value: Any) -> str:
    """A value of JSON for a message, however long or deeply nested it is.

    >>> shown({"a": None}), shown([0] * 100)
    ('{"a": null}', '[0, 0, 0, 0, 0, 0, ...]')
    """
    short = reprlib.repr(value)
    try:
        text = json.dumps(value)
    except RecursionError:
        return short
    return text if len(text) <= 80 else short


def is_within(value: Any, low: float, high: float) -> bool:
    """Whether a value of JSON is a number in a range of finite ends; NaN is not."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
