"""How long the editor takes from a movement of the pointer to the picture: ``python -m benchmarks.app``.

Prints medians and quartiles of ``--repeats``, in milliseconds, on a square preview. Then, for a photograph of
``--megapixels``, the same; from a pan at 100 % to the PNG files of what is newly seen, and of a view that
is all new; the time to open it and to save three edits of it as a JPEG, beside that of ``nlfilter-torch apply`` with
the same edit, and the memory at the peak, above that before the photograph was opened.
"""

import asyncio
import multiprocessing
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

from benchmarks.commands import cost
from benchmarks.harness import MIB, forget_peak, options, resident, seconds
from benchmarks.photographs import enlarged
from benchmarks.preview import RECIPES
from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.closeup import Closeup
from nlfilter_torch.photo.app.dialogs import Tasks
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph

MOVES = 9  # of the sliders of the other edits
VIEW = (864, 648)  # width and height of the canvas in a window of 1280x800
SAVED = ("detail", "recolor", "denoise")


def milliseconds(work: Callable[[], object]) -> float:
    """Time of one call."""
    return 1e3 * seconds(work)


def report(name: str, times: list[float]) -> None:
    """Print a line of the table."""
    low, middle, high = statistics.quantiles(times, n=4) if len(times) > 1 else times * 3
    print(f"{name:<52} {middle:>8.0f}   {low:.0f} to {high:.0f}")


def in_the_library(path: Path, repeats: int) -> None:
    """Sliders and strokes without a page."""
    report("open", [milliseconds(lambda: Session(path.parent, path))])
    session = Session(path.parent, path)
    size = session.preview.size

    def slide(value: float) -> None:
        session.set("detail", alpha=(value, 1.0, 1.0, 1.0))
        session.render(0)

    report("first slider: the operator and its layers", [milliseconds(lambda: slide(2.0))])
    report("slider to pixels", [milliseconds(lambda i=i: slide(1 + i / 10)) for i in range(repeats)])
    pixels = session.render()
    report("pixels to JPEG", [milliseconds(lambda: drawing.picture(pixels)) for _ in range(repeats)])

    def stroke(shift: float) -> None:
        session.add_stroke("detail", [(shift * size[1], 0.8 * size[0]), (0.6 * size[1], 0.85 * size[0])], 0.01, "in")
        session.preview.masks(session.recipe.current("detail"))

    report("first stroke to mask", [milliseconds(lambda: stroke(0.3))])
    report("stroke to mask", [milliseconds(lambda i=i: stroke(0.3 + i / 100)) for i in range(repeats)])
    for step, paint, entry, first, last in (
        ("tone", "", "contrast", 1.1, 1.3),
        ("sharpen", "", "amount", 2.0, 4.0),
        ("recolor", "#2040e0", "reach", 0.5, 0.7),
        ("colorize", "#2040e0", "strength", 0.5, 0.7),
        ("defocus", "in", "radius", 2.0, 4.0),
        ("abstract", "", "power", 0.05, 0.2),
        ("denoise", "", "strength", 0.95, 0.55),
        ("look", "", "amount", 0.4, 1.2),
    ):
        session.load(RECIPES[step] if step == "look" else Recipe())
        moves = min(MOVES, repeats)
        values = [first + (last - first) * i / moves for i in range(moves + 1)]
        if paint:
            session.add_stroke(step, [(0.4 * size[1], 0.4 * size[0]), (0.5 * size[1], 0.4 * size[0])], 0.02, paint)
        else:
            session.set(step, **{entry: values[0]})
        report(f"{step}", [milliseconds(session.render)])
        times = []
        for value in values[1:]:
            session.set(step, **{entry: value})
            times.append(milliseconds(session.render))
        report(f"{step}, {entry} changed", times)


class AtOnce(Tasks):
    """The work of a page, in its own thread, and tasks in a list."""

    def __init__(self, tasks: list[Awaitable[None]]) -> None:
        self.start = tasks.append

    def say(self, who: object, doing: str = "") -> None:
        """Show nothing."""

    async def run(self, doing: str, work: Callable[..., Any], *arguments: Any, progress: object = None) -> Any:
        """Run something."""
        return work(*arguments)


