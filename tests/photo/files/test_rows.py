"""Memory that commands may use to read pictures in parts, and where arrays are written."""

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
from nlfilter_torch.photo.files.metadata import Metadata
from nlfilter_torch.photo.files.rows import StoredPicture, open_picture, write_picture
from tests.commands import refused, small_photo
from tests.files import PLENTY, PROFILE, cat, rows_of
from tests.pairwise import each_value


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
