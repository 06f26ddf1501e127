"""Progress on standard error: bars on a terminal, otherwise a line every few seconds."""

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

from nlfilter_torch.core import progress

PAUSE = 10.0  # seconds between two lines


def _bar(*columns: ProgressColumn) -> Progress:
    """A bar that disappears when the work is done."""
    console = Console(stderr=True)
    console.quiet = not console.is_terminal  # older versions of rich end a disabled bar with an empty line
    return Progress(*columns, console=console, transient=True, disable=console.quiet)


class _TimeLeft(ProgressColumn):
    """The time left, as the lines say it."""

    def __init__(self, current: progress.Progress) -> None:
        super().__init__()
        self._current = current

    def render(self, task: Task) -> str:
        """The time left, or nothing if it is unknown."""
        left = self._current.seconds_left
        return "" if left is None else f"about {progress.time_text(left)} left"


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
    while not ended.wait(PAUSE):
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
        self.lines.begin(name)

    def report(self, stage: str, done: int, total: int) -> None:
        """Show how much of a stage is done."""
        self.lines(stage, done, total)
        self.bar.update(self.task, description=stage, completed=self.lines.fraction, total=1.0)


@contextmanager
def steps(total: int, *, lines: bool = True) -> Iterator[Callable[[str], None]]:
    """Show a bar of ``total`` steps; yield a function that ends the current step and begins the one of a given name.

    Without ``lines``, nothing is printed if there is no terminal.
    """
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with _bar(*columns) as bar, _lines(progress.Progress(), bar.disable and lines) as current:
        yield _Shown(bar, bar.add_task("", total=total, completed=-1), current).begin


@contextmanager
def stages(expected: Sequence[progress.Stage] = ()) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar of a job; yield a function of the stage, the amount done and the total.

    The bar is that of the whole job if its stages are expected, and otherwise restarts with every stage.
    """
    current = progress.Progress(stages=expected)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), _TimeLeft(current))
    with _bar(*columns) as bar, _lines(current, bar.disable) as lines:
        yield _Shown(bar, bar.add_task("", total=1.0), lines).report
