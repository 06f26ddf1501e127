"""The sliders of the editor: what each of them sets, and the widget that shows and changes it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Self

from nicegui import ui

from nlfilter_torch.photo.declared import declaration
from nlfilter_torch.photo.declared.declaration import Parameter
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import DETAIL, EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step

Change = Callable[[str, Mapping[str, Value], bool], None]  # step, values, whether the change is complete
Replace = Callable[[Recipe, int | None], None]  # a new edit, and the place of the step whose slider moves, or None
SYMBOLS = {"gain": "\u00d7", "%": "%"}


@dataclass(frozen=True)
class Control:
    """A slider for a parameter of a step.

    Attributes:
        edit: name of the step.
        parameter: what it sets.
        slider: its range and label.
        help: a sentence.
        index: which number the slider sets, if the parameter is a tuple of numbers.
    """

    edit: str
    parameter: Parameter
    slider: declaration.Slider
    help: str
    index: int | None = None

    def read(self, recipe: Recipe) -> float:
        """The slider's value for an edit."""
        if self.index is not None:
            return float(self._numbers(recipe)[self.index])
        value: float | None = recipe.current(self.edit)[self.parameter.name]
        if value is None:
            return self.slider.low if self.slider.none is None else self.slider.none
        return float(value)

    def _numbers(self, recipe: Recipe) -> tuple[float, ...]:
        """The numbers of which the slider sets one."""
        step = recipe.current(self.edit)
        numbers: tuple[float, ...] = step[self.parameter.name]
        return step.sliders_inside if self.parameter.name == "inside" else numbers

    def usual(self, recipe: Recipe) -> float:
        """The slider's value at the start; in a region, that of the slider elsewhere.

        >>> OF_EDIT["sharpen"][0].usual(Recipe())
        1.0
        """
        step = Step.idle(self.edit)
        if self.parameter.name == "inside":
            step = step.changed(inside=recipe.current(self.edit)["alpha"])
        elif self.index is not None:
            step = step.changed(strokes=None, **{self.parameter.name: (1.0,) * len(self._numbers(recipe))})
        return self.read(Recipe((step,)))

    def entries(self, recipe: Recipe, value: float) -> dict[str, Value]:
        """The values of the step's parameters for a value of the slider."""
        name = self.parameter.name
        if self.slider.none is not None:
            number = round(value) if self.slider.step >= 1 else round(value, 4)
            return {name: None if value == self.slider.none else number}
        value = round(value, 4)
        if self.index is None:
            return {name: value}
        numbers = list(self._numbers(recipe))
        numbers[self.index] = value
        return {name: tuple(numbers)}

    def show(self, value: float) -> str:
        """The value as text.

        >>> [control.show(2) for control in (*OF_EDIT["defocus"], OF_EDIT["abstract"][-1])]
        ['2.0 %', '2']
        """
        if value == self.slider.none:
            return self.slider.none_text
        return f"{digits(value, self.slider.step)} {SYMBOLS.get(self.parameter.unit, '')}".rstrip()


def digits(value: float, step: float) -> str:
    """A value of a slider as text, with the places that its step has."""
    return f"{value:.{len(f'{step:g}'.partition('.')[2])}f}"


LAYERS = (
    ("Texture", "The finest detail: hair, cloth, grain."),
    ("Fine detail", "Small shapes: wrinkles, leaves, letters."),
    ("Large detail", "Light and shade within objects."),
)


def detail_sliders(name: str, count: int) -> tuple[Control, ...]:
    """A slider for each layer of the details; ``name`` is ``alpha`` or ``inside``."""
    layers = LAYERS if count == 4 else tuple((f"Layer {i + 1}", "Fine to coarse.") for i in range(count - 1))
    parameter = DETAIL[name]
    finer = [
        Control("detail", parameter, declaration.Slider(label, 0, 5, 0.05), text + " 1 leaves it, 0 removes it.", i)
        for i, (label, text) in enumerate(layers)
    ]
    shading = "The smooth rest: overall brightness and contrast. 1 leaves it."
    last = declaration.Slider("Shading", 0.7, 1.3, 0.01)
    return (*finer, Control("detail", parameter, last, shading, count - 1))


#: Sliders of the parameters that declare one, of every edit.
OF_EDIT: dict[str, tuple[Control, ...]] = {
    edit.name: tuple(Control(edit.name, p, p.slider, p.help) for p in edit if p.slider is not None)
    for edit in EDITS.values()
}


def show_pressed(button: ui.button, on: bool) -> None:
    """Show whether a button that switches something is pressed, as screen readers and the style sheet read it."""
    button.props(f'aria-pressed="{str(on).lower()}"')


