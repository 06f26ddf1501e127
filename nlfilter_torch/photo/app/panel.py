"""The controls beside the picture: a tab for each edit, the list of its steps, and the histogram."""

from collections.abc import Callable

from nicegui import ui

from nlfilter_torch.photo.app.detail_tab import DetailTab
from nlfilter_torch.photo.app.develop_tab import DevelopTab
from nlfilter_torch.photo.app.look_tab import LookTab
from nlfilter_torch.photo.app.step_list import StepList
from nlfilter_torch.photo.app.tabs import EditTab, Link
from nlfilter_torch.photo.declared.development import DEVELOP
from nlfilter_torch.photo.declared.parameters import DETAIL, EDITS
from nlfilter_torch.photo.declared.shared_parameters import LOOK
from nlfilter_torch.photo.declared.strokes import ScribbleRole

#: The kind of tab of each edit, in the order of the tabs.
TABS: dict[str, type[EditTab]] = dict.fromkeys((DEVELOP.name, DETAIL.name, *EDITS), EditTab) | {
    DEVELOP.name: DevelopTab,
    DETAIL.name: DetailTab,
    LOOK.name: LookTab,
}
TITLES = {edit: edit.capitalize() for edit in TABS} | {DEVELOP.name: "Photo"}
CLIPPED = 0.001  # share of the picture that an edit may clip without a warning


class Panel:
    """Tabs of all edits, the list of steps and a histogram, built into the open element.

    ``switch`` is called with the name of the edit whose tab was opened.
    """

    def __init__(self, link: Link, switch: Callable[[str], None]) -> None:
        self._recipe = link.recipe
        with ui.tabs(on_change=lambda event: switch(event.value)).classes("w-full") as bar:
            bar.props("dense no-caps align=justify")
            self._titles = {edit: ui.tab(edit, label=TITLES[edit]) for edit in TABS}
        panels = ui.tab_panels(bar, value=DETAIL.name, animated=False, keep_alive=True)
        self._bar = bar
        self._tabs: dict[str, EditTab] = {}
        with panels.classes("w-full bg-transparent"):
            for edit, kind in TABS.items():
                with ui.tab_panel(edit).classes("gap-1"):
                    self._tabs[edit] = kind(edit, link)
        self._steps = StepList(link.recipe, link.replace, bar.set_value)
        ui.label("Histogram").classes("group q-px-sm")
        self._histogram = ui.html("", sanitize=False).classes("w-full q-px-sm")
        self._clipped = ui.label("").classes("hint q-px-sm")
        self.follow()

    @property
    def tab(self) -> str:
        """The edit whose tab is open."""
        return str(self._bar.value)

    def follow(self) -> None:
        """Show the current edit."""
        for tab in self._tabs.values():
            tab.follow()
        self._steps.follow()
        recipe = self._recipe()
        acting = {step.edit for step in recipe.acting} | (set() if recipe.develop.is_idle else {DEVELOP.name})
        for edit, title in self._titles.items():
            state = f'alert=amber aria-label="{TITLES[edit]}, in use"'
            title.props(state if edit in acting else "", remove="" if edit in acting else "alert aria-label")

    def take(self, role: ScribbleRole) -> None:
        """Take the tool that draws scribbles with a role, in the open tab."""
        self._tabs[self.tab].take(role)

    def draw_levels(self, histogram: str, clipped: tuple[float, float], before: tuple[float, float]) -> None:
        """Show the histogram, and how much of the picture is white or black, now and before the edit."""
        self._histogram.set_content(histogram)
        texts = [f"{100 * now:.1f}\u00a0% {name}" for now, name in zip(clipped, ("white", "black"), strict=True)]
        worse = any(now > was + CLIPPED for now, was in zip(clipped, before, strict=True))
        warning = f"; before the edit {100 * before[0]:.1f}\u00a0% and {100 * before[1]:.1f}\u00a0%" if worse else ""
        self._clipped.set_text("Clipped: " + ", ".join(texts) + warning)
        self._clipped.classes(add="warning" if worse else "", remove="" if worse else "warning")

    def draw_response(self, svg: str) -> None:
        """Show the response of the sliders for the layers."""
        for tab in self._tabs.values():
            tab.draw_response(svg)
