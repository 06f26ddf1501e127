"""Progress of a long computation as text, with an estimate of the time left."""

import time
from collections.abc import Callable

KNOWN = 0.05  # fraction of a stage after which the remaining time can be estimated


class Progress:
    """Current stage of a computation and the fraction completed; called to report, converted to text for display.

    The time left is estimated at each report, from the time that the second half of the part done has taken, and
    counted down until the next one.

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
        self._reports = [(self._first, self._begun)]  # shares done, with their times

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units of a stage are complete."""
        share = done / max(total, 1)
        if stage != self._stage or share < self._share:
            self._begin(stage, share)
        elif share > self._share:
            self._share = share
            self._reports.append((share, self._clock()))

    def begin(self, stage: str) -> None:
        """Begin a stage without progress reports."""
        self._begin(stage, 0.0)

    def _begin(self, stage: str, share: float) -> None:
        self._stage, self._share, self._begun, self._first = stage, share, self._clock(), share
        self._reports = [(self._first, self._begun)]  # shares done, with their times

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds until the stage ends, or None if unknown."""
        done = self._share - self._first
        if done < KNOWN:
            return None
        share, then = max(report for report in self._reports if report[0] <= self._first + done / 2)
        last = self._reports[-1][1]
        estimate = (last - then) * (1 - self._share) / (self._share - share)
        return max(0.0, estimate - (self._clock() - last))

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
