"""The tab of an edit: its sliders, and the settings of the brush."""

import pytest
from nicegui import Client, ui

from nlfilter_torch.photo.app.tabs import EditTab
from nlfilter_torch.photo.app.tools import BRUSHES, PALETTE, Brush
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from tests.photo.app.page_controls import Controls


@pytest.fixture
def shown(client: Client) -> Controls:
    return Controls(client)


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_has_its_hint_its_sliders_and_its_brush(shown: Controls, name: str) -> None:
    EditTab(name, shown)
    assert EDITS[name].hint in shown.texts()
    labels = {p.slider.label for p in EDITS[name] if p.slider is not None}
    assert shown.sliders().keys() - {"Brush size"} == labels
    assert ("Tools" in shown.texts()) == (name in BRUSHES) == ("Brush size" in shown.sliders())


def test_the_sliders_follow_the_edit(shown: Controls) -> None:
    shown.show(EditTab("tone", shown), Recipe((Step("tone", contrast=0.8),)))
    assert shown.sliders()["Contrast"] == 0.8
    assert shown.changes == []


def test_the_settings_of_the_brush(shown: Controls) -> None:
    EditTab("recolor", shown)
    EditTab("defocus", shown)
    EditTab("colorize", shown)  # whose field shows the same colour
    words, others, _ = shown.of(ui.toggle)
    assert (words.value, others.value) == ("colour", "in")
    words.set_value("out")
    assert shown.brush.paint("recolor") == "out"
    words.set_value("add colour")
    assert shown.brush.paint("recolor") == f"add {PALETTE[0]}"
    assert shown.brush.paint("defocus") == "in"
    words.set_value("colour")
    buttons = [button for button in shown.of(ui.button) if button.props.get("aria-label") == PALETTE[2]]
    for listener in buttons[0]._event_listeners.values():
        listener.handler(None)
    assert shown.brush.paint("recolor") == PALETTE[2]
    assert {field.value for field in shown.of(ui.color_input)} == {PALETTE[2]}
    sizes = [slider for slider in shown.of(ui.slider) if slider.props["aria-label"] == "Brush size"]
    sizes[1].set_value(5.0)
    assert (shown.brush.radius["recolor"], shown.brush.radius["defocus"]) == (0.02, 0.05)


def test_strokes_are_cleared(shown: Controls) -> None:
    EditTab("recolor", shown)
    shown.click("Clear strokes")
    assert shown.cleared == ["recolor"]


def test_what_the_brush_paints() -> None:
    brush = Brush()
    assert brush.paint("detail") == "in"
    brush.word["detail"] = "out"
    assert brush.paint("detail") == "out"
    brush.choose_colour("#ABCDEF")
    assert brush.paint("recolor") == "#abcdef"
    for value in ("#abc", "red", None, "1234567"):
        brush.choose_colour(value)
    assert brush.colour == "#abcdef"


def test_what_takes_part_is_chosen(shown: Controls) -> None:
    tab = EditTab("recolor", shown)
    assert shown.pressed("Only this")
    shown.click("Only this")
    assert shown.changes == []
    shown.click("All alike")
    assert shown.changes.pop() == ("recolor", {"extent": "near"}, True)
    (wider,) = shown.of(ui.checkbox)
    for extent, button in (("near", "All alike"), ("everywhere", "All alike"), ("object", "Only this")):
        shown.show(tab, Recipe((Step("recolor", extent=extent),)))
        assert shown.pressed(button)
        assert (wider.value, wider.visible) == (extent == "everywhere", extent != "object")
        shown.click(button)
    assert shown.changes == []
    shown.show(tab, Recipe((Step("recolor", extent="near"),)))
    wider.set_value(True)
    assert shown.changes == [("recolor", {"extent": "everywhere"}, True)]


def test_an_object_is_cut_out(shown: Controls) -> None:
    EditTab("defocus", shown)
    shown.click("Cut out")
    assert shown.cut == ["defocus"]
    EditTab("colorize", shown)
    assert [button.text for button in shown.of(ui.button)].count("Cut out") == 1
