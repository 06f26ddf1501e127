"""The README's picture of the editor, taken in a headless Chromium: ``python -m benchmarks.editor_picture docs``."""

import sys
import tempfile
from pathlib import Path

import skimage.data
import torch

from nlfilter_torch.io.photographs import Photograph, write_photograph
from tests.app.browser import Editor, Tab, chromium


def main() -> None:
    """Open a photograph of a cat, move sliders, drag the before-and-after wipe to the middle, and take a screenshot."""
    target = Path(sys.argv[1]) / "editor.jpg"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pixels = torch.from_numpy(skimage.data.chelsea().copy()).permute(2, 0, 1)[None].float() / 255
        write_photograph(Photograph(pixels), folder / "chelsea.png")
        editor = Editor(folder, "chelsea.png")
        try:
            with chromium() as browser:
                tab = Tab(browser.new_page(viewport={"width": 1280, "height": 780}))
                tab.page.goto(editor.url)
                tab.wait_for_picture()
                tab.page.locator(".response circle").first.wait_for()
                for slider, position in (("Texture", 0.5), ("Fine detail", 0.5), ("Large detail", 0.7)):
                    before = tab.source()
                    tab.drag(tab.slider(slider), 0.2, position)
                    tab.wait_for_picture(before)
                tab.drag(tab.slider("Before and after"), 0.0, 0.5)
                tab.page.mouse.move(600, 20)
                tab.page.wait_for_timeout(2000)
                tab.page.screenshot(path=target, type="jpeg", quality=85)
        finally:
            editor.stop()
    print(target)


if __name__ == "__main__":
    main()
