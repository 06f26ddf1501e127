"""axe-core finds no serious defect of accessibility in the editor, on every size of screen, at every step."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.browser import SCREENS, Editor, Tab, running
from tests.pages import ROOT
from tests.problems import cat

AXE = Path(os.environ.get("AXE_CORE", ROOT / "node_modules" / "axe-core" / "axe.min.js"))

pytestmark = pytest.mark.skipif(not AXE.exists(), reason="no axe-core here; install it: npm install --no-package-lock")


@pytest.fixture(scope="module")
def editor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Editor]:
    folder = tmp_path_factory.mktemp("editor")
    write_photograph(Photograph(cat()), folder / "cat.png")
    with running(folder, "cat.png") as editor:
        yield editor


def defects(page: Page) -> list[tuple[str, str]]:
    """Rules that the page breaks seriously, and the first element that does."""
    page.wait_for_function("() => !document.querySelector('.q-ripple__inner')")  # white, where a button was pressed
    # Together, since a page whose connection was lost loads itself again.
    run = "(axe) => { (0, eval)(axe); return window.axe.run(document, {resultTypes: ['violations']}); }"
    result: dict[str, Any] = page.evaluate(run, AXE.read_text(encoding="utf-8"))
    assert result["passes"]  # it has looked
    serious = [rule for rule in result["violations"] if rule["impact"] in ("serious", "critical")]
    return [(rule["id"], rule["nodes"][0]["html"][:200]) for rule in serious]


@pytest.mark.parametrize(("width", "height"), SCREENS)
def test_no_serious_defect(browser: Browser, editor: Editor, width: int, height: int) -> None:
    tab = Tab.at(browser, editor.with_token(), width, height, touch=width < 500)
    page = tab.page
    tab.wait_until_ready()
    result = {"Photo": defects(page)}
    page.get_by_role("button", name="Crop").click()
    tab.slider("Left edge").wait_for()
    result["crop"] = defects(page)
    page.keyboard.press("Escape")
    tab.open_details()
    result["Detail"] = defects(page)
    page.get_by_role("tab", name="Look").click()
    page.get_by_role("button", name="faded").click()
    expect(page.get_by_role("checkbox", name="Look: on")).to_be_attached()
    result["Look"] = defects(page)
    page.get_by_role("tab", name="Recolor").click()
    page.get_by_role("button", name="#8a46c8").first.wait_for()
    result["Recolor"] = defects(page)
    page.get_by_role("button", name="Save photo").click()
    page.get_by_label("Name").wait_for()
    result["saving"] = defects(page)
    tab.close()
    assert {place: rules for place, rules in result.items() if rules} == {}
