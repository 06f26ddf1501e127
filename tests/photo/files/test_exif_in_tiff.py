"""EXIF blocks pass through every type of file with types, bytes and the place of the maker note."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files import exif_in_tiff, tiff
from nlfilter_torch.photo.files.rows import open_picture, write_picture
from nlfilter_torch.photo.files.tables import TiffTables
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.files import MAKER_NOTE, PLENTY, camera_block, fields_of, photograph, stored_values
from tests.pairwise import each_value


def upright_fields(order: str) -> dict[tuple[int, int], bytes]:
    """Those of the camera's block, once the picture is upright."""
    wanted = fields_of(camera_block(order))
    wanted[274, 3] = struct.pack(order + "H", 1)
    wanted[40962, 4], wanted[40963, 4] = wanted[40963, 4], wanted[40962, 4]
    return wanted


@pytest.mark.parametrize(("order", "suffix"), each_value(["<", ">"], [".jpg", ".png", ".webp", ".avif", ".tif"]))
def test_types_bytes_and_the_maker_note_stay(tmp_path: Path, suffix: str, order: str) -> None:
    picture = np.full((48, 64, 3), 90, np.uint8)
    Image.fromarray(picture).save(tmp_path / "in.jpg", exif=camera_block(order))
    opened = read_photograph(tmp_path / "in.jpg")
    assert fields_of(opened.exif) == upright_fields(order)
    if suffix == ".tif":
        with pytest.warns(UserWarning, match=r"out\.tif is written without .*: the thumbnail$"):
            write_photograph(opened, tmp_path / "out.tif")
    else:
        write_photograph(opened, tmp_path / f"out{suffix}")
    again = read_photograph(tmp_path / f"out{suffix}")
    assert fields_of(again.exif) == upright_fields(order)
    if suffix != ".tif":
        assert len(again.exif or b"") == len(opened.exif or b"")
        small = (again.exif or b"")[(again.exif or b"").index(b"\xff\xd8") :]
        with Image.open(io.BytesIO(small)) as thumbnail:
            assert np.abs(np.asarray(thumbnail).astype(int) - 90).max() < 3


@pytest.mark.parametrize(("order", "depth"), each_value(["<", ">"], ["uint8", "uint16", "float32"]))
def test_tiff_and_bigtiff_by_rows(tmp_path: Path, order: str, depth: str, monkeypatch: pytest.MonkeyPatch) -> None:
    values = stored_values(3, depth)
    block = exif_tags.read_upright(camera_block(order, thumbnail=False)).block
    write_photograph(Photograph(photograph(values).pixels, depth, exif=block), tmp_path / "in.tif")  # type: ignore[arg-type]
    for limit in (1 << 30, 10):
        monkeypatch.setattr(tiff, "MAX_CLASSIC_BYTES", limit)
        with open_picture(tmp_path / "in.tif", PLENTY) as picture:
            assert fields_of(picture.metadata.exif) == upright_fields(order)
            write_picture(tmp_path / "out.tif", iter([(slice(0, 5), values)]), depth, picture)
        with tifffile.TiffFile(tmp_path / "out.tif") as file:
            assert file.is_bigtiff == (limit == 10)
            assert file.pages.first.tags[34665].value["MakerNote"] == MAKER_NOTE
            np.testing.assert_array_equal(file.asarray(), values)
        wanted, found = upright_fields(order), fields_of(read_photograph(tmp_path / "out.tif").exif)
        if limit == 10:  # offsets of more bytes: read as a block that is built anew
            wanted.pop((37500, 0)), found.pop((37500, 0))
        assert found == wanted


def test_a_block_too_long_for_jpeg_loses_its_maker_note(tmp_path: Path) -> None:
    block = camera_block(thumbnail=False)
    shorter = exif_in_tiff.shortened(block, len(block) - 50)
    assert shorter is not None
    wanted = fields_of(block)
    del wanted[37500, 7], wanted[37500, 0]
    assert fields_of(shorter) == wanted
    assert exif_in_tiff.shortened(block, 100) is None
    tables = exif_tags.parsed(block)
    assert tables is not None
    packed = fields_of(exif_in_tiff.packed(tables, None))
    assert {key: value for key, value in packed.items() if key[1]} == {
        key: value for key, value in fields_of(block).items() if key[1]
    }


def test_tables_with_loops_and_cuts_end() -> None:
    block = camera_block()[6:]
    for length in range(8, len(block), 7):
        list(TiffTables(block[:length]).walk())
        list(TiffTables(block[:length]).ranges())
        exif_tags.read_upright(block[:length])
    place = struct.unpack("<I", block[4:8])[0] + 2 + 2 * 12 + 8
    loop = block[:place] + struct.pack("<I", 8) + block[place + 4 :]  # the table of EXIF is the first one
    assert len(list(TiffTables(loop).walk())) < 100
    assert exif_tags.read_upright(loop).block is not None
