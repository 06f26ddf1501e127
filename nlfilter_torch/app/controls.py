"""The controls of the editor, told in a few words each, and how they become widgets that follow the edit."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from nicegui import ui

from nlfilter_torch.edits.recipe import Recipe

Change = Callable[[str, dict[str, Any], bool], None]  # step, entries, whether the change is complete


@dataclass(frozen=True)
class Control:
    """A slider for one entry of a step.

    Attributes:
        step: its name.
        entry: its name.
        label: what the user reads.
        low: end of the range.
        high: end of the range.
        grain: of the values.
        help: a sentence.
        unit: behind the value.
        index: of the number that the slider is for, where the entry is a list of them.
        live: whether the picture follows while the slider moves; else when it is let go.
        none: value that stands for None, or None.
    """

    step: str
    entry: str
    label: str
    low: float
    high: float
    grain: float
    help: str
    unit: str = ""
    index: int | None = None
    live: bool = True
    none: float | None = None

    def read(self, recipe: Recipe) -> float:
        """The slider's value under an edit."""
        value = getattr(getattr(recipe, self.step), self.entry)
        if self.index is not None:
            value = value[self.index]
        return self.none if value is None and self.none is not None else float(value)

    def entries(self, recipe: Recipe, value: float) -> dict[str, Any]:
        """What the step takes for a value of the slider."""
        if self.none is not None:
            return {self.entry: None if value == self.none else round(value)}
        value = round(value, 4)
        if self.index is None:
            return {self.entry: value}
        numbers = list(getattr(getattr(recipe, self.step), self.entry))
        numbers[self.index] = value
        return {self.entry: tuple(numbers)}

    def show(self, value: float) -> str:
        """The value as text.

        >>> RADIUS.show(2.5), TONES.show(1)
        ('2.5 %', 'all')
        """
        if value == self.none:
            return "all"
        places = max(0, len(f"{self.grain:g}".partition(".")[2]))
        return f"{value:.{places}f}{' ' + self.unit if self.unit else ''}"


LAYERS = (
    ("Texture", "The finest detail: hair, cloth, grain."),
    ("Fine detail", "Small shapes: wrinkles, leaves, letters."),
    ("Large detail", "Light and shade within things."),
)


def detail_sliders(entry: str, count: int) -> tuple[Control, ...]:
    """A slider for each layer of the details; ``entry`` is ``alpha`` or ``inside``."""
    names = LAYERS if count == 4 else tuple((f"Layer {i + 1}", "Fine to coarse.") for i in range(count - 1))
    finer = [
        Control("detail", entry, name, 0, 5, 0.05, text + " 1 leaves it, 0 takes it away.", "\u00d7", i)
        for i, (name, text) in enumerate(names)
    ]
    shading = "The smooth rest: brightness and contrast as a whole. 1 leaves it."
    return (*finer, Control("detail", entry, "Shading", 0.7, 1.3, 0.01, shading, "\u00d7", count - 1))


SPREAD = Control("detail", "spread", "Reach of the region", 0.1, 5, 0.1, "How far it spreads to what is less alike.")
REACH = Control("recolor", "reach", "Reach", 0, 0.95, 0.05, "How far a colour spreads to what is less alike.")
TOLERANCE = Control(
    "recolor",
    "tolerance",
    "Tolerance",
    3,
    40,
    1,
    "How different colours may be and still count as alike, in units of CIE Lab.",
    live=False,  # it takes another filter
)
STRENGTH = Control("colorize", "strength", "Fill", 0, 1, 0.05, "How much colour goes to what resembles no stroke.")
RADIUS = Control(
    "defocus", "radius", "Blur", 0.5, 10, 0.1, "Radius of the strongest blur, as a share of the short side.", "%"
)
POWER = Control("abstract", "power", "Flatten", 0, 1, 0.01, "How much detail goes: 0 none, 0.1 all but outlines.")
EDGES = Control("abstract", "edges", "Lines", 0, 1, 0.05, "Darkness of lines along edges.")
WIDTH = Control("abstract", "width", "Width of lines", 0.5, 6, 0.1, "In thousandths of the short side.", "\u2030")
TONES = Control("abstract", "tones", "Tones", 1, 16, 1, "Reduce brightness to so many tones.", none=1)

OF_STEP: dict[str, tuple[Control, ...]] = {
    "recolor": (REACH, TOLERANCE),
    "colorize": (STRENGTH,),
    "defocus": (RADIUS,),
    "abstract": (POWER, EDGES, WIDTH, TONES),
}


class SteadySlider(ui.slider):
    """A slider that the server does not answer: an answer that comes late would move it back under the pointer."""

    LOOPBACK = False


class Slider:
    """A slider on the page that follows the edit and changes it.

    Args:
        control: what it is for.
        recipe: gives the edit as it is.
        change: takes changes.
        suffix: behind the label for readers of the page's structure, where two sliders have one name.
    """

    def __init__(self, control: Control, recipe: Callable[[], Recipe], change: Change, suffix: str = "") -> None:
        self._control, self._recipe, self._change = control, recipe, change
        self._following = False
        with ui.column().classes("control gap-0"):
            with ui.row().classes("w-full justify-between items-center"):
                ui.label(control.label).tooltip(control.help)
                self._value = ui.label().classes("value")
            value = control.read(recipe())
            self._slider = SteadySlider(min=control.low, max=control.high, step=control.grain, value=value)
            self._slider.props(f'aria-label="{control.label}{suffix}" dense')
            self._slider.on_value_change(lambda event: self._moved(event.value))
            self._slider.on("change", lambda event: self._released(float(event.args)))
        self._value.set_text(control.show(value))

    def follow(self) -> None:
        """Show the edit as it is."""
        value = self._control.read(self._recipe())
        self._following = True
        self._slider.set_value(value)
        self._following = False
        self._value.set_text(self._control.show(value))

    def _moved(self, value: float | None) -> None:
        if self._following or value is None:
            return
        self._value.set_text(self._control.show(value))
        if self._control.live:
            self._change(self._control.step, self._control.entries(self._recipe(), value), False)

    def _released(self, value: float) -> None:
        self._change(self._control.step, self._control.entries(self._recipe(), value), True)
