"""Pictures of the editor, taken in a headless Chromium: ``python -m docs.editor_picture docs``.

One for the README, and one for each size of screen that the editor is tested on.
"""

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import skimage.data
import torch
from playwright.sync_api import Browser

from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.browser import Editor, Tab, by_finger, chromium

QUALITY = 85
QUIET = 5000  # milliseconds until the photograph has been edited at its full size
SAUCER, CUP, BEHIND = (
    ((0.27, 0.78), (0.36, 0.86), (0.48, 0.88)),
    ((0.42, 0.35), (0.5, 0.62)),
    ((0.03, 0.05), (0.2, 0.05)),
)


@dataclass(frozen=True)
class Screenshot:
    """A picture of the editor.

    Attributes:
        file: its name.
        photograph: scikit-image's.
        size: width and height of the screen.
        work: what is done before.
        touch: whether it is a screen for fingers.
    """

    file: str
    photograph: str
    size: tuple[int, int]
    work: Callable[[Tab], None]
    touch: bool = False

    def take(self, browser: Browser, folder: Path) -> Path:
        """Open the photograph, do the work, and write the picture into a folder."""
        target = folder / self.file
        with tempfile.TemporaryDirectory() as name:
            photograph = Path(name) / f"{self.photograph}.png"
            pixels = torch.from_numpy(getattr(skimage.data, self.photograph)().copy())
            write_photograph(Photograph(pixels.permute(2, 0, 1)[None].float() / 255), photograph)
            editor = Editor(Path(name), photograph.name)
            try:
                tab = Tab.at(browser, editor.with_token(), *self.size, touch=self.touch)
                tab.open_details()
                self.work(tab)
                tab.page.mouse.move(4, 70)  # away from what it explains
                tab.page.wait_for_timeout(QUIET)
                tab.page.screenshot(path=target, type="jpeg", quality=QUALITY)
                tab.close()
            finally:
                editor.stop()
        return target


def slide(tab: Tab, **positions: float) -> None:
    """Drag sliders to fractions of their length."""
    for name, position in positions.items():
        before = tab.source()
        tab.drag(tab.slider(name.replace("_", " ")), 0.2, position)
        tab.wait_for_picture(before)


def wiped(tab: Tab) -> None:
    """Sliders of detail, and the photograph before and after."""
    slide(tab, Texture=0.5, Fine_detail=0.5, Large_detail=0.7)
    tab.drag(tab.slider("Before and after"), 0.0, 0.5)


def recoloured(tab: Tab) -> None:
    """A new colour under a finger."""
    before = tab.source()
    tab.page.get_by_role("tab", name="Recolor").tap()
    tab.page.get_by_role("button", name="#2f6fde").first.tap()
    by_finger(tab, *SAUCER)
    tab.wait_for_picture(before)


def enlarged(tab: Tab) -> None:
    """Part of the photograph at more than full size, with more detail."""
    slide(tab, Texture=0.5, Fine_detail=0.5)
    tab.page.get_by_role("button", name="Zoom in").click()


def of_a_region(tab: Tab) -> None:
    """A scribble on the cup, one on the background, and the mask."""
    tab.paint(*CUP)
    tab.page.get_by_role("button", name="Not this").first.click()
    tab.paint(*BEHIND)
    tab.page.get_by_text("Mask", exact=True).first.click()


def saved(tab: Tab) -> None:
    """The dialog that saves."""
    slide(tab, Texture=0.5, Large_detail=0.6)
    tab.page.get_by_role("button", name="Save photo").click()


PICTURES = (
    Screenshot("editor.jpg", "chelsea", (1280, 780), wiped),
    Screenshot("pictures/editor-phone.jpg", "coffee", (390, 844), recoloured, touch=True),
    Screenshot("pictures/editor-small.jpg", "chelsea", (800, 600), enlarged),
    Screenshot("pictures/editor-region.jpg", "coffee", (1280, 800), of_a_region),
    Screenshot("pictures/editor-large.jpg", "astronaut", (1920, 1080), saved),
)


def main() -> None:
    """Take all pictures."""
    with chromium() as browser:
        for picture in PICTURES:
            print(picture.take(browser, Path(sys.argv[1])))


if __name__ == "__main__":
    main()