RESETTING = ("dblclick", "keydown.home.prevent", "keydown.delete", "keydown.backspace")


class SteadySlider(ui.slider):
    """A slider to which the server does not send values back, since a late one would move it away from the pointer."""

    LOOPBACK = False

    def on_reset(self, reset: Callable[[], object]) -> Self:
        """Call a function on a double-click, or when Home, Delete or Backspace is pressed."""
        for event in RESETTING:
            self.on(event, lambda _: reset(), args=[])
        return self


class Slider:
    """A slider on the page that shows the current edit and calls ``change`` with changes.

    Where two sliders have the same label, ``suffix`` tells them apart for screen readers.
    """

    def __init__(self, control: Control, recipe: Callable[[], Recipe], change: Change, suffix: str = "") -> None:
        self._control, self._recipe, self._change = control, recipe, change
        with ui.column().classes("control gap-0"):
            with ui.row().classes("w-full justify-between items-center"):
                ui.label(control.slider.label).tooltip(control.help)
                self._value = ui.label().classes("value")
            value = control.read(recipe())
            self._slider = SteadySlider(
                min=control.slider.low, max=control.slider.high, step=control.slider.step, value=value
            )
            self._slider.props(f'aria-label="{control.slider.label}{suffix}" dense')
            self._slider.on_value_change(lambda event: self._moved(event.value))
            self._slider.on("change", lambda event: self._released(float(event.args)))
            self._slider.on_reset(self.reset)
        self._value.set_text(control.show(value))

    def follow(self) -> None:
        """Show the current edit."""
        value = self._control.read(self._recipe())
        self._slider.set_value(value)
        self._value.set_text(self._control.show(value))

    def set_enabled(self, is_enabled: bool) -> None:
        """Let the slider be moved, or not."""
        self._slider.set_enabled(is_enabled)

    def reset(self) -> None:
        """Set the slider to its value at the start."""
        self._released(self._control.usual(self._recipe()))

    def _moved(self, value: float | None) -> None:
        if value is None:
            return
        self._value.set_text(self._control.show(value))
        if self._control.slider.live and value != self._control.read(self._recipe()):  # otherwise it follows the edit
            self._change(self._control.edit, self._control.entries(self._recipe(), value), False)

    def _released(self, value: float) -> None:
        self._change(self._control.edit, self._control.entries(self._recipe(), value), True)


class Choice:
    """A choice of what takes part, which shows the current edit and calls ``change`` with changes.

    Two buttons choose between all that is alike nearby and the object alone; a box lets what is alike be anywhere.
    """

    def __init__(self, edit: str, parameter: Parameter, recipe: Callable[[], Recipe], change: Change) -> None:
        self._edit, self._parameter, self._recipe, self._change = edit, parameter, recipe, change
        (near, alike), (alone, only), (self._wide, wider) = zip(parameter.choices, parameter.labels, strict=True)
        self._near = near
        with ui.row().classes("w-full items-center no-wrap gap-2 q-mt-xs"):
            self._buttons = {
                value: ui.button(label, on_click=partial(self._choose, value))
                .props("dense no-caps unelevated")
                .classes("q-px-sm")
                .tooltip(parameter.help)
                for value, label in ((alone, only), (near, alike))
            }
            self._wider = ui.checkbox(wider).props("dense").tooltip(parameter.help)
        self.follow()
        self._wider.on_value_change(lambda event: self._widen(event.value))

    @property
    def _chosen(self) -> str:
        return str(self._recipe().current(self._edit)[self._parameter.name])

    def follow(self) -> None:
        """Show the current edit."""
        chosen = self._chosen
        for value, button in self._buttons.items():
            is_on = value == (self._near if chosen == self._wide else chosen)
            show_pressed(button, is_on)
            button.props(f"color={'primary' if is_on else 'grey-8'}")
        self._wider.set_visibility(chosen in (self._near, self._wide))
        self._wider.set_value(chosen == self._wide)

    def _choose(self, value: str) -> None:
        if value != self._chosen and not (value == self._near and self._wider.value):
            self._change(self._edit, {self._parameter.name: value}, True)

    def _widen(self, wide: bool) -> None:
        """Let what is alike be anywhere, or near; the box follows the edit, too, where only the object takes part."""
        if self._chosen == (self._near if wide else self._wide):
            self._change(self._edit, {self._parameter.name: self._wide if wide else self._near}, True)


def choices(edit: str, recipe: Callable[[], Recipe], change: Change) -> list[Choice]:
    """A control for every choice of an edit that the editor offers, built into the open element."""
    return [Choice(edit, parameter, recipe, change) for parameter in EDITS[edit] if parameter.labels]
