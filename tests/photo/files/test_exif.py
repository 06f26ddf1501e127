"""Orientation is applied and reset; invalid fields are ignored, and the others are kept."""

import contextlib
import struct
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as some
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image, ImageOps

from nlfilter_torch.photo.files.exif import PREFIX, parsed, read_upright, upright
from nlfilter_torch.photo.files.tables import LENGTHS
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph
from tests.files import exif_block, photograph, same, stored_values, tags
from tests.pairwise import each_value


@pytest.mark.parametrize(("orientation", "suffix"), each_value(range(1, 9), [".png", ".tif"]))
def test_exif_orientation_is_applied_and_reset(tmp_path: Path, orientation: int, suffix: str) -> None:
    values = stored_values(3, "uint8")
    image, exif = Image.fromarray(values), exif_block(orientation)
    image.save(tmp_path / f"in{suffix}", exif=exif)
    image.save(tmp_path / "with_tag.png", exif=exif)
    with Image.open(tmp_path / "with_tag.png") as stored:
        upright = np.asarray(ImageOps.exif_transpose(stored))
    opened = read_photograph(tmp_path / f"in{suffix}")
    assert torch.equal(opened.pixels, photograph(upright).pixels)
    main, details, gps = tags(opened.exif)
    assert main == {ExifTags.Base.Make: "Maker", ExifTags.Base.Orientation: 1}
    height, width = opened.pixels.shape[-2:]
    assert (details[ExifTags.Base.ExifImageWidth], details[ExifTags.Base.ExifImageHeight]) == (width, height)
    assert details[ExifTags.Base.LensModel] == "a lens with a long name"
    assert gps == {ExifTags.GPS.GPSLatitudeRef: "N"}
    write_photograph(opened, tmp_path / f"again{suffix}")
    same(read_photograph(tmp_path / f"again{suffix}"), opened)


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


ODD = [
    "text",
    "beyond the standard",
    "rational",
    "table that is text",
    "table beyond the end",
    "maker beyond the end",
]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_fields_of_exif_without_sense_are_ignored(tmp_path: Path, suffix: str) -> None:
    for kind in ODD:
        Image.fromarray(stored_values(3, "uint8")).save(tmp_path / f"in{suffix}", exif=odd_exif(kind))
        opened = read_photograph(tmp_path / f"in{suffix}")
        assert opened.pixels.shape[-2:] == stored_values(3, "uint8").shape[:2]
        assert tags(opened.exif)[0][ExifTags.Base.Make] == "Maker"
        for other in (".png", ".tif", ".jpg"):
            with pytest.warns(UserWarning, match="damaged") if opened.extras.left_out else contextlib.nullcontext():
                write_photograph(opened, tmp_path / f"out{other}")
            assert tags(read_photograph(tmp_path / f"out{other}").exif)[0][ExifTags.Base.Make] == "Maker"


@pytest.mark.parametrize(
    ("suffix", "depth"),
    [
        (".png", "uint8"),
        (".png", "uint16"),
        (".jpg", "uint8"),
        (".tif", "uint8"),
        (".webp", "uint8"),
        (".avif", "uint8"),
    ],
)
def test_text_beyond_ascii_is_kept(tmp_path: Path, suffix: str, depth: str) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Artist] = "Jörg".encode()
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.LensModel] = "Gorlitz"
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSMapDatum] = "Süd".encode()
    places = (ExifTags.Base.Artist, ExifTags.Base.LensModel, ExifTags.GPS.GPSMapDatum)
    block = exif.tobytes().replace(b"Gorlitz", b"G\xf6rlitz")  # latin-1
    write_photograph(photograph(stored_values(3, depth), exif=block), tmp_path / "in.png")
    write_photograph(read_photograph(tmp_path / "in.png"), tmp_path / f"between{suffix}")
    write_photograph(read_photograph(tmp_path / f"between{suffix}"), tmp_path / f"out{suffix}")
    opened = read_photograph(tmp_path / f"out{suffix}").exif
    texts = [table[place] for table, place in zip(tags(opened), places, strict=True)]
    # Pillow reads latin-1.
    assert [str(text).encode("latin-1") for text in texts] == ["Jörg".encode(), b"G\xf6rlitz", "Süd".encode()]


def test_text_beyond_ascii_is_kept_beside_invalid_fields(tmp_path: Path) -> None:
    exif = odd_exif("rational").replace(b"Maker\0", b"M\xe4her\0")
    Image.fromarray(stored_values(3, "uint8")).save(tmp_path / "in.png", exif=exif)
    main, _, _ = tags(read_photograph(tmp_path / "in.png").exif)
    assert main[ExifTags.Base.Make] == "Mäher"


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_the_table_inside_the_table_of_exif_is_kept(tmp_path: Path, suffix: str) -> None:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {1: "R98", 2: b"0100"}
    write_photograph(photograph(stored_values(3, "uint8"), exif=exif.tobytes()), tmp_path / "in.png")
    write_photograph(read_photograph(tmp_path / "in.png"), tmp_path / f"out{suffix}")
    with Image.open(tmp_path / f"out{suffix}") as image:
        assert image.getexif().get_ifd(ExifTags.IFD.Interop) == {1: "R98", 2: b"0100"}


