"""The controls beside the picture: they show the edit, and pass on what the user changes."""

from collections.abc import Mapping

import pytest
from nicegui import Client, ui

from nlfilter_torch.photo.app.brush import BRUSHES, Brush
from nlfilter_torch.photo.app.panel import Panel, entries_of
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke

IN = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in")


class Page:
    """A stand-in for the page with a panel, which records what the panel calls."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.recipe = Recipe()
        self.brush = Brush()
        self.changes: list[tuple[str, Mapping[str, object], bool]] = []
        self.cleared: list[str] = []
        self.opened: list[str] = []
        self.panel = Panel(
            lambda: self.recipe,
            self.brush,
            lambda *change: self.changes.append(change),
            self.cleared.append,
            self.opened.append,
        )

    def show(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.panel.follow()

    def of(self, kind: type[ui.element]) -> list[ui.element]:
        return [element for element in self.client.elements.values() if isinstance(element, kind)]

    def texts(self) -> list[str]:
        return [element.text for element in self.client.elements.values() if isinstance(element, ui.label)]

    def sliders(self) -> dict[str, float]:
        """Values of the sliders by their labels for screen readers."""
        return {slider.props["aria-label"]: slider.value for slider in self.of(ui.slider)}


@pytest.fixture
def shown(client: Client) -> Page:
    return Page(client)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_those_of_the_command(name: str) -> None:
    assert Recipe((Step("detail", **entries_of(name)),)) == PRESETS[name]


def test_every_edit_has_a_tab_with_its_sliders(shown: Page) -> None:
    assert {tab.props["name"] for tab in shown.of(ui.tab)} == set(EDITS)
    labels = {p.slider.label for edit in EDITS.values() for p in edit if p.slider is not None and edit.name != "detail"}
    assert labels | {"Texture", "Shading"} <= shown.sliders().keys()
    assert len(shown.of(ui.toggle)) == len(BRUSHES)


def test_the_sliders_follow_the_edit(shown: Page) -> None:
    shown.show(Recipe((Step("detail", alpha=(3.0, 1.0, 1.0, 1.0)), Step("tone", contrast=0.8))))
    assert shown.sliders()["Texture"] == 3.0
    assert shown.sliders()["Contrast"] == 0.8
    assert shown.changes == []


def test_a_region_has_sliders_of_its_own(shown: Page) -> None:
    assert "Texture in the region" not in shown.sliders()
    shown.show(Recipe((Step("detail", (IN,), alpha=(3.0, 1.0, 1.0, 1.0), inside=(2.0, 1.0, 1.0, 1.0)),)))
    assert (shown.sliders()["Texture"], shown.sliders()["Texture in the region"]) == (3.0, 2.0)
    assert "In the region" in shown.texts()
    shown.show(Recipe((Step("detail", alpha=(3.0, 2.0, 1.0)),)))
    assert "Texture in the region" not in shown.sliders()
    assert "Layer 1" in shown.sliders()


def test_a_preset_is_chosen_and_named(shown: Page) -> None:
    shown.panel._choose("crisp")
    (change,) = shown.changes
    assert change == ("detail", {**entries_of("crisp"), "inside": None}, True)
    shown.show(PRESETS["crisp"])
    assert shown.panel._presets.value == "crisp"
    assert shown.panel._presets.props["label"] == "Start from"
    shown.show(Recipe((PRESETS["crisp"].steps[0].changed(bandwidth=33.0),)))
    assert shown.panel._presets.value is None
    assert shown.panel._presets.props["label"] == "Started from crisp, then changed"
    assert len(shown.changes) == 1


def test_a_preset_keeps_the_sliders_of_a_region_with_as_many_layers(shown: Page) -> None:
    layers = len(PRESETS["crisp"].steps[0]["alpha"])
    for count, kept in ((layers, True), (layers - 1, False)):
        inside = (2.0,) + (1.0,) * (count - 1)
        shown.show(Recipe((Step("detail", (IN,), alpha=(3.0,) + (1.0,) * (count - 1), inside=inside),)))
        shown.panel._choose("crisp")
        assert shown.changes[-1][1]["inside"] == (inside if kept else None)


def test_the_bandwidth(shown: Page) -> None:
    shown.show(Recipe((Step("detail", bandwidth=15.0),)))
    assert (shown.panel._automatic.value, shown.panel._bandwidth.value) == (False, 15.0)
    assert shown.panel._bandwidth.visible
    shown.show(Recipe((Step("detail", bandwidth="auto"),)))
    assert shown.panel._automatic.value
    assert not shown.panel._bandwidth.visible
    shown.panel._automatic.set_value(False)
    assert shown.changes == [("detail", {"bandwidth": 20.0}, True)]


def test_the_brush() -> None:
    brush = Brush()
    assert brush.paint("detail") == "in"
    brush.word["detail"] = "out"
    assert brush.paint("detail") == "out"
    brush.choose_colour("#ABCDEF")
    assert brush.paint("recolor") == "#abcdef"
    for value in ("#abc", "red", None, "1234567"):
        brush.choose_colour(value)
    assert brush.colour == "#abcdef"


def test_levels(shown: Page) -> None:
    shown.panel.draw_levels("<svg></svg>", (0.0123, 0.0), (0.012, 0.0))
    assert shown.panel._clipped.text == "Clipped: 1.2 % white, 0.0 % black"
    assert "warning" not in shown.panel._clipped.classes
    shown.panel.draw_levels("<svg></svg>", (0.02, 0.0), (0.012, 0.0))
    assert shown.panel._clipped.text.endswith("; before the edit 1.2 % and 0.0 %")
    assert "warning" in shown.panel._clipped.classes
