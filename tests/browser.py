"""A headless Chromium and a separate editor process, for tests of the editor in a browser."""

import io
import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self
from urllib.parse import urljoin

import numpy as np
import torch
from PIL import Image
from playwright.sync_api import APIResponse, Browser, CDPSession, FloatRect, Locator, Page, expect, sync_playwright
from playwright.sync_api import TimeoutError as Expired

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
SCREENS = [(390, 844), (800, 600), (1280, 800), (1920, 1080)]  # width and height
TOUCHED, POINTED = SCREENS[::2], SCREENS[1::2]  # long tests take two of them by finger, and two by mouse
TIMEOUT = 300_000  # milliseconds, of everything that is waited for: far more than a busy machine needs
OPENING = 12_000  # milliseconds in which an entry of a list is there, unless the list has been closed again
# Colours and places are then those of a state at once, and never on the way to it. Animations stay: they show masks.
STILL = """document.addEventListener("DOMContentLoaded", () => {
  const sheet = new CSSStyleSheet(); sheet.replaceSync("*, *::before, *::after { transition: none !important; }");
  document.adoptedStyleSheets = [...document.adoptedStyleSheets, sheet]; })"""
FLASHES = re.compile(r"^(?!.*\bhidden\b).*\bflash-[01]\b")  # the classes of what is shown for a moment


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser that is closed at the end."""
    with sync_playwright() as playwright:
        # Chromium has no sandbox when run as root, as in most containers; only pages of this machine are opened here.
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options, timeout=TIMEOUT)
        expect.set_options(timeout=TIMEOUT)
        yield browser
        browser.close()


class Editor:
    """``nlfilter-torch app`` in a separate process, in which some Python code may have run before."""

    def __init__(self, folder: Path, *arguments: str, threads: int = 1, before: str = "") -> None:
        program = ["-m", "nlfilter_torch"]
        if before:
            program = ["-c", f"{before}\nfrom nlfilter_torch.__main__ import main\nmain()"]
        command = [sys.executable, *program, "app", "--no-open", *arguments]
        # With pytest's environment variables, NiceGUI would treat the process as a test of NiceGUI.
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
        self.state = folder.parent / f"{folder.name}-state"
        environment = inherited | {"OMP_NUM_THREADS": str(threads), "XDG_STATE_HOME": str(self.state)}
        self.log = folder / "log.txt"
        with self.log.open("w") as stream:
            self.process = subprocess.Popen(
                command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=stream, text=True
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        address = re.search(r"(http://\S+/)\?token=(\S+)", line)
        if address is None:
            self.stop()
            raise RuntimeError(self.log.read_text())
        self.url, self.token = address.groups()

    def with_token(self, url: str = "") -> str:
        """An address of the editor, by default that of its page, for a browser that does not know the token."""
        url = url or self.url
        return f"{url}{'&' if '?' in url else '?'}token={self.token}"

    def stop(self) -> None:
        """Interrupt the process, as Ctrl+C does; one that does not end is killed, and the test fails."""
        assert self.process.stdout is not None
        self.process.terminate()
        try:
            self.process.wait(TIMEOUT / 1000)
        finally:
            self.process.kill()
            self.process.wait()
            self.process.stdout.close()


@contextmanager
def running(folder: Path, *arguments: str) -> Iterator[Editor]:
    """An editor that is stopped at the end, and has logged no traceback and no warning by then."""
    editor = Editor(folder, *arguments)
    yield editor
    editor.stop()
    assert editor.log.read_text() == ""


class Tab:
    """A page of the editor, and the actions of its user."""

    @classmethod
    def at(cls, browser: Browser, url: str, width: int = 1280, height: int = 900, *, touch: bool = False) -> Self:
        """Open an address in a window, or on the screen of a phone or tablet."""
        tab = cls(
            browser.new_page(
                viewport={"width": width, "height": height}, has_touch=touch, is_mobile=touch and width < 500
            )
        )
        tab.page.goto(url)
        return tab

    def __init__(self, page: Page) -> None:
        self.page = page
        page.set_default_timeout(TIMEOUT)
        page.add_init_script(STILL)
        self.photo = page.locator(".photo > img").first
        self.mask = page.get_by_alt_text("mask")

    def slider(self, name: str) -> Locator:
        """Return the slider with a label."""
        return self.page.get_by_role("slider", name=name, exact=True)

    def source(self) -> str:
        """Address of the picture shown, which differs from picture to picture."""
        return self.photo.get_attribute("src") or ""

    def wait_for_picture(self, other_than: str = "") -> None:
        """Wait until a picture with another address is shown and the editor is idle."""
        self.page.wait_for_function(
            """old => { const image = document.querySelector('.photo > img');
            return image && image.getAttribute('src') && image.getAttribute('src') != old && image.complete
            && image.naturalWidth > 0; }""",
            arg=other_than,
        )

    def wait_until_ready(self) -> None:
        """Wait until a photograph is shown, the controls can be used, and the page has its final layout."""
        self.wait_for_picture()
        expect(self.page.locator(".panel[inert]")).to_have_count(0)
        self.place()

    def open_details(self) -> None:
        """Open the tab of details, whose brush draws on every photograph, once one is shown."""
        self.wait_until_ready()
        self.page.get_by_role("tab", name="Detail").click()
        expect(self.page.locator(".response circle")).not_to_have_count(0)

    def place(self) -> FloatRect:
        """Position and size of the photograph on the page, once they are the same in several frames."""
        left, top, width, height = self.page.evaluate(
            """async () => { const frame = () => new Promise(requestAnimationFrame); let old = '', same = 0;
            for (;;) { await frame(); const b = document.querySelector('.photo > img').getBoundingClientRect();
              const now = [b.x, b.y, b.width, b.height];
              same = b.width * b.height > 0 && now.join() == old ? same + 1 : 0; old = now.join();
              if (same == 5) return now; } }"""
        )
        return {"x": left, "y": top, "width": width, "height": height}

    def answer(self, address: str) -> APIResponse:
        """What the editor answers to a request for an address."""
        return self.page.request.get(urljoin(self.page.url, address))

    def picture(self, address: str = "") -> torch.Tensor:
        """The picture shown, or that at another address of the editor; (1, 3, H, W) in [0, 1]."""
        return pixels_of(self.answer(address or self.source()))

    def wait_until(self, measure: Callable[[], float], *, least: float = 0.0, most: float = math.inf) -> None:
        """Wait until a value that is measured again and again is in a range."""
        deadline = time.monotonic() + TIMEOUT / 1000
        while not least <= (value := measure()) <= most:
            assert time.monotonic() < deadline, value
            self.page.wait_for_timeout(100)

    def expect_picture(self, other: torch.Tensor, *, least: float = 0.0, most: float = math.inf) -> None:
        """Wait until the difference of the picture shown from another one is in a range, see :func:`difference`."""
        self.wait_until(lambda: self._difference_from(other), least=least, most=most)

    def _difference_from(self, other: torch.Tensor) -> float:
        answer = self.answer(self.source())
        # The address may be that of a picture before, which is gone.
        return difference(pixels_of(answer), other) if answer.status == 200 else math.nan

    def expect_mask(self) -> None:
        """Wait until the mask is shown for a moment: its picture and classes, as a busy machine may look too late."""
        expect(self.mask).to_have_class(FLASHES)
        self.page.wait_for_function("image => image.naturalWidth > 0", arg=self.mask.element_handle())

    def open(self, path: Path) -> None:
        """Choose a photograph."""
        self._choose("Open", path)

    def load_edit(self, path: Path) -> None:
        """Choose an edit."""
        self._choose("Load edit", path)

    def _choose(self, button: str, path: Path) -> None:
        with self.page.expect_file_chooser() as chooser:
            self.page.get_by_role("button", name=button, exact=True).click()
        chooser.value.set_files(path)

    def choose(self, select: str, option: str) -> None:
        """Choose an option of a list, which a page that is still being built may close again."""
        entry = self.page.get_by_role("option", name=option)
        for _ in range(5):
            self.page.get_by_role("combobox", name=select).click()
            try:
                entry.click(timeout=OPENING)
                return
            except Expired:
                continue
        raise AssertionError(f"the list {select} did not stay open")

    def drag(self, slider: Locator, start: float, end: float, *, steps: int = 4, release: bool = True) -> None:
        """Drag a slider from one fraction of its length to another."""
        expect(slider).to_be_visible()
        slider.scroll_into_view_if_needed()
        box = slider.bounding_box()
        assert box is not None
        y = box["y"] + box["height"] / 2
        self.page.mouse.move(box["x"] + start * box["width"], y)
        self.page.mouse.down()
        self.page.mouse.move(box["x"] + end * box["width"], y, steps=steps)
        # A busy page handles moves frame by frame: a move that arrives together with the release would be lost.
        self.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        if release:
            self.page.mouse.up()

    def wait_for_brush(self) -> None:
        """Wait until the page draws with a pointer, which the editor tells it after a tab with a brush is chosen."""
        self.page.wait_for_function("!document.documentElement.classList.contains('brushless')")

    def paint(self, *points: tuple[float, float], release: bool = True) -> None:
        """Draw a line through points given as fractions of the picture's size."""
        self.wait_for_brush()
        box = self.place()
        at = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in points]
        self.page.mouse.move(*at[0])
        self.page.mouse.down()
        for point in at[1:]:
            self.page.mouse.move(*point, steps=4)
        if release:
            self.page.mouse.up()

    def save(self, button: str, name: str) -> None:
        """Save under a name, and wait until saving is done."""
        self.page.get_by_role("button", name=button, exact=True).click()
        self.page.get_by_label("Name").fill(name)
        self.page.get_by_role("button", name="Save", exact=True).click()
        self.page.get_by_text("Saved ").and_(self.page.get_by_text(name)).wait_for()

    def close(self) -> None:
        self.page.context.close()


