"""The picture of a page at rest: what a file would hold."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app import closeup
from nlfilter_torch.photo.app.closeup import AtRest
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from tests.browser import difference
from tests.problems import cat

BLUE, IN = Stroke(((0.37, 0.35), (0.4, 0.37)), 0.04, "#2040e0"), Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in")
LINES = Recipe((Step("abstract", edges=0.8, tones=6),))
RECIPES = {
    "recolor": Recipe((Step("recolor", (BLUE,)),)),
    "defocus": Recipe((Step("defocus", (IN,)),)),
    "abstract": LINES,
    "beyond white": Recipe((Step("detail", alpha=(9.0, 5.0, 1.0), limits="none", landmarks=60),)),
    "two steps": Recipe((Step("detail", alpha=(3.0, 2.0, 1.0), landmarks=60), *LINES.steps)),
}


@pytest.fixture
def large(tmp_path: Path) -> Session:
    """A session with a photograph of 450x300 pixels and a preview of 150x100."""
    write_photograph(Photograph(cat(1)), tmp_path / "large.png")
    session = Session(tmp_path, tmp_path / "large.png", pixels=15_000)
    assert session.preview.stride == pytest.approx(3)
    return session


class Page:
    """A stand-in for the page, which shows the session given and calls ``before_work`` before any work in a thread."""

    def __init__(self, session: Session) -> None:
        self.shown: list[torch.Tensor] = []
        self.works: list[Awaitable[None]] = []
        self.session: Session | None = session
        self.before_work: Callable[[], None] = lambda: None
        self.at_rest = AtRest(self, lambda session: session is self.session, self.shown.append)

    def start(self, work: Awaitable[None]) -> None:
        self.works.append(work)

    async def run(self, doing: str, work: Callable[..., Any], *arguments: object, progress: Progress) -> Any:
        self.before_work()
        return work(*arguments)

    def draw(self, session: Session) -> None:
        self.at_rest.drawn(session)
        while self.works:
            asyncio.run(self.works.pop())  # type: ignore[arg-type]


@pytest.fixture
def page(large: Session, monkeypatch: pytest.MonkeyPatch) -> Page:
    monkeypatch.setattr(closeup, "QUIET", 0.0)
    return Page(large)


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize("name", RECIPES)
def test_the_picture_at_rest_is_the_saved_file(name: str, large: Session) -> None:
    large.load(RECIPES[name])
    saved = resize(read_photograph(large.save("out.png")).pixels, large.preview.size).clamp(0, 1)
    shown = large.at_rest(large.recipe)
    assert difference(shown, saved) < 0.3  # the file is rounded to 256 levels
    assert difference(large.preview.pixels, saved) > 2
    assert large.at_rest(large.recipe) is shown  # for other tabs


def test_it_is_shown_once_nothing_changes(page: Page, large: Session) -> None:
    page.draw(large)
    assert page.shown == []  # no edit
    large.load(LINES)
    page.draw(large)
    assert len(page.shown) == 1
    assert difference(page.shown[0], resize(apply_recipe(LINES, cat(1)).clamp(0, 1), large.preview.size)) < 0.01
    page.session = None  # another photograph, a part at full size, or a slider that moves
    page.draw(large)
    assert len(page.shown) == 1


def test_an_edit_that_changes_interrupts_it(page: Page, large: Session) -> None:
    large.load(LINES)

    def change() -> None:
        page.before_work = lambda: None
        large.load(RECIPES["recolor"])
        page.at_rest.drawn(large)

    page.before_work = change
    page.draw(large)
    assert len(page.shown) == 1
    wanted = apply_recipe(RECIPES["recolor"], cat(1)).clamp(0, 1)
    assert difference(page.shown[0], resize(wanted, large.preview.size)) < 0.05


def test_a_small_photograph_needs_no_other_picture(page: Page, tmp_path: Path) -> None:
    session = Session(tmp_path, tmp_path / "large.png")
    session.load(LINES)
    page.session = session
    page.draw(session)
    assert page.shown == []
