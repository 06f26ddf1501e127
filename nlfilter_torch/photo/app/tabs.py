"""The tabs of edits: sliders, the settings of the brush, and what photographs, details and looks have beside these."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from nicegui import ui
from torch import Tensor

from nlfilter_torch.photo.app import controls, drawing
from nlfilter_torch.photo.app.controls import Choice, Control, Slider, SteadySlider, digits, show_pressed
from nlfilter_torch.photo.app.curve import CurveEditor
from nlfilter_torch.photo.app.shots import thumbnail
from nlfilter_torch.photo.app.tools import BRUSH_RADIUS, BRUSHES, FREE, PALETTE, PROPORTIONS, Brush, Proportions
from nlfilter_torch.photo.declared.development import AUTO_BALANCE, DEVELOP, WHOLE_CROP
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import LOOKS, PRESETS, PURPOSES, Recipe
from nlfilter_torch.photo.declared.steps import NONE, Step
from nlfilter_torch.photo.declared.strokes import ScribbleRole
from nlfilter_torch.photo.edits.applying import apply_step

BANDWIDTH = 20.0  # grey levels, the start when the bandwidth is not automatic
AMOUNT = "amount"
UNITS_OF_DEVELOPMENT = {"exposure": " stops", "temperature": " K", "straighten": "\u00b0"}
COLOURS, GEOMETRY = ("temperature", "warmth", "tint", "vibrance", "saturation"), ("straighten",)  # groups of sliders
BY_HAND = "Brush (B) and Eraser (E) paint on the mask itself; S is the first tool again."


class EditedPage(Protocol):
    """What the tabs show of a page, and what they call.

    Attributes:
        brush: the settings of the brush, which the tabs show and change.
        proportions: those that a crop keeps.
        is_cropping: whether the frame of the crop is shown.
    """

    brush: Brush
    proportions: Proportions
    is_cropping: bool

    @property
    def is_picking(self) -> bool:
        """Whether the next click on the photograph chooses what is grey."""

    def recipe(self) -> Recipe:
        """The current edit."""

    def change(self, step: str, values: Mapping[str, Value], complete: bool) -> None:
        """Change parameters of a step; ``complete`` when the pointer is released."""

    def clear(self, step: str) -> None:
        """Remove the strokes of a step."""

    def cut_out(self, step: str) -> None:
        """Ask for a name, and save the object that a step marks on transparent ground."""

    def replace(self, recipe: Recipe, moving: int | None) -> None:
        """Replace the edit; ``moving`` is the place of a step whose slider moves, or None if the change is complete."""

    def thumbnail(self, look: str) -> str:
        """The address of a picture of the photograph under a look, or "" if there is none."""

    def develop(self, values: Mapping[str, Value], complete: bool) -> bool:
        """Change how the photograph is developed, and return whether it can be; ``complete`` at the end of a drag."""

    def toggle_crop(self) -> None:
        """Show the frame of the crop over the whole photograph, or hide it."""

    def hold(self, name: str) -> None:
        """Let the crop keep proportions from now on, and cut it to them."""

    def turn(self, quarters: int) -> None:
        """Turn the photograph clockwise by quarters of a circle."""

    def toggle_pick(self) -> None:
        """Let the next click on the photograph choose what is grey, or no longer."""


class EditTab:
    """The tab of an edit, built into the open element."""

    def __init__(self, edit: str, page: EditedPage) -> None:
        self._edit, self._page = edit, page
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

    def draw_tones(self, histogram: str) -> None:
        """Show the histogram of the photograph before the edit, in a tab that has a place for it."""

    def _build(self) -> None:
        ui.label(EDITS[self._edit].hint).classes("hint")
        needs_strokes = EDITS[self._edit].requires_strokes  # then painting comes first
        if needs_strokes:
            self._build_brush()
        self._sliders += [self._slider(control) for control in controls.OF_EDIT[self._edit]]
        if not needs_strokes:
            self._build_brush()

    def _slider(self, control: Control, suffix: str = "") -> Slider:
        return Slider(control, self._page.recipe, self._page.change, suffix)

    def _build_brush(self, hint: str = "") -> None:
        """Build the settings of the brush, if the edit takes strokes."""
        if self._edit not in BRUSHES:
            return
        brush, edit = self._page.brush, self._edit
        with ui.row().classes("w-full items-center no-wrap"):
            ui.label("Tools").classes("group")
            ui.space()
            if EDITS[edit].with_role("added"):
                cut = ui.button("Cut out", on_click=lambda: self._page.cut_out(edit)).props("flat dense no-caps")
                cut.tooltip("Save the object on transparent ground")
            ui.button("Clear strokes", on_click=self._clear).props("flat dense no-caps")
        if hint:
            ui.label(hint).classes("hint")
        self._tools = ui.toggle(BRUSHES[edit], value=brush.word[edit])
        self._tools.props('dense no-caps unelevated spread role="group" aria-label="Tools"').classes(
            "tools w-full q-mt-xs"
        )
        self._tools.on_value_change(lambda event: brush.word.update({edit: event.value}))
        self._choices += controls.choices(edit, self._page.recipe, self._page.change)
        if EDITS[edit].with_role("added"):
            ui.label(BY_HAND).classes("hint wide")
        if "colour" in BRUSHES[edit]:
            self._build_colours()
        with ui.row().classes("w-full items-center no-wrap gap-3 q-mt-xs"):
            ui.label("Size").tooltip("Radius of the brush, in hundredths of the short side")
            size = SteadySlider(min=0.5, max=10, step=0.5, value=100 * brush.radius[edit])
            size.props('dense label aria-label="Brush size"')
            size.on_value_change(lambda event: brush.radius.update({edit: event.value / 100}))
            size.on_reset(lambda: size.set_value(100 * BRUSH_RADIUS))

    def _clear(self) -> None:
        self._page.clear(self._edit)

    def _build_colours(self) -> None:
        """Build a field for the colour that the brush paints, the same in all tabs, and buttons for some colours."""
        brush = self._page.brush
        with ui.row().classes("gap-2 q-mt-xs"):
            for colour in PALETTE:
                ui.button(on_click=partial(brush.choose_colour, colour)).props(
                    f'round dense unelevated size=sm aria-label="{colour}"'
                ).style(f"background: {colour} !important")
        field = ui.color_input("Colour", value=brush.colour, on_change=lambda event: brush.choose_colour(event.value))
        field.props("dense outlined").classes("w-full q-mt-xs")
        brush.shown.append(field.set_value)


@dataclass(frozen=True)
class DevelopControl(Control):
    """A slider for a value of how the photograph is developed."""

    def read(self, recipe: Recipe) -> float:
        """The slider's value for an edit."""
        value = getattr(recipe.develop, self.parameter.name)
        return value if isinstance(value, float) else self.slider.none or 0.0

    def usual(self, recipe: Recipe) -> float:
        """The slider's value at the start."""
        return self.read(Recipe())

    def show(self, value: float) -> str:
        """The value as text."""
        return digits(value, self.slider.step) + UNITS_OF_DEVELOPMENT.get(self.parameter.name, "")