def test_a_pointer_of_exif_to_nothing_is_left_out(tmp_path: Path) -> None:
    exif = Image.Exif()
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.IFD.Interop], details[ExifTags.Base.LensModel] = 9999, "a lens"
    write_photograph(photograph(stored_values(3, "uint8"), exif=exif.tobytes()), tmp_path / "in.png")
    with pytest.warns(UserWarning, match=r"out.tif is written without .*: damaged fields of EXIF"):
        write_photograph(read_photograph(tmp_path / "in.png"), tmp_path / "out.tif")
    with Image.open(tmp_path / "out.tif") as image:
        assert image.getexif().get_ifd(ExifTags.IFD.Exif) == {ExifTags.Base.LensModel: "a lens"}


SUBJECT_AREA = 0x9214


def subject_block(orientation: int, *, sized: bool) -> bytes:
    """An EXIF block with the place of the main subject, in a picture of 40 x 30 pixels."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[SUBJECT_AREA] = (9, 5, 4, 2)
    if sized:
        details[ExifTags.Base.ExifImageWidth], details[ExifTags.Base.ExifImageHeight] = 40, 30
    return exif.tobytes()


def test_the_place_of_the_subject_turns_with_the_picture() -> None:
    for orientation in range(1, 9):
        stored = np.zeros((30, 40, 1), np.uint8)
        stored[5, 9] = 255
        (row,), (column,), _ = upright(stored, orientation).nonzero()
        turned = read_upright(subject_block(orientation, sized=True))
        _, details, _ = tags(turned.block)
        wanted = (4, 2) if orientation < 5 else (2, 4)
        assert details[SUBJECT_AREA] == (column, row, *wanted)
        assert turned.left_out == ()
        unsized = read_upright(subject_block(orientation, sized=False))
        if orientation == 1:
            assert tags(unsized.block)[1][SUBJECT_AREA] == (9, 5, 4, 2)
        else:
            assert unsized.left_out == ("the place of the subject, as the picture is turned",)


@some.composite
def fields(draw: some.DrawFn, codes: range | tuple[int, ...]) -> list[tuple[int, int, bytes]]:
    """Fields of a table, with types and values of EXIF."""
    chosen = sorted(draw(some.sets(some.sampled_from(codes), min_size=1, max_size=4)))
    kinds = [draw(some.integers(1, 12)) for _ in chosen]
    lengths = [LENGTHS[kind] * draw(some.integers(1, 4)) for kind in kinds]
    values = [draw(some.binary(min_size=length, max_size=length)) for length in lengths]
    return list(zip(chosen, kinds, values, strict=True))


def block_with(order: str, first: list[tuple[int, int, bytes]], detail: list[tuple[int, int, bytes]]) -> bytes:
    """An EXIF block with those fields."""

    def table(entries: list[tuple[int, int, bytes]], start: int) -> bytes:
        head, values = struct.pack(order + "H", len(entries)), b""
        for code, kind, data in entries:
            count = len(data) // LENGTHS[kind]
            if len(data) > 4:
                place = start + 6 + 12 * len(entries) + len(values)
                values, data = values + data + bytes(len(data) % 2), struct.pack(order + "I", place)
            head += struct.pack(order + "HHI", code, kind, count) + data.ljust(4, b"\0")
        return head + bytes(4) + values

    pointer = (34665, 4, bytes(4))
    inner = 8 + len(table(sorted([*first, pointer]), 8))
    whole = table(sorted([*first, (34665, 4, struct.pack(order + "I", inner))]), 8) + table(detail, inner)
    return PREFIX + (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8) + whole


@hypothesis.settings(max_examples=30, deadline=None)
@hypothesis.given(
    order=some.sampled_from("<>"),
    first=fields((315, 316, 33432, 40091)),
    detail=fields(range(50000, 50010)),
    suffix=some.sampled_from([".jpg", ".png", ".webp", ".avif", ".tif"]),
)
def test_fields_of_any_type_and_count_come_out_as_they_went_in(
    tmp_path_factory: pytest.TempPathFactory, order: str, first: Any, detail: Any, suffix: str
) -> None:
    path = tmp_path_factory.getbasetemp() / f"any{suffix}"
    write_photograph(photograph(stored_values(3, "uint8"), exif=block_with(order, first, detail)), path)
    tables = parsed(read_photograph(path).exif)
    assert tables is not None
    assert tables.order == order
    found = [(field.code, field.kind, tables.raw(field)) for field in tables.walk() if field.code not in (274, 34665)]
    assert sorted(found) == sorted([*first, *detail])
