"""The large picture with its overlays, and the brush that draws on it."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from nicegui import Client

from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.canvas import Canvas
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.tools import Brush
from nlfilter_torch.photo.declared.strokes import Region
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.problems import cat


class Page:
    """A stand-in for the page with a canvas, which records what the canvas calls."""

    def __init__(self) -> None:
        self.brush = Brush()
        self.strokes = 0
        self.canvas = Canvas(self.brush, "token", self.draw, self.lay, "() => 0")
        self.canvas.switch("detail")

    def draw(self, step: str, add: Callable[[], None]) -> None:
        add()
        self.strokes += 1

    def lay(self) -> None:
        self.canvas.lay_over()
        self.canvas.show_layers()

    def open(self, session: Session) -> None:
        self.canvas.open(session)

    def paint(self, *points: tuple[float, float]) -> None:
        for kind, point in zip(("pointerdown", *["pointermove"] * len(points)), points, strict=False):
            self.canvas._pointer(kind, *point)
        self.canvas._pointer("pointerup", *points[-1])


@pytest.fixture
def shown(client: Client, scripts: list[str]) -> Page:
    page = Page()
    scripts.clear()
    return page


@pytest.fixture
def opened(shown: Page, session: Session) -> Page:
    shown.open(session)
    return shown


def test_opening(opened: Page, scripts: list[str]) -> None:
    canvas = opened.canvas
    assert scripts == ["closeup.open(150, 100, '/picture/token')"]
    assert canvas._size.text == "150\u00d7100 pixels, shown at 150\u00d7100"
    assert canvas._photo.visible
    assert not canvas._welcome.visible
    assert canvas.pictures == {"before": drawing.picture(cat())}
    assert canvas.clipped_before == drawing.clipped_shares(cat())


def test_drawing_the_edit(opened: Page, session: Session) -> None:
    canvas = opened.canvas
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    canvas.draw(None)
    edited = session.render()
    assert canvas.pictures["after"] == drawing.picture(edited)
    assert canvas.pictures["mask"] == b""
    assert canvas.clipped == drawing.clipped_shares(edited)
    assert canvas.histogram == drawing.histogram_svg(edited)
    source = canvas._photo.source
    canvas.show()
    assert canvas._photo.source != source
    assert str(canvas._photo.source).startswith("/picture/token/after?")


def test_nothing_is_drawn_before_a_photograph(shown: Page) -> None:
    shown.canvas.draw(None)
    shown.paint((10.0, 20.0), (30.0, 20.0))
    assert not any(shown.canvas.pictures.values())
    assert shown.strokes == 0


def test_a_stroke(opened: Page, session: Session) -> None:
    canvas = opened.canvas
    canvas._pointer("pointermove", 10, 20)  # it did not begin here
    canvas._pointer("pointerdown", 20, 20)
    canvas._pointer("pointermove", 40, 20)
    assert canvas._photo.content.count("<path") == 1  # while it is drawn
    assert session.recipe.current("detail").strokes == ()
    canvas._pointer("pointerup", 40, 20)
    (stroke,) = session.recipe.current("detail").strokes
    assert (stroke.paint, stroke.radius) == ("in", 0.02)
    assert stroke.points[0] == (round(20 / 150, 4), 0.2)
    assert opened.strokes == 1
    canvas._show_strokes.set_value(False)
    assert canvas._photo.content == ""
    canvas._show_strokes.set_value(True)
    assert canvas._photo.content.count("<path") == 1


def test_a_box(opened: Page, session: Session) -> None:
    canvas = opened.canvas
    canvas._brush.word["detail"] = "box"
    canvas._pointer("pointerdown", 20, 20)
    canvas._pointer("pointerup", 21, 60)  # a click, nearly
    assert session.recipe.current("detail").strokes == ()
    canvas._pointer("pointerdown", 120, 80)
    canvas._pointer("pointermove", 30, 20)
    assert canvas._photo.content.count("Z") == 1  # while it is drawn
    canvas._pointer("pointerup", 30, 20)
    (box,) = session.recipe.current("detail").strokes
    assert box == Region.upright((0.2, 0.2, 0.6, 0.6), "rectangle", "box")


def test_a_gradient(opened: Page, session: Session) -> None:
    canvas = opened.canvas
    canvas._step = "light"
    canvas._brush.word["light"] = "linear: add"
    canvas._pointer("pointerdown", 20, 20)
    canvas._pointer("pointermove", 20, 80)
    assert canvas._photo.content.count("M") == 3  # its axis and bars across it
    canvas._pointer("pointerup", 20, 80)
    (gradient,) = session.recipe.current("light").strokes
    assert gradient == Region(((round(20 / 150, 4), 0.2), (round(20 / 150, 4), 0.8)), "linear", "add")


def test_a_stroke_that_is_dropped(opened: Page, session: Session) -> None:
    opened.canvas._pointer("pointerdown", 20, 20)
    opened.canvas.drop_stroke()
    opened.canvas._pointer("pointerup", 40, 20)
    assert session.recipe.current("detail").strokes == ()
    assert opened.canvas._photo.content == ""


def test_each_step_has_its_strokes(opened: Page, session: Session, scripts: list[str]) -> None:
    opened.paint((20.0, 20.0), (40.0, 20.0))
    opened.canvas.switch("recolor")
    assert opened.canvas._photo.content == ""
    opened.paint((20.0, 20.0), (40.0, 20.0))
    assert session.recipe.current("recolor").strokes[0].paint == opened.brush.colour
    opened.canvas.switch("tone")
    opened.paint((20.0, 20.0), (40.0, 20.0))  # it takes no strokes
    assert opened.strokes == 2
    assert scripts[-2:] == ["closeup.brush(true)", "closeup.brush(false)"]


def test_the_mask_is_shown_when_it_is_new_or_kept_in_sight(opened: Page) -> None:
    canvas = opened.canvas
    opened.paint((20.0, 20.0), (40.0, 20.0))
    canvas.draw(None)
    assert canvas.pictures["mask"]
    canvas.draw_mask()
    assert canvas._mask.visible
    assert "flash-1" in canvas._mask.classes
    canvas.draw_mask()  # it is not new, and disappears by itself
    assert "flash-1" in canvas._mask.classes
    canvas._show_mask.set_value(True)
    assert canvas._mask.visible
    assert not {"flash-0", "flash-1"} & set(canvas._mask.classes)
    canvas.draw_mask(moving=True)
    assert not canvas._mask.visible
    canvas.draw_mask()
    assert canvas._mask.visible
    canvas._show_mask.set_value(False)
    assert not canvas._mask.visible
    canvas.switch("recolor")
    assert not canvas._mask.visible


def test_masks_of_all_brushes_in_colour_and_in_black_and_white(opened: Page, session: Session) -> None:
    canvas = opened.canvas
    canvas.switch("defocus")
    opened.paint((20.0, 20.0), (40.0, 20.0))
    canvas.draw(None)
    assert not canvas.pictures["mask"]  # it is computed when it is asked for
    canvas._show_mask.set_value(True)
    assert canvas._mask.visible
    mask = session.mask("defocus")
    assert mask is not None
    tint = drawing.contrasting_tint(session.render(), mask)
    assert canvas.pictures["mask"] == drawing.mask_picture(mask, tint)
    canvas._is_plain.set_value(True)
    assert canvas.pictures["mask"] == drawing.lossless(mask)
    canvas.switch("tone")
    assert not canvas._mask.visible
    canvas._show_mask.set_value(False)
    assert not canvas._is_plain.visible


def test_parts_of_strokes_that_do_not_count_are_hatched(shown: Page, tmp_path: Path) -> None:
    pixels = torch.full((1, 3, 60, 90), 0.5) + torch.tensor([0.3, -0.2, -0.2]).view(1, 3, 1, 1)
    pixels[..., 48:] = torch.tensor([0.1, 0.5, 0.2]).view(1, 3, 1, 1)
    write_photograph(Photograph(pixels), tmp_path / "two.png")
    session = Session(tmp_path, tmp_path / "two.png")
    shown.open(session)
    canvas = shown.canvas
    shown.paint((20.0, 30.0), (55.0, 30.0))
    canvas.draw(None)
    canvas.draw_strokes()
    assert canvas._ignored.visible
    ignored = session.ignored("detail")
    assert ignored is not None
    assert canvas.pictures["ignored"] == drawing.hatching(ignored)
    assert ignored.nonzero()[:, 3].min() >= 44  # the green begins at 48
    canvas._show_strokes.set_value(False)
    assert not canvas._ignored.visible


def test_what_is_clipped(opened: Page, session: Session) -> None:
    canvas = opened.canvas
    assert not canvas._clipped.visible
    canvas._show_clipped.set_value(True)
    assert canvas._clipped.visible
    assert canvas.pictures["clipped"] == drawing.clipped_picture(cat())
    session.set("tone", contrast=1.4)
    canvas.draw(None)
    assert canvas.pictures["clipped"] == drawing.clipped_picture(session.render())