DEVELOP_CONTROLS = tuple(DevelopControl(DEVELOP.name, p, p.slider, p.help) for p in DEVELOP if p.slider is not None)
UNGROUPED = [c.parameter.name for c in DEVELOP_CONTROLS if c.parameter.name not in COLOURS + GEOMETRY]


class DevelopTab(EditTab):
    """The tab, built into the open element."""

    def follow(self) -> None:
        """Show the current edit."""
        super().follow()
        develop = self._page.recipe().develop
        for button, is_on in (
            (self._crop, self._page.is_cropping),
            (self._pick, self._page.is_picking),
            (self._auto, develop.temperature == AUTO_BALANCE),
        ):
            show_pressed(button, is_on)
        self._curve.follow(develop.curve)
        self._whole.set_enabled(develop.crop != WHOLE_CROP)
        self._proportions.set_value(self._page.proportions.name)

    def _build(self) -> None:
        ui.label(DEVELOP.hint).classes("hint")
        self._build_sliders(set(UNGROUPED))
        self._curve = CurveEditor(lambda curve, complete: self._develop("", {"curve": curve}, complete))
        ui.label("Colour").classes("group")
        with ui.row().classes("w-full items-center no-wrap gap-2"):
            self._auto = ui.button("Auto", icon="wb_auto", on_click=self._toggle_auto).props("flat dense no-caps")
            self._auto.tooltip("Estimate the light of the photograph, and make it white")
            self._pick = ui.button("Grey point", icon="colorize", on_click=self._page.toggle_pick)
            self._pick.props("flat dense no-caps")
            self._pick.tooltip("Click on something that is grey or white: the white balance makes it so")
        self._build_sliders(set(COLOURS))
        ui.label("Crop").classes("group")
        with ui.row().classes("w-full items-center no-wrap gap-2"):
            for label, icon, quarters in (("Turn left", "rotate_left", 3), ("Turn right", "rotate_right", 1)):
                turn = ui.button(label, icon=icon, on_click=partial(self._page.turn, quarters))
                turn.props("flat dense no-caps").tooltip("By 90 degrees")
        self._build_sliders(set(GEOMETRY))
        with ui.row().classes("w-full items-center no-wrap gap-2 q-mt-xs"):
            self._crop = ui.button("Crop", icon="crop", on_click=self._page.toggle_crop).props("flat dense no-caps")
            self._crop.tooltip("Drag a frame over the whole photograph; Escape ends it")
            self._proportions = ui.select(list(PROPORTIONS), value=self._page.proportions.name, label="Proportions")
            self._proportions.props("dense outlined options-dense").classes("grow")
            self._proportions.tooltip("Width to height of the crop, which it keeps while its frame is dragged")
            self._proportions.on_value_change(lambda event: self._hold(event.value))
            self._whole = ui.button("Whole picture", on_click=self._uncrop).props("flat dense no-caps")

    def _build_sliders(self, names: set[str]) -> None:
        """Build the sliders of some values."""
        controls = [control for control in DEVELOP_CONTROLS if control.parameter.name in names]
        self._sliders += [Slider(control, self._page.recipe, self._develop) for control in controls]

    def draw_tones(self, histogram: str) -> None:
        """Show the histogram of the photograph before the edit behind the curve."""
        self._curve.draw_tones(histogram)

    def _toggle_auto(self) -> None:
        is_auto = self._page.recipe().develop.temperature == AUTO_BALANCE
        self._page.develop({"temperature": None if is_auto else AUTO_BALANCE, "warmth": 0.0, "tint": 0.0}, True)

    def _develop(self, _: str, values: Mapping[str, Value], complete: bool) -> None:
        """Change some values."""
        self._page.develop(values, complete)

    def _hold(self, name: str) -> None:
        """Let the crop keep proportions, if these are not those that it keeps already."""
        if name != self._page.proportions.name:
            self._page.hold(name)

    def _uncrop(self) -> None:
        self._page.hold(FREE)
        self._page.develop({"crop": WHOLE_CROP}, True)


