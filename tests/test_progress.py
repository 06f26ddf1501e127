"""Progress as text and lines, edits that use tiles automatically, and progress of saving in the editor."""

import time
from pathlib import Path

import pytest

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.cli import editing, main, progress
from nlfilter_torch.photo.io import rows
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from tests.problems import LINE, cat, difference


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


def test_lines_where_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress, "PAUSE", 0.01)
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


def test_a_fifth_of_the_memory_and_no_more_than_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "FIFTH", 1000)
    for free, wanted in ((500, 400), (10_000, 1000)):
        machine = type("Memory", (), {"available": free})
        monkeypatch.setattr(rows.psutil, "virtual_memory", lambda machine=machine: machine)
        assert editing.allowed_memory(None) == editing.allowed_memory(None, rows.TILED) == wanted
    assert editing.allowed_memory(2.0) == editing.allowed_memory(2.0, rows.TILED) == 2_000_000_000


def test_tiles_use_little_unless_more_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "FIFTH", 8_000_000_000)
    machine = type("Memory", (), {"available": 20_000_000_000})
    monkeypatch.setattr(rows.psutil, "virtual_memory", lambda: machine)
    assert (editing.allowed_memory(None), editing.allowed_memory(None, rows.TILED)) == (8_000_000_000, 1_000_000_000)
    for free, wanted in ((7_900_000_000, 1_000_000_000), (300_000_000, 300_000_000), (-5, 1)):
        job = editing.Job(None, "uint8", free, editing.allowed_memory(None, rows.TILED), lambda *_: None, None)  # type: ignore[arg-type]
        assert job.passes(False, Path()).memory == wanted


def test_the_command_line_goes_to_tiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photograph(Photograph(cat().repeat(1, 1, 2, 3)), tmp_path / "in.tif")
    options = ("--alpha", "2,1.5,1", "--landmarks", "20")
    arguments = ["detail", str(tmp_path / "in.tif"), str(tmp_path / "out.tif"), *options]
    used: list[bool] = []
    read = editing.read_if_it_fits

    def watched(*given: object) -> Photograph | None:
        found = read(*given)  # type: ignore[arg-type]
        used.append(found is None)
        return found

    monkeypatch.setattr(editing, "read_if_it_fits", watched)
    assert main(arguments) == 0
    whole = read_photograph(tmp_path / "out.tif").pixels
    monkeypatch.setattr(editing, "WHOLE", 38_000_000)
    assert main(arguments) == 0
    assert used == [False, True]
    assert difference(read_photograph(tmp_path / "out.tif").pixels, whole) <= 2


def test_saving_in_the_editor_reports_its_progress(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """In memory and, for a large photograph, in tiles."""
    session.set("detail", alpha=(2.0, 1.5, 1.0, 1.0))
    session.add_stroke("recolor", LINE, 0.03, "#2040e0")
    found = []
    for name, memory, in_tiles in (("small.png", 10**9, False), ("large.png", 0, True)):
        monkeypatch.setattr("nlfilter_torch.photo.app.session.WHOLE", memory)
        stages: list[str] = []
        found.append(read_photograph(session.save(name, lambda stage, *_, told=stages: told.append(stage))).pixels)
        assert stages[-1] == "Writing"
        assert len(set(stages)) > 2 if in_tiles else set(stages) == {"Editing", "Writing"}
    assert float((found[0] - found[1]).square().mean().sqrt()) * 255 < 1
    assert sorted(path.name for path in session.folder.iterdir()) == ["cat.png", "large.png", "small.png"]
