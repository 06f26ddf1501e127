"""Zoom and pan in a real browser, by wheel, keys, buttons and fingers, on every size of screen."""

import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from playwright.sync_api import Browser, Page, expect

from nlfilter_torch.photo.declared.presets import find_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.browser import POINTED, TOUCHED, Editor, Fingers, Tab, pixels_of, running
from tests.problems import cat

WIDTH, HEIGHT = 450, 300


@pytest.fixture(scope="module")
def editor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Editor]:
    folder = tmp_path_factory.mktemp("editor")
    write_photograph(Photograph(cat(1)), folder / "cat.png")
    with running(folder, "cat.png") as editor:
        yield editor


class Zoomed(Tab):
    """A page of the editor with the photograph open, and the part of it that is shown."""

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self.level = page.locator(".zoom-level")
        self.pieces = page.locator(".pieces img")

    def middle(self) -> tuple[float, float]:
        """Of the canvas, in pixels of the page."""
        box = self.page.locator(".canvas").bounding_box()
        assert box is not None
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def share(self, x: float, y: float) -> tuple[float, float]:
        """Return the point of the photograph at a point of the page, as fractions of its width and height."""
        box = self.place()
        return (x - box["x"]) / box["width"], (y - box["y"]) / box["height"]

    def scale(self) -> float:
        """Pixels of the page per pixel of the photograph."""
        box = self.place()
        assert box["width"] / box["height"] == pytest.approx(WIDTH / HEIGHT, rel=0.02)
        return box["width"] / WIDTH

    def enlarge(self, level: str) -> None:
        """Zoom in by the button until a level is reached."""
        for _ in range(8):
            if self.level.text_content() == level:
                return
            self.page.get_by_role("button", name="Zoom in").click()
        expect(self.level).to_have_text(level)

    def wait_for_pieces(self) -> None:
        """Wait until the middle of the visible part is covered and every piece has loaded."""
        self.page.wait_for_function(
            """() => { const box = document.querySelector('.canvas').getBoundingClientRect();
            const x = box.x + box.width / 2, y = box.y + box.height / 2;
            const images = [...document.querySelectorAll('.pieces img')];
            return images.some((image) => { const b = image.getBoundingClientRect();
              return image.complete && b.left <= x && x <= b.right && b.top <= y && y <= b.bottom; }); }"""
        )

    def expect_pieces(self, wanted: torch.Tensor) -> None:
        """Wait until all pieces agree with a photograph (1, 3, H, W) to one grey level and are in the right places."""
        self.wait_for_pieces()
        self.wait_until(lambda: self._difference(wanted), most=1.001)

    def _difference(self, wanted: torch.Tensor) -> float:
        """The largest difference of the pieces from a photograph (1, 3, H, W) in grey levels of 255."""
        places: list[list[Any]] = self.pieces.evaluate_all(
            """images => images.map((image) => [image.getAttribute('src'), ...['left', 'top', 'width', 'height'].map(
            (side) => parseFloat(image.style[side]))])"""
        )
        differences = []
        for source, left, top, width, height in places:
            answer = self.answer(source)
            if answer.status != 200:  # a piece of an edit before
                return math.inf
            pixels = pixels_of(answer)
            x, y = round(left / 100 * WIDTH), round(top / 100 * HEIGHT)
            assert pixels.shape[2:] == (round(height / 100 * HEIGHT), round(width / 100 * WIDTH))
            part = wanted[..., y : y + pixels.shape[2], x : x + pixels.shape[3]]
            differences.append(255 * float((pixels - part).abs().max()))
        return max(differences, default=math.inf)


@pytest.mark.parametrize(("width", "height"), POINTED)
def test_zoom_and_pan_by_mouse_keys_and_buttons(browser: Browser, editor: Editor, width: int, height: int) -> None:
    tab = Zoomed.at(browser, editor.with_token(), width, height)
    tab.open_details()
    page, fit = tab.page, tab.scale()
    page.keyboard.press("1")
    expect(tab.level).to_have_text("100 %")
    assert tab.scale() == pytest.approx(1, abs=0.005)
    tab.enlarge("400 %")
    assert tab.scale() == pytest.approx(4, abs=0.01)
    tab.expect_pieces(cat(1))

    x, y = tab.middle()
    page.mouse.move(x + 50, y + 40)
    under = tab.share(x + 50, y + 40)
    page.mouse.wheel(0, -200)
    expect(tab.level).not_to_have_text("400 %")
    assert tab.scale() > 4.5
    assert tab.share(x + 50, y + 40) == pytest.approx(under, abs=0.003)  # the point under the pointer stays there

    before = tab.share(x, y)
    page.mouse.down(button="middle")
    page.mouse.move(x, y + 10, steps=3)
    page.mouse.up(button="middle")
    after = tab.share(x, y)
    assert after[0] > before[0]  # the photograph moved with the pointer, to the left and up
    assert after[1] > before[1]
    page.keyboard.press("ArrowLeft")
    assert tab.share(x, y)[0] < after[0]
    page.keyboard.press("-")
    expect(tab.level).to_have_text("400 %")
    tab.expect_pieces(cat(1))
    page.get_by_role("button", name="Fit", exact=True).click()
    assert tab.scale() == pytest.approx(fit, rel=0.01)
    expect(page.locator("path.stroke")).to_have_count(0)  # none of this drew
    tab.close()


