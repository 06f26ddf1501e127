"""TIFF files of every kind become plain channels; invalid tags are ignored."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from nlfilter_torch.photo.files.exif import upright
from nlfilter_torch.photo.files.rows import open_picture
from nlfilter_torch.photo.files.tiff import TiffRows
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph
from tests.files import cat, photograph, rows_of, same, stored_values


@pytest.mark.parametrize("tag", [(274, 2, 4, "top"), (274, 5, 1, (1, 0)), (274, 3, 2, (6, 1)), (34675, 3, 1, 5)])
def test_tags_of_tiff_without_sense_are_ignored(tmp_path: Path, tag: tuple[object, ...]) -> None:
    tifffile.imwrite(tmp_path / "in.tif", stored_values(3, "uint8"), extratags=[(*tag, True)], metadata=None)
    opened = read_photograph(tmp_path / "in.tif")
    assert torch.equal(opened.pixels, photograph(stored_values(3, "uint8")).pixels)
    assert opened.icc is None


def test_stored_kinds_are_made_plain(tmp_path: Path) -> None:
    """Inverted grey, separate planes, compression, premultiplied alpha, BigTIFF, pages and JPEG."""
    bare = {"metadata": None, "software": False}  # otherwise tifffile describes the array in its own tags
    grey, rgba = stored_values(1, "uint16")[..., 0], stored_values(4, "uint16")
    tifffile.imwrite(tmp_path / "inverted.tif", grey, photometric="miniswhite", byteorder=">")
    assert torch.equal(read_photograph(tmp_path / "inverted.tif").pixels, photograph(65535 - grey[..., None]).pixels)
    planes = np.moveaxis(rgba[..., :3], -1, 0)
    tifffile.imwrite(tmp_path / "planes.tif", planes, photometric="rgb", planarconfig="separate")
    assert torch.equal(read_photograph(tmp_path / "planes.tif").pixels, photograph(rgba[..., :3]).pixels)
    for compression in ("lzw", "zlib", "lzma"):
        tifffile.imwrite(
            tmp_path / "packed.tif", rgba, photometric="rgb", extrasamples=[2], compression=compression, **bare
        )
        same(read_photograph(tmp_path / "packed.tif"), photograph(rgba))
    half = np.full((3, 4, 4), [100, 50, 0, 128], np.uint8)
    tifffile.imwrite(tmp_path / "associated.tif", half, photometric="rgb", extrasamples=["assocalpha"])
    opened = read_photograph(tmp_path / "associated.tif")
    assert (255 * opened.pixels[0, :, 0, 0]).round().tolist() == [199, 100, 0]
    floats = half.astype(np.float32) / 255
    tifffile.imwrite(tmp_path / "associated.tif", floats, photometric="rgb", extrasamples=["assocalpha"])
    torch.testing.assert_close(
        read_photograph(tmp_path / "associated.tif").pixels[0, :, 0, 0], torch.tensor([100 / 128, 50 / 128, 0])
    )
    tifffile.imwrite(tmp_path / "big.tif", rgba, photometric="rgb", extrasamples=[2], bigtiff=True, **bare)
    same(read_photograph(tmp_path / "big.tif"), photograph(rgba))
    tifffile.imwrite(tmp_path / "pages.tif", np.stack([rgba, rgba // 2]), photometric="rgb", extrasamples=[2], **bare)
    with pytest.warns(UserWarning, match="pages.tif has 2 pages, of which only the first is read; save the others"):
        same(read_photograph(tmp_path / "pages.tif"), photograph(rgba))
    rgb = Image.fromarray(np.full((16, 16, 3), 90, np.uint8))
    rgb.save(tmp_path / "jpeg.tif", compression="jpeg")
    torch.testing.assert_close(read_photograph(tmp_path / "jpeg.tif").pixels, torch.full((1, 3, 16, 16), 90 / 255))


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


def test_rows_are_upright(tmp_path: Path) -> None:
    for orientation in range(1, 9):
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
    visible = whole.alpha[0, 0].numpy() > 0
    np.testing.assert_array_equal(rows_of(tmp_path / "alpha.tif")[visible], np.rint(wanted * 255)[visible])


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


GROUND = [
    (33550, "d", 3, (0.5, 0.5, 0.0), True),
    (33922, "d", 6, (0.0, 0.0, 0.0, 440720.0, 100000.0, 0.0), True),
    (34735, "H", 8, (1, 1, 0, 1, 1024, 0, 1, 1), True),
    (34736, "d", 2, (6378137.0, 298.25), True),
    (34737, "s", 0, "WGS 84|", True),
    (42112, "s", 0, "<GDALMetadata/>", True),
    (42113, "s", 0, "-9999", True),
]


def raw_tags(path: Path) -> dict[int, object]:
    with tifffile.TiffFile(path) as file:
        return {code: file.pages.first.tags[code].value for code, *_ in GROUND if code in file.pages.first.tags}


@pytest.mark.parametrize("order", ["<", ">"])
def test_tags_of_geotiff_are_kept(tmp_path: Path, order: str) -> None:
    grey = cat(channels=1)[..., 0].astype(np.float32)
    tifffile.imwrite(tmp_path / "in.tif", grey, extratags=GROUND, metadata=None, byteorder=order)
    opened = read_photograph(tmp_path / "in.tif")
    write_photograph(opened, tmp_path / "out.tif")
    assert len(raw_tags(tmp_path / "in.tif")) == 7
    assert raw_tags(tmp_path / "out.tif") == raw_tags(tmp_path / "in.tif")
    with pytest.warns(UserWarning, match="without .*: the TIFF tag 42113$"):
        write_photograph(replace(opened, depth="uint8"), tmp_path / "out.tif")
    with pytest.warns(UserWarning, match="without .*: the TIFF tags 33550, 33922, 34735, 34736, 34737$"):
        write_photograph(replace(opened, pixels=opened.pixels[..., :50]), tmp_path / "small.tif")
    with pytest.warns(UserWarning, match="without .*: the TIFF tags 33550, 33922, .*, 42112, 42113$"):
        write_photograph(replace(opened, depth="uint8"), tmp_path / "out.png")
    tifffile.imwrite(tmp_path / "in.tif", grey, extratags=[*GROUND, (274, "H", 1, 3, True)], metadata=None)
    with pytest.warns(UserWarning, match="the TIFF tag 33550, as the picture is turned"):
        write_photograph(read_photograph(tmp_path / "in.tif"), tmp_path / "out.tif")
    assert set(raw_tags(tmp_path / "out.tif")) == {42112, 42113}


def test_the_resolution_keeps_its_unit(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", cat(), photometric="rgb", resolution=((11811, 100), (3, 7)), resolutionunit=3)
    write_photograph(read_photograph(tmp_path / "in.tif"), tmp_path / "out.tif")
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert [file.pages.first.tags[code].value for code in (282, 283, 296)] == [(11811, 100), (3, 7), 3]
