"""The editor at full size: it shows what it saves, and computes only the missing pieces."""

import asyncio
import io
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app import closeup, drawing
from nlfilter_torch.photo.app.closeup import CELL, Closeup
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.parts import Rectangle
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.problems import cat

PLACE = Rectangle(range(21, 83), range(33, 120))
IN, OUT = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in"), Stroke(((0.8, 0.8),), 0.04, "out")
BLUE = Stroke(((0.37, 0.35), (0.4, 0.37)), 0.04, "#2040e0")
REGION = Step("detail", (IN, OUT), alpha=(0.2, 1.0, 1.0), inside=(3.0, 4.0, 1.0), reach=0.5, landmarks=60)
RECIPES = {
    "nothing": Recipe(),
    "detail": Recipe((Step("detail", alpha=(3.0, 2.0, 1.0), landmarks=60),)),
    "detail, reduced": Recipe((Step("detail", alpha=(3.0, 2.0, 1.0), viewing_size=0.006, landmarks=60),)),
    "region": Recipe((REGION,)),
    "region, reduced": Recipe((REGION.changed(viewing_size=0.006),)),
    "recolor": Recipe((Step("recolor", (BLUE,)),)),
    "defocus": Recipe((Step("defocus", (IN,)),)),
    "abstract": Recipe((Step("abstract", edges=0.5),)),
    "several": Recipe(
        (Step("denoise", noise_level=6.0, method="rule"), REGION, Step("tone", contrast=1.2, landmarks=60))
    ),
}


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize("name", RECIPES)
def test_what_is_shown_at_full_size_is_what_is_saved(name: str, session: Session) -> None:
    """They agree to one grey level, whether the photograph is saved in memory or, as large ones are, in tiles."""
    session.load(RECIPES[name])
    saved = read_photograph(session.save("out.png")).pixels
    shown = session.part(PLACE, session.recipe)
    wanted = saved[..., PLACE.rows.start : PLACE.rows.stop, PLACE.columns.start : PLACE.columns.stop]
    levels = (255 * shown).round()
    assert (levels - (255 * wanted).round()).abs().max() <= 1
    assert name == "nothing" or (saved - cat()).abs().max() > 5 / 255


class Page:
    """A stand-in for the page: it records messages, and work runs when :meth:`finish` is called."""

    def __init__(self, session: Session) -> None:
        self.told: list[str] = []
        self.works: list[Awaitable[None]] = []
        self.said: list[str] = []
        self.parts: list[Rectangle] = []
        self.before_work: Callable[[], None] = lambda: None
        self.closeup = Closeup(self, self.told.append)
        self.closeup.open(session)

    def start(self, work: Awaitable[None]) -> None:
        self.works.append(work)

    def say(self, who: object, doing: str = "") -> None:
        self.said.append(doing)

    async def run(
        self, doing: str, work: Callable[..., Any], *arguments: object, progress: Progress | None = None
    ) -> Any:
        self.before_work()
        return work(*arguments)

    def finish(self) -> None:
        async def all_of_it() -> None:
            while self.works:
                await self.works.pop()

        asyncio.run(all_of_it())

    def look(self, *view: int) -> list[str]:
        """Return the messages that the page receives when it shows a part."""
        self.told.clear()
        self.closeup.look(view or None)
        self.finish()
        return list(self.told)


@pytest.fixture
def large(tmp_path: Path) -> Session:
    """A session with a photograph of 450x300 pixels."""
    write_photograph(Photograph(cat(1)), tmp_path / "large.png")
    return Session(tmp_path, tmp_path / "large.png")


@pytest.fixture
def page(large: Session, monkeypatch: pytest.MonkeyPatch) -> Page:
    """A page that shows the photograph; ``parts`` are the parts that were computed."""
    page, part = Page(large), large.part

    def counted(place: Rectangle, *arguments: Any) -> torch.Tensor:
        page.parts.append(place)
        return part(place, *arguments)

    monkeypatch.setattr(large, "part", counted)
    return page


def pixels(content: bytes | None) -> torch.Tensor:
    assert content is not None
    return torch.from_numpy(np.array(Image.open(io.BytesIO(content)))).permute(2, 0, 1)[None] / 255


def test_pieces_cover_what_is_seen_and_a_pan_adds_what_is_new(page: Page, large: Session) -> None:
    assert page.look(10, 20, 130, 100) == ["closeup.add('piece-1', 0, 0, 192, 128)"]
    assert page.look(40, 20, 180, 128) == []  # already computed
    assert page.look(100, 20, 230, 100) == ["closeup.add('piece-2', 192, 0, 256, 128)"]
    assert page.look(100, 200, 250, 300) == ["closeup.add('piece-3', 64, 192, 256, 300)"]  # to the border
    assert len(page.parts) == 3
    assert torch.equal(pixels(page.closeup.file("piece-2")), cat(1)[..., :128, 192:256])
    assert page.look() == []
    assert page.closeup.file("piece-9") is None


