"""The controls beside the picture, a tab for each step of an edit."""

from collections.abc import Callable
from functools import partial

from nicegui import ui

from nlfilter_torch.photo.app import controls
from nlfilter_torch.photo.app.brush import BRUSHES, COLOURS, Brush
from nlfilter_torch.photo.app.controls import Change, Control, Slider
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, PURPOSES, Recipe
from nlfilter_torch.photo.declared.steps import NONE, Step

TABS = ("detail", *(edit for edit in EDITS if edit != "detail"))
CLIPPED = 0.001  # share of the picture that an edit may clip without a warning
BANDWIDTH = 20.0  # grey levels, the start when the bandwidth is not automatic


class Panel:
    """Tabs with sliders, brushes and presets, built into the open element.

    Args:
        recipe: returns the current edit.
        brush: its settings, which the panel shows and changes.
        change: is called with changes of the parameters of a step.
        clear: is called with a step whose strokes are to be removed.
        switch: is called with the step whose tab was opened.
    """

    def __init__(
        self,
        recipe: Callable[[], Recipe],
        brush: Brush,
        change: Change,
        clear: Callable[[str], None],
        switch: Callable[[str], None],
    ) -> None:
        self._recipe, self._brush, self._change, self._clear = recipe, brush, change, clear
        self._following = False
        self._sliders: list[Slider] = []
        self._layout: tuple[int, bool] = (0, False)
        self._started: str | None = None  # the preset that was chosen last
        with ui.tabs(on_change=lambda event: switch(event.value)).classes("w-full") as tabs:
            tabs.props("dense no-caps align=justify")
            for step in TABS:
                ui.tab(step, label=step.capitalize())
        with ui.tab_panels(tabs, value="detail", animated=False, keep_alive=True).classes("w-full bg-transparent"):
            for step in TABS:
                with ui.tab_panel(step).classes("gap-1"):
                    if step == "detail":
                        self._build_detail()
                    else:
                        ui.label(EDITS[step].hint).classes("hint")
                        self._sliders += [self._slider(control) for control in controls.OF_EDIT[step]]
                        self._build_brush(step)
        self._build_levels()
        self.follow()

    def follow(self) -> None:
        """Show the current edit."""
        detail = self._recipe().last("detail")
        self._following = True
        if self._layout != (len(detail["alpha"]), detail.has_region()):
            self._layout = (len(detail["alpha"]), detail.has_region())
            self._build_detail_sliders(detail)
        for slider in (*self._sliders, *self._detail_sliders):
            slider.follow()
        automatic = isinstance(detail["bandwidth"], str)
        self._automatic.set_value(automatic)
        self._bandwidth.set_visibility(not automatic)
        if not isinstance(detail["bandwidth"], str):
            self._bandwidth.set_value(detail["bandwidth"])
        self._name_preset(detail)
        self._following = False

    def draw_levels(self, histogram: str, clipped: tuple[float, float], before: tuple[float, float]) -> None:
        """Show the histogram, and how much of the picture is white or black, now and before the edit."""
        self._histogram.set_content(histogram)
        texts = [f"{100 * now:.1f} % {name}" for now, name in zip(clipped, ("white", "black"), strict=True)]
        worse = any(now > was + CLIPPED for now, was in zip(clipped, before, strict=True))
        warning = f"; before the edit {100 * before[0]:.1f} % and {100 * before[1]:.1f} %" if worse else ""
        self._clipped.set_text("Clipped: " + ", ".join(texts) + warning)
        self._clipped.classes(add="warning" if worse else "", remove="" if worse else "warning")

    def draw_response(self, svg: str) -> None:
        """Show the response of the sliders."""
        self._response.set_content(svg)

    def _slider(self, control: Control, suffix: str = "") -> Slider:
        return Slider(control, self._recipe, self._change, suffix)

    def _build_levels(self) -> None:
        ui.label("Histogram").classes("group q-px-sm")
        self._histogram = ui.html("", sanitize=False).classes("w-full q-px-sm")
        self._clipped = ui.label("").classes("hint q-px-sm")

    def _build_detail(self) -> None:
        names = {name: f"{name}: {PURPOSES[name]}" for name in PRESETS}
        self._presets = ui.select(names, label="Start from", on_change=lambda event: self._choose(event.value))
        self._presets.props("dense outlined options-dense").classes("w-full")
        self._box = ui.column().classes("w-full gap-1")
        self._response = ui.html("", sanitize=False).classes("w-full q-mt-sm")
        self._response.tooltip("What the sliders do to each eigenvalue of the filter; each dot is one of them.")
        with ui.row().classes("w-full items-center no-wrap gap-3 q-mt-xs"):
            label = ui.label("Detail is").classes("text-no-wrap")
            label.tooltip(
                "How different two places may be and still count as alike, in grey levels of 255. Small values affect "
                "only fine texture, large ones treat much as detail."
            )
            self._automatic = ui.checkbox("as the photo suggests", value=True).props("dense")
            self._automatic.on_value_change(lambda event: self._set_bandwidth("auto" if event.value else BANDWIDTH))
        self._bandwidth = controls.SteadySlider(min=2, max=80, step=1, value=BANDWIDTH)
        self._bandwidth.props('dense label aria-label="Bandwidth"')
        self._bandwidth.on("change", lambda event: self._set_bandwidth(float(event.args)))
        self._build_brush("detail")

    def _build_detail_sliders(self, detail: Step) -> None:
        self._box.clear()
        self._detail_sliders = []
        with self._box:
            if detail.has_region():
                ui.label("In the region").classes("group")
                ui.label("They begin as the sliders elsewhere, and move by themselves.").classes("hint")
                inside = controls.detail_sliders("inside", len(detail.sliders_inside))
                self._detail_sliders += [self._slider(control, " in the region") for control in inside]
                self._detail_sliders.append(self._slider(controls.OF_EDIT["detail"][0]))
                ui.label("Elsewhere").classes("group")
            outside = controls.detail_sliders("alpha", len(detail["alpha"]))
            self._detail_sliders += [self._slider(control) for control in outside]

    def _build_brush(self, step: str) -> None:
        if step not in BRUSHES:
            return
        brush = self._brush
        ui.label("Brush").classes("group")
        if step == "detail":
            ui.label(EDITS[step].hint).classes("hint")
        with ui.row().classes("w-full items-center no-wrap gap-2 q-mt-xs"):
            words = ui.toggle(BRUSHES[step], value=brush.word[step]).props("dense no-caps unelevated")
            words.on_value_change(lambda event: brush.word.update({step: event.value}))
            ui.space()
            clear = ui.button("Clear strokes", on_click=partial(self._clear, step))
            clear.props("flat dense no-caps")
        if "colour" in BRUSHES[step]:
            self._build_colours(brush)
        with ui.row().classes("w-full items-center no-wrap gap-3 q-mt-xs"):
            ui.label("Size").tooltip("Radius of the brush, in hundredths of the short side")
            size = ui.slider(min=0.5, max=10, step=0.5, value=100 * brush.radius[step])
            size.props('dense label aria-label="Brush size"')
            size.on_value_change(lambda event: brush.radius.update({step: event.value / 100}))

    @staticmethod
    def _build_colours(brush: Brush) -> None:
        field = ui.color_input("Colour", value=brush.colour, on_change=lambda event: brush.choose_colour(event.value))
        field.props("dense outlined").classes("w-full q-mt-xs")
        with ui.row().classes("gap-2 q-mt-xs"):
            for colour in COLOURS:
                ui.button(on_click=partial(field.set_value, colour)).props(
                    f'round dense unelevated size=sm aria-label="{colour}"'
                ).style(f"background: {colour} !important")

    def _choose(self, name: str | None) -> None:
        if name is None or self._following:
            return
        self._started = name
        inside = self._recipe().last("detail")["inside"]
        fits = inside is not None and len(inside) == len(PRESETS[name].steps[0]["alpha"])
        self._change("detail", {**entries_of(name), "inside": inside if fits else None}, True)

    def _name_preset(self, detail: Step) -> None:
        """Show the preset that the sliders equal, or else the one they started from, which can be chosen again."""
        same = [name for name in PRESETS if all(detail[k] == v for k, v in entries_of(name).items())]
        if same and self._started not in same:
            self._started = same[0]
        if detail["alpha"] == NONE:
            self._started = None
        self._presets.set_value(self._started if self._started in same else None)
        changed = self._started is not None and self._started not in same
        self._presets.props(f'label="{f"Started from {self._started}, then changed" if changed else "Start from"}"')

    def _set_bandwidth(self, value: float | str) -> None:
        if not self._following:
            self._change("detail", {"bandwidth": value}, True)


def entries_of(name: str) -> dict[str, object]:
    """What a preset sets."""
    detail = PRESETS[name].steps[0]
    return {entry: detail[entry] for entry in ("alpha", "bandwidth", "spatial_bandwidth", "landmarks")}
