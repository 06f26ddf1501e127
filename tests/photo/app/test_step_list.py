"""The list of steps: it shows what was used, and changes the edit by one step."""

import pytest
from nicegui import Client, ui

from nlfilter_torch.photo.app.panel import StepList, listed
from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from tests.photo.app.page_controls import IN, Controls

TONE, SHARPEN, IDLE = Step("tone", contrast=0.8), Step("sharpen"), Step.idle("abstract")
RECIPE = Recipe((TONE, IDLE, SHARPEN))


@pytest.fixture
def shown(client: Client) -> Controls:
    shown = Controls(client)
    shown.edit = RECIPE
    return shown


@pytest.fixture
def opened() -> list[str]:
    return []


@pytest.fixture
def steps(shown: Controls, opened: list[str]) -> StepList:
    return StepList(shown.recipe, shown.replace, opened.append)


def boxes(shown: Controls) -> dict[str, bool]:
    return {box.props["aria-label"]: box.value for box in shown.of(ui.checkbox)}


def test_steps_that_were_used_are_listed(shown: Controls, steps: StepList) -> None:
    assert boxes(shown) == {"Tone: on": True, "Sharpen: on": True}
    assert shown.sliders() == {"Tone: opacity": 100, "Sharpen: opacity": 100}
    shown.edit = Recipe((TONE.mixed(on=False, opacity=0.3),))
    steps.follow()
    assert boxes(shown) == {"Tone: on": False}
    assert shown.sliders() == {"Tone: opacity": 30}
    shown.edit = Recipe()
    steps.follow()
    assert boxes(shown) == {}
    assert "None yet. Move a slider, or paint." in shown.texts()
    shown.edit = Recipe((), Development(exposure=1.0))
    steps.follow()
    assert 'No steps yet; the settings of "Photo" come first.' in shown.texts()
    assert shown.replaced == []
    assert listed(Recipe((Step("defocus", (IN,)), IDLE.mixed(on=False)))) == ((0, "Defocus"), (1, "Abstract"))


def test_a_step_is_switched_mixed_moved_and_removed(shown: Controls, steps: StepList, opened: list[str]) -> None:
    shown.of(ui.checkbox)[0].set_value(False)
    assert shown.replaced.pop() == (Recipe((TONE.mixed(on=False), IDLE, SHARPEN)), None)
    slider = shown.of(ui.slider)[1]
    slider.set_value(25.0)
    assert shown.replaced.pop() == (Recipe((TONE, IDLE, SHARPEN.mixed(opacity=0.25))), 2)  # while it moves
    steps.rows[1].mix(25.0, None)
    assert shown.replaced.pop()[1] is None
    assert "25 %" in shown.texts()
    shown.click("Tone: down")
    assert shown.replaced.pop() == (Recipe((IDLE, SHARPEN, TONE)), None)
    shown.click("Sharpen: up")
    assert shown.replaced.pop() == (Recipe((SHARPEN, TONE, IDLE)), None)
    shown.click("Sharpen: remove")
    assert shown.replaced.pop() == (Recipe((TONE, IDLE)), None)
    shown.click("Tone")
    assert opened == ["tone"]
    assert shown.replaced == []


def test_one_of_two_steps_of_an_edit_is_chosen(shown: Controls, steps: StepList, opened: list[str]) -> None:
    def current() -> list[str]:
        return [button.text for button in shown.of(ui.button) if "aria-current" in button.props]

    assert current() == []
    shown.edit = Recipe((TONE, SHARPEN, TONE.changed(clarity=2.0)))
    steps.follow()
    assert current() == ["Tone 2"]
    shown.click("Tone 1")
    ((recipe, moving),) = shown.replaced
    assert (recipe, recipe.chosen, moving) == (shown.edit, 0, None)
    shown.edit = recipe
    steps.follow()
    assert current() == ["Tone 1"]
    shown.click("Tone 1")
    assert opened == ["tone", "tone"]
    assert len(shown.replaced) == 1
