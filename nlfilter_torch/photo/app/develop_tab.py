"""The tab of the photograph itself: exposure, white balance, straightening and crop, which come before all edits."""

from collections.abc import Mapping
from dataclasses import dataclass

from nicegui import ui

from nlfilter_torch.photo.app.controls import Control, Slider, show_pressed
from nlfilter_torch.photo.app.crop_tool import FREE, PROPORTIONS
from nlfilter_torch.photo.app.tabs import EditTab
from nlfilter_torch.photo.declared.development import DEVELOP, WHOLE
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.presets import Recipe

UNITS = {"exposure": " stops", "straighten": "\u00b0"}


@dataclass(frozen=True)
class DevelopControl(Control):
    """A slider for a value of how the photograph is developed."""

    def read(self, recipe: Recipe) -> float:
        """The slider's value for an edit."""
        return float(getattr(recipe.develop, self.parameter.name))

    def usual(self, recipe: Recipe) -> float:
        """The slider's value at the start."""
        return self.parameter.default_number

    def show(self, value: float) -> str:
        """The value as text."""
        return super().show(value) + UNITS.get(self.parameter.name, "")


CONTROLS = tuple(DevelopControl(DEVELOP.name, p, p.slider, p.help) for p in DEVELOP if p.slider is not None)


class DevelopTab(EditTab):
    """The tab, built into the open element."""

    def follow(self) -> None:
        """Show the current edit."""
        super().follow()
        photo = self._link.photo
        for button, is_on in ((self._crop, photo.is_cropping()), (self._pick, photo.is_picking())):
            show_pressed(button, is_on)
        self._whole.set_enabled(self._link.recipe().develop.crop != WHOLE)
        self._proportions.set_value(photo.held())

    def _build(self) -> None:
        ui.label(DEVELOP.hint).classes("hint")
        self._sliders = [Slider(control, self._link.recipe, self._develop) for control in CONTROLS]
        photo = self._link.photo
        self._pick = ui.button("Grey point", icon="colorize", on_click=photo.pick).props("flat dense no-caps")
        self._pick.tooltip("Click on something that is grey or white: the white balance makes it so")
        ui.label("Crop").classes("group")
        with ui.row().classes("w-full items-center no-wrap gap-2 q-mt-xs"):
            self._crop = ui.button("Crop", icon="crop", on_click=photo.crop).props("flat dense no-caps")
            self._crop.tooltip("Drag a frame over the whole photograph; Escape ends it")
            self._proportions = ui.select(list(PROPORTIONS), value=photo.held(), label="Proportions")
            self._proportions.props("dense outlined options-dense").classes("grow")
            self._proportions.tooltip("Width to height of the crop, which it keeps while its frame is dragged")
            self._proportions.on_value_change(lambda event: self._hold(event.value))
            self._whole = ui.button("Whole picture", on_click=self._uncrop).props("flat dense no-caps")

    def _develop(self, _: str, values: Mapping[str, Value], complete: bool) -> None:
        """Change some values."""
        self._link.photo.develop(values, complete)

    def _hold(self, name: str) -> None:
        """Let the crop keep proportions, if these are not those that it keeps already."""
        if name != self._link.photo.held():
            self._link.photo.hold(name)

    def _uncrop(self) -> None:
        self._link.photo.hold(FREE)
        self._link.photo.develop({"crop": WHOLE}, True)
