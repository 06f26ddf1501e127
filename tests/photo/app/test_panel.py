"""The controls beside the picture: a tab for each edit, and the histogram."""

import pytest
from nicegui import Client, ui

from nlfilter_torch.photo.app.panel import Panel
from nlfilter_torch.photo.app.tools import BRUSHES
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from tests.photo.app.page_controls import Controls


@pytest.fixture
def shown(client: Client) -> Controls:
    return Controls(client)


@pytest.fixture
def opened() -> list[str]:
    """The edits whose tabs were opened."""
    return []


@pytest.fixture
def panel(shown: Controls, opened: list[str]) -> Panel:
    return Panel(shown, opened.append)


def test_every_edit_has_a_tab_with_its_sliders(shown: Controls, panel: Panel, opened: list[str]) -> None:
    tabs = [tab.props["name"] for tab in shown.of(ui.tab)]
    assert tabs[:2] == ["develop", "detail"]
    assert set(tabs[1:]) == set(EDITS)
    assert len(tabs) == len(EDITS) + 1
    assert shown.of(ui.tabs)[0].value == "develop"
    labels = {p.slider.label for edit in EDITS.values() for p in edit if p.slider is not None and edit.name != "detail"}
    assert labels | {"Texture", "Shading"} <= shown.sliders().keys()
    assert len(shown.of(ui.toggle)) == len(BRUSHES)
    shown.of(ui.tabs)[0].set_value("recolor")
    assert opened[-1] == "recolor"


def test_a_key_takes_a_tool_of_the_open_tab(shown: Controls, panel: Panel) -> None:
    for edit, role, paint in (
        ("detail", "added", "add"),
        ("recolor", "added", f"add {shown.brush.colour}"),
        ("recolor", "removed", "remove"),
        ("recolor", "object", shown.brush.colour),
        ("colorize", "removed", shown.brush.colour),
    ):
        shown.of(ui.tabs)[0].set_value(edit)
        panel.take(role)
        assert shown.brush.paint(edit) == paint
    shown.of(ui.tabs)[0].set_value("tone")
    panel.take("added")


def test_all_tabs_follow_the_edit(shown: Controls, panel: Panel) -> None:
    shown.edit = Recipe((Step("detail", alpha=(3.0, 1.0, 1.0, 1.0)), Step("tone", contrast=0.8)))
    panel.follow()
    assert shown.sliders()["Texture"] == 3.0
    assert shown.sliders()["Contrast"] == 0.8
    assert shown.changes == []


def test_the_response_is_shown_in_the_tab_with_layers(shown: Controls, panel: Panel) -> None:
    panel.draw_response("<svg>response</svg>")
    assert [element.content for element in shown.of(ui.html)].count("<svg>response</svg>") == 1


def test_levels(panel: Panel) -> None:
    panel.draw_levels("<svg></svg>", (0.0123, 0.0), (0.012, 0.0))
    assert panel._clipped.text == "Clipped: 1.2\u00a0% white, 0.0\u00a0% black"
    assert "warning" not in panel._clipped.classes
    panel.draw_levels("<svg></svg>", (0.02, 0.0), (0.012, 0.0))
    assert panel._clipped.text.endswith("; before the edit 1.2\u00a0% and 0.0\u00a0%")
    assert "warning" in panel._clipped.classes


def test_tabs_of_acting_steps_are_marked_and_opened_from_the_list(
    shown: Controls, panel: Panel, opened: list[str]
) -> None:
    shown.edit = Recipe((Step("tone"), Step("sharpen").mixed(on=False)))
    panel.follow()
    assert [tab.props["name"] for tab in shown.of(ui.tab) if "alert" in tab.props] == ["tone"]
    shown.click("Sharpen")
    assert opened[-1] == "sharpen"
    shown.edit = Recipe()
    panel.follow()
    assert not any("alert" in tab.props for tab in shown.of(ui.tab))
