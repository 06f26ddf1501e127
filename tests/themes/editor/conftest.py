"""Fixtures of tests in a browser: Chromium, one editor for all modules, its folder and a page of it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.browser import CHROMIUM, Editor, Tab, chromium, running
from tests.problems import cat


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium here; install it: apt-get install chromium")
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="package")
def editor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Editor]:
    with running(tmp_path_factory.mktemp("editor")) as editor:
        yield editor


@pytest.fixture
def folder(editor: Editor) -> Iterator[Path]:
    """The folder that the editor saves to, with a photograph in it."""
    folder = editor.log.parent
    write_photograph(Photograph(cat()), folder / "cat.png")
    yield folder
    for file in folder.iterdir():
        if file != editor.log:
            file.unlink()


@pytest.fixture
def tab(browser: Browser, editor: Editor, folder: Path) -> Iterator[Tab]:
    tab = Tab(browser.new_page(viewport={"width": 1280, "height": 900}))
    page = tab.page
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("request", lambda request: None if request.url.startswith(editor.url) else troubles.append(request.url))
    page.goto(editor.with_token())
    yield tab
    page.close()
    # Every script, font and picture is served by the editor itself.
    assert [trouble for trouble in troubles if not trouble.startswith(("data:", "blob:", "ws://127.0.0.1:"))] == []


@pytest.fixture
def opened(tab: Tab, folder: Path) -> Tab:
    tab.open(folder / "cat.png")
    expect(tab.page.get_by_text("150×100 pixels")).to_be_visible()
    tab.open_details()
    return tab