class DetailTab(EditTab):
    """The tab of an edit with sliders for layers, built into the open element."""

    def __init__(self, edit: str, page: EditedPage) -> None:
        self._layout: tuple[int, bool] = (0, False)  # number of layers, and whether a region has its own sliders
        self._started: str | None = None  # the preset that was chosen last
        super().__init__(edit, page)

    def follow(self) -> None:
        """Show the current edit."""
        detail = self._step
        if self._layout != (len(detail["alpha"]), detail.has_region()):
            self._layout = (len(detail["alpha"]), detail.has_region())
            self._build_sliders(detail)
        super().follow()
        automatic = isinstance(detail["bandwidth"], str)
        self._automatic.set_value(automatic)
        self._by_hand.set_visibility(not automatic)
        if not automatic:
            self._bandwidth.set_value(detail["bandwidth"])
        self._name_preset(detail)

    def draw_response(self, svg: str) -> None:
        """Show the response of the sliders."""
        self._response.set_content(svg)

    @property
    def _step(self) -> Step:
        """The current step of the edit."""
        return self._page.recipe().current(self._edit)

    def _build(self) -> None:
        names = {name: f"{name}: {PURPOSES[name]}" for name in PRESETS}
        self._presets = ui.select(names, label="Preset", on_change=lambda event: self._choose(event.value))
        self._presets.props("dense outlined options-dense").classes("w-full")
        self._box = ui.column().classes("w-full gap-1")
        self._response = ui.html("", sanitize=False).classes("w-full q-mt-sm")
        self._response.tooltip("What the sliders do to each eigenvalue of the filter; each dot is one of them.")
        self._build_bandwidth()
        self._build_brush(EDITS[self._edit].hint)

    def _build_bandwidth(self) -> None:
        self._automatic = ui.checkbox("Edge threshold: automatic", value=True)
        self._automatic.props("dense").classes("q-mt-xs")
        self._automatic.on_value_change(lambda event: self._let_choose(bool(event.value)))
        with ui.column().classes("control gap-0") as self._by_hand:
            ui.label("Edge threshold").tooltip(
                "Differences beyond it are edges, and stay as they are; smaller ones are detail, which the sliders "
                "change. In grey levels of 255."
            )
            self._bandwidth = SteadySlider(min=2, max=80, step=1, value=BANDWIDTH)
            self._bandwidth.props('dense label aria-label="Edge threshold"')
            self._bandwidth.on("change", lambda event: self._set_bandwidth(float(event.args)))
            self._bandwidth.on_reset(lambda: self._set_bandwidth(BANDWIDTH))

    def _build_sliders(self, detail: Step) -> None:
        self._box.clear()
        sliders: list[Slider] = []
        with self._box:
            if detail.has_region():
                ui.label("In the region").classes("group")
                ui.label("They start at the values of the sliders below, and change the region only.").classes("hint")
                inside = controls.detail_sliders("inside", len(detail.sliders_inside))
                sliders += [self._slider(control, " in the region") for control in inside]
                sliders += [self._slider(control) for control in controls.OF_EDIT[self._edit]]
                ui.label("Elsewhere").classes("group")
            outside = controls.detail_sliders("alpha", len(detail["alpha"]))
            sliders += [self._slider(control) for control in outside]
        self._sliders = sliders

    def _choose(self, name: str | None) -> None:
        """Set the sliders to a preset; those of a region stay if there are as many."""
        if name is None or name in _equal_presets(self._step):  # the latter follows the edit
            return
        self._started = name
        inside = self._step["inside"]
        fits = inside is not None and len(inside) == len(PRESETS[name].steps[0]["alpha"])
        self._page.change(self._edit, {**preset_entries(name), "inside": inside if fits else None}, True)

    def _name_preset(self, detail: Step) -> None:
        """Show the preset that the sliders equal, or else the one they started from, which can be chosen again."""
        same = _equal_presets(detail)
        if same and self._started not in same:
            self._started = same[0]
        if detail["alpha"] == NONE:
            self._started = None
        self._presets.set_value(self._started if self._started in same else None)
        changed = self._started is not None and self._started not in same
        self._presets.props(f'label="{f"Preset {self._started}, changed" if changed else "Preset"}"')

    def _let_choose(self, automatic: bool) -> None:
        """Let the bandwidth be chosen from the photograph, or by hand."""
        if automatic != isinstance(self._step["bandwidth"], str):  # otherwise it follows the edit
            self._set_bandwidth("auto" if automatic else BANDWIDTH)

    def _set_bandwidth(self, value: float | str) -> None:
        self._page.change(self._edit, {"bandwidth": value}, True)