@pytest.mark.parametrize(("width", "height"), TOUCHED)
def test_zoom_and_pan_by_fingers(browser: Browser, editor: Editor, width: int, height: int) -> None:
    tab = Zoomed.at(browser, editor.with_token(), width, height, touch=True)
    tab.open_details()
    page, fit, fingers = tab.page, tab.scale(), Fingers(tab)
    x, y = tab.middle()
    under = tab.share(x, y)
    fingers.to("Start", (x - 20, y))  # the first finger begins a stroke
    fingers.to("Start", (x - 20, y), (x + 20, y))
    for apart in (30, 40, 60):
        fingers.to("Move", (x - apart, y), (x + apart, y))
    fingers.to("End")
    assert tab.scale() == pytest.approx(3 * fit, rel=0.05)
    assert tab.share(x, y) == pytest.approx(under, abs=0.02)
    expect(page.locator("path.stroke")).to_have_count(0)
    tab.expect_pieces(cat(1))

    before = tab.share(x, y)
    fingers.to("Start", (x - 20, y))
    fingers.to("Start", (x - 20, y), (x + 20, y))
    for far in (5, 15, 30):
        fingers.to("Move", (x - 20 - far, y - far), (x + 20 - far, y - far))
    fingers.to("End")
    after = tab.share(x, y)
    moved = 30 / (tab.scale() * WIDTH), 30 / (tab.scale() * HEIGHT)
    assert after == pytest.approx((before[0] + moved[0], before[1] + moved[1]), abs=0.01)

    page.get_by_role("button", name="Move", exact=True).tap()
    fingers.to("Start", (x, y))
    for far in (5, 15, 30):
        fingers.to("Move", (x + far, y + far))
    fingers.to("End")
    assert tab.share(x, y) == pytest.approx(before, abs=0.01)  # one finger is enough now
    page.get_by_role("button", name="Move", exact=True).tap()
    page.get_by_role("button", name="Fit", exact=True).tap()
    assert tab.scale() == pytest.approx(fit, rel=0.01)
    expect(page.locator("path.stroke")).to_have_count(0)
    tab.close()


def test_scribbles_before_and_pieces_follow_the_zoom(browser: Browser, editor: Editor) -> None:
    """A scribble stays where it was drawn, its edit is shown as it is saved, and the wipe shows the original."""
    tab, folder = Zoomed.at(browser, editor.with_token(), 1280, 800), editor.log.parent
    tab.open_details()
    page = tab.page
    tab.enlarge("400 %")
    x, y = tab.middle()
    start, end = tab.share(x - 60, y + 20), tab.share(x + 60, y + 20)
    page.mouse.move(x - 60, y + 20)
    page.mouse.down()
    page.mouse.move(x + 60, y + 20, steps=5)
    page.mouse.up()
    expect(page.get_by_text("In the region")).to_be_visible()
    tab.drag(tab.slider("Texture in the region"), 0.2, 0.8)
    expect(page.get_by_text("4.00 ×")).to_be_visible()
    tab.save("Save photo", "out.png")
    tab.save("Save edit", "edit.json")
    stroke = find_recipe(str(folder / "edit.json")).current("detail").strokes[0]
    assert stroke.points[0] == pytest.approx(start, abs=0.005)
    assert stroke.points[-1] == pytest.approx(end, abs=0.005)
    saved = read_photograph(folder / "out.png").pixels
    assert (saved - cat(1)).abs().max() > 5 / 255
    tab.expect_pieces(saved)

    expect(page.locator(".q-notification")).to_have_count(0)  # they cover the slider
    tab.drag(tab.slider("Before and after"), 0.0, 0.5)
    expect(page.locator(".originals img")).to_have_count(1)
    edge = page.locator(".edge").bounding_box()
    assert edge is not None
    assert edge["x"] == pytest.approx(x, abs=12)  # half of the visible part
    source = page.locator(".originals img").get_attribute("src")
    assert source is not None
    left, top, right, bottom = (int(number) for number in source.partition("at=")[2].split(","))
    assert torch.equal(tab.picture(source), cat(1)[..., top:bottom, left:right])
    page.get_by_role("button", name="Reset").click()
    expect(page.locator("path.stroke")).to_have_count(0)
    tab.close()
