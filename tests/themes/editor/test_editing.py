"""The editor in a real browser: tests perform the actions of a user."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Region, Stroke
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import read_photograph
from tests.browser import Tab, difference
from tests.problems import cat


def test_photograph_is_shown(opened: Tab, folder: Path) -> None:
    opened.expect_picture(cat(), most=4)  # JPEG
    expect(opened.page.get_by_text("cat.png")).to_be_visible()
    assert sorted(file.name for file in folder.iterdir()) == ["cat.png", "log.txt"]  # nothing is left behind


def test_picture_follows_a_slider_and_undo(opened: Tab) -> None:
    before = opened.source()
    opened.drag(opened.slider("Texture"), 0.2, 0.8, release=False)
    opened.wait_for_picture(before)  # while the button is held
    opened.page.mouse.up()
    expect(opened.page.get_by_text("4.00 ×")).to_be_visible()
    wanted = apply_recipe(Recipe(), cat())
    opened.expect_picture(wanted, least=8)
    before = opened.source()
    opened.page.keyboard.press("Control+z")
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("4.00 ×")).not_to_be_visible()
    opened.expect_picture(wanted, most=4)
    before = opened.source()
    opened.page.get_by_role("button", name="Redo").click()
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("4.00 ×")).to_be_visible()

    before = opened.source()
    opened.page.get_by_role("checkbox", name="Detail: on").click()
    opened.wait_for_picture(before)
    opened.expect_picture(wanted, most=4)
    opened.page.get_by_role("checkbox", name="Detail: on").click()
    page = opened.page
    page.keyboard.down("o")
    expect(page.get_by_text("before", exact=True)).to_have_css("opacity", "1")
    page.keyboard.up("o")
    expect(page.get_by_text("before", exact=True)).to_have_css("opacity", "0")
    opened.slider("Texture").focus()
    focused = "() => [document.activeElement.role, document.activeElement.ariaLabel]"
    expect(opened.slider("Texture")).to_have_attribute("aria-valuenow", "4")
    assert page.evaluate(focused) == ["slider", "Texture"]
    page.keyboard.press("Home")
    expect(opened.page.get_by_text("4.00 ×")).not_to_be_visible()
    expect(opened.slider("Texture")).to_have_attribute("aria-valuenow", "1")
    page.keyboard.press("Control+s")
    expect(page.get_by_role("dialog", name="Save the photograph")).to_be_visible()


def test_stroke_shows_a_mask_and_sliders_of_the_region(opened: Tab) -> None:
    """The mask is shown for a second, or while its box is checked, but never while a slider moves."""
    page = opened.page
    expect(opened.mask).not_to_be_visible()
    opened.paint((0.2, 0.9), (0.3, 0.9), release=False)
    expect(page.locator("path.stroke")).to_have_count(1)  # while the button is held
    page.mouse.up()
    opened.expect_mask()
    expect(page.get_by_text("In the region")).to_be_visible()
    expect(opened.mask).not_to_be_visible()  # after a second, by itself
    page.get_by_role("checkbox", name="Mask").click()
    expect(opened.mask).to_be_visible()
    before = opened.source()
    opened.drag(opened.slider("Texture in the region"), 0.2, 0.9, release=False)
    opened.wait_for_picture(before)
    expect(opened.mask).not_to_be_visible()  # not while a slider moves
    page.mouse.up()
    expect(opened.mask).to_be_visible()
    page.get_by_role("checkbox", name="Mask").click()
    expect(opened.mask).not_to_be_visible()
    page.get_by_role("button", name="Clear strokes").first.click()
    expect(page.get_by_text("In the region")).not_to_be_visible()
    expect(page.locator("path.stroke")).to_have_count(0)


def test_saved_files_are_what_the_library_and_the_command_line_make(opened: Tab, folder: Path) -> None:
    """Sliders, a region and a new colour; then the same edit from its file."""
    page = opened.page
    opened.drag(opened.slider("Fine detail"), 0.2, 0.6)
    opened.paint((0.2, 0.9), (0.3, 0.9))
    opened.expect_mask()
    before = opened.source()
    page.get_by_role("tab", name="Recolor").click()
    page.get_by_role("button", name="#8a46c8").first.click()
    opened.paint((0.37, 0.35), (0.4, 0.37))
    opened.wait_for_picture(before)
    for key, tool, y in (("b", "Brush", 0.8), ("e", "Eraser", 0.82)):
        before = opened.source()
        page.keyboard.press(key)
        tools = page.get_by_role("group", name="Tools").get_by_role("button", name=tool)
        expect(tools.locator("visible=true")).to_have_attribute("aria-pressed", "true")
        opened.paint((0.7, y), (0.8, 0.8))
        opened.wait_for_picture(before)
    opened.save("Save photo", "out.png")
    opened.save("Save edit", "edit.json")

    recipe = find_recipe(str(folder / "edit.json"))
    assert recipe.current("detail")["inside"] == (1.0, 3.0, 1.0, 1.0)
    assert [stroke.paint for stroke in recipe.current("recolor").strokes] == ["#8a46c8", "add #8a46c8", "remove"]
    saved = read_photograph(folder / "out.png").pixels
    assert (saved - apply_recipe(recipe, cat()).clamp(0, 1)).abs().max() <= 1 / 255
    assert main(["apply", str(folder / "cat.png"), str(folder / "cli.png"), "--preset", str(folder / "edit.json")]) == 0
    assert (saved - read_photograph(folder / "cli.png").pixels).abs().max() <= 1 / 255
    opened.expect_picture(saved, most=5)

    page.get_by_role("button", name="Reset").click()
    expect(opened.mask).not_to_be_visible()
    before = opened.source()
    opened.load_edit(folder / "edit.json")
    opened.wait_for_picture(before)
    page.get_by_role("tab", name="Detail").click()
    opened.expect_mask()
    opened.expect_picture(saved, most=5)

    page.get_by_role("button", name="Save photo").click()
    page.get_by_label("Name").fill("out.png")
    page.get_by_role("button", name="Save", exact=True).click()
    expect(page.get_by_text("A file of that name is there already.")).to_be_visible()
    page.get_by_role("button", name="Replace").click()
    expect(page.get_by_text("out.png").first).to_be_visible()


@pytest.mark.parametrize(("step", "control"), [("Defocus", "Blur"), ("Abstract", "Flatten"), ("Colorize", "Fill")])
def test_other_steps_change_the_picture(opened: Tab, step: str, control: str) -> None:
    page = opened.page
    page.get_by_role("tab", name=step).click()
    before = opened.source()
    if step != "Abstract":
        opened.paint((0.4, 0.4), (0.45, 0.4))
        if step == "Colorize":
            page.get_by_role("button", name="Replace all colours").click()
        opened.wait_for_picture(before)
        before = opened.source()
    opened.drag(opened.slider(control), 0.5, 0.7, release=False)
    opened.wait_for_picture(before)  # while the button is held
    page.mouse.up()
    opened.expect_picture(cat(), least=5)


def test_preset_and_response(opened: Tab) -> None:
    curve = opened.page.locator(".response polyline")
    flat = curve.get_attribute("points")
    assert flat
    before = opened.source()
    opened.choose("Preset", "crisp")
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("2.20 ×").first).to_be_visible()
    expect(curve).not_to_have_attribute("points", flat)
    expect(opened.page.get_by_text("crisp:").first).to_be_visible()  # the name stays
    before = opened.source()
    opened.drag(opened.slider("Edge threshold"), 0.3, 0.6)
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("Preset crisp, changed")).to_be_visible()


def test_histogram_and_clipping(opened: Tab) -> None:
    page = opened.page
    expect(page.get_by_role("img", name="histogram")).to_be_visible()
    clipped = page.get_by_alt_text("clipped")
    expect(clipped).not_to_be_visible()
    page.get_by_role("checkbox", name="Clipped").click()
    expect(clipped).to_be_visible()
    page.get_by_role("tab", name="Tone").click()
    before = opened.source()
    opened.drag(opened.slider("Contrast"), 0.5, 1.0)
    opened.wait_for_picture(before)
    expect(page.get_by_text("Clipped: ")).to_be_visible()


def test_wipe_shows_what_was_before(opened: Tab) -> None:
    opened.drag(opened.slider("Before and after"), 0.0, 0.5)
    half = re.compile(r"^inset\(0px (calc\(50%|50%)")
    expect(opened.page.get_by_alt_text("before")).to_have_css("clip-path", half)
    expect(opened.page.get_by_text("before", exact=True)).to_be_visible()


def crop_to_a_square(tab: Tab) -> None:
    """Show the frame of the crop as a square of 92 pixels, make it smaller, and then the whole photograph."""
    page, left = tab.page, tab.slider("Left edge")
    tab.choose("Proportions", "1:1")
    expect(left).to_be_visible()
    expect(page.get_by_text("92×92 pixels")).to_be_attached()
    expect(left).to_have_attribute("aria-valuenow", re.compile(r"^19\."))  # 29 of 150 pixels
    left.focus()
    page.keyboard.press("ArrowRight")
    expect(page.get_by_text("92×92 pixels")).to_have_count(0)
    expect(page.get_by_text(re.compile(r"\b(\d+)×\1 pixels"))).to_be_attached()
    page.get_by_role("button", name="Whole picture").click()
    expect(page.get_by_text("138×92 pixels")).to_be_attached()


def test_a_photograph_is_developed(opened: Tab, folder: Path) -> None:
    """Exposure, straightening, crops by several means, and a stroke on what is left; the file as of `apply`."""
    page = opened.page
    page.get_by_role("tab", name="Photo").click()
    before = opened.source()
    opened.drag(opened.slider("Exposure"), 0.5, 0.6)
    opened.wait_for_picture(before)
    expect(page.get_by_role("tab", name="Photo, in use")).to_be_visible()
    before = opened.source()
    opened.drag(opened.slider("Straighten"), 0.5, 0.6)
    opened.wait_for_picture(before)
    expect(page.get_by_text("138×92 pixels")).to_be_visible()

    left, bottom = opened.slider("Left edge"), opened.slider("Bottom edge")
    crop_to_a_square(opened)
    expect(left).to_have_attribute("aria-valuenow", "4.0")  # 6 of 150 pixels
    left.focus()
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    expect(left).to_have_attribute("aria-valuetext", "14.0 %")
    expect(page.get_by_text("123×92 pixels")).to_be_attached()
    box = bottom.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] - 200, steps=4)
    page.mouse.up()
    expect(page.get_by_text("123×92 pixels")).to_have_count(0)
    page.keyboard.press("Escape")
    expect(left).not_to_be_visible()

    page.get_by_role("tab", name="Recolor").click()
    opened.paint((0.3, 0.5), (0.5, 0.5))
    expect(page.get_by_role("tab", name="Recolor, in use")).to_be_visible()
    recipe = Recipe.from_json((folder / "cat.png.edit.json").read_bytes(), "cat.png.edit.json")
    frame = recipe.develop.frame((100, 150))
    assert recipe.develop.exposure == pytest.approx(0.6, abs=0.1)
    assert recipe.steps[0].strokes[0].points[0] == pytest.approx(frame.outward(0.3, 0.5), abs=0.02)
    opened.save("Save photo", "developed.png")
    assert (
        main(
            [
                "apply",
                str(folder / "cat.png"),
                str(folder / "by-command.png"),
                "--preset",
                str(folder / "cat.png.edit.json"),
            ]
        )
        == 0
    )
    saved, wanted = (read_photograph(folder / name).pixels for name in ("developed.png", "by-command.png"))
    assert saved.shape[-2:] == frame.size
    assert difference(saved, wanted) < 0.1
    opened.expect_picture(wanted, most=4)


def test_a_grey_point_sets_the_white_balance(opened: Tab) -> None:
    opened.page.get_by_role("tab", name="Photo").click()
    button = opened.page.get_by_role("button", name="Grey point")
    before = opened.source()
    button.click()
    expect(button).to_have_attribute("aria-pressed", "true")
    expect(button).to_have_css("background-color", "rgb(47, 111, 174)")  # as that of a chosen tool
    opened.paint((0.5, 0.5))
    opened.wait_for_picture(before)
    expect(button).to_have_attribute("aria-pressed", "false")
    expect(opened.slider("Temperature")).not_to_have_attribute("aria-valuenow", "0")


def test_a_rectangle_is_dragged_around_an_object(opened: Tab) -> None:
    """Once, with no stroke: all outside it is blurred."""
    page = opened.page
    page.get_by_role("tab", name="Defocus").click()
    tools = page.get_by_role("group", name="Tools").locator("visible=true")
    tools.get_by_role("button", name="Around it").click()
    before = opened.source()
    opened.paint((0.2, 0.2), (0.5, 0.5), (0.8, 0.9))
    expect(page.locator("path.stroke")).to_have_count(1)
    opened.wait_for_picture(before)
    step = Step("defocus", (Region.upright((0.2, 0.2, 0.6, 0.7), "rectangle", "box"),))
    opened.expect_picture(apply_step(step, cat()), most=5)
    before = opened.source()
    opened.paint((0.1, 0.1), (0.9, 0.9))  # takes its place
    opened.wait_for_picture(before)
    expect(page.locator("path.stroke")).to_have_count(1)


def test_a_gradient_is_dragged_and_light_changes_under_it(opened: Tab) -> None:
    page = opened.page
    page.get_by_role("tab", name="Light").click()
    page.get_by_role("group", name="Tools").locator("visible=true").get_by_role("button", name="Gradient").click()
    opened.paint((0.5, 0.1), (0.5, 0.5), (0.5, 0.9))
    expect(page.locator("path.stroke")).to_have_count(1)
    before = opened.source()
    opened.drag(opened.slider("Exposure"), 0.5, 0.9)
    opened.wait_for_picture(before)
    stops = float(opened.slider("Exposure").get_attribute("aria-valuenow") or 0)
    assert stops > 1
    step = Step("light", (Region(((0.5, 0.1), (0.5, 0.9)), "linear", "add"),), exposure=stops)
    opened.expect_picture(apply_step(step, cat()), most=5)
    opened.expect_picture(cat(), least=20)


def test_only_this_or_all_alike_is_a_click(opened: Tab) -> None:
    page = opened.page
    page.get_by_role("tab", name="Defocus").click()
    opened.paint((0.37, 0.35), (0.4, 0.37))
    only, alike = (page.get_by_role("button", name=name).locator("visible=true") for name in ("Only this", "All alike"))
    stroke = Stroke(((0.37, 0.35), (0.4, 0.37)), 0.02, "in")
    for button, extent in ((only, "object"), (alike, "near")):
        button.click()
        expect(button).to_have_attribute("aria-pressed", "true")
        opened.expect_picture(apply_step(Step("defocus", (stroke,), extent=extent), cat()), most=6)


def test_an_object_is_cut_out_into_a_file(opened: Tab, folder: Path) -> None:
    page = opened.page
    page.get_by_role("tab", name="Defocus").click()
    opened.paint((0.37, 0.35), (0.4, 0.37))
    page.get_by_role("button", name="Cut out", exact=True).locator("visible=true").click()
    page.get_by_label("Name").fill("cut.png")
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("Saved ").and_(page.get_by_text("cut.png")).wait_for()
    cut = read_photograph(folder / "cut.png")
    assert cut.alpha is not None
    assert 0 < cut.alpha.mean() < 1