def preset_entries(name: str) -> dict[str, Value]:
    """The values that a preset sets."""
    detail = PRESETS[name].steps[0]
    return {entry: detail[entry] for entry in ("alpha", "bandwidth", "spatial_bandwidth", "landmarks")}


def _equal_presets(detail: Step) -> list[str]:
    """The presets that a step equals."""
    return [name for name in PRESETS if all(detail[k] == v for k, v in preset_entries(name).items())]


def thumbnails(picture: Tensor) -> dict[str, bytes]:
    """A picture (1, C, H, W) in [0, 1] under each look, small, as PNG files."""
    small = thumbnail(picture)
    return {name: drawing.lossless(apply_step(look, small).clamp(0, 1)) for name, look in LOOKS.items()}


def look_entries(look: Step) -> dict[str, Value]:
    """All values of a look but its amount, which a person has chosen."""
    return {p.name: look[p.name] for p in look.declared if p.name != AMOUNT}


class LookTab(EditTab):
    """The tab of looks, built into the open element."""

    def __init__(self, edit: str, page: EditedPage) -> None:
        self._buttons: dict[str, ui.button] = {}
        self._pictures: dict[str, ui.element] = {}
        super().__init__(edit, page)

    def follow(self) -> None:
        """Show the current edit."""
        super().follow()
        look = self._page.recipe().current(self._edit)
        has_look = look.changed(amount=1.0).would_change()
        for slider in self._sliders:
            slider.set_enabled(has_look)
        for name, button in self._buttons.items():
            address = self._page.thumbnail(name)
            button.set_enabled(bool(address))
            if address:
                self._pictures[name].props(f'src="{address}"')
            self._pictures[name].set_visibility(bool(address))
            show_pressed(button, has_look and look_entries(look) == look_entries(LOOKS[name]))

    def _build(self) -> None:
        with ui.element("div").classes("looks w-full").props('role="group" aria-label="Looks"'):
            for name in LOOKS:
                button = ui.button(on_click=partial(self._choose, name)).props(f'flat no-caps aria-label="{name}"')
                with button, ui.element("div"):
                    self._pictures[name] = ui.element("img").classes("thumbnail").props('alt=""')
                    ui.label(name.capitalize())
                self._buttons[name] = button
        super()._build()

    def _choose(self, name: str) -> None:
        entries = look_entries(LOOKS[name])
        if self._page.recipe().current(self._edit)[AMOUNT] == 0:
            entries[AMOUNT] = 1.0  # a look that is chosen is to be seen
        self._page.change(self._edit, entries, True)
