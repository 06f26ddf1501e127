"""Progress bars on the standard error stream; nothing is drawn unless it is a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


def _bar(*columns: ProgressColumn) -> Progress:
    """A bar that disappears when the work is done."""
    console = Console(stderr=True)
    console.quiet = not console.is_terminal  # older versions of rich end a disabled bar with an empty line
    return Progress(*columns, console=console, transient=True, disable=console.quiet)


@contextmanager
def steps(total: int) -> Iterator[Callable[[str], None]]:
    """A bar of ``total`` steps; yields a function that begins the step of a name and ends the one before."""
    with _bar(SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn()) as bar:
        task = bar.add_task("", total=total, completed=-1)
        yield lambda name: bar.update(task, description=name, advance=1)


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """A bar that starts again with every stage; yields a function of the stage, what is done, and the total."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with _bar(*columns) as bar:
        task = bar.add_task("")

        def report(stage: str, done: int, total: int) -> None:
            if stage != bar.tasks[0].description:
                bar.reset(task, description=stage)
            bar.update(task, completed=done, total=total)

        yield report
