"""The sliders of the editor: what they set, and what they show."""

from collections.abc import Mapping

from nicegui import Client

from nlfilter_torch.photo.app import controls
from nlfilter_torch.photo.app.controls import Slider
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step

CONTROLS = [c for step in controls.OF_EDIT.values() for c in step] + list(controls.detail_sliders("inside", 3))


def test_controls_stay_within_what_a_step_takes() -> None:
    for control in CONTROLS:
        recipe = Recipe((Step("detail", alpha=(1.0,) * 3, inside=(1.0,) * 3), Step("denoise", noise_level=1.0)))
        low, high = control.slider.low, control.slider.high
        assert low <= control.read(recipe) <= high
        for value in (low, high):
            changed = control.entries(recipe, value)
            assert control.parameter.is_valid(changed[control.parameter.name])
            assert control.read(recipe.with_current(recipe.current(control.edit).changed(**changed))) == value


def test_a_slider_of_a_list_sets_the_number_of_its_layer() -> None:
    recipe = Recipe((Step("detail", alpha=(3.0, 2.0, 1.0), inside=(4.0, 1.0, 1.0)),))
    outside, inside = controls.detail_sliders("alpha", 3), controls.detail_sliders("inside", 3)
    assert [control.read(recipe) for control in outside] == [3.0, 2.0, 1.0]
    assert outside[1].entries(recipe, 0.123456) == {"alpha": (3.0, 0.1235, 1.0)}
    assert inside[0].entries(recipe, 2.0) == {"inside": (2.0, 1.0, 1.0)}
    assert [control.slider.label for control in controls.detail_sliders("alpha", 4)][::3] == ["Texture", "Shading"]


def test_a_slider_can_stand_for_no_value() -> None:
    (tones,) = [control for control in controls.OF_EDIT["abstract"] if control.parameter.name == "tones"]
    nothing = tones.slider.none
    assert nothing is not None
    assert tones.read(Recipe((Step("abstract", tones=None),))) == nothing
    assert tones.entries(Recipe(), nothing) == {"tones": None}
    assert tones.entries(Recipe(), 6.4) == {"tones": 6}
    assert (tones.show(nothing), tones.show(6)) == ("all", "6")
    (grain,) = [control for control in controls.OF_EDIT["denoise"] if control.parameter.name == "grain"]
    assert grain.entries(Recipe(), grain.usual(Recipe())) == {"grain": None}
    assert [grain.entries(Recipe(), value) for value in (0.0, 0.15)] == [{"grain": 0.0}, {"grain": 0.15}]
    assert (grain.show(grain.usual(Recipe())), grain.show(0.15)) == ("automatic", "0.15")


def test_a_slider_on_the_page(client: Client) -> None:
    """It calls ``change`` while it moves and when it is released, and not when it follows the edit."""
    changes: list[tuple[str, Mapping[str, object], bool]] = []
    recipe = Recipe()
    (control,) = [control for control in controls.OF_EDIT["tone"] if control.parameter.name == "contrast"]
    assert control.parameter is EDITS["tone"]["contrast"]
    slider = Slider(control, lambda: recipe, lambda *change: changes.append(change))
    slider._moved(1.2)
    slider._released(1.3)
    assert changes == [("tone", {"contrast": 1.2}, False), ("tone", {"contrast": 1.3}, True)]
    assert slider._value.text.startswith("1.2")
    recipe = Recipe((Step("tone", contrast=0.8),))
    slider.follow()
    assert slider._slider.value == 0.8
    assert slider._value.text.startswith("0.8")
    assert len(changes) == 2


def test_sliders_are_reset(client: Client) -> None:
    """To where they start, or in a region to the slider elsewhere; by a double-click and by keys."""
    recipe = Recipe((Step("detail", alpha=(3.0, 2.0, 1.0), inside=(4.0, 1.0, 1.0)), Step("denoise")))
    usual = {c.slider.label: c.usual(recipe) for c in (*controls.OF_EDIT["denoise"], *controls.OF_EDIT["abstract"])}
    assert usual["Strength"] == usual["Flatten"] == 0.0
    assert usual["Tones"] == 1.0
    assert [c.usual(recipe) for c in controls.detail_sliders("alpha", 3)] == [1.0, 1.0, 1.0]
    assert [c.usual(recipe) for c in controls.detail_sliders("inside", 3)] == [3.0, 2.0, 1.0]
    changes: list[tuple[str, Mapping[str, object], bool]] = []
    slider = Slider(controls.detail_sliders("alpha", 3)[0], lambda: recipe, lambda *change: changes.append(change))
    for listener in slider._slider._event_listeners.values():
        if listener.type in ("dblclick", "keydown.home.prevent"):
            listener.handler(None)
    assert changes == [("detail", {"alpha": (1.0, 2.0, 1.0)}, True)] * 2
