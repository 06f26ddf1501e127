"""A bar on the standard error stream while something takes its time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


@contextmanager
def steps(total: int) -> Iterator[Callable[[str], None]]:
    """A bar of ``total`` steps; calling what it gives ends a step and names the next one.

    Nothing is drawn where the stream is no terminal, and the bar is gone when the work is done.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda name: None
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=total, completed=-1)

        def begin(name: str) -> None:
            progress.update(task, description=name, advance=1)

        yield begin


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """A bar that starts again with every stage; what it gives is called with a stage, what is done, and all there is.

    Nothing is drawn where the stream is no terminal, and the bar is gone when the work is done.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda stage, done, total: None
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("")
        shown = ""

        def report(stage: str, done: int, total: int) -> None:
            nonlocal shown
            if stage != shown:
                progress.reset(task, description=stage, total=total)
                shown = stage
            progress.update(task, completed=done, total=total)

        yield report
