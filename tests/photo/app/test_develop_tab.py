"""The tab of the photograph itself, without a browser."""

import pytest
from nicegui import Client, ui

from nlfilter_torch.photo.app.tabs import DEVELOP_CONTROLS, DevelopTab
from nlfilter_torch.photo.declared.development import DEVELOP, WHOLE_CROP, Development
from nlfilter_torch.photo.declared.presets import Recipe
from tests.photo.app.page_controls import Controls


def test_sliders_show_and_change_the_development(client: Client) -> None:
    shown = Controls(client)
    tab = DevelopTab("develop", shown)
    shown.show(
        tab,
        Recipe((), Development(exposure=0.5, warmth=-0.2, tint=0.1, straighten=3.0, temperature=5000.0, shadows=0.4)),
    )
    changed = {"Exposure": 0.5, "Warmth": -0.2, "Tint": 0.1, "Straighten": 3.0, "Temperature": 5000, "Shadows": 0.4}
    assert {label: value for label, value in shown.sliders().items() if value and "Curve" not in label} == changed
    assert {"0.50 stops", "5000 K", "3.0\u00b0"} <= set(shown.texts())
    slider = shown.of(ui.slider)[0]
    for listener in list(slider._event_listeners.values()):
        if listener.type == "dblclick":
            listener.handler(None)
    assert shown.developed == [({"exposure": 0.0}, True)]
    usual = {control.parameter.name: control.usual(Recipe()) for control in DEVELOP_CONTROLS}
    assert usual.pop("temperature") == 6500
    assert set(usual.values()) == {0}
    assert [control.parameter.name for control in DEVELOP_CONTROLS] == [p.name for p in DEVELOP if p.slider is not None]
    shown.developed.clear()
    shown.click("Auto")
    shown.click("Turn right")
    assert shown.developed == [({"temperature": "auto", "warmth": 0.0, "tint": 0.0}, True), 1]
    (kelvin,) = (control for control in DEVELOP_CONTROLS if control.parameter.name == "temperature")
    assert [kelvin.entries(Recipe(), value) for value in (5000, 6500)] == [{"temperature": 5000}, {"temperature": None}]


def test_the_crop_is_shown_and_reset(client: Client) -> None:
    shown = Controls(client)
    tab = DevelopTab("develop", shown)
    shown.show(tab, Recipe())
    pick, crop, whole = (shown.button(text) for text in ("Grey point", "Crop", "Whole picture"))
    assert not whole.enabled
    assert crop.props["aria-pressed"] == "false"
    shown.click("Crop")
    shown.click("Grey point")
    assert shown.developed == ["crop", "pick"]
    shown.developed.clear()
    assert pick.props["aria-pressed"] == "false"
    shown.is_cropping = shown.is_picking = True
    shown.show(tab, Recipe((), Development(crop=(0.1, 0.0, 1.0, 1.0))))
    assert crop.props["aria-pressed"] == pick.props["aria-pressed"] == "true"
    (select,) = shown.of(ui.select)
    select.set_value("16:9")
    assert shown.developed == ["16:9"]
    shown.show(tab, shown.edit)
    assert shown.developed == ["16:9"]
    shown.click("Whole picture")
    assert shown.developed[1:] == ["Free", ({"crop": WHOLE_CROP}, True)]
    shown.show(tab, shown.edit)
    assert select.value == "Free"


@pytest.mark.parametrize("name", ["exposure", "straighten"])
def test_values_of_sliders_are_rounded(name: str) -> None:
    control = next(control for control in DEVELOP_CONTROLS if control.parameter.name == name)
    assert control.entries(Recipe(), 0.123456) == {name: 0.1235}
