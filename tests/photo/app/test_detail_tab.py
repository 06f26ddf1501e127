"""The tab of detail: it shows the edit, and passes on what the user changes."""

import pytest
from nicegui import Client

from nlfilter_torch.photo.app.tabs import DetailTab, preset_entries
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from tests.photo.app.page_controls import IN, Controls


@pytest.fixture
def shown(client: Client) -> Controls:
    return Controls(client)


@pytest.fixture
def tab(shown: Controls) -> DetailTab:
    tab = DetailTab("detail", shown)
    tab.follow()
    return tab


def test_presets_are_those_of_the_command() -> None:
    for name in PRESETS:
        assert Recipe((Step("detail", **preset_entries(name)),)) == PRESETS[name]


def test_a_region_has_sliders_of_its_own(shown: Controls, tab: DetailTab) -> None:
    assert "Texture in the region" not in shown.sliders()
    shown.show(tab, Recipe((Step("detail", (IN,), alpha=(3.0, 1.0, 1.0, 1.0), inside=(2.0, 1.0, 1.0, 1.0)),)))
    assert (shown.sliders()["Texture"], shown.sliders()["Texture in the region"]) == (3.0, 2.0)
    assert "In the region" in shown.texts()
    shown.show(tab, Recipe((Step("detail", alpha=(3.0, 2.0, 1.0)),)))
    assert "Texture in the region" not in shown.sliders()
    assert "Layer 1" in shown.sliders()


def test_a_preset_is_chosen_and_named(shown: Controls, tab: DetailTab) -> None:
    tab._choose("crisp")
    (change,) = shown.changes
    assert change == ("detail", {**preset_entries("crisp"), "inside": None}, True)
    shown.show(tab, PRESETS["crisp"])
    assert tab._presets.value == "crisp"
    assert tab._presets.props["label"] == "Preset"
    shown.show(tab, Recipe((PRESETS["crisp"].steps[0].changed(bandwidth=33.0),)))
    assert tab._presets.value is None
    assert tab._presets.props["label"] == "Preset crisp, changed"
    assert len(shown.changes) == 1


def test_a_preset_keeps_the_sliders_of_a_region_with_as_many_layers(shown: Controls, tab: DetailTab) -> None:
    layers = len(PRESETS["crisp"].steps[0]["alpha"])
    for count, kept in ((layers, True), (layers - 1, False)):
        inside = (2.0,) + (1.0,) * (count - 1)
        shown.show(tab, Recipe((Step("detail", (IN,), alpha=(3.0,) + (1.0,) * (count - 1), inside=inside),)))
        tab._choose("crisp")
        assert shown.changes[-1][1]["inside"] == (inside if kept else None)


def test_the_bandwidth(shown: Controls, tab: DetailTab) -> None:
    shown.show(tab, Recipe((Step("detail", bandwidth=15.0),)))
    assert (tab._automatic.value, tab._bandwidth.value) == (False, 15.0)
    assert tab._by_hand.visible
    shown.show(tab, Recipe((Step("detail", bandwidth="auto"),)))
    assert tab._automatic.value
    assert not tab._by_hand.visible
    tab._automatic.set_value(False)
    assert shown.changes == [("detail", {"bandwidth": 20.0}, True)]


def test_the_response(tab: DetailTab) -> None:
    tab.draw_response("<svg>response</svg>")
    assert tab._response.content == "<svg>response</svg>"
