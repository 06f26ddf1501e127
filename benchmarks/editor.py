"""How long the editor takes from an input in the browser to its pixels: ``python -m benchmarks.editor [--quick]``.

Starts ``nlfilter-torch app`` with a photograph of ``--megapixels`` as a JPEG, and a headless Chromium. Each row has the
seconds until the picture has changed (and been decoded) on the page, and the processor time of the editor meanwhile,
which other programs on the machine disturb less; of several moves, the median.
"""

import re
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import psutil
import torch
from playwright.sync_api import Locator

from benchmarks.harness import options
from benchmarks.photographs import enlarged
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.browser import Editor, Tab, chromium

SLIDERS = (("Photo", "Exposure"), ("Photo", "Highlights"), ("Tone", "Contrast"), ("Detail", "Texture"))
MOVES = 5
PAUSE = 400  # milliseconds between two moves, in which nothing else is computed
VISIBLE = """(first) => { const box = document.querySelector('.canvas').getBoundingClientRect();
  const shares = first ? [0.5] : [0.02, 0.25, 0.5, 0.75, 0.98];
  const places = shares.flatMap((x) => shares.map((y) => [x, y]));
  const pieces = [...document.querySelectorAll('.pieces img')].filter((image) => image.complete)
    .map((image) => image.getBoundingClientRect());
  return places.every(([x, y]) => pieces.some((p) => p.left <= box.x + x * box.width && box.x + x * box.width <= p.right
    && p.top <= box.y + y * box.height && box.y + y * box.height <= p.bottom)); }"""


class Clock:
    """Measures the editor, a process, from inputs to pixels."""

    def __init__(self, editor: Editor) -> None:
        self._process = psutil.Process(editor.process.pid)

    def used(self) -> float:
        """Seconds of processors that the editor has used."""
        times = self._process.cpu_times()
        return float(times.user + times.system)

    def report(self, name: str, *inputs: Callable[[], object]) -> None:
        """Make inputs, each of which returns once its pixels are there, and print their times."""
        rows = []
        for make in inputs:
            begun, used = time.perf_counter(), self.used()
            make()
            rows.append((time.perf_counter() - begun, self.used() - used))
            time.sleep(PAUSE / 1000)
        show(name, [wall for wall, _ in rows], [used for _, used in rows])


def show(name: str, walls: Sequence[float], used: Sequence[float]) -> None:
    """Print a row."""
    print(f"{name:<44}{statistics.median(walls):>9.2f}{statistics.median(used):>12.2f}", flush=True)


def moves(tab: Tab, slider: Locator) -> list[Callable[[], None]]:
    """The inputs that move a slider, of which the first presses the pointer on it."""

    def move(number: int) -> None:
        before = tab.source()
        if number == 0:
            tab.drag(slider, 0.5, 0.54, release=False)
        else:
            box = slider.bounding_box()
            assert box is not None
            tab.page.mouse.move(box["x"] + (0.54 + 0.07 * number) * box["width"], box["y"] + box["height"] / 2)
        tab.wait_for_picture(before)

    return [partial(move, number) for number in range(MOVES + 1)]


def slide(tab: Tab, clock: Clock, edit: str, label: str) -> None:
    """Report the first move of a slider, the next ones, and its release."""
    tab.page.get_by_role("tab", name=re.compile(f"^{edit}")).click()
    tab.page.wait_for_timeout(3 * PAUSE)
    first, *others = moves(tab, tab.slider(label))
    clock.report(f"{edit}, {label}: first move", first)
    clock.report(f"{edit}, {label}: further moves", *others)
    tab.page.mouse.up()
    tab.page.get_by_role("button", name="Reset").click()
    tab.page.wait_for_timeout(3 * PAUSE)


def full_size(tab: Tab, clock: Clock, edit: str) -> None:
    """Report how long the pieces at 100 % take."""

    def look(first: bool) -> None:
        tab.page.wait_for_function(VISIBLE, arg=first)

    def zoom() -> None:
        tab.page.keyboard.press("1")
        look(True)

    clock.report(f"100 %, {edit}: the middle", zoom)
    clock.report(f"100 %, {edit}: the rest", lambda: look(False))
    tab.page.keyboard.press("0")


def stroke(tab: Tab, y: float) -> None:
    """Paint."""
    before = tab.source()
    tab.paint((0.4, y), (0.5, y))
    tab.wait_for_picture(before)


def main() -> None:
    """Measure and print."""
    parser = options("editor", __doc__, "2 megapixels")
    parser.add_argument("--megapixels", type=float, default=21.5)
    arguments = parser.parse_args()
    side = round(((2 if arguments.quick else arguments.megapixels) * 1e6 / 1.5) ** 0.5)
    print(f"{1.5e-6 * side**2:.1f} MP, {torch.get_num_threads()} threads, load {psutil.getloadavg()[0]:.1f}")
    print(f"{'':<44}{'seconds':>9}{'processor':>12}")
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        folder = Path(name) / "photographs"
        folder.mkdir()
        write_photograph(Photograph(enlarged("astronaut", side, round(1.5 * side))), folder / "photograph.jpg")
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto("about:blank")
        begun = time.perf_counter()
        editor = Editor(folder, "photograph.jpg", threads=torch.get_num_threads())
        clock, tab = Clock(editor), Tab(page)
        page.set_default_timeout(150_000)
        try:
            show("start to address", [time.perf_counter() - begun], [clock.used()])
            page.goto(editor.with_token())
            tab.wait_for_picture()
            show("start to picture", [time.perf_counter() - begun], [clock.used()])
            tab.wait_until_ready()
            page.wait_for_timeout(5 * PAUSE)
            full_size(tab, clock, "no edit")
            for place in SLIDERS:
                slide(tab, clock, *place)
            page.get_by_role("tab", name="Recolor").click()
            page.get_by_role("button", name="#8a46c8").first.click()
            clock.report("first stroke of recolouring", lambda: stroke(tab, 0.4))
            clock.report("second stroke", lambda: stroke(tab, 0.45))
            full_size(tab, clock, "recoloured")
        finally:
            editor.stop()


if __name__ == "__main__":
    main()