def test_pieces_are_not_too_large_and_those_out_of_sight_are_dropped(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(closeup, "PIECE_PIXELS", 6 * CELL**2)
    monkeypatch.setattr(closeup, "KEPT_PIECES", 30_000)
    told = page.look(0, 0, 192, 192)
    assert told == ["closeup.add('piece-1', 0, 0, 192, 128)", "closeup.add('piece-2', 0, 128, 192, 192)"]
    told = page.look(256, 0, 384, 128)
    assert told == ["closeup.add('piece-3', 256, 0, 384, 128)", "closeup.drop('piece-1')"]
    assert page.closeup.file("piece-1") is None
    assert page.look(0, 0, 64, 64) == ["closeup.add('piece-4', 0, 0, 64, 64)", "closeup.drop('piece-2')"]


def test_an_edit_that_changes_takes_its_pieces_with_it(page: Page, large: Session) -> None:
    page.look(0, 0, 100, 100)
    large.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    page.told.clear()
    page.closeup.hold()  # the slider moves
    assert page.told == ["closeup.clear()"]
    assert page.look(0, 0, 110, 100) == []
    large.commit()
    page.closeup.follow()
    page.finish()
    assert page.told == ["closeup.add('piece-2', 0, 0, 128, 128)"]
    piece = pixels(page.closeup.file("piece-2"))
    wanted = apply_recipe(large.recipe, cat(1)).clamp(0, 1)[..., :128, :128]
    assert (piece - wanted).abs().max() <= 1 / 255
    page.told.clear()
    page.closeup.follow()  # nothing has changed
    page.finish()
    assert page.told == []


def test_what_is_worked_out_for_an_edit_that_has_changed_is_not_shown(page: Page, large: Session) -> None:
    """The fit is interrupted and replaced by that of the new edit."""
    large.load(Recipe((Step("detail", alpha=(3.0, 1.0)),)))
    meanwhile = iter([lambda: large.load(Recipe((Step("detail", alpha=(0.0, 1.0)),)))])
    page.before_work = lambda: next(meanwhile, lambda: None)()
    assert page.look(0, 0, 64, 64) == ["closeup.add('piece-1', 0, 0, 64, 64)"]
    assert len(page.parts) == 2
    wanted = apply_recipe(large.recipe, cat(1)).clamp(0, 1)[..., :64, :64]
    assert (pixels(page.closeup.file("piece-1")) - wanted).abs().max() <= 1 / 255


def test_the_original_at_full_size(page: Page) -> None:
    assert torch.equal(pixels(page.closeup.original("30,10,90,50")), cat(1)[..., 10:50, 30:90])
    assert torch.equal(pixels(page.closeup.original("400,250,999,999")), cat(1)[..., 250:, 400:])
    for place in ("", "1,2,3", "1,2,x,4", "90,10,30,50", "-9,-9,0,0", "1,2,3,4,5"):
        assert page.closeup.original(place) is None


def test_what_was_drawn_is_shown_below_the_pieces(page: Page, large: Session) -> None:
    """At once the part is nearly what it will be, as the preview has the same pixels here."""
    recipe = Recipe((Step("detail", alpha=(3.0, 1.0)),))
    large.load(recipe)
    drawn = large.render()
    seen = drawn[..., 40:104, 20:84]
    near = large.nearly(Rectangle(range(40, 104), range(20, 84)), recipe)
    assert near is not None
    assert (near - seen).abs().max() < 1e-4
    page.closeup._view = Rectangle(range(40, 104), range(20, 84))
    page.closeup.show_nearly()
    page.finish()
    assert page.told == ["closeup.add('near-1', 20, 40, 84, 104)"]
    assert page.closeup.file("near-1") == drawing.picture(near)
    assert page.look(20, 40, 84, 104) == ["closeup.add('piece-2', 0, 0, 128, 128)", "closeup.drop('near-1')"]
    assert page.closeup.file("near-1") is None
    page.closeup.hold()  # a slider moves: the pieces go, and what is near follows
    large.set("detail", alpha=(2.0, 1.0))
    large.render(0)
    page.told.clear()
    page.closeup.show_nearly()
    page.finish()
    assert page.told == ["closeup.add('near-3', 20, 40, 84, 104)"]
    page.closeup.hold()
    assert page.closeup.file("near-3") is not None  # until the next one is there
    moved = large.recipe
    large.load(Recipe())
    assert large.nearly(Rectangle(range(4), range(4)), moved) is not None
    large.render()
    assert large.nearly(Rectangle(range(4), range(4)), moved) is None
