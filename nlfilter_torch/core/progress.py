"""Progress of a long computation as text, with an estimate of the time left."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock

KNOWN = 0.05  # fraction of a stage after which the remaining time can be estimated
KNOWN_OF_JOB = 0.1  # fraction of a job, likewise
# How much the speed of the stages before counts in that of the current stage, at most, as a share of the latter. Stages
# are not even: what is kept of a pass makes the first tiles of the next one quicker than the rest.
TRUST_IN_PLAN = 0.4
MOST_SKIPPED = 0.5  # of a job; expected stages that do not occur are skipped, up to this share at once
CAUTION = 0.1  # share by which the first estimate is longer
MOST_RISE = 1.1  # a later estimate exceeds the least earlier one by this factor at most, unless the job overran that
GRACE = 1.0  # seconds by which an estimate may be overrun, as long as the least time that is told


@dataclass(frozen=True)
class Stage:
    """A stage of a job that is still to come.

    Attributes:
        name: of the stage, as it is reported.
        seconds: that it takes on some machine until all of it is reported; only the ratios between stages matter.
        rest: seconds of what follows until the next stage, such as the solution of a linear system.
    """

    name: str
    seconds: float
    rest: float = 0.0

    @property
    def total(self) -> float:
        """Seconds until the next stage."""
        return self.seconds + self.rest


@dataclass(frozen=True)
class _Estimate:
    """Seconds left at the time of a report: of the current stage, which are counted down, and of the later ones."""

    now: float
    own: float
    later: float

    def at(self, now: float) -> float:
        """Seconds left at a later time without another report; the later stages do not count down."""
        return max(0.0, self.own - (now - self.now)) + self.later


class _Job:
    """Time left of a job, from the stages that it is expected to have; stages that do not occur are skipped.

    Only reports change it: to ask for the time left does not.

    Attributes:
        place: number of the current stage, or of the last one before it, if it was not expected.
        expected: whether the current stage was expected.
        share: share of the current stage that is done.
    """

    def __init__(self, stages: Sequence[Stage], now: float) -> None:
        self._stages, self.place, self.expected, self.share = list(stages), -1, False, 0.0
        self._begun = now
        self._taken, self._worked = 0.0, 0.0  # seconds that stages took, and those that were expected
        self._estimate: _Estimate | None = None
        self._least, self._least_at = float("inf"), now  # the least time left until the last report, and when it held

    def report(self, name: str, share: float, now: float) -> None:
        """Take note of the share of a stage that is done."""
        if not self.expected or name != self._stages[self.place].name:
            self._begin(self._following(name), share, now)
        elif share > self.share:
            self.share = share
        elif share < self.share and self._comes_next(name):
            self._begin(self.place + 1, share, now)
        else:  # it goes on: nothing is new, or it has more passes than expected
            return
        self._estimate_again(now)

    def _begin(self, place: int | None, share: float, now: float) -> None:
        if self.expected:
            self._taken += now - self._begun
            self._worked += self._stages[self.place].total
        self.expected, self.share, self._begun = place is not None, share, now
        if place is not None:
            self.place = place

    def _comes_next(self, name: str) -> bool:
        """Whether the stage after the current one has that name."""
        return self.place + 1 < len(self._stages) and self._stages[self.place + 1].name == name

    def _following(self, name: str) -> int | None:
        """Number of the next stage of that name; None if too much would be skipped before it."""
        skipped, total = 0.0, sum(stage.total for stage in self._stages)
        for place in range(self.place + 1, len(self._stages)):
            if self._stages[place].name == name:
                return place if skipped <= MOST_SKIPPED * total else None
            skipped += self._stages[place].total
        return None

    @property
    def fraction(self) -> float:
        """Share of the job that is done."""
        done = sum(stage.total for stage in self._stages[: self.place + (not self.expected)])
        if self.expected:
            done += self.share * self._stages[self.place].seconds
        return done / max(sum(stage.total for stage in self._stages), 1e-9)

    def left(self, now: float) -> float | None:
        """Estimated seconds until the job ends; None if unknown, and once the least earlier estimate is overrun."""
        if self._estimate is None or now > self._least_at + self._least + GRACE:
            return None
        return min(self._estimate.at(now), MOST_RISE * self._least)

    def _estimate_again(self, now: float) -> None:
        """Estimate the time left at a report."""
        if self._estimate is not None:
            left = self.left(now)
            if left is None:  # it was wrong, and limits the next one no longer
                self._least = float("inf")
            self._lower(left, now)
        self._estimate = self._estimated(now)
        self._lower(self.left(now), now)

    def _lower(self, left: float | None, now: float) -> None:
        """Take note of a time left if it is the least."""
        if left is not None and left < self._least:
            self._least, self._least_at = left, now

    def _estimated(self, now: float) -> _Estimate | None:
        """The time left by what is known at a report."""
        later = sum(stage.total for stage in self._stages[self.place + 1 :])
        if self.fraction < KNOWN_OF_JOB or not (self.expected or later):
            return None
        if not self.expected:
            return _Estimate(now, 0.0, self._cautious(later * self._taken / self._worked)) if self._worked else None
        stage, taken = self._stages[self.place], now - self._begun
        done, before = self.share * stage.seconds, 0.0  # of this stage, and what it counts that others were slower
        if self._worked:
            trusted = min(TRUST_IN_PLAN * stage.total, self._worked)
            done, before = done + trusted, trusted * self._taken / self._worked
        if done == 0:
            return None
        own = (taken + before) / done * (stage.total - self.share * stage.seconds)
        slowness = (self._taken + taken + own) / (self._worked + stage.total)
        return _Estimate(now, self._cautious(own), self._cautious(slowness * later))

    def _cautious(self, left: float) -> float:
        """A longer time as long as little is known, since an estimate may fall, but not rise."""
        return left * (1 + CAUTION * (1 - self.fraction) ** 2)


class Progress:
    """Current stage of a computation and the fraction completed; called to report, converted to text for display.

    The time left is that of the job if its stages are known in advance, and otherwise that of the stage, from the time
    that the second half of the part done has taken. It is counted down between reports. That of a job does not rise by
    more than a tenth: if an estimate turns out too low, it waits. A second after the time has passed, none is told
    until the next report, which estimates it anew.

    Args:
        clock: returns the time in seconds.
        stages: that the job is expected to have, in order; none are known by default.

    Example:
        >>> now = [0.0]
        >>> progress = Progress(lambda: now[0])
        >>> progress("Averaging", 0, 100)
        >>> now[0] = 30.0
        >>> progress("Averaging", 25, 100)
        >>> print(progress)
        Averaging, 25 %, about 2 min left
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, stages: Sequence[Stage] = ()) -> None:
        self._clock = clock
        self._stage, self._share, self._begun, self._first = "", 0.0, clock(), 0.0
        self._reports = [(self._first, self._begun)]  # shares done, with their times
        self._job = _Job(stages, self._begun) if stages else None
        self._lock = Lock()  # reports and texts come from different threads

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units of a stage are complete."""
        share = done / max(total, 1)
        with self._lock:
            if stage != self._stage or share < self._share:
                self._begin(stage, share)
            elif share > self._share:
                self._share = share
                self._reports.append((share, self._clock()))
            if self._job is not None:
                self._job.report(stage, share, self._clock())

    def begin(self, stage: str) -> None:
        """Begin a stage without progress reports."""
        with self._lock:
            self._begin(stage, 0.0)
            if self._job is not None:
                self._job.report(stage, 0.0, self._clock())

    def _begin(self, stage: str, share: float) -> None:
        self._stage, self._share, self._begun, self._first = stage, share, self._clock(), share
        self._reports = [(self._first, self._begun)]  # shares done, with their times

    @property
    def fraction(self) -> float:
        """Share of the job that is done, or of the stage if the stages of the job are not known."""
        with self._lock:
            return self._share if self._job is None else self._job.fraction

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds until the job ends, or the stage if the job's are not known; None if unknown or overrun."""
        with self._lock:
            return self._left_of_stage() if self._job is None else self._job.left(self._clock())

    def _left_of_stage(self) -> float | None:
        done = self._share - self._first
        if done < KNOWN:
            return None
        share, then = max(report for report in self._reports if report[0] <= self._first + done / 2)
        last = self._reports[-1][1]
        left = (last - then) * (1 - self._share) / (self._share - share) - (self._clock() - last)
        return max(0.0, left) if left >= -GRACE else None

    def __str__(self) -> str:
        """The stage with the fraction done and the time left, or with the elapsed time if that is unknown."""
        left = self.seconds_left
        if left is not None:
            return f"{self._stage}, {100 * self.fraction:.0f} %, about {time_text(left)} left"
        return f"{self._stage}, {time_text(self._clock() - self._begun)} so far" if self._stage else ""


def time_text(seconds: float) -> str:
    """Format a time in seconds or minutes.

    >>> time_text(0.4), time_text(89.7), time_text(130)
    ('1 s', '90 s', '2 min')
    """
    return f"{max(1, round(seconds))} s" if seconds < 90 else f"{round(seconds / 60)} min"
