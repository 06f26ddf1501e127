"""Files appear complete or not at all, where they can be written; parts left by killed processes are removed."""

import fcntl
import io
import os
import stat
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.files import writing as files
from nlfilter_torch.photo.files.writing import check_folder, open_beside, temporary_rows
from nlfilter_torch.photo.picture.photographs import write_photograph
from tests.commands import refused, small_photo
from tests.files import photograph, stored_values


def test_a_folder_is_no_output(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a folder; add a file name to it"):
        write_photograph(photograph(stored_values(3, "uint8")), tmp_path)


def test_a_read_only_folder_is_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write anywhere
    with pytest.raises(ValueError, match="is read-only; choose another"):
        write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "out.png")
    with pytest.raises(ValueError, match="is read-only; choose another"):
        check_folder(tmp_path)


def test_a_read_only_file_is_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "out.png").write_bytes(b"kept")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).is_dir())  # root may write anywhere
    with pytest.raises(ValueError, match=r"out\.png is read-only; allow writing to it, or choose another name"):
        write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "out.png")
    assert (tmp_path / "out.png").read_bytes() == b"kept"
    write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "new.png")


def test_output_folders(tmp_path: Path) -> None:
    check_folder(tmp_path)
    check_folder(tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is a file, not a folder"):
        check_folder(tmp_path / "file")
    with pytest.raises(ValueError, match="does not exist; make it first"):
        check_folder(tmp_path / "new" / "newer")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.png"
    path.write_bytes(b"old")

    def fail(stream: io.BufferedRandom, *_: object) -> None:
        stream.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("nlfilter_torch.photo.files.png.write_png", fail)
    with pytest.raises(OSError, match="disk full"):
        write_photograph(photograph(stored_values(3, "uint8")), path)
    assert [file.name for file in tmp_path.iterdir()] == ["out.png"]
    assert path.read_bytes() == b"old"


def test_written_files_have_the_usual_permissions(tmp_path: Path) -> None:
    write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "out.png")
    (tmp_path / "plain").touch()
    modes = {stat.S_IMODE(file.stat().st_mode) for file in tmp_path.iterdir()}
    assert len(modes) == 1


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return small_photo(tmp_path)


def part_of(path: Path) -> Path:
    """Make the file that a process leaves when it is killed while writing ``path``."""
    part = files.name_beside(path)
    part.write_text("half")
    return part


def test_stale_parts_of_the_same_output_are_removed(photo: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.png"
    stale, other = part_of(out), part_of(tmp_path / "other.png")
    unlike = tmp_path / ".out.png.mine.part"  # of another file
    unlike.write_text("mine")
    assert main(["detail", str(photo), str(out), "--alpha", "1,1"]) == 0
    assert not stale.exists()
    assert other.exists()
    assert unlike.exists()


def test_parts_that_are_being_written_stay(tmp_path: Path) -> None:
    out, claimed = tmp_path / "out.txt", part_of(tmp_path / "out.txt")
    with claimed.open() as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)  # like another process that is writing it
        with open_beside(out) as first:
            first.write(b"first")
            with open_beside(out) as second:
                second.write(b"second")
            assert out.read_bytes() == b"second"
        assert out.read_bytes() == b"first"
        assert claimed.exists()
    with open_beside(out) as stream:
        stream.write(b"third")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.txt"]
    assert not files.unfinished


@pytest.mark.parametrize("letter", ["x", "é"])
def test_the_longest_names_can_be_written(letter: str, photo: Path, tmp_path: Path) -> None:
    out = tmp_path / f"{letter * (251 // len(letter.encode()))}.png"
    assert main(["detail", str(photo), str(out), "--alpha", "1,1"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([photo.name, out.name])


def test_names_too_long_are_told(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(capsys, "detail", photo, tmp_path / f"{'x' * 252}.png")
    assert told.endswith(": File name too long; check the name and the permissions\n")


def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    usage = files.shutil.disk_usage("/")._replace(free=1000)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda folder: usage)
    with ExitStack() as stack, pytest.raises(MemoryError, match=r"temporary file of 3 MB .* set TMPDIR to a folder"):
        temporary_rows((1000, 1000, 3), np.dtype(np.uint8), stack)
