"""Files read and written by rows: all layouts of TIFF, zarr, and their metadata."""

from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import skimage.data
import tifffile
import torch
import zarr
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from nlfilter_torch.photo.io import rows as streaming_files
from nlfilter_torch.photo.io import tiff
from nlfilter_torch.photo.io.exif import upright
from nlfilter_torch.photo.io.photographs import read_photograph
from nlfilter_torch.photo.io.rows import StoredPicture, open_picture, write_picture
from nlfilter_torch.photo.io.tiff import TiffRows

Array = NDArray[Any]
PLENTY = 1 << 30
PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def cat(height: int = 200, width: int = 150, channels: int = 3) -> Array:
    """(height, width, channels) of 8 bits; the fourth channel is a ramp."""
    picture = skimage.data.chelsea()[20 : 20 + height, 90 : 90 + width]
    ramp = np.broadcast_to(np.arange(width, dtype=np.uint8)[:, None], (height, width, 1))
    return np.ascontiguousarray(np.concatenate([picture, ramp], axis=2)[..., :channels])


def rows_of(path: Path, step: int = 37) -> Array:
    with open_picture(path, PLENTY) as picture:
        height = picture.shape[0]
        parts = [picture.rows[slice(top, min(top + step, height))] for top in range(0, height, step)]
        return np.concatenate(parts)


@pytest.mark.parametrize(
    "layout",
    [
        {},
        {"compression": "zlib", "predictor": True, "rowsperstrip": 7},
        {"compression": "lzw", "tile": (32, 48)},
        {"tile": (64, 64)},
        {"rowsperstrip": 16},
        {"planarconfig": "separate"},
        {"planarconfig": "separate", "tile": (32, 32), "compression": "zlib"},
        {"bigtiff": True, "byteorder": ">", "compression": "zlib", "tile": (128, 128)},
        {"byteorder": ">"},
        {"compression": "jpeg", "tile": (64, 64)},
    ],
)
def test_rows_of_every_layout_of_tiff(tmp_path: Path, layout: dict[str, Any]) -> None:
    picture = cat() if layout.get("compression") == "jpeg" else cat().astype(np.uint16) * 250
    tifffile.imwrite(
        tmp_path / "in.tif",
        np.moveaxis(picture, 2, 0) if "planarconfig" in layout else picture,
        photometric="rgb",
        **layout,
    )
    whole = read_photograph(tmp_path / "in.tif").pixels[0].permute(1, 2, 0).numpy()
    white = 255 if picture.dtype == np.uint8 else 65535
    np.testing.assert_array_equal(rows_of(tmp_path / "in.tif"), np.rint(whole * white).astype(picture.dtype))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_rows_are_upright(tmp_path: Path, orientation: int) -> None:
    picture = cat(90, 60)
    tags = [(274, "H", 1, orientation, True)]
    tifffile.imwrite(tmp_path / "in.tif", picture, photometric="rgb", extratags=tags, rowsperstrip=10)
    np.testing.assert_array_equal(rows_of(tmp_path / "in.tif"), upright(picture, orientation))


def test_grey_floats_white_at_zero_and_multiplied_alpha(tmp_path: Path) -> None:
    grey = cat(channels=1)[..., 0]
    tifffile.imwrite(tmp_path / "float.tif", grey / np.float32(255), photometric="minisblack")
    np.testing.assert_allclose(rows_of(tmp_path / "float.tif")[..., 0] * 255, grey, rtol=1e-6)
    tifffile.imwrite(tmp_path / "white.tif", grey, photometric="miniswhite", tile=(32, 32))
    np.testing.assert_array_equal(rows_of(tmp_path / "white.tif")[..., 0], 255 - grey)
    tifffile.imwrite(tmp_path / "alpha.tif", cat(channels=4), photometric="rgb", extrasamples=["assocalpha"])
    whole = read_photograph(tmp_path / "alpha.tif")
    assert whole.alpha is not None
    wanted = torch.cat([whole.pixels, whole.alpha], 1)[0].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(rows_of(tmp_path / "alpha.tif"), np.rint(wanted * 255))


def test_tiles_that_a_sparse_file_leaves_out_are_black(tmp_path: Path) -> None:
    tile = cat(64, 64)
    tiles = iter([tile, None, None, tile])
    tifffile.imwrite(tmp_path / "in.tif", tiles, shape=(128, 128, 3), dtype=np.uint8, tile=(64, 64), photometric="rgb")
    rows = rows_of(tmp_path / "in.tif")
    np.testing.assert_array_equal(rows[:64, :64], tile)
    np.testing.assert_array_equal(rows[64:, 64:], tile)
    assert not rows[:64, 64:].any()
    assert not rows[64:, :64].any()


def test_a_part_of_a_tiff_is_read_without_the_rest(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", cat(), photometric="rgb", tile=(32, 32), compression="zlib")
    with TiffRows(tmp_path / "in.tif") as rows:
        rows[slice(70, 80)]
        assert list(rows.bands) == [2]
        rows[slice(60, 130)]
        assert list(rows.bands) == [3, 4]
        assert rows.cached == 3 * 32 * 150 * 3


def test_a_tiff_in_one_piece_needs_memory_for_it(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", cat(), photometric="rgb", rowsperstrip=200, compression="zlib")
    with pytest.raises(MemoryError, match=r"can only be read in pieces of 0 MB, .* save it in smaller tiles"):
        open_picture(tmp_path / "in.tif", 100_000).__enter__()


@pytest.mark.parametrize("suffix", [".tif", ".zarr", ".png"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_writing_rows_keeps_everything(tmp_path: Path, suffix: str, channels: int) -> None:
    picture = cat(270, 350, 4)[..., [0] if channels == 1 else [0, 3] if channels == 2 else slice(channels)]
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    like = StoredPicture(picture, channels in (2, 4), 0, PROFILE, exif.tobytes(), {"stain": "H&E"})
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
            assert written.icc == PROFILE
            assert written.exif is not None
            assert b"Maker" in written.exif
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
