"""The tab of an edit: its sliders, and the settings of the brush that draws strokes for it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from nicegui import ui

from nlfilter_torch.photo.app import controls
from nlfilter_torch.photo.app.brush import BRUSHES, COLOURS, RADIUS, Brush
from nlfilter_torch.photo.app.controls import Change, Choice, Control, Slider, SteadySlider
from nlfilter_torch.photo.app.step_list import Replace
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.strokes import ScribbleRole

BY_HAND = "Brush (B) and Eraser (E) paint on the mask itself; S is the first tool again."


@dataclass(frozen=True)
class PhotoLink:
    """What the tab of the photograph itself calls.

    Attributes:
        develop: is called with changes, and whether they are complete.
        crop: is called to show the frame of the crop, or to hide it.
        is_cropping: returns whether it is shown.
        hold: is called with the proportions that a crop is to keep.
        held: returns these.
        pick: is called to let a person point at something grey, or to stop that.
        is_picking: returns whether the next click does that.
    """

    develop: Callable[[Mapping[str, Value], bool], object]
    crop: Callable[[], None]
    is_cropping: Callable[[], bool]
    hold: Callable[[str], None]
    held: Callable[[], str]
    pick: Callable[[], None]
    is_picking: Callable[[], bool]


@dataclass(frozen=True)
class Link:
    """What the tabs show, and what they call.

    Attributes:
        recipe: returns the current edit.
        brush: its settings, which the tabs show and change.
        change: is called with changes of the parameters of a step.
        clear: is called with a step whose strokes are to be removed.
        replace: is called with another edit, and the place of the step whose slider moves, or None.
        thumbnail: returns the address of a picture of the photograph under a look, or "" if there is none.
        photo: what the tab of the photograph itself calls.
    """

    recipe: Callable[[], Recipe]
    brush: Brush
    change: Change
    clear: Callable[[str], None]
    replace: Replace
    thumbnail: Callable[[str], str]
    photo: PhotoLink


class EditTab:
    """The tab of an edit, built into the open element."""

    def __init__(self, edit: str, link: Link) -> None:
        self._edit, self._link = edit, link
        self._sliders: list[Slider] = []
        self._choices: list[Choice] = []
        self._build()

    def follow(self) -> None:
        """Show the current edit."""
        for slider in self._sliders:
            slider.follow()
        for choice in self._choices:
            choice.follow()

    def take(self, role: ScribbleRole) -> None:
        """Take the tool that draws scribbles with a role, if the edit has one."""
        if self._edit in BRUSHES:
            for scribble in EDITS[self._edit].with_role(role):
                self._tools.set_value(scribble.word)

    def draw_response(self, svg: str) -> None:
        """Show the response of the sliders, in a tab that has a place for it."""

    def _build(self) -> None:
        ui.label(EDITS[self._edit].hint).classes("hint")
        needs_strokes = EDITS[self._edit].requires_strokes  # then painting comes first
        if needs_strokes:
            self._build_brush()
        self._sliders += [self._slider(control) for control in controls.OF_EDIT[self._edit]]
        self._choices += controls.choices(self._edit, self._link.recipe, self._link.change)
        if not needs_strokes:
            self._build_brush()

    def _slider(self, control: Control, suffix: str = "") -> Slider:
        return Slider(control, self._link.recipe, self._link.change, suffix)

    def _build_brush(self, hint: str = "") -> None:
        """Build the settings of the brush, if the edit takes strokes."""
        if self._edit not in BRUSHES:
            return
        brush, edit = self._link.brush, self._edit
        with ui.row().classes("w-full items-center no-wrap"):
            ui.label("Tools").classes("group")
            ui.space()
            clear = ui.button("Clear strokes", on_click=partial(self._link.clear, edit))
            clear.props("flat dense no-caps")
        if hint:
            ui.label(hint).classes("hint")
        self._tools = ui.toggle(BRUSHES[edit], value=brush.word[edit])
        self._tools.props('dense no-caps unelevated spread role="group" aria-label="Tools"').classes("w-full q-mt-xs")
        self._tools.on_value_change(lambda event: brush.word.update({edit: event.value}))
        if EDITS[edit].with_role("added"):
            ui.label(BY_HAND).classes("hint wide")
        if "colour" in BRUSHES[edit]:
            self._build_colours()
        with ui.row().classes("w-full items-center no-wrap gap-3 q-mt-xs"):
            ui.label("Size").tooltip("Radius of the brush, in hundredths of the short side")
            size = SteadySlider(min=0.5, max=10, step=0.5, value=100 * brush.radius[edit])
            size.props('dense label aria-label="Brush size"')
            size.on_value_change(lambda event: brush.radius.update({edit: event.value / 100}))
            size.on_reset(lambda: size.set_value(100 * RADIUS))

    def _build_colours(self) -> None:
        """Build a field for the colour that the brush paints, the same in all tabs, and buttons for some colours."""
        brush = self._link.brush
        with ui.row().classes("gap-2 q-mt-xs"):
            for colour in COLOURS:
                ui.button(on_click=partial(brush.choose_colour, colour)).props(
                    f'round dense unelevated size=sm aria-label="{colour}"'
                ).style(f"background: {colour} !important")
        field = ui.color_input("Colour", value=brush.colour, on_change=lambda event: brush.choose_colour(event.value))
        field.props("dense outlined").classes("w-full q-mt-xs")
        brush.shown.append(field.set_value)
