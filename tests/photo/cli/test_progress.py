"""Progress on the terminal, and as lines elsewhere."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from nlfilter_torch.photo.cli import progress


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Console]:
    """A terminal that records what is drawn on it."""
    with open(os.devnull, "w") as nowhere:
        shown = Console(force_terminal=True, width=80, record=True, file=nowhere)
        monkeypatch.setattr(progress, "Console", lambda stderr: shown)
        yield shown


def test_lines_where_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "LINE_PAUSE", 0.01)
    said = ""
    with progress.stages() as report:
        report("Averaging", 0, 10)
        for _ in range(1000):  # until a line is printed
            said += capsys.readouterr().err
            if "Averaging" in said:
                break
            time.sleep(0.01)
    assert "Averaging, 1 s so far\n" in said
    assert "nlfilter-torch:" not in said  # the prefix of errors and notes
    with progress.steps(2) as begin:
        begin("Reading")
    assert "\x1b" not in said + capsys.readouterr().err


def test_quick_work_says_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with progress.steps(1) as begin:
        begin("Reading")
    assert capfd.readouterr() == ("", "")


def test_report_of_progress_is_drawn_on_a_terminal(terminal: Console) -> None:
    with progress.stages() as report:
        report("Looking", 1, 4)
        report("Filtering", 3, 4)
    text = terminal.export_text()
    assert "Filtering" in text
    assert "75%" in text
