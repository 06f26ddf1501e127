"""Work in the background: how it is started, reported and interrupted."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.picture.sampling import Report

T = TypeVar("T")
Start = Callable[[Awaitable[None]], None]  # a task in the background, whose failure is reported


class Run(Protocol):
    """Runs something in a thread, while the page shows what it is doing."""

    def __call__(self, doing: str, work: Callable[[], T], progress: Progress | None = None) -> Awaitable[T]:
        """Return the result of ``work``."""


class OutdatedError(Exception):
    """The edit has changed meanwhile."""


@dataclass(frozen=True)
class Interruptible:
    """Passes reports of progress on, and raises OutdatedError at the first one after something is outdated."""

    report: Report
    is_outdated: Callable[[], bool]

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` parts of a stage are done."""
        if self.is_outdated():
            raise OutdatedError
        self.report(stage, done, total)
