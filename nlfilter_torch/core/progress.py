"""Progress of a long computation as text, with an estimate of the time left."""

import time
from collections.abc import Callable

KNOWN = 0.05  # fraction of a stage after which the remaining time can be estimated


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
        Averaging, 25 %, about 2 min left
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._stage, self._share, self._begun, self._first = "", 0.0, clock(), 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units of a stage are complete."""
        share = done / max(total, 1)
        if stage != self._stage or share < self._share:
            self._stage, self._begun, self._first = stage, self._clock(), share
        self._share = share

    def begin(self, stage: str) -> None:
        """Begin a stage without progress reports."""
        self._stage, self._begun, self._first, self._share = stage, self._clock(), 0.0, 0.0

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds until the stage ends, or None if unknown."""
        done = self._share - self._first
        if done < KNOWN:
            return None
        return (self._clock() - self._begun) * (1 - self._share) / done

    def __str__(self) -> str:
        """The stage with the fraction done and the time left, or with the elapsed time if that is unknown."""
        left = self.seconds_left
        if left is not None:
            return f"{self._stage}, {100 * self._share:.0f} %, about {_time(left)} left"
        return f"{self._stage}, {_time(self._clock() - self._begun)} so far" if self._stage else ""


def _time(seconds: float) -> str:
    """Format a time in seconds or minutes.

    >>> _time(0.4), _time(89.7), _time(130)
    ('1 s', '90 s', '2 min')
    """
    return f"{max(1, round(seconds))} s" if seconds < 90 else f"{round(seconds / 60)} min"
