"""Progress as text, with a simulated clock and recorded runs."""

import pytest

from nlfilter_torch.core.progress import Progress, Stage

#: Times in seconds of the reports, evenly spaced in the work, of stages of edits of 0.64 megapixels in tiles; recorded
#: with two threads on two cores that other programs kept busy.
RUNS = {
    "detail: Sampling": [
        0.0,
        1.23,
        2.34,
        3.48,
        4.54,
        5.69,
        6.78,
        7.87,
        9.0,
        10.08,
        11.14,
        12.37,
        13.48,
        14.55,
        15.66,
        16.9,
        18.08,
        19.18,
        20.28,
        21.48,
        22.89,
    ],
    "detail: Filtering": [
        0.0,
        0.5,
        0.51,
        0.79,
        1.08,
        1.33,
        1.35,
        1.69,
        2.07,
        2.34,
        2.75,
        3.01,
        3.01,
        5.47,
        7.77,
        10.48,
        13.84,
        17.04,
        17.04,
        18.16,
        19.29,
        20.23,
        20.96,
        21.82,
    ],
    "sharpen: Sampling": [
        0.0,
        0.33,
        0.55,
        0.78,
        1.03,
        1.26,
        1.52,
        1.73,
        1.98,
        2.21,
        2.46,
        2.73,
        2.99,
        3.19,
        3.44,
        3.69,
        3.92,
        4.16,
        4.41,
        4.63,
        4.91,
    ],
    "sharpen: Filtering": [
        0.0,
        0.01,
        0.02,
        0.03,
        0.04,
        0.05,
        0.05,
        0.07,
        0.19,
        0.31,
        0.4,
        0.54,
        0.54,
        1.18,
        1.82,
        2.37,
        2.4,
        2.43,
        2.43,
        2.74,
        3.17,
        3.57,
        4.02,
        4.39,
    ],
}


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_time_left() -> None:
    clock = Clock()
    told = Progress(clock)
    assert str(told) == ""
    assert told.seconds_left is None
    told.begin("Reading")
    clock.now = 3.0
    assert str(told) == "Reading, 3 s so far"
    told("Averaging", 0, 200)
    clock.now = 13.0
    told("Averaging", 100, 200)
    assert told.seconds_left == pytest.approx(10)
    assert str(told) == "Averaging, 50 %, about 10 s left"
    told("Averaging", 0, 200)  # a second pass with the same name
    assert told.seconds_left is None
    told("Writing", 1, 0)  # of zero
    assert "Writing" in str(told)


def test_time_left_is_counted_down_between_reports() -> None:
    clock = Clock()
    told = Progress(clock)
    told("Averaging", 0, 10)
    clock.now = 5.0
    told("Averaging", 5, 10)
    clock.now = 8.0
    assert told.seconds_left == pytest.approx(2)
    clock.now = 10.5
    assert told.seconds_left == 0
    clock.now = 20.0  # it is overrun
    assert told.seconds_left is None
    assert str(told) == "Averaging, 20 s so far"


@pytest.mark.parametrize("run", list(RUNS))
def test_recorded_runs(run: str) -> None:
    """Half-way, the estimate is within a quarter of the truth; while work is even, it rises by a tenth at most."""
    clock, times = Clock(), RUNS[run]
    told, total, least, checked = Progress(clock), times[-1], float("inf"), False
    for tick in range(round(100 * total)):
        clock.now = tick / 100
        done = sum(time <= clock.now for time in times) - 1
        told("Filtering", done, len(times) - 1)
        left = told.seconds_left
        if left is None:
            continue
        if run.endswith("Sampling"):  # the columns of the first tiles to filter are kept, and quicker than the rest
            least = min(least, left + total / len(times))  # it is counted down until the next report
            assert left <= 1.1 * least
        if not checked and clock.now >= total / 2:
            assert left == pytest.approx(total - clock.now, rel=0.25)
            checked = True
    assert checked


