"""Progress as text, with a simulated clock and recorded runs."""

import pytest

from nlfilter_torch.core.progress import Progress

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
    clock.now = 20.0
    assert told.seconds_left == 0


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
