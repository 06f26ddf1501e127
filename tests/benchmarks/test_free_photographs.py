"""Photographs from Debian's packages: sets without overlap, Qt's archives, and prepared pictures."""

import io
import struct
import zlib
from pathlib import Path

import pytest
from PIL import Image

from benchmarks import free_photographs
from benchmarks.free_photographs import (
    LARGEST_SCALE,
    PIXELS,
    SETS,
    SMALLEST_SCALE,
    contents,
    photographs,
    resources,
    scale_of,
    unpacked,
)


def archive(files: dict[str, bytes]) -> bytes:
    """One of Qt's archives, of version 2, with all files in one folder; the second is compressed."""
    names, offsets = b"", []
    for name in ("", "folder", *files):
        offsets.append(len(names))
        names += struct.pack(">HI", len(name), 0) + name.encode("utf-16-be")
    tree = struct.pack(">IHIIQ", offsets[0], 2, 1, 1, 0) + struct.pack(">IHIIQ", offsets[1], 2, len(files), 2, 0)
    bodies = b""
    for number, body in enumerate(files.values()):
        packed = struct.pack(">I", len(body)) + zlib.compress(body) if number == 1 else body
        tree += struct.pack(">IHHHIQ", offsets[number + 2], int(number == 1), 0, 0, len(bodies), 0)
        bodies += struct.pack(">I", len(packed)) + packed
    start = 20
    header = struct.pack(">4s4I", b"qres", 2, start, start + len(tree), start + len(tree) + len(bodies))
    return header + tree + bodies + names


def image(side: int) -> bytes:
    with io.BytesIO() as file:
        Image.linear_gradient("L").resize((side, side)).convert("RGB").save(file, "PNG")
        return file.getvalue()


def test_no_photograph_is_in_two_sets_and_a_quarter_of_the_largest_package_is_kept_aside() -> None:
    rows = photographs()
    assert len({row.name for row in rows}) == len({(row.package, row.path) for row in rows}) == len(rows)
    assert {row.set for row in rows} == set(SETS)
    assert all(row.licence not in ("", "unknown") for row in rows)
    sets = [row.set for row in rows if row.package == "gcompris-qt-data"]
    assert sets.count("reporting") >= len(sets) / 4
    for name in SETS:
        assert any(row.repeated for row in rows if row.set == name)


def test_archives_of_qt_are_read(tmp_path: Path) -> None:
    files = {"plain.webp": b"plain", "packed.webp": 100 * b"packed"}
    data = archive(files)
    assert resources(data) == {f"folder/{name}": body for name, body in files.items()}
    (tmp_path / "some.rcc").write_bytes(data)
    assert contents(tmp_path, "some.rcc/folder/plain.webp") == b"plain"
    with pytest.raises(ValueError, match="data must be one of Qt's archives"):
        resources(b"no archive")


def test_pictures_are_reduced_until_their_files_have_enough_bits_for_a_pixel() -> None:
    assert scale_of((1000, 1000), 187_500) == pytest.approx(0.5**0.5)
    assert scale_of((1000, 1000), 10**7) == LARGEST_SCALE
    assert scale_of((1000, 1000), 1000) == SMALLEST_SCALE
    width, height = 6000, 4000
    assert scale_of((width, height), 10**8) ** 2 * width * height == pytest.approx(PIXELS)


def test_packages_are_downloaded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def run(command: list[str], **_: object) -> None:
        calls.append(command[0])
        if command[0] == "apt-get":
            (tmp_path / "some_1_all.deb").touch()
        else:
            Path(command[3]).mkdir()

    monkeypatch.setattr(free_photographs.subprocess, "run", run)
    assert unpacked("some", tmp_path) == unpacked("some", tmp_path) == tmp_path / "some"
    assert calls == ["apt-get", "dpkg-deb"]


def test_the_command_prepares_the_photographs_of_a_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "packages" / "some").mkdir(parents=True)
    (tmp_path / "packages" / "some" / "a.png").write_bytes(image(100))
    rows = [
        free_photographs.Photograph("training", "first", "some", "a.png", "CC0-1.0", repeated=False),
        free_photographs.Photograph("choosing", "second", "some", "absent.png", "CC0-1.0", repeated=False),
    ]
    monkeypatch.setattr(free_photographs, "photographs", lambda: rows)
    free_photographs.main(["--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "absent.png is not in this version of some, and is left out" in printed
    assert "training: 1 photographs" in printed
    with Image.open(tmp_path / "training" / "first.png") as prepared:
        assert prepared.mode == "RGB"
        assert prepared.width < 100
