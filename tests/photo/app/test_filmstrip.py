"""The strip of photographs, and an edit for several at once."""

import asyncio
import gc
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from nicegui import Client, ui

from nlfilter_torch.photo.app.dialogs import Tasks
from nlfilter_torch.photo.app.filmstrip import Filmstrip, Stoppable, StoppedError
from nlfilter_torch.photo.app.library import Library
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.shots import Shot
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.problems import cat

BRIGHT = Recipe((Step("tone", contrast=1.4),))


class Works(Tasks):
    """Work of the page that runs when :meth:`finish` is called."""

    def __init__(self) -> None:
        super().__init__()
        self.works: list[Awaitable[None]] = []
        self.before: Callable[[], object] = lambda: None

    def start(self, work: Awaitable[None]) -> None:
        self.works.append(work)

    async def run(self, doing: str, work: Callable[..., Any], *arguments: Any, progress: object = None) -> Any:
        if progress is not None:
            self.before()
        return work(*arguments)

    def finish(self) -> None:
        while self.works:
            asyncio.run(self.works.pop(0))  # type: ignore[arg-type]


class Page:
    """A page that shows photographs of a library."""

    def __init__(self, client: Client, library: Library) -> None:
        self.client, self.library, self.tasks = client, library, Works()
        self.session: Session | None = None
        self.shots: dict[str, Shot] = {}
        self.strip = Filmstrip(library, self.shots, self.tasks, lambda: self.session, self.show, self.follow, "token")

    def show(self, shot: Shot) -> None:
        self.session = self.library.session(shot)
        self.follow()

    def follow(self) -> None:
        self.strip.follow()

    def finish(self) -> None:
        self.tasks.finish()

    def said(self) -> list[str]:
        return [element.message for element in self.client.elements.values() if isinstance(element, ui.notification)]


@pytest.fixture
def page(client: Client, tmp_path: Path) -> Iterator[Page]:
    """Three photographs, of which the first is shown, and one that is none."""
    page = Page(client, Library(tmp_path))
    for name, image in (("a.png", cat()), ("b.jpg", cat().flip(3)), ("c.png", cat().flip(2))):
        write_photograph(Photograph(image), tmp_path / name)
        page.shots[name] = page.library.shot(tmp_path / name)
    page.show(page.shots["a.png"])
    page.finish()
    yield page
    page.finish()


def test_thumbnails_follow_edits_and_what_is_none_leaves(page: Page, tmp_path: Path) -> None:
    before = [page.strip.picture(f"shot-{number}") for number in range(4)]
    assert all(before[:3])
    assert before[3] is None
    assert page.library.thumbnails["b.jpg"].size == (100, 150)
    assert page.library.thumbnails["b.jpg"].pixels.shape == (1, 3, 100, 150)
    assert page.session is not None
    page.session.load(BRIGHT)
    (tmp_path / "notes.png").write_text("dear diary")
    page.shots["notes.png"] = page.library.shot(tmp_path / "notes.png")
    page.follow()
    page.finish()
    after = [page.strip.picture(f"shot-{number}") for number in range(4)]
    assert [old != new for old, new in zip(before, after, strict=True)] == [True, False, False, False]
    assert "notes.png" not in page.shots
    (error,) = (element for element in page.client.elements.values() if isinstance(element, ui.notification))
    assert "notes.png is not a PNG" in error.message


def test_each_photograph_keeps_its_edit_and_its_history(page: Page) -> None:
    assert page.session is not None
    page.session.load(BRIGHT)
    for step, name in ((1, "b.jpg"), (1, "c.png"), (1, "a.png"), (-1, "c.png"), (1, "a.png")):
        page.strip.turn(step)
        assert page.session.name == name
        assert page.session.recipe == (BRIGHT if name == "a.png" else Recipe())
    gc.collect()
    assert len(page.library._sessions) <= 2  # at full size in memory
    assert page.session.undo()
    assert page.session.recipe == Recipe()


def test_a_copied_edit_is_pasted(page: Page) -> None:
    assert page.session is not None
    page.strip.paste()  # nothing yet
    page.session.load(BRIGHT)
    page.session.add_stroke("recolor", [(20.0, 20.0), (40.0, 20.0)], 0.03, "#2040e0")
    page.strip.copy()
    page.strip.turn(1)
    page.strip.paste()
    assert page.session.recipe == BRIGHT  # what is painted stays where it is
    assert page.session.undo()


@pytest.mark.parametrize("saves", [False, True])
def test_all_others_get_an_edit(page: Page, tmp_path: Path, saves: bool) -> None:
    assert page.session is not None
    page.session.load(BRIGHT)
    others = [page.shots[name] for name in ("b.jpg", "c.png")]
    (tmp_path / "c-edited.png").write_bytes(b"another file")
    asyncio.run(page.strip.give(BRIGHT, others, saves=saves))
    page.finish()
    for shot in others:
        assert page.library.recipe(shot) == BRIGHT
        assert page.library.session(shot).undo()  # and it can be undone
    assert {path.name for path in tmp_path.glob("*-edited*")} == (
        {"b-edited.jpg", "c-edited.png", "c-edited-2.png"} if saves else {"c-edited.png"}
    )
    assert (tmp_path / "c-edited.png").read_bytes() == b"another file"


def test_giving_is_stopped(page: Page) -> None:
    others = [page.shots[name] for name in ("b.jpg", "c.png")]
    stops = iter([lambda: None, page.strip._give_or_stop])
    page.tasks.before = lambda: next(stops)()
    asyncio.run(page.strip.give(BRIGHT, others, saves=False))
    assert [page.library.recipe(shot) for shot in others] == [BRIGHT, Recipe()]
    assert page.strip._all.text == "Apply to all"


def test_progress_says_how_many_are_done() -> None:
    progress = Stoppable(3)
    progress.done = 1
    progress("Editing", 1, 2)
    assert str(progress).startswith("1 of 3 done; Editing, 50 %")
    progress.stop()
    with pytest.raises(StoppedError):
        progress("Editing", 2, 2)
