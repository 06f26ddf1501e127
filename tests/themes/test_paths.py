"""Files that the command line reads and writes: pipes, links, odd names, and output that cannot be written."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.picture.photographs import read_photograph
from tests.commands import refused, small_photo


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return small_photo(tmp_path)


@pytest.mark.parametrize("option", [[], ["--mask"], ["--preset"]])
def test_a_pipe_is_no_file(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]) -> None:
    pipe = tmp_path / "pipe.png"
    os.mkfifo(pipe)
    inputs = [photo, tmp_path / "out.png", *option, pipe] if option else [pipe, tmp_path / "out.png"]
    assert "pipe.png" in refused(capsys, "detail", *inputs)
    assert "pipe.png is a pipe, a socket or a device, not a file" in refused(capsys, "detail", photo, pipe)
    assert pipe.is_fifo()


def test_an_unreadable_file_is_told(photo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(photo))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ValueError, match=r"in\.png cannot be read: Permission denied; check its permissions"):
        read_photograph(photo)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".zarr"])
def test_what_is_written_to_a_link_goes_where_it_points(photo: Path, tmp_path: Path, suffix: str) -> None:
    there, link = tmp_path / "there" / f"real{suffix}", tmp_path / f"link{suffix}"
    there.parent.mkdir()
    link.symlink_to(there)
    for _ in range(2):  # the target does not exist the first time
        assert main(["detail", str(photo), str(link), "--alpha", "1,1"]) == 0
        assert link.is_symlink()
        assert link.readlink() == there
        assert there.is_dir() if suffix == ".zarr" else there.is_file()
        assert [path.name for path in there.parent.iterdir()] == [there.name]


def test_links_that_lead_nowhere(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop.png").symlink_to("loop.png")
    (tmp_path / "far.png").symlink_to("gone/far.png")
    assert "is a symbolic link that leads back to itself" in refused(capsys, "detail", photo, tmp_path / "loop.png")
    assert "does not exist; make it first" in refused(capsys, "detail", photo, tmp_path / "far.png")
    assert (tmp_path / "loop.png").is_symlink()


def test_damaged_tiff_is_one_sentence(photo: Path, tmp_path: Path) -> None:
    """In a separate process, since pytest handles log messages, which otherwise go to standard error."""
    whole = tmp_path / "whole.tif"
    tifffile.imwrite(whole, np.zeros((16, 20, 3), np.uint8))
    (tmp_path / "cut.tif").write_bytes(whole.read_bytes()[:100])
    command = [sys.executable, "-m", "nlfilter_torch", "detail", str(tmp_path / "cut.tif"), str(tmp_path / "out.png")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 2
    assert len(finished.stderr.splitlines()) == 1
    assert "cut.tif is damaged or cut short" in finished.stderr


@pytest.mark.parametrize("name", ["[red]x.png", "x[", "ü ☃.png"])
def test_odd_names(
    photo: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rich treats square brackets as markup, and `[/]` alone as an error."""
    monkeypatch.setenv("COLUMNS", "500")  # long paths are not wrapped
    folder = tmp_path / "[" / "b]"
    folder.mkdir(parents=True)
    source = folder / name
    source.write_bytes(photo.read_bytes())
    assert main(["inspect", str(source), str(tmp_path / "looks"), "--landmarks", "20"]) == 0
    assert name.removesuffix(".png") in capsys.readouterr().out.replace("\n", "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="is a device of Linux")
def test_output_that_cannot_be_written() -> None:
    with open("/dev/full", "w") as full:
        arguments = [sys.executable, "-m", "nlfilter_torch", "presets"]
        told = subprocess.run(arguments, stdout=full, stderr=subprocess.PIPE, text=True)
    sentence = "the output cannot be written: No space left on device; free some space there"
    assert (told.returncode, told.stderr) == (2, f"nlfilter-torch: {sentence}\n")
