"""The list of steps of the edit: each can be switched on and off, mixed, moved and removed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from nicegui import ui

from nlfilter_torch.photo.app.controls import SteadySlider
from nlfilter_torch.photo.declared.presets import Recipe

Replace = Callable[[Recipe, int | None], None]  # a new edit, and the place of the step whose slider moves, or None
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


@dataclass
class Row:
    """The controls of a step."""

    place: int
    on: ui.checkbox
    opacity: SteadySlider
    value: ui.label
    title: ui.button


class StepList:
    """The steps of an edit in the order in which they are applied, built into the open element.

    Args:
        recipe: returns the current edit.
        replace: is called with a changed edit.
        open_tab: is called with the name of an edit whose controls are to be shown, of the step that is chosen.
    """

    def __init__(self, recipe: Callable[[], Recipe], replace: Replace, open_tab: Callable[[str], object]) -> None:
        self._recipe, self._replace, self._open_tab = recipe, replace, open_tab
        self._following = False
        self._shown: tuple[tuple[int, str], ...] | None = None
        self._rows: list[Row] = []
        ui.label("Steps, from first to last").classes("group q-px-sm")
        self._box = ui.column().classes("steps w-full q-px-sm gap-0").props('role="group" aria-label="Steps"')
        self._none = ui.label("").classes("hint q-px-sm")
        self.follow()

    def follow(self) -> None:
        """Show the current edit."""
        recipe = self._recipe()
        self._following = True
        if listed(recipe) != self._shown:
            self._shown = listed(recipe)
            self._build(recipe)
        self._none.set_text(NO_STEPS if recipe.develop.is_idle else ONLY_PHOTO)
        self._none.set_visibility(not self._rows)
        for row in self._rows:
            step = recipe.steps[row.place]
            row.on.set_value(step.on)
            row.opacity.set_value(100 * step.opacity)
            row.value.set_text(f"{100 * step.opacity:.0f} %")
            several = sum(other.edit == step.edit for other in recipe.steps) > 1
            is_chosen = several and recipe.place_of(step.edit) == row.place
            row.title.props('aria-current="true"' if is_chosen else "", remove="" if is_chosen else "aria-current")
        self._following = False

    def _build(self, recipe: Recipe) -> None:
        self._box.clear()
        shown = self._shown or ()
        places = [place for place, _ in shown]
        with self._box:
            self._rows = [self._row(name, places, number, recipe) for number, (_, name) in enumerate(shown)]

    def _row(self, name: str, places: list[int], number: int, recipe: Recipe) -> Row:
        place, step = places[number], recipe.steps[places[number]]
        with ui.row().classes("step w-full items-center no-wrap"):
            on = ui.checkbox(value=step.on, on_change=lambda event: self._switch(place, bool(event.value)))
            on.props(f'dense aria-label="{name}: on"').tooltip("Switch this step on or off")
            title = ui.button(name, on_click=partial(self._choose, place)).props("flat dense no-caps align=left")
            title.classes("name").tooltip("Show its controls")
            opacity = SteadySlider(min=0, max=100, step=1, value=100 * step.opacity).classes("mixing")
            opacity.props(f'dense aria-label="{name}: opacity"').tooltip(
                "Opacity: how much of this step is mixed with the picture before it"
            )
            opacity.on_value_change(lambda event: self._mix(place, event.value, place))
            opacity.on("change", lambda event: self._mix(place, float(event.args), None))
            opacity.on_reset(partial(self._mix, place, 100.0, None))
            value = ui.label("").classes("value")
            last = len(places) - 1
            self._button(name, "up", "arrow_upward", number > 0, partial(self._move, place, places[max(number - 1, 0)]))
            self._button(
                name, "down", "arrow_downward", number < last, partial(self._move, place, places[min(number + 1, last)])
            )
            self._button(name, "remove", "close", True, partial(self._remove, place))
        return Row(place, on, opacity, value, title)

    @staticmethod
    def _button(name: str, action: str, icon: str, enabled: bool, act: Callable[[], None]) -> None:
        button = ui.button(icon=icon, on_click=act).props(f'flat dense size=sm aria-label="{name}: {action}"')
        button.tooltip(TIPS[action]).set_enabled(enabled)

    def _choose(self, place: int) -> None:
        """Show the controls of a step."""
        recipe = self._recipe()
        if recipe.place_of(recipe.steps[place].edit) != place:
            self._replace(recipe.choosing(place), None)
        self._open_tab(recipe.steps[place].edit)

    def _switch(self, place: int, on: bool) -> None:
        if not self._following:
            recipe = self._recipe()
            self._replace(recipe.replaced(place, recipe.steps[place].mixed(on=on)), None)

    def _mix(self, place: int, percent: float | None, moving: int | None) -> None:
        if not self._following and percent is not None:
            recipe = self._recipe()
            self._row_at(place).value.set_text(f"{percent:.0f} %")
            self._replace(recipe.replaced(place, recipe.steps[place].mixed(opacity=percent / 100)), moving)

    def _row_at(self, place: int) -> Row:
        return next(row for row in self._rows if row.place == place)

    def _move(self, place: int, to: int) -> None:
        self._replace(self._recipe().moved(place, to), None)

    def _remove(self, place: int) -> None:
        self._replace(self._recipe().replaced(place), None)
