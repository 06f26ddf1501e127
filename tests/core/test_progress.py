"""Progress as text, with a simulated clock."""

from nlfilter_torch.core.progress import Progress


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_stages_with_what_is_done_of_them_and_their_time() -> None:
    clock = Clock()
    told = Progress(clock)
    assert str(told) == ""
    told("Reading", 0, 1)
    clock.now = 3.0
    assert str(told) == "Reading, 3 s so far"
    told("Averaging", 0, 200)
    clock.now = 13.0
    told("Averaging", 100, 200)
    assert str(told) == "Averaging, 50 %, 10 s so far"
    clock.now = 203.0
    assert str(told) == "Averaging, 50 %, 3 min so far"  # also without a report
    told("Averaging", 0, 200)  # a second pass with the same name
    assert str(told) == "Averaging, 1 s so far"
    told("Writing", 1, 0)  # of zero
    assert "Writing" in str(told)
