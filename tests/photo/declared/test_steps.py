"""Steps: values, strokes, effect, memory."""

import json
from typing import Any

import pytest
import torch

from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step, acting_steps, json_of, working_bytes
from nlfilter_torch.photo.edits.recipe import apply_recipe
from tests.recipes import BLUE, COLORIZE, DEFOCUS, DETAIL, IN, RECOLOR, WHOLE


def test_idle_steps_change_nothing(pixels: torch.Tensor) -> None:
    for edit in EDITS:
        assert not Step.idle(edit).changes()
        assert apply_recipe(Recipe((Step.idle(edit),)), pixels) is pixels
        changed: dict[str, dict[str, Any]] = {"look": {"matrix": (0.5,) * 9}, "light": {"exposure": 1.0}}
        assert Step(edit, (BLUE, IN), **changed.get(edit, {})).changes()  # the default look and light change nothing


def test_more_memory_is_asked_for_by_hungrier_steps() -> None:
    assert Recipe().bytes_per_pixel == 0
    assert Recipe((RECOLOR, DEFOCUS, COLORIZE)).bytes_per_pixel == working_bytes(100, 5)
    assert Recipe((DETAIL,)).bytes_per_pixel == working_bytes(DETAIL["landmarks"], 5, factors=2)
    assert Recipe((Step("denoise", method="rule", patch_size=9),)).bytes_per_pixel == working_bytes(200, 9)
    assert WHOLE.bytes_per_pixel == max(step.bytes_per_pixel() for step in WHOLE.acting)


def test_a_step_holds_what_differs_from_the_defaults() -> None:
    step = Step("tone", clarity=2.0, contrast=1.2)  # the default
    assert step.values == (("clarity", 2.0),)
    assert step["contrast"] == 1.2
    assert step == Step("tone", clarity=2.0)
    assert step.changed(clarity=3.0)["clarity"] == 3.0
    assert step["clarity"] == 2.0
    with pytest.raises(TypeError, match="tone has no parameter power; its parameters are contrast, clarity"):
        Step("tone", power=1.0)


def test_strokes_belong_to_the_scribbles_of_the_edit() -> None:
    assert RECOLOR.painted_as("object") == (BLUE,)
    assert RECOLOR.painted_as("background") == RECOLOR.strokes[1:]
    assert RECOLOR.is_drawn()
    assert not RECOLOR.has_region()
    assert RECOLOR.changed(strokes=()).painted_as("object") == ()
    assert not RECOLOR.changed(strokes=RECOLOR.strokes[1:]).changes()  # nothing has a colour


def test_a_region_has_sliders_of_its_own() -> None:
    assert DETAIL.has_region()
    assert DETAIL.sliders_inside == DETAIL["inside"]
    plain = Step("detail", (IN,), alpha=(1.0, 1.0))
    assert plain.sliders_inside == (1.0, 1.0)
    assert not plain.changes()
    assert plain.changed(inside=(2.0, 1.0)).changes()
    assert not plain.changed(inside=(2.0, 1.0), strokes=()).changes()


def test_arguments_of_the_function_and_of_its_filter() -> None:
    step = Step("detail", bandwidth=51.0, tolerance=20.0, spatial_bandwidth=30.0)
    arguments = step.arguments((120, 200), stride=2)
    assert arguments["photometric_bandwidth"] == 0.2
    assert arguments["mask_bandwidth"] == 0.2
    assert arguments["spatial_bandwidth"] == 15.0
    assert "inside" not in arguments  # it comes with the strokes
    options = step.filter_options((120, 200))
    assert sorted(options) == [
        "landmarks", "num_landmarks", "patch_size", "photometric_bandwidth", "spatial_bandwidth",
    ]  # fmt: skip
    assert options["spatial_bandwidth"] == 30.0
    assert Step("detail").filter_options((120, 200))["spatial_bandwidth"] == 10.0  # a twelfth of the short side


def test_files_of_steps_have_defaults_only_on_request() -> None:
    step = Step("abstract", edges=0.5)
    assert json.loads(step.to_json()) == {"edit": "abstract", "power": 0.3, "edges": 0.5}
    complete = json.loads(step.to_json(complete=True))
    assert complete["tones"] is None
    assert set(complete) == {"edit", *(parameter.name for parameter in step.declared)}
    entries = {name: value for name, value in complete.items() if name != "edit"}
    assert Step.from_entries("abstract", entries, "abstract") == step
    assert acting_steps([step, Step.idle("tone")]) == (step,)
    assert json.loads(json_of([])) == {"version": 1, "steps": []}


def test_steps_that_are_off_or_mixed_come_back_from_files(pixels: torch.Tensor) -> None:
    """And are applied: off or at opacity 0 a step changes nothing, in between it is mixed with the picture before."""
    step = Step("tone", contrast=1.4, landmarks=30)
    recipe = Recipe((step.mixed(on=False), step.mixed(opacity=0.25)))
    assert Recipe.from_json(recipe.to_json(drawn=True), "edit.json") == recipe
    assert Recipe.from_json(recipe.to_json(), "edit.json") == recipe
    assert recipe.acting == recipe.steps[1:]
    assert step.mixed(on=False, opacity=0.5).changed(clarity=2.0) == step.changed(clarity=2.0).mixed(
        on=False, opacity=0.5
    )
    assert not step.mixed(opacity=0.0).changes()
    assert step.mixed(on=False).would_change()
    whole = apply_recipe(Recipe((step,)), pixels)
    assert torch.allclose(apply_recipe(recipe, pixels), pixels.lerp(whole, 0.25), atol=1e-6)


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ('"on": 1', "on of tone, step 1 in edit.json must be true or false, got 1; correct it"),
        ('"opacity": 2', "opacity of tone, step 1 in edit.json must be a number from 0 to 1, got 2; correct it"),
        ('"opacity": true', "opacity of tone, step 1 in edit.json must be a number from 0 to 1, got true; correct it"),
        ('"onn": true', "entries other than contrast, .*, on, opacity, got onn; remove it"),
    ],
)
def test_what_is_not_on_nor_an_opacity(entry: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Recipe.from_json(f'{{"version": 1, "steps": [{{"edit": "tone", {entry}}}]}}', "edit.json")
