"""Edits that persist when the page, the tab or the editor is closed."""

import signal
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Dialog, Page, expect

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.browser import Editor, Tab
from tests.problems import cat


@pytest.fixture
def shots(tmp_path: Path) -> Path:
    """A folder with two photographs."""
    folder = tmp_path / "shots"
    folder.mkdir()
    write_photograph(Photograph(cat()), folder / "cat.png")
    write_photograph(Photograph(cat().flip(3)), tmp_path / "elsewhere.png")
    return folder


def shown(tab: Tab) -> None:
    """Wait for the photograph."""
    expect(tab.page.get_by_text("150×100 pixels")).to_be_visible()
    tab.open_details()


def leaving_is_asked_for(page: Page) -> None:
    """Try to leave a page, and stay."""
    page.wait_for_function("page.isUnsaved")  # the server says so after it has enabled Undo
    dialogs: list[str] = []

    def stay(dialog: Dialog) -> None:
        dialogs.append(dialog.type)
        dialog.dismiss()

    page.on("dialog", stay)
    with page.expect_event("dialog"):
        page.evaluate("() => { location.href = 'about:blank'; }")
    assert dialogs == ["beforeunload"]
    assert page.url.endswith("?photo=cat.png&tab=detail")
    page.remove_listener("dialog", stay)


def test_reload_second_tab_and_new_start(browser: Browser, shots: Path) -> None:
    editor = Editor(shots, "cat.png")
    kept = shots / "cat.png.edit.json"
    try:
        tab = Tab.at(browser, editor.with_token())
        page = tab.page
        shown(tab)
        undo = page.get_by_role("button", name="Undo")
        expect(undo).to_be_disabled()
        tab.paint((0.2, 0.9), (0.3, 0.9))
        expect(page.get_by_text("In the region")).to_be_visible()
        expect(undo).to_be_enabled()
        leaving_is_asked_for(page)

        page.reload()
        expect(page.locator("path.stroke")).to_have_count(1)
        expect(page.get_by_text("In the region")).to_be_visible()
        other = Tab.at(browser, editor.with_token(page.url))
        shown(other)
        expect(other.page.locator("path.stroke")).to_have_count(1)
        other.paint((0.6, 0.2), (0.7, 0.2))
        expect(page.locator("path.stroke")).to_have_count(2)  # in both
        page.get_by_role("button", name="Undo").click()
        expect(other.page.locator("path.stroke")).to_have_count(1)
        other.page.close()
        recipe = Recipe.from_json(kept.read_text(), "")
        assert len(recipe.current("detail").strokes) == 1
        port = editor.url.rstrip("/").rsplit(":", 1)[1]
        editor.process.send_signal(signal.SIGKILL)
        editor.process.wait()
        editor.stop()
        editor = Editor(shots, "--port", port)
        # The page reconnects to the new editor without asking: the edit is stored.
        expect(undo).to_be_disabled()
        shown(tab)
        expect(page.locator("path.stroke")).to_have_count(1)
        expect(page.get_by_text("In the region")).to_be_visible()
        before = tab.source()
        page.get_by_role("button", name="Reset").click()
        tab.wait_for_picture(before)
        expect(page.locator("path.stroke")).to_have_count(0)
        page.close()
        assert not kept.exists()
        assert editor.log.read_text() == ""
    finally:
        editor.stop()


def test_a_photograph_of_another_folder(browser: Browser, shots: Path) -> None:
    """The browser does not reveal its path: its edit is stored in the user's state folder, and restored from there."""
    editor = Editor(shots)
    try:
        tab = Tab.at(browser, editor.with_token())
        tab.open(shots.parent / "elsewhere.png")
        shown(tab)
        tab.paint((0.2, 0.9), (0.3, 0.9))
        expect(tab.page.get_by_text("In the region")).to_be_visible()
        tab.page.reload()
        expect(tab.page.locator("path.stroke")).to_have_count(1)
        address = tab.page.url
        tab.page.close()
        assert [path.name for path in (editor.state / "nlfilter-torch").glob("*-elsewhere.png.edit.json")] != []
        assert {path.name for path in shots.iterdir()} == {"cat.png", "log.txt"}
        port = editor.url.rstrip("/").rsplit(":", 1)[1]
        editor.stop()
        editor = Editor(shots, "--port", port)
        tab = Tab.at(browser, editor.with_token(address))
        expect(tab.page.get_by_text("open the photograph again")).to_be_visible()
        tab.open(shots.parent / "elsewhere.png")
        expect(tab.page.locator("path.stroke")).to_have_count(1)
        expect(tab.page.get_by_text("open the photograph again")).not_to_be_visible()
        tab.page.close()
    finally:
        editor.stop()
