"""Progress on standard error: bars on a terminal, otherwise a line every few seconds."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from nlfilter_torch.core import progress

LINE_PAUSE = 10.0  # seconds between two lines


def _bar(*columns: ProgressColumn) -> Progress:
    """A bar that disappears when the work is done."""
    console = Console(stderr=True)
    console.quiet = not console.is_terminal  # older versions of rich end a disabled bar with an empty line
    return Progress(*columns, console=console, transient=True, disable=console.quiet)


@contextmanager
def _lines(current: progress.Progress, wanted: bool) -> Iterator[progress.Progress]:
    """Print progress every few seconds from a thread, if ``wanted``."""
    ended = threading.Event()
    thread = threading.Thread(target=_print_lines, args=(current, ended), daemon=True)
    if wanted:
        thread.start()
    try:
        yield current
    finally:
        ended.set()
        if wanted:
            thread.join()


def _print_lines(current: progress.Progress, ended: threading.Event) -> None:
    while not ended.wait(LINE_PAUSE):
        if text := str(current):
            sys.stderr.write(f"{text}\n")
            sys.stderr.flush()


@dataclass(frozen=True)
class _Shown:
    """Progress that is shown by a bar, or printed as lines.

    Attributes:
        bar: the bar.
        task: its only task.
        lines: what the lines say.
    """

    bar: Progress
    task: TaskID
    lines: progress.Progress

    def begin(self, name: str) -> None:
        """End the current step, and begin the one of that name."""
        self.bar.update(self.task, description=name, advance=1)
        self.lines(name, 0, 1)

    def report(self, stage: str, done: int, total: int) -> None:
        """Show how much of a stage is done."""
        self.lines(stage, done, total)
        shown = self.bar.tasks[0]
        if stage != shown.description or done < shown.completed:
            self.bar.reset(self.task, description=stage, total=max(total, 1))  # the time left is that of the stage
        self.bar.update(self.task, completed=done)


@contextmanager
def steps(total: int, *, lines: bool = True) -> Iterator[Callable[[str], None]]:
    """Show a bar of ``total`` steps; yield a function that ends the current step and begins the one of a given name.

    Without ``lines``, nothing is printed if there is no terminal.
    """
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with _bar(*columns) as bar, _lines(progress.Progress(), bar.disable and lines) as current:
        yield _Shown(bar, bar.add_task("", total=total, completed=-1), current).begin


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar, which restarts with every stage; yield a function of the stage, the amount done and the total."""
    text = TextColumn("{task.description}", markup=False)
    with (
        _bar(text, BarColumn(), TaskProgressColumn(), TimeRemainingColumn()) as bar,
        _lines(progress.Progress(), bar.disable) as lines,
    ):
        yield _Shown(bar, bar.add_task(""), lines).report
