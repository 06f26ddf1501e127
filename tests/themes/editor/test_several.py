"""Several photographs in a real browser: the strip, an edit that is copied, and one for all."""

from pathlib import Path

from playwright.sync_api import expect

from nlfilter_torch.photo.declared.presets import find_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.browser import Tab, dropped
from tests.problems import cat
from tests.themes.editor.test_accessibility import AXE, defects

TEN = [f"shot {number}.png" for number in range(10)]


def test_ten_photographs_are_dropped_and_share_an_edit(tab: Tab, folder: Path) -> None:
    page, image = tab.page, cat()
    for number, name in enumerate(TEN):
        write_photograph(Photograph(image.roll(9 * number, 3)), folder / name)
    dropped(page, {name: (folder / name).read_bytes() for name in TEN})
    tab.wait_until_ready()
    shots = page.get_by_role("group", name="Photographs").get_by_role("button")
    expect(shots).to_have_count(10)
    page.wait_for_function(
        "() => [...document.querySelectorAll('.shot img')].filter((image) => image.naturalWidth).length === 10"
    )
    title, first = page.locator(".title"), TEN[0]
    expect(title).to_have_text(first)
    expect(shots.first).to_have_accessible_name(first)
    expect(shots.and_(page.locator("[aria-current=true]"))).to_have_accessible_name(first)

    others = [name for name in TEN if name != first]
    tab.drag(tab.slider("Exposure"), 0.5, 0.8)
    expect(page.get_by_role("button", name="Undo")).to_be_enabled()
    page.get_by_role("button", name="Copy edit").click()
    page.get_by_role("button", name=others[3]).click()
    expect(title).to_have_text(others[3])
    expect(page.get_by_role("button", name="Undo")).to_be_disabled()
    tab.expect_picture(image.roll(9 * TEN.index(others[3]), 3), most=4)  # it has an edit of its own
    page.keyboard.press("Control+Shift+V")
    tab.expect_picture(image.roll(9 * TEN.index(others[3]), 3), least=20)
    page.keyboard.press("n")
    expect(title).not_to_have_text(others[3])
    page.keyboard.press("p")
    expect(title).to_have_text(others[3])
    expect(page.get_by_role("button", name="Undo")).to_be_enabled()  # it has kept what was done
    if AXE.exists():
        assert defects(page) == []

    page.get_by_role("button", name="Apply to all").click()
    page.get_by_role("dialog").get_by_role("button", name="Apply to all").click()
    expect(page.get_by_text("9 of 9 have the edit.")).to_be_visible()
    exposures = {find_recipe(str(folder / f"{name}.edit.json")).develop.exposure for name in TEN}
    assert len(exposures) == 1
    assert exposures != {0.0}
    page.reload()
    expect(shots).to_have_count(10)
