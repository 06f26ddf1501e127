"""The controls beside the picture: a tab for each edit, the list of its steps, and the histogram."""

from collections.abc import Callable

from nicegui import ui

from nlfilter_torch.photo.app.controls import Replace, SteadySlider
from nlfilter_torch.photo.app.tabs import DetailTab, DevelopTab, EditedPage, EditTab, LookTab
from nlfilter_torch.photo.declared.development import DEVELOP
from nlfilter_torch.photo.declared.parameters import DETAIL, EDITS
from nlfilter_torch.photo.declared.presets import Recipe
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
NO_STEPS = "None yet. Move a slider, or paint."
ONLY_PHOTO = 'No steps yet; the settings of "Photo" come first.'
#: What the buttons of a step do.
TIPS = {
    "up": "Apply this step earlier",
    "down": "Apply this step later",
    "remove": "Remove this step; Undo brings it back",
}


def listed(recipe: Recipe) -> tuple[tuple[int, str], ...]:
    """Places and names of the steps that the list shows: those that were used.

    Steps of the same edit are numbered.

    >>> from nlfilter_torch.photo.declared.steps import Step
    >>> listed(Recipe((Step("tone"), Step.idle("detail"), Step("tone", clarity=2.0))))
    ((0, 'Tone 1'), (2, 'Tone 2'))
    """
    places = [i for i, s in enumerate(recipe.steps) if s.would_change() or s.strokes or not s.on or s.opacity != 1]
    edits = [recipe.steps[place].edit for place in places]
    numbers = [edits[: i + 1].count(edit) for i, edit in enumerate(edits)]
    names = [
        edit.capitalize() if edits.count(edit) == 1 else f"{edit.capitalize()} {number}"
        for edit, number in zip(edits, numbers, strict=True)
    ]
    return tuple(zip(places, names, strict=True))


class Row:
    """The controls of a step, built into the open element.

    Args:
        steps: the list that it is in.
        place: of the step in the edit.
        name: of the step.
        neighbours: places of the steps that the list shows before and after it, if there are any.
    """

    def __init__(self, steps: "StepList", place: int, name: str, neighbours: tuple[int | None, int | None]) -> None:
        self._steps, self.place = steps, place
        self._earlier, self._later = neighbours
        step = steps.recipe().steps[place]
        with ui.row().classes("step w-full items-center no-wrap"):
            self._on = ui.checkbox(value=step.on, on_change=lambda event: self._switch(bool(event.value)))
            self._on.props(f'dense aria-label="{name}: on"').tooltip("Switch this step on or off")
            self._title = ui.button(name, on_click=self._choose).props("flat dense no-caps align=left")
            self._title.classes("name").tooltip("Show its controls")
            self._opacity = SteadySlider(min=0, max=100, step=1, value=100 * step.opacity).classes("mixing")
            self._opacity.props(f'dense aria-label="{name}: opacity"').tooltip(
                "Opacity: how much of this step is mixed with the picture before it"
            )
            self._opacity.on_value_change(lambda event: self._moved(event.value))
            self._opacity.on("change", lambda event: self.mix(float(event.args), None))
            self._opacity.on_reset(lambda: self.mix(100.0, None))
            self._value = ui.label("").classes("value")
            for action, icon, enabled, act in (
                ("up", "arrow_upward", self._earlier is not None, self._move_up),
                ("down", "arrow_downward", self._later is not None, self._move_down),
                ("remove", "close", True, self._remove),
            ):
                button = ui.button(icon=icon, on_click=act).props(f'flat dense size=sm aria-label="{name}: {action}"')
                button.tooltip(TIPS[action]).set_enabled(enabled)

    def follow(self, recipe: Recipe) -> None:
        """Show the step in the current edit."""
        step = recipe.steps[self.place]
        self._on.set_value(step.on)
        self._opacity.set_value(100 * step.opacity)
        self._value.set_text(f"{100 * step.opacity:.0f} %")
        several = sum(other.edit == step.edit for other in recipe.steps) > 1
        is_chosen = several and recipe.place_of(step.edit) == self.place
        self._title.props('aria-current="true"' if is_chosen else "", remove="" if is_chosen else "aria-current")

    def _choose(self) -> None:
        """Show its controls."""
        recipe = self._steps.recipe()
        if recipe.place_of(recipe.steps[self.place].edit) != self.place:
            self._steps.replace(recipe.choosing(self.place), None)
        self._steps.open_tab(recipe.steps[self.place].edit)

    def _switch(self, on: bool) -> None:
        recipe = self._steps.recipe()
        if on != recipe.steps[self.place].on:  # otherwise it follows the edit
            self._steps.replace(recipe.replaced(self.place, recipe.steps[self.place].mixed(on=on)), None)

    def _moved(self, percent: float | None) -> None:
        if percent is not None and percent != 100 * self._steps.recipe().steps[self.place].opacity:
            self.mix(percent, self.place)

    def mix(self, percent: float, moving: int | None) -> None:
        """Set the opacity; ``moving`` is the place while the slider moves, or None."""
        recipe = self._steps.recipe()
        self._value.set_text(f"{percent:.0f} %")
        mixed = recipe.steps[self.place].mixed(opacity=percent / 100)
        self._steps.replace(recipe.replaced(self.place, mixed), moving)

    def _move_up(self) -> None:
        if self._earlier is not None:
            self._steps.replace(self._steps.recipe().moved(self.place, self._earlier), None)

    def _move_down(self) -> None:
        if self._later is not None:
            self._steps.replace(self._steps.recipe().moved(self.place, self._later), None)

    def _remove(self) -> None:
        self._steps.replace(self._steps.recipe().replaced(self.place), None)


