"""Progress as text."""

import pytest

from nlfilter_torch.core.progress import Progress


def test_time_left() -> None:
    now = [0.0]
    told = Progress(lambda: now[0])
    assert str(told) == ""
    assert told.seconds_left is None
    told.begin("Reading")
    now[0] = 3.0
    assert str(told) == "Reading, 3 s so far"
    told("Averaging", 0, 200)
    now[0] = 13.0
    told("Averaging", 100, 200)
    assert told.seconds_left == pytest.approx(10)
    assert str(told) == "Averaging, 50 %, about 10 s left"
    told("Averaging", 0, 200)  # a second pass with the same name
    assert told.seconds_left is None
    told("Writing", 1, 0)  # of zero
    assert "Writing" in str(told)
