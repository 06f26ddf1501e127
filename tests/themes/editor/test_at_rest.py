"""The picture of a page at rest in a real browser."""

from pathlib import Path

from playwright.sync_api import Browser

from nlfilter_torch.photo.app.preview import PIXELS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from tests.browser import Tab, running
from tests.problems import cat

LINES = Recipe((Step("abstract", edges=0.8, tones=6, landmarks=40, patch_size=1),))


def test_the_preview_is_replaced_by_what_a_file_holds(browser: Browser, tmp_path: Path) -> None:
    """The preview appears first and then what a file holds."""
    photograph = Photograph(resize(cat(1), (1010, 1515)).clamp(0, 1))
    assert PIXELS < 1010 * 1515
    write_photograph(photograph, tmp_path / "large.png")
    photograph = read_photograph(tmp_path / "large.png")  # rounded to 256 levels, on which the tones depend
    (tmp_path / "lines.json").write_text(LINES.to_json())
    with running(tmp_path, "large.png") as editor:
        tab = Tab.at(browser, editor.with_token())
        tab.wait_until_ready()
        tab.load_edit(tmp_path / "lines.json")
        size = (tab.picture().shape[-2], tab.picture().shape[-1])
        saved = resize(apply_recipe(LINES, photograph.pixels).clamp(0, 1), size)
        tab.expect_picture(saved, most=1.5)  # pictures of the page are JPEGs
        tab.close()
