"""The tab of looks: a picture of the photograph under each named look, and the strength."""

from functools import partial

from nicegui import ui
from torch import Tensor

from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.controls import show_pressed
from nlfilter_torch.photo.app.tabs import EditTab, Link
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.presets import LOOKS
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.picture.resizing import resize

SIDE = 160  # of a thumbnail in pixels, twice as many as on the page
AMOUNT = "amount"


def thumbnails(picture: Tensor) -> dict[str, bytes]:
    """A picture (1, C, H, W) in [0, 1] under each look, small, as PNG files."""
    scale = min(1.0, SIDE / max(picture.shape[-2:]))
    size = (max(1, round(picture.shape[-2] * scale)), max(1, round(picture.shape[-1] * scale)))
    small = resize(picture, size).clamp(0, 1)
    return {name: drawing.lossless(apply_step(look, small).clamp(0, 1)) for name, look in LOOKS.items()}


def entries_of(look: Step) -> dict[str, Value]:
    """All values of a look but its amount, which a person has chosen."""
    return {p.name: look[p.name] for p in look.declared if p.name != AMOUNT}


class LookTab(EditTab):
    """The tab of looks, built into the open element."""

    def __init__(self, edit: str, link: Link) -> None:
        self._buttons: dict[str, ui.button] = {}
        self._pictures: dict[str, ui.element] = {}
        super().__init__(edit, link)

    def follow(self) -> None:
        """Show the current edit."""
        super().follow()
        look = self._link.recipe().current(self._edit)
        has_look = look.changed(amount=1.0).would_change()
        for slider in self._sliders:
            slider.set_enabled(has_look)
        for name, button in self._buttons.items():
            address = self._link.thumbnail(name)
            button.set_enabled(bool(address))
            if address:
                self._pictures[name].props(f'src="{address}"')
            self._pictures[name].set_visibility(bool(address))
            show_pressed(button, has_look and entries_of(look) == entries_of(LOOKS[name]))

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
        entries = entries_of(LOOKS[name])
        if self._link.recipe().current(self._edit)[AMOUNT] == 0:
            entries[AMOUNT] = 1.0  # a look that is chosen is to be seen
        self._link.change(self._edit, entries, True)