class Fingers:
    """Two fingers on the screen."""

    def __init__(self, tab: Tab) -> None:
        self.session: CDPSession = tab.page.context.new_cdp_session(tab.page)

    def to(self, kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        self.session.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})


def by_finger(tab: Tab, *points: tuple[float, float]) -> None:
    """Draw a line with a finger through points given as fractions of the picture's size."""
    tab.wait_for_brush()
    fingers, box = Fingers(tab), tab.place()
    kind = "Start"
    for x, y in points:
        fingers.to(kind, (box["x"] + x * box["width"], box["y"] + y * box["height"]))
        kind = "Move"
    fingers.to("End")


def dropped(page: Page, files: dict[str, bytes]) -> bool:
    """Drop files on the page, or text if there are none; whether the browser does with them what it would do."""
    return bool(
        page.evaluate(
            """files => { const data = new DataTransfer(); data.setData("text/plain", "text");
            for (const [name, bytes] of files) data.items.add(new File([new Uint8Array(bytes)], name,
              { type: name.endsWith(".png") ? "image/png" : "" }));
            const how = { dataTransfer: data, bubbles: true, cancelable: true };
            return document.querySelector(".panel").dispatchEvent(new DragEvent("drop", how)); }""",
            [(name, list(content)) for name, content in files.items()],
        )
    )


def pixels_of(answer: APIResponse) -> torch.Tensor:
    """The picture (1, 3, H, W) in [0, 1] that the editor has answered with."""
    return torch.from_numpy(np.array(Image.open(io.BytesIO(answer.body())))).permute(2, 0, 1)[None] / 255


def difference(a: torch.Tensor, b: torch.Tensor) -> float:
    """Root mean square difference in grey levels of 255."""
    return float((a.clamp(0, 1) - b.clamp(0, 1)).square().mean().sqrt()) * 255
