"""The editor in a real browser: layout on every size of screen, by mouse and by touch, and keyboard focus."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, expect

from tests.browser import POINTED, SCREENS, TOUCHED, Editor, Tab, by_finger


def test_keyboard_focus_can_be_seen(opened: Tab) -> None:
    page = opened.page
    frame = "() => getComputedStyle(document.activeElement).boxShadow"
    page.keyboard.press("Tab")
    for _ in range(3):
        assert "rgb(255, 213, 74)" in page.evaluate(frame), page.evaluate("() => document.activeElement.outerHTML")
        page.keyboard.press("Tab")
    opened.slider("Texture").focus()
    page.keyboard.press("ArrowRight")
    assert "rgb(255, 213, 74)" in page.evaluate(frame)


@pytest.mark.parametrize("touch", [False, True])
@pytest.mark.parametrize(("width", "height"), SCREENS)
def test_layout_on_every_screen(
    browser: Browser, editor: Editor, folder: Path, width: int, height: int, touch: bool
) -> None:
    """Nothing is outside the screen, the panel is beside the photograph, and buttons are large enough."""
    tab = Tab.at(browser, editor.with_token(), width, height, touch=touch)
    page = tab.page
    tab.open(folder / "cat.png")
    tab.open_details()
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    photo, save = tab.place(), page.get_by_role("button", name="Save photo").bounding_box()
    panel = page.locator(".panel").bounding_box()
    assert save is not None
    assert panel is not None
    assert save["x"] + save["width"] <= width
    assert save["y"] >= 0
    assert (36 if width < 1000 else 30) <= save["height"] <= 52  # large enough for a finger, and not cut off
    assert photo["width"] * photo["height"] > 0.15 * width * height
    assert panel["y"] >= photo["y"] + photo["height"] or panel["x"] >= photo["x"] + photo["width"]  # beside it
    tab.close()


@pytest.mark.parametrize(
    ("width", "height", "touch"), [*[(*size, True) for size in TOUCHED], *[(*size, False) for size in POINTED]]
)
def test_an_edit_on_every_screen(
    browser: Browser, editor: Editor, folder: Path, width: int, height: int, touch: bool
) -> None:
    """A scribble with its mask and sliders, a name that cannot be saved, saving, and loading the page again."""
    tab = Tab.at(browser, editor.with_token(), width, height, touch=touch)
    page = tab.page

    def press(button: Locator) -> None:
        button.tap() if touch else button.click()

    tab.open(folder / "cat.png")
    tab.open_details()
    expect(page.get_by_role("button", name="Undo")).to_be_disabled()
    if touch:
        by_finger(tab, (0.2, 0.9), (0.25, 0.9), (0.3, 0.9))
    else:
        tab.paint((0.2, 0.9), (0.3, 0.9))
    tab.expect_mask()
    expect(page.locator("path.stroke")).to_have_count(1)
    expect(page.get_by_text("In the region")).to_be_visible()
    expect(page.get_by_role("img", name="histogram")).to_be_visible()
    expect(page.get_by_role("button", name="Undo")).to_be_enabled()
    expect(tab.mask).not_to_be_visible()  # after a second
    if width < 500:
        press(page.get_by_role("button", name="Show or hide the controls"))
        expect(page.get_by_text("In the region")).not_to_be_in_viewport()
    press(page.get_by_role("button", name="Save photo"))
    for name, sentence in (("out.gif", "out.gif must end in .png"), ("out.png", "Saved ")):
        page.get_by_label("Name").fill(name)
        press(page.get_by_role("button", name="Save", exact=True))
        expect(page.get_by_text(sentence)).to_be_visible()
    assert (folder / "out.png").exists()
    page.reload()
    expect(page.locator("path.stroke")).to_have_count(1)
    expect(page.get_by_text("In the region")).to_be_visible()
    tab.close()
