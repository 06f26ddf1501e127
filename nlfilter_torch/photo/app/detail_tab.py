"""The tab of detail: presets, a slider for each layer, in a region and elsewhere, their response, and the bandwidth."""

from nicegui import ui

from nlfilter_torch.photo.app import controls
from nlfilter_torch.photo.app.controls import Slider
from nlfilter_torch.photo.app.tabs import EditTab, Link
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, PURPOSES
from nlfilter_torch.photo.declared.steps import NONE, Step

BANDWIDTH = 20.0  # grey levels, the start when the bandwidth is not automatic


class DetailTab(EditTab):
    """The tab of an edit with sliders for layers, built into the open element."""

    def __init__(self, edit: str, link: Link) -> None:
        self._following = False
        self._layout: tuple[int, bool] = (0, False)  # number of layers, and whether a region has its own sliders
        self._started: str | None = None  # the preset that was chosen last
        super().__init__(edit, link)

    def follow(self) -> None:
        """Show the current edit."""
        detail = self._step
        self._following = True
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
        self._following = False

    def draw_response(self, svg: str) -> None:
        """Show the response of the sliders."""
        self._response.set_content(svg)

    @property
    def _step(self) -> Step:
        """The current step of the edit."""
        return self._link.recipe().current(self._edit)

    def _build(self) -> None:
        names = {name: f"{name}: {PURPOSES[name]}" for name in PRESETS}
        self._presets = ui.select(names, label="Start from", on_change=lambda event: self._choose(event.value))
        self._presets.props("dense outlined options-dense").classes("w-full")
        self._box = ui.column().classes("w-full gap-1")
        self._response = ui.html("", sanitize=False).classes("w-full q-mt-sm")
        self._response.tooltip("What the sliders do to each eigenvalue of the filter; each dot is one of them.")
        self._build_bandwidth()
        self._build_brush(EDITS[self._edit].hint)

    def _build_bandwidth(self) -> None:
        self._automatic = ui.checkbox("What counts as detail: automatic", value=True)
        self._automatic.props("dense").classes("q-mt-xs")
        self._automatic.on_value_change(lambda event: self._set_bandwidth("auto" if event.value else BANDWIDTH))
        with ui.column().classes("control gap-0") as self._by_hand:
            ui.label("Largest difference that counts as detail").tooltip(
                "How different two places may be and still count as alike, in grey levels of 255. Small values affect "
                "only fine texture, large ones treat much as detail."
            )
            self._bandwidth = controls.SteadySlider(min=2, max=80, step=1, value=BANDWIDTH)
            self._bandwidth.props('dense label aria-label="Bandwidth"')
            self._bandwidth.on("change", lambda event: self._set_bandwidth(float(event.args)))
            self._bandwidth.on_reset(lambda: self._set_bandwidth(BANDWIDTH))

    def _build_sliders(self, detail: Step) -> None:
        self._box.clear()
        sliders: list[Slider] = []
        self._choices = []
        with self._box:
            if detail.has_region():
                ui.label("In the region").classes("group")
                ui.label("They start at the values of the sliders below, and change the region only.").classes("hint")
                inside = controls.detail_sliders("inside", len(detail.sliders_inside))
                sliders += [self._slider(control, " in the region") for control in inside]
                sliders += [self._slider(control) for control in controls.OF_EDIT[self._edit]]
                self._choices = controls.choices(self._edit, self._link.recipe, self._link.change)
                ui.label("Elsewhere").classes("group")
            outside = controls.detail_sliders("alpha", len(detail["alpha"]))
            sliders += [self._slider(control) for control in outside]
        self._sliders = sliders

    def _choose(self, name: str | None) -> None:
        """Set the sliders to a preset; those of a region stay if there are as many."""
        if name is None or self._following:
            return
        self._started = name
        inside = self._step["inside"]
        fits = inside is not None and len(inside) == len(PRESETS[name].steps[0]["alpha"])
        self._link.change(self._edit, {**entries_of(name), "inside": inside if fits else None}, True)

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
            self._link.change(self._edit, {"bandwidth": value}, True)


def entries_of(name: str) -> dict[str, Value]:
    """The values that a preset sets."""
    detail = PRESETS[name].steps[0]
    return {entry: detail[entry] for entry in ("alpha", "bandwidth", "spatial_bandwidth", "landmarks")}
