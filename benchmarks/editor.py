"""How long the editor takes from an input in the browser to its pixels: ``python -m benchmarks.editor [--quick]``.

Starts ``nlfilter-torch app`` with a photograph of ``--megapixels`` as a JPEG, and a headless Chromium. Each row has the
seconds until another picture is decoded on the page, and the processor time of the editor meanwhile, which other
programs disturb less; of several moves, the medians.
"""

import re
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import psutil
import torch

from benchmarks.harness import options
from benchmarks.photographs import enlarged
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.browser import Editor, Tab, chromium

SLIDERS = (("Photo", "Exposure"), ("Photo", "Highlights"), ("Tone", "Contrast"), ("Detail", "Texture"))
MOVES = 5
PAUSE = 400  # milliseconds between two moves
READING = 4000  # milliseconds that a person looks at a tab that is new
VISIBLE = """(shares) => { const box = document.querySelector('.canvas').getBoundingClientRect();
  const pieces = [...document.querySelectorAll('.pieces img')].filter((image) => image.complete)
    .map((image) => image.getBoundingClientRect());
  return shares.every((share) => { const x = box.x + share * box.width, y = box.y + share * box.height;
    return pieces.some((p) => p.left <= x && x <= p.right && p.top <= y && y <= p.bottom); }); }"""


class Clock:
    """The times of inputs to an editor and its page."""

    def __init__(self, editor: Editor, tab: Tab, begun: float) -> None:
        self.tab, self._process, self._begun = tab, psutil.Process(editor.process.pid), begun

    def report(self, name: str, *inputs: Callable[[], object]) -> None:
        """Print the times of inputs, each of which returns once its pixels are there; of none those since the start."""
        rows = [(time.perf_counter() - self._begun, self._used())] if not inputs else []
        for make in inputs:
            begun, used = time.perf_counter(), self._used()
            make()
            rows.append((time.perf_counter() - begun, self._used() - used))
            self.tab.page.wait_for_timeout(PAUSE)
        wall, used = (statistics.median(column) for column in zip(*rows, strict=True))
        print(f"{name:<44}{wall:>9.2f}{used:>12.2f}", flush=True)

    def _used(self) -> float:
        times = self._process.cpu_times()
        return float(times.user + times.system)

    def slide(self, edit: str, label: str) -> None:
        """Report the first move of a slider, and the next ones."""
        page, slider = self.tab.page, self.tab.slider(label)
        page.get_by_role("tab", name=re.compile(f"^{edit}")).click()
        page.wait_for_timeout(READING)

        def move(number: int) -> None:
            before, box = self.tab.source(), slider.bounding_box()
            assert box is not None
            if number == 0:
                self.tab.drag(slider, 0.5, 0.54, release=False)
            else:
                page.mouse.move(box["x"] + (0.54 + 0.07 * number) * box["width"], box["y"] + box["height"] / 2)
            self.tab.wait_for_picture(before)

        self.report(f"{edit}, {label}: first move", partial(move, 0))
        self.report(f"{edit}, {label}: further moves", *(partial(move, number) for number in range(1, MOVES + 1)))
        page.mouse.up()
        page.get_by_role("button", name="Reset").click()
        page.wait_for_timeout(READING)

    def full_size(self, edit: str) -> None:
        """Report how long pieces at 100 % take, of the middle and of the rest."""
        page = self.tab.page
        self.report(f"100 %, {edit}: the middle", lambda: (page.keyboard.press("1"), self._see(0.5)))
        self.report(f"100 %, {edit}: the rest", lambda: self._see(0.02, 0.25, 0.5, 0.75, 0.98))
        page.keyboard.press("0")

    def _see(self, *shares: float) -> None:
        self.tab.page.wait_for_function(VISIBLE, arg=shares)

    def stroke(self, y: float) -> None:
        """Paint."""
        before = self.tab.source()
        self.tab.paint((0.4, y), (0.5, y))
        self.tab.wait_for_picture(before)


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
        tab, begun = Tab(browser.new_page(viewport={"width": 1280, "height": 800})), time.perf_counter()
        editor = Editor(folder, "photograph.jpg", threads=torch.get_num_threads())
        clock = Clock(editor, tab, begun)
        try:
            clock.report("start to address")
            tab.page.goto(editor.with_token())
            tab.wait_for_picture()
            clock.report("start to picture")
            tab.wait_until_ready()
            clock.full_size("no edit")
            for place in SLIDERS:
                clock.slide(*place)
            tab.page.get_by_role("tab", name="Recolor").click()
            tab.page.get_by_role("button", name="#8a46c8").first.click()
            clock.report("first stroke of recolouring", partial(clock.stroke, 0.4))
            clock.report("second stroke", partial(clock.stroke, 0.45))
            clock.full_size("recoloured")
        finally:
            editor.stop()


if __name__ == "__main__":
    main()
