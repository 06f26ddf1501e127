"""Memory that commands may use to read pictures in parts, and where arrays are written."""

from pathlib import Path

import pytest

from nlfilter_torch.photo.cli import editing
from nlfilter_torch.photo.io import rows
from tests.commands import refused, small_photo


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return small_photo(tmp_path)


def test_a_file_is_no_array_of_zarr(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out.zarr").write_text("mine")
    assert "is a file, not a zarr array" in refused(capsys, "detail", photo, tmp_path / "out.zarr")
    assert (tmp_path / "out.zarr").read_text() == "mine"


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
