"""The tab of looks: pictures of the photograph under each, of which one is chosen."""

import io

import numpy as np
import pytest
import torch
from nicegui import Client, ui
from PIL import Image

from nlfilter_torch.photo.app.shots import THUMBNAIL
from nlfilter_torch.photo.app.tabs import LookTab, look_entries, thumbnails
from nlfilter_torch.photo.declared.presets import LOOKS, Recipe
from nlfilter_torch.photo.edits.applying import apply_step
from tests.photo.app.page_controls import Controls
from tests.problems import cat


def buttons(shown: Controls) -> dict[str, ui.button]:
    return {button.props["aria-label"]: button for button in shown.of(ui.button)}


def test_a_look_is_chosen(client: Client) -> None:
    shown = Controls(client)
    tab = LookTab("look", shown)
    tab.follow()
    assert list(buttons(shown)) == list(LOOKS)
    assert not any(button.enabled for button in buttons(shown).values())  # there is no photograph
    assert not shown.of(ui.slider)[0].enabled
    shown.thumbnails = dict.fromkeys(LOOKS, "/picture/token/look")
    tab.follow()
    assert all(button.enabled for button in buttons(shown).values())
    assert not shown.of(ui.slider)[0].enabled  # there is no look
    shown.click("faded")
    ((edit, values, is_complete),) = shown.changes
    assert (edit, is_complete) == ("look", True)
    assert values == look_entries(LOOKS["faded"])
    shown.show(tab, Recipe((LOOKS["faded"].changed(amount=0.4),)))
    assert [n for n, button in buttons(shown).items() if button.props["aria-pressed"] == "true"] == ["faded"]
    assert shown.of(ui.slider)[0].enabled
    shown.show(tab, Recipe((LOOKS["faded"].changed(amount=0.0),)))
    shown.click("warm")
    assert shown.changes.pop()[1] == {**look_entries(LOOKS["warm"]), "amount": 1.0}


def test_pictures_show_the_looks() -> None:
    large = torch.nn.functional.interpolate(cat(), scale_factor=3)
    pictures = {name: np.asarray(Image.open(io.BytesIO(content))) for name, content in thumbnails(large).items()}
    assert {picture.shape for picture in pictures.values()} == {(107, THUMBNAIL, 3)}
    assert np.ptp(pictures["mono"].astype(int), axis=2).max() <= 1
    assert pictures["warm"][..., 2].mean() < pictures["cool"][..., 2].mean()
    assert thumbnails(cat()[:, :1]).keys() == LOOKS.keys()


@pytest.mark.parametrize("name", LOOKS)
def test_looks_are_gentle(name: str) -> None:
    """They clip little, change the mean brightness little, and come back from files."""
    edited = apply_step(LOOKS[name], cat())
    assert ((edited < -0.02) | (edited > 1.02)).float().mean() < 0.02
    assert (edited.mean() - cat().mean()).abs() < 0.06
    recipe = Recipe((LOOKS[name],))
    assert Recipe.from_json(recipe.to_json(), "look.json") == recipe
    assert look_entries(LOOKS[name]).keys() == {p.name for p in LOOKS[name].declared} - {"amount"}