def test_time_left_of_a_job_counts_its_later_stages() -> None:
    clock = Clock()
    told = Progress(clock, [Stage("Looking", 1.0, rest=1.0), Stage("Sampling", 2.0), Stage("Filtering", 6.0)])
    told("Looking", 0, 4)
    assert told.seconds_left is None
    clock.now = 2.0
    told("Looking", 4, 4)
    assert told.fraction == pytest.approx(0.1)
    assert told.seconds_left == pytest.approx(18, rel=0.13)  # everything takes twice as long as expected
    clock.now = 4.0
    told("Filtering", 0, 2)  # without the stage before
    assert told.seconds_left == pytest.approx(12, rel=0.13)
    assert str(told) == "Filtering, 40 %, about 12 s left"
    clock.now = 10.0
    told("Filtering", 1, 2)
    assert told.seconds_left == pytest.approx(6, rel=0.02)


def test_time_left_of_a_job_does_not_rise() -> None:
    clock = Clock()
    told = Progress(clock, [Stage("Looking", 1.0), Stage("Filtering", 1.0)])
    told("Looking", 0, 10)
    clock.now = 1.0
    told("Looking", 5, 10)
    first = told.seconds_left
    assert first is not None
    clock.now = 3.0  # something slows it down
    waiting = told.seconds_left
    assert waiting is not None
    told("Looking", 6, 10)
    assert told.seconds_left == pytest.approx(1.1 * waiting)
    clock.now = 3.1
    told("Filtering", 9, 10)
    left = told.seconds_left
    assert left is not None
    assert left <= 1.1 * waiting


def test_time_left_of_a_job_does_not_depend_on_who_asks() -> None:
    clock, told_often, told_once = Clock(), [], []
    often, once = (Progress(clock, [Stage("Looking", 1.0), Stage("Filtering", 10.0)]) for _ in range(2))
    reports = [(0.2 * i, i / 10) for i in range(11)] + [(5.0, 0.5), (5.1, 0.51), (40.0, 0.6), (50.0, 0.7)]
    for (now, share), (later, _) in zip(reports, [*reports[1:], (60.0, 1.0)], strict=True):
        for progress in (often, once):
            progress("Looking" if now <= 2.0 else "Filtering", round(100 * share), 100)
        told_once.append(once.seconds_left)
        told_often.append(often.seconds_left)
        for _ in range(20):  # a display
            clock.now += (later - now) / 20
            str(often)
    assert told_often == told_once


def test_an_overrun_job_has_no_time_left_until_it_is_estimated_anew() -> None:
    clock = Clock()
    told = Progress(clock, [Stage("Filtering", 10.0)])
    told("Filtering", 0, 10)
    clock.now = 1.0
    told("Filtering", 5, 10)
    assert told.seconds_left == pytest.approx(1, rel=0.03)
    clock.now = 2.5
    assert told.seconds_left == 0
    for clock.now in (3.5, 4.0, 50.0):
        assert told.seconds_left is None
    assert str(told) == "Filtering, 50 s so far"
    told("Filtering", 6, 10)
    assert told.seconds_left == pytest.approx(50 / 6 * 4, rel=0.02)
    clock.now = 60.0
    assert told.seconds_left == pytest.approx(50 / 6 * 4 - 10, rel=0.03)


def test_stages_of_a_job_that_were_not_expected() -> None:
    clock = Clock()
    names = ("Looking", "Filtering", "Looking", "Filtering")
    told = Progress(clock, [Stage(name, seconds) for name, seconds in zip(names, (1.0, 4.0, 1.0, 4.0), strict=True)])
    for now, name in enumerate(("Looking", "Looking", "Straightening", "Filtering")):  # the second pass is no other job
        clock.now = float(now)
        told(name, 0, 2)
        told(name, 1, 2)
    assert told.fraction == pytest.approx((1 + 2) / 10)
    told("Writing", 0, 1)
    assert told.fraction == pytest.approx(0.5)
    assert told.seconds_left is not None
