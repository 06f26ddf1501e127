"""Metadata of image files: invalid fields are ignored, and the others are kept."""

import struct
from pathlib import Path

import pytest
import tifffile
import torch
from PIL import ExifTags, Image

from nlfilter_torch.io.photographs import read_photograph, write_photograph
from tests.test_files import photograph, stored_values, tags


def odd_exif(kind: str) -> bytes:
    """An EXIF block with the maker's name and an invalid field."""

    def field(tag: int, number_type: int, count: int, value: bytes) -> bytes:
        return struct.pack("<HHL", tag, number_type, count) + value

    orientation = {
        "text": field(274, 2, 4, b"top\0"),
        "beyond the standard": field(274, 3, 1, struct.pack("<L", 99)),
        "rational": field(274, 5, 1, struct.pack("<L", 44)),  # where 1/0 is
        "table that is text": field(34665, 2, 4, b"abc\0"),
        "table beyond the end": field(34665, 4, 1, struct.pack("<L", 9999)),
        "maker beyond the end": field(272, 2, 100_000, struct.pack("<L", 5)),
    }[kind]
    head = b"II*\0" + struct.pack("<LH", 8, 2) + field(271, 2, 6, struct.pack("<L", 38))
    return b"Exif\0\0" + head + orientation + struct.pack("<L", 0) + b"Maker\0" + struct.pack("<LL", 1, 0)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
@pytest.mark.parametrize(
    "kind",
    [
        "text",
        "beyond the standard",
        "rational",
        "table that is text",
        "table beyond the end",
        "maker beyond the end",
    ],
)
def test_fields_of_exif_without_sense_are_ignored(tmp_path: Path, kind: str, suffix: str) -> None:
    Image.fromarray(stored_values(3, "uint8")).save(tmp_path / f"in{suffix}", exif=odd_exif(kind))
    found = read_photograph(tmp_path / f"in{suffix}")
    assert found.pixels.shape[-2:] == stored_values(3, "uint8").shape[:2]
    assert tags(found.exif)[0][ExifTags.Base.Make] == "Maker"
    for other in (".png", ".tif", ".jpg"):
        write_photograph(found, tmp_path / f"out{other}")
        assert tags(read_photograph(tmp_path / f"out{other}").exif)[0][ExifTags.Base.Make] == "Maker"


@pytest.mark.parametrize("tag", [(274, 2, 4, "top"), (274, 5, 1, (1, 0)), (274, 3, 2, (6, 1)), (34675, 3, 1, 5)])
def test_tags_of_tiff_without_sense_are_ignored(tmp_path: Path, tag: tuple[object, ...]) -> None:
    tifffile.imwrite(tmp_path / "in.tif", stored_values(3, "uint8"), extratags=[(*tag, True)], metadata=None)
    found = read_photograph(tmp_path / "in.tif")
    assert torch.equal(found.pixels, photograph(stored_values(3, "uint8")).pixels)
    assert found.icc is None


def test_text_beyond_ascii_is_kept_in_tiff(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Artist] = "Jörg"
    write_photograph(photograph(stored_values(3, "uint8"), exif=exif.tobytes()), tmp_path / "in.png")
    found = read_photograph(tmp_path / "in.png")
    write_photograph(found, tmp_path / "out.tif")
    main, _, _ = tags(read_photograph(tmp_path / "out.tif").exif)
    assert main[ExifTags.Base.Artist] == tags(found.exif)[0][ExifTags.Base.Artist]
