"""Memory and temporary files that commands may use to read pictures in parts, and where arrays are written."""

import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import psutil
import pytest
import tifffile
import zarr
from PIL import ExifTags, Image

from nlfilter_torch.photo.cli import editing
from nlfilter_torch.photo.files import rows, tiff
from nlfilter_torch.photo.files import rows as streaming_files
from nlfilter_torch.photo.files.exif import upright
from nlfilter_torch.photo.files.formats import read_channels
from nlfilter_torch.photo.files.metadata import Metadata
from nlfilter_torch.photo.files.rows import StoredPicture, open_picture, upright_copy, write_picture
from nlfilter_torch.photo.files.writing import FileRows, temporary_rows
from tests.commands import refused, small_photo
from tests.files import PLENTY, PROFILE, cat, rows_of
from tests.pairwise import each_value, pairwise


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
        assert editing.allowed_memory(None) == editing.allowed_memory(None, rows.TILED_MEMORY) == wanted
    assert editing.allowed_memory(2.0) == editing.allowed_memory(2.0, rows.TILED_MEMORY) == 2_000_000_000


def test_tiles_use_little_unless_more_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "FIFTH", 8_000_000_000)
    machine = type("Memory", (), {"available": 20_000_000_000})
    monkeypatch.setattr(rows.psutil, "virtual_memory", lambda: machine)
    assert (editing.allowed_memory(None), editing.allowed_memory(None, rows.TILED_MEMORY)) == (
        8_000_000_000,
        1_000_000_000,
    )
    for free, wanted in ((7_900_000_000, 1_000_000_000), (300_000_000, 300_000_000), (-5, 1)):
        job = editing.Job(None, "uint8", free, editing.allowed_memory(None, rows.TILED_MEMORY), lambda *_: None, None)  # type: ignore[arg-type]
        assert job.passes(False, Path()).memory == wanted


@pytest.mark.parametrize(("suffix", "channels"), each_value([".tif", ".zarr", ".png"], [1, 2, 3, 4]))
def test_writing_rows_keeps_everything(tmp_path: Path, suffix: str, channels: int) -> None:
    picture = cat(270, 350, 4)[..., [0] if channels == 1 else [0, 3] if channels == 2 else slice(channels)]
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    like = StoredPicture(picture, channels in (2, 4), 0, Metadata(PROFILE, exif.tobytes()), {"stain": "H&E"})
    parts = ((slice(top, min(top + 41, 270)), picture[top : top + 41]) for top in range(0, 270, 41))
    path = tmp_path / f"out{suffix}"
    write_picture(path, parts, "uint8", like)
    np.testing.assert_array_equal(rows_of(path).reshape(picture.shape), picture)
    with open_picture(path, PLENTY) as written:
        assert written.shape == picture.shape
        assert written.alpha == (channels in (2, 4))
        if suffix == ".zarr":
            assert written.attributes == {"stain": "H&E"}
        else:
            assert written.metadata.icc == PROFILE
            assert written.metadata.exif is not None
            assert b"Maker" in written.metadata.exif
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_large_file_becomes_a_bigtiff(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff, "MAX_CLASSIC_BYTES", 1000)
    picture = cat()
    write_picture(tmp_path / "out.tif", iter([(slice(0, 200), picture)]), "uint8", StoredPicture(picture, False, 0))
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.is_bigtiff
        assert file.pages.first.is_tiled
    np.testing.assert_array_equal(rows_of(tmp_path / "out.tif"), picture)


def test_a_zarr_array_that_changes_its_shape_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    array = zarr.create_array(store=tmp_path / "in.zarr", data=cat(), chunks=(64, 64, 3))
    with open_picture(tmp_path / "in.zarr", PLENTY) as picture:
        picture.rows[slice(0, 10)]
        array.resize((100, 150, 3))
        with pytest.raises(ValueError, match=r"in\.zarr changed its shape while it was read, from \(200, 150, 3\)"):
            picture.rows[slice(10, 20)]


def test_free_memory_leaves_some(monkeypatch: pytest.MonkeyPatch) -> None:
    free = psutil.virtual_memory()._replace(available=1000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    assert streaming_files.free_memory() == 800


@pytest.mark.parametrize("orientation", range(1, 9))
def test_copies_are_upright(orientation: int) -> None:
    with ExitStack() as stack:
        stored = temporary_rows((200, 150, 3), np.dtype(np.uint8), stack)
        with stored.array() as out:
            out[...] = cat()
        copy = upright_copy(stored, orientation, 37, stack)
        wanted = upright(cat(), orientation)
        assert copy.shape == wanted.shape
        np.testing.assert_array_equal(copy[slice(10, 90)], wanted[10:90])


@pytest.mark.parametrize(("channels", "suffix", "orientation"), pairwise([1, 3, 4], [".png", ".jpg"], [1, 3, 6]))
def test_large_files(
    tmp_path: Path, channels: int, suffix: str, orientation: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if suffix == ".jpg" and channels == 4:
        pytest.skip("JPEG has no alpha channel")
    exif = Image.Exif()
    exif[274], exif[271] = orientation, "Maker"
    picture = cat(channels=channels)
    path = tmp_path / f"in{suffix}"
    Image.fromarray(picture[..., 0] if channels == 1 else picture).save(path, exif=exif)
    whole = read_channels(path, bytes_per_pixel=0, memory=None)
    monkeypatch.setattr(rows, "TILED_MEMORY", 1000)
    np.testing.assert_array_equal(rows_of(path), whole.channels)
    with open_picture(path, PLENTY) as stored:
        assert isinstance(stored.rows, FileRows)
        assert stored.metadata == whole.metadata
        assert stored.alpha == (channels == 4)
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(ValueError, match="is damaged or cut short"):
        rows_of(path)


@pytest.mark.parametrize(("name", "options"), [("in.jpg", {"progressive": True}), ("in.webp", {})])
def test_others_need_memory(
    tmp_path: Path, name: str, options: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.fromarray(cat()).save(tmp_path / name, **options)
    monkeypatch.setattr(rows, "TILED_MEMORY", 1000)
    assert rows_of(tmp_path / name).shape == (200, 150, 3)
    with pytest.raises(MemoryError, match="has 150x200 pixels and needs about 0 MB"):
        open_picture(tmp_path / name, 1000).__enter__()


@pytest.mark.parametrize("name", ["out.png", "out.tif"])
def test_rows_are_written_with_a_note_on_what_is_left_out(tmp_path: Path, name: str) -> None:
    Image.fromarray(cat()).save(tmp_path / "in.jpg", comment=b"by hand")
    with open_picture(tmp_path / "in.jpg", PLENTY) as stored:
        rows = iter([(slice(0, 200), np.asarray(stored.rows[slice(0, 200)]))])
        with pytest.warns(UserWarning, match="is written without some metadata of the input: the comment"):
            write_picture(tmp_path / name, rows, "uint8", stored)


@pytest.mark.skipif(sys.platform == "win32", reason="has no such permissions")
def test_a_zarr_array_keeps_the_permissions_of_the_one_that_it_replaces(tmp_path: Path) -> None:
    path, picture = tmp_path / "out.zarr", cat()
    for folder, file in ((0o700, 0o600), (0o750, 0o640)):
        if path.exists():
            path.chmod(folder)
            (path / "zarr.json").chmod(file)
        write_picture(path, iter([(slice(0, 200), picture)]), "uint8", StoredPicture(picture, False, 0))
    for part in (path, *path.rglob("*")):
        assert part.stat().st_mode & 0o777 == (0o750 if part.is_dir() else 0o640)
    np.testing.assert_array_equal(rows_of(path), picture)
