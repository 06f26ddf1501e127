"""The editor in a real browser as newcomers use it: by finger, mouse or keyboard alone, and on a slow connection."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import skimage.data
import torch
from playwright.sync_api import Browser, expect

from nlfilter_torch.photo.declared.presets import find_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.browser import Editor, Tab, by_finger
from tests.problems import cat

PHONE, TABLET, DESKTOP = (390, 844), (820, 1180), (1280, 800)
LIGHTNESS = """image => { const canvas = document.createElement("canvas"); canvas.width = canvas.height = 16;
  const context = canvas.getContext("2d"); context.drawImage(image, 0, 0, 16, 16);
  return context.getImageData(0, 0, 16, 16).data.reduce((sum, value) => sum + value, 0) / 1024; }"""


@pytest.mark.parametrize(("width", "height"), [PHONE, TABLET, DESKTOP])
def test_the_first_five_minutes_of_a_newcomer(
    browser: Browser, editor: Editor, folder: Path, tmp_path: Path, width: int, height: int
) -> None:
    """Light, a look, a painted colour, before and after, the order of the steps, undo, and saving; recorded."""
    coffee = torch.from_numpy(skimage.data.coffee().copy()).permute(2, 0, 1)[None].float() / 255
    write_photograph(Photograph(coffee), folder / "coffee.png")
    touch = width < DESKTOP[0]
    tab = Tab.at(browser, editor.with_token(), width, height, touch=touch)
    page = tab.page

    def record(name: str) -> None:
        page.screenshot(path=tmp_path / f"{width}-{name}.png")

    record("1-empty")
    tab.open(folder / "coffee.png")
    tab.wait_until_ready()
    record("2-open")
    before = tab.source()
    tab.drag(tab.slider("Exposure"), 0.5, 0.56)
    tab.wait_for_picture(before)
    page.get_by_role("tab", name="Look").click()
    page.get_by_role("button", name="faded").click()
    expect(page.get_by_role("checkbox", name="Look: on")).to_be_attached()
    record("3-look")
    page.get_by_role("tab", name="Recolor").click()
    page.get_by_role("button", name="#2f6fde").first.click()
    saucer, before = ((0.27, 0.78), (0.36, 0.86), (0.48, 0.88)), tab.source()
    by_finger(tab, *saucer) if touch else tab.paint(*saucer)
    tab.wait_for_picture(before)
    expect(page.get_by_role("tab", name="Recolor, in use")).to_be_visible()
    record("4-painted")
    tab.drag(tab.slider("Before and after"), 0.0, 0.5)
    expect(page.get_by_text("before", exact=True)).to_have_css("opacity", "1")
    record("5-before-and-after")
    tab.drag(tab.slider("Look: opacity"), 1.0, 0.5)
    switches = page.get_by_role("checkbox", name=re.compile(": on$"))
    expect(switches.first).to_have_accessible_name("Recolor: on")
    page.get_by_role("button", name="Look: up").click()
    expect(switches.first).to_have_accessible_name("Look: on")  # the rows are those of the new order
    page.get_by_role("checkbox", name="Look: on").click()
    record("6-steps")
    page.get_by_role("button", name="Recolor: remove").click()
    expect(page.get_by_role("checkbox", name="Recolor: on")).to_have_count(0)
    page.get_by_role("button", name="Undo").click()
    expect(page.get_by_role("checkbox", name="Recolor: on")).to_be_visible()
    save(tab, folder, record)
    assert len(list(tmp_path.glob(f"{width}-*.png"))) == 8
    tab.close()


def save(tab: Tab, folder: Path, record: Callable[[str], None]) -> None:
    """Save the photograph in another size; the file, and the edit that is kept."""
    page = tab.page
    page.get_by_role("button", name="Save photo").click()
    page.get_by_label("Name").fill("mine.jpg")
    page.get_by_label("Longest side in pixels").fill("150")
    record("7-saving")
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("Saved ").and_(page.get_by_text("mine.jpg")).wait_for()
    record("8-saved")
    assert read_photograph(folder / "mine.jpg").size == (100, 150)
    kept = find_recipe(str(folder / "coffee.png.edit.json"))
    assert [(step.edit, step.on) for step in kept.steps] == [("look", False), ("recolor", True)]
    assert kept.steps[0].opacity == pytest.approx(0.5, abs=0.05)
    assert kept.develop.exposure > 0


def test_all_of_it_by_keyboard(tab: Tab, folder: Path) -> None:
    page = tab.page

    def reach(role: str, name: str) -> None:
        """Go to a control by the key Tab alone."""
        wanted = page.get_by_role(role, name=name, exact=True).first  # type: ignore[arg-type]
        for _ in range(150):
            if wanted.evaluate("element => element.contains(document.activeElement)"):
                return
            page.keyboard.press("Tab")
        raise AssertionError(f"the key Tab does not reach {name}")

    reach("button", "Open")
    with page.expect_file_chooser() as chooser:
        page.keyboard.press("Enter")
    chooser.value.set_files(folder / "cat.png")
    tab.wait_until_ready()
    before = tab.source()
    reach("slider", "Exposure")
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    tab.wait_for_picture(before)
    reach("tab", "Photo, in use")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    reach("slider", "Texture")
    before = tab.source()
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    tab.wait_for_picture(before)
    expect(page.get_by_role("checkbox", name="Detail: on")).to_be_attached()
    page.keyboard.press("Control+s")
    expect(page.get_by_role("dialog")).to_be_visible()
    expect(page.get_by_label("Name")).to_be_focused()
    page.keyboard.press("Control+a")
    page.keyboard.type("typed.png")
    page.keyboard.press("Enter")
    page.get_by_text("Saved ").and_(page.get_by_text("typed.png")).wait_for()
    recipe = find_recipe(str(folder / "cat.png.edit.json"))
    assert recipe.develop.exposure > 0
    assert recipe.current("detail")["alpha"][0] > 1
    assert difference_of(folder / "typed.png") > 3


def difference_of(path: Path) -> float:
    """The mean difference of a file from the photograph in grey levels of 255."""
    return float((read_photograph(path).pixels - cat()).abs().mean()) * 255


def test_a_slow_connection_shows_the_last_picture(opened: Tab) -> None:
    """Pictures that come late are left out, and none of them stays in place of the last one."""
    page = opened.page
    page.get_by_role("tab", name="Photo").click()
    slow = page.context.new_cdp_session(page)
    slow.send("Network.enable")
    limits = {"offline": False, "latency": 400, "downloadThroughput": 40_000, "uploadThroughput": 40_000}
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url) if "/after?" in request.url else None)
    start = opened.photo.evaluate(LIGHTNESS)
    slow.send("Network.emulateNetworkConditions", limits)
    opened.drag(opened.slider("Exposure"), 0.5, 0.7, steps=30)
    expect(page.get_by_role("button", name="Undo")).to_be_enabled()
    wanted = float(opened.picture().mean())
    opened.wait_until(lambda: opened.photo.evaluate(LIGHTNESS), least=start + 10)
    opened.wait_until(lambda: abs(opened.photo.evaluate(LIGHTNESS) - shown(opened)), most=3)
    assert float(opened.picture().mean()) >= wanted
    assert len(requests) < 30


def shown(tab: Tab) -> float:
    """The lightness that the picture at the last address has, with the opacity that a browser adds."""
    return (3 * 255 * float(tab.picture().mean()) + 255) / 4