def at_full_size(path: Path, repeats: int) -> None:
    """The part that is seen at 100 %, after pans by a third of it, and after jumps to other places."""
    session, tasks = Session(path.parent, path), list[Awaitable[None]]()
    height, width = session.whole_size

    closeup = Closeup(AtOnce(tasks), lambda script: None)

    def look(x: float, y: float) -> float:
        """Milliseconds until what is seen at a place, in shares of the way to the lower right corner, is there."""
        left, top = round(x * max(0, width - VIEW[0])), round(y * max(0, height - VIEW[1]))

        def work() -> None:
            closeup.look((left, top, left + VIEW[0], top + VIEW[1]))
            while tasks:
                asyncio.run(tasks.pop())  # type: ignore[arg-type]

        return milliseconds(work)

    for step, paint in (("detail", "in"), ("recolor", "#2040e0"), ("defocus", "in")):
        session.load(Recipe())
        preview = session.preview.size
        session.add_stroke(
            step, [(0.4 * preview[1], 0.4 * preview[0]), (0.5 * preview[1], 0.4 * preview[0])], 0.02, paint
        )
        if step == "detail":
            session.set("detail", inside=(2.0, 2.0, 2.0, 1.0))
            session.commit()
        closeup.open(session)
        report(f"{step} of a region: first 100 % view", [look(0.1, 0.2)])
        third = VIEW[0] / 3 / max(1, width - VIEW[0])
        name = f"100 % view after a pan at {width * height / 1e6:.0f} MP"
        report(f"{name}, a third", [look(0.1 + i * third, 0.2) for i in range(1, max(2, repeats // 2))])
        report(f"{name}, all of it", [look(0.5, 0.3 + 0.2 * i) for i in range(3)])


def opened_and_saved(path: Path, edit: str) -> tuple[float, float, float]:
    """Milliseconds to open the first photograph of a process and to save an edit of it, and MB above the start."""
    before = forget_peak()
    begun = time.perf_counter()
    session = Session(path.parent, path)
    opening = 1000 * (time.perf_counter() - begun)
    session.load(RECIPES[edit])
    saving = milliseconds(lambda: session.save("saved.jpg"))
    return opening, saving, (resident("VmHWM") - before) * MIB / 1e6


def files(path: Path, quick: bool) -> None:
    """Opening and saving in the editor, and on the command line; ``quick`` saves most edits in this process only."""
    folder = path.parent
    for edit in SAVED[:-1] if quick else ():
        report(f"save {edit}", [opened_and_saved(path, edit)[1]])
    for edit in SAVED[-1:] if quick else SAVED:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as fresh:
            opening, saving, memory = fresh.submit(opened_and_saved, path, edit).result()
        preset = folder / "edit.json"
        preset.write_text(RECIPES[edit].to_json())
        call = ["-m", "nlfilter_torch", "apply", str(path), str(folder / "out" / "out.jpg"), "--preset", str(preset)]
        _, wall, _ = cost("apply", [sys.executable, *call], folder)
        report("open", [opening])
        report(f"save {edit}, {memory:.0f} MB above the start", [saving])
        report("the same on the command line", [1e3 * wall])


def main() -> None:
    """Measure and print."""
    parser = options("app", __doc__, "saves one edit only as the first one of a process")
    parser.add_argument("--side", type=int, default=1000, help="pixels of a square preview")
    parser.add_argument("--megapixels", type=float, default=24, help="of the photograph that is seen at 100 %%")
    parser.add_argument("--repeats", type=int, default=20, help="of each movement")
    arguments = parser.parse_args()
    print(f"{arguments.side}x{arguments.side} pixels, {torch.get_num_threads()} threads, {platform.machine()}")
    print(f"{'milliseconds, median and quartiles':<52}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photograph.png"
        write_photograph(Photograph(enlarged("astronaut", arguments.side, arguments.side)), path)
        in_the_library(path, arguments.repeats)
        print(f"\n{arguments.megapixels:g} megapixels")
        large, compressed = Path(folder) / "large.tif", Path(folder) / "large.jpg"
        height = round((arguments.megapixels * 1e6 / 1.5) ** 0.5)
        for file in (large, compressed):
            write_photograph(Photograph(enlarged("astronaut", height, round(1.5 * height))), file)
        in_the_library(compressed, arguments.repeats)
        files(compressed, arguments.quick)
        at_full_size(large, arguments.repeats)


if __name__ == "__main__":
    main()