class StepList:
    """The steps of an edit in the order in which they are applied, built into the open element.

    Args:
        recipe: returns the current edit.
        replace: is called with a changed edit.
        open_tab: is called with the name of an edit whose controls are to be shown, of the step that is chosen.
    """

    def __init__(self, recipe: Callable[[], Recipe], replace: Replace, open_tab: Callable[[str], object]) -> None:
        self.recipe, self.replace, self.open_tab = recipe, replace, open_tab
        self._shown: tuple[tuple[int, str], ...] | None = None
        self.rows: list[Row] = []
        ui.label("Steps, from first to last").classes("group q-px-sm")
        self._box = ui.column().classes("steps w-full q-px-sm gap-0").props('role="group" aria-label="Steps"')
        self._none = ui.label("").classes("hint q-px-sm")
        self.follow()

    def follow(self) -> None:
        """Show the current edit."""
        recipe = self.recipe()
        if listed(recipe) != self._shown:
            self._shown = listed(recipe)
            self._build(self._shown)
        self._none.set_text(NO_STEPS if recipe.develop.is_idle else ONLY_PHOTO)
        self._none.set_visibility(not self.rows)
        for row in self.rows:
            row.follow(recipe)

    def _build(self, shown: tuple[tuple[int, str], ...]) -> None:
        places = [None, *(place for place, _ in shown), None]
        self._box.clear()
        with self._box:
            self.rows = [
                Row(self, place, name, (places[number], places[number + 2]))
                for number, (place, name) in enumerate(shown)
            ]


class Panel:
    """Tabs of all edits, the list of steps and a histogram, built into the open element.

    ``switch`` is called with the name of the edit whose tab was opened; ``opened`` is the one that is open at first, by
    default that of the photograph.
    """

    def __init__(self, page: EditedPage, switch: Callable[[str], None], opened: str = "") -> None:
        self._recipe = page.recipe
        with ui.tabs(on_change=lambda event: switch(event.value)).classes("w-full") as bar:
            bar.props("dense no-caps align=justify")
            self._titles = {edit: ui.tab(edit, label=TITLES[edit]) for edit in TABS}
        panels = ui.tab_panels(bar, value=opened if opened in TABS else DEVELOP.name, animated=False, keep_alive=True)
        self._bar = bar
        self._tabs: dict[str, EditTab] = {}
        with panels.classes("w-full bg-transparent"):
            for edit, kind in TABS.items():
                with ui.tab_panel(edit).classes("gap-1"):
                    self._tabs[edit] = kind(edit, page)
        self._steps = StepList(page.recipe, page.replace, bar.set_value)
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

    def draw_tones(self, histogram: str) -> None:
        """Show the histogram of the photograph before the edit."""
        for tab in self._tabs.values():
            tab.draw_tones(histogram)

    def draw_response(self, svg: str) -> None:
        """Show the response of the sliders for the layers."""
        for tab in self._tabs.values():
            tab.draw_response(svg)
