"""Progress of a long computation as text."""

import time
from collections.abc import Callable
from threading import Lock


class Progress:
    """Current stage of a computation and the fraction completed; called to report, converted to text for display.

    Args:
        clock: returns the time in seconds.

    Example:
        >>> now = [0.0]
        >>> progress = Progress(lambda: now[0])
        >>> progress("Averaging", 0, 100)
        >>> now[0] = 30.0
        >>> progress("Averaging", 25, 100)
        >>> print(progress)
        Averaging, 25 %, 30 s so far
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._stage, self._share, self._begun = "", 0.0, clock()
        self._lock = Lock()  # reports and texts come from different threads

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units of a stage are complete; fewer than before begin it anew."""
        share = done / max(total, 1)
        with self._lock:
            if stage != self._stage or share < self._share:
                self._stage, self._begun = stage, self._clock()
            self._share = share

    def __str__(self) -> str:
        """The stage with the fraction done, if any, and the time that it has taken."""
        with self._lock:
            stage, share, seconds = self._stage, self._share, self._clock() - self._begun
        done = f", {100 * share:.0f} %" if share else ""
        return f"{stage}{done}, {time_text(seconds)} so far" if stage else ""


def time_text(seconds: float) -> str:
    """Format a time in seconds or minutes.

    >>> time_text(0.4), time_text(89.7), time_text(130)
    ('1 s', '90 s', '2 min')
    """
    return f"{max(1, round(seconds))} s" if seconds < 90 else f"{round(seconds / 60)} min"
