"""TIFF files of every kind become plain channels; invalid tags are ignored."""

import contextlib
import io
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as some
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from nlfilter_torch.photo.files import tiff
from nlfilter_torch.photo.files.exif import upright
from nlfilter_torch.photo.files.metadata import Extras, Header, Metadata, Tag
from nlfilter_torch.photo.files.rows import open_picture
from nlfilter_torch.photo.files.tables import LENGTHS, TiffTables
from nlfilter_torch.photo.files.tiff import TiffRows
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph, write_photographs
from tests.files import camera_block, cat, photograph, rows_of, same, stored_values, tags


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
    with pytest.warns(UserWarning, match="pages.tif has 2 pages, of which only the first is read; --pages edits all"):
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


def levels_of(path: Path) -> np.ndarray:
    """The channels (H, W, S) in 8 bits, the same in memory and by rows."""
    opened = read_photograph(path)
    assert opened.depth == "uint8"
    levels = np.rint(opened.pixels[0].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    np.testing.assert_array_equal(rows_of(path), levels)
    return levels


SMALL, FULL = cat(30, 40), cat(90, 120)
REDUCED: dict[str, Any] = {"photometric": "rgb", "metadata": None, "subfiletype": 1}
PLAIN: dict[str, Any] = {"photometric": "rgb", "metadata": None}


@pytest.mark.parametrize("nested", [False, True])
def test_the_full_picture_is_read_where_a_reduced_one_comes_first(tmp_path: Path, nested: bool) -> None:
    tags = [(33723, 7, 9, b"a caption", True), (274, "H", 1, 6, True), (297, "H", 2, (0, 2), True)]
    with tifffile.TiffWriter(tmp_path / "in.tif") as file:
        file.write(SMALL, subifds=int(nested), software="a camera", extratags=tags, **REDUCED)
        file.write(FULL, resolution=(300, 300), **PLAIN)
    np.testing.assert_array_equal(levels_of(tmp_path / "in.tif"), upright(FULL, 6))
    opened = read_photograph(tmp_path / "in.tif")
    assert opened.extras.dpi == (300, 300)
    with pytest.warns(UserWarning, match="without .*: the tags of page numbers, smaller versions and masks$"):
        write_photograph(opened, tmp_path / "out.tif")
    with tifffile.TiffFile(tmp_path / "out.tif") as written:
        assert len(written.pages) == 1
        assert written.pages.first.tags[33723].value == b"a caption"
        assert written.pages.first.software == "a camera"


def test_of_reduced_versions_alone_the_largest_is_read(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "in.tif") as file:
        for picture in (SMALL, FULL, SMALL):
            file.write(picture, **REDUCED)
    np.testing.assert_array_equal(levels_of(tmp_path / "in.tif"), FULL)


def test_a_full_picture_in_front_stays_the_one_that_is_read(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "in.tif") as file:
        file.write(SMALL, subifds=1, **PLAIN)
        file.write(FULL, **REDUCED)
        file.write(FULL, **REDUCED)
    np.testing.assert_array_equal(levels_of(tmp_path / "in.tif"), SMALL)


@pytest.mark.parametrize("wide", [1, 257])
def test_palettes_are_read_at_8_bits(tmp_path: Path, wide: int) -> None:
    """Some programs write 8 bits where the standard asks for 16."""
    palette = np.random.default_rng(0).integers(0, 256, (3, 256), np.uint16)
    grey = cat(channels=1)[..., 0]
    for layout in ({}, {"tile": (32, 32), "compression": "lzw"}):
        tifffile.imwrite(tmp_path / "in.tif", grey, photometric="palette", colormap=palette * wide, **layout)
        np.testing.assert_array_equal(levels_of(tmp_path / "in.tif"), palette.T[grey])


@pytest.mark.parametrize("compression", [None, "group3", "group4", "packbits"])
def test_one_bit_is_black_and_white(tmp_path: Path, compression: str | None) -> None:
    picture = cat(channels=1)[..., 0] > 100
    Image.fromarray(picture).save(tmp_path / "in.tif", compression=compression)
    np.testing.assert_array_equal(levels_of(tmp_path / "in.tif")[..., 0], picture * np.uint8(255))


@pytest.mark.parametrize(("bits", "photometric"), [(2, 1), (4, 0), (4, 3)])
def test_few_bits_become_8(tmp_path: Path, bits: int, photometric: int) -> None:
    numbers = np.random.default_rng(0).integers(0, 2**bits, (8, 16), np.uint8)
    packed = np.packbits((numbers[..., None] >> np.arange(bits)[::-1] & 1).astype(np.uint8).reshape(8, -1), axis=1)
    palette = np.random.default_rng(1).integers(0, 256, (3, 2**bits), np.uint16)
    fields = [(256, 3, [16]), (257, 3, [8]), (258, 3, [bits]), (259, 3, [1]), (262, 3, [photometric])]
    fields += [(277, 3, [1]), (278, 3, [8])] + [(320, 3, list((palette * 257).ravel()))] * (photometric == 3)
    (tmp_path / "in.tif").write_bytes(tiff_of(fields, packed.tobytes()))
    plain = numbers if photometric else 2**bits - 1 - numbers
    wanted = palette.T[numbers] if photometric == 3 else plain[..., None] * (255 // (2**bits - 1))
    np.testing.assert_array_equal(levels_of(tmp_path / "in.tif"), wanted)


def tiff_of(fields: list[tuple[int, int, list[int]]], pixels: bytes, scan: int = 0) -> bytes:
    """A TIFF file of one strip of pixels at offset 8, whose scan begins some bytes later."""
    fields = sorted([*fields, (273, 4, [8 + scan]), (279, 4, [len(pixels) - scan])])
    values, entries = pixels + bytes(len(pixels) % 2), b""
    for code, kind, numbers in fields:
        data = struct.pack(f"<{len(numbers)}{'H' if kind == 3 else 'I'}", *numbers)
        if len(data) > 4:
            values, data = values + data, struct.pack("<I", 8 + len(values))
        entries += struct.pack("<HHI", code, kind, len(numbers)) + data.ljust(4, b"\0")
    return b"II*\0" + struct.pack("<I", 8 + len(values)) + values + struct.pack("<H", len(fields)) + entries + bytes(4)


@pytest.mark.parametrize("apart", [False, True])
def test_old_jpeg_is_read(tmp_path: Path, apart: bool) -> None:
    """The strip is the whole file of JPEG, or its scan alone."""
    colour, stream = np.full((48, 64, 3), (200, 40, 60), np.uint8), io.BytesIO()
    Image.fromarray(colour).save(stream, "JPEG", quality=95)
    jpeg = stream.getvalue()
    scan = jpeg.index(b"\xff\xda") + 2 + 12  # of three channels
    fields = [(256, 4, [64]), (257, 4, [48]), (258, 3, [8, 8, 8]), (259, 3, [6]), (262, 3, [6]), (277, 3, [3])]
    fields += [(278, 4, [48]), (513, 4, [8]), (514, 4, [len(jpeg)]), (530, 3, [2, 2])]
    (tmp_path / "in.tif").write_bytes(tiff_of(fields, jpeg, scan if apart else 0))
    assert np.abs(levels_of(tmp_path / "in.tif").astype(int) - colour).max() < 4


def test_unknown_compression_is_not_called_damage(tmp_path: Path) -> None:
    fields = [(256, 3, [4]), (257, 3, [2]), (258, 3, [8]), (259, 3, [50099]), (262, 3, [1]), (277, 3, [1])]
    (tmp_path / "in.tif").write_bytes(tiff_of([*fields, (278, 3, [2])], bytes(8)))
    for read in (read_photograph, rows_of):
        with pytest.raises(
            ValueError, match=r"in\.tif is compressed in a way, number 50099, that libtiff, which reads"
        ):
            read(tmp_path / "in.tif")


def test_a_stack_behind_one_page_is_told(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", SMALL, description="ImageJ=1.53t\nimages=9\nslices=9\n", **PLAIN)
    with pytest.warns(UserWarning, match=r"in\.tif has 9 pictures behind one page, of which only the first is read"):
        read_photograph(tmp_path / "in.tif")


OME = b'<?xml version="1.0"?><OME xmlns="x"><Image><Pixels SizeZ="9" SizeX="120" SizeY="90"/></Image></OME>'
STATED = [
    (b"ImageJ=1.53t\nimages=1\nslices=1\nunit=micron\nmin=3.0\nmax=255.0\n", b"ImageJ=1.53t\nunit=micron\n", "ImageJ"),
    (b"ImageJ=1.53t\nchannels=1\nimages=1\n", None, "ImageJ"),
    (OME, None, "OME"),
    (b'{"shape": [9, 90, 120, 3], "axes": "ZYXS"}', None, None),
    (b'{"shape": [90, 120, 3], "lens": "wide", "axes": "YXS"}', b'{"lens": "wide"}', None),
    (b"shape=(90, 120, 3)", None, None),
    (b"Aperio Image Library v10\n46000x32914 [0,0 46000x32914]", None, "SVS"),
    (b"a cat = images", b"a cat = images", None),
]


@pytest.mark.parametrize(("stated", "kept", "program"), STATED)
@pytest.mark.parametrize("cropped", [False, True])
def test_descriptions_state_nothing_that_is_untrue(
    tmp_path: Path, stated: bytes, kept: bytes | None, program: str | None, cropped: bool, recwarn: Any
) -> None:
    tifffile.imwrite(tmp_path / "in.tif", FULL, description=stated, software="a microscope", **PLAIN)
    opened = read_photograph(tmp_path / "in.tif")
    part = opened.pixels[..., :50, :30] if cropped else opened.pixels
    write_photograph(opened.with_pixels(part), tmp_path / "out.tif")
    notes = [str(warning.message).split(": ")[1] for warning in recwarn]
    assert notes == ([] if program is None else [f"the description of the file for {program}"])
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        page = file.pages.first
        assert (page.tags[270].value.encode() + b"\n" if 270 in page.tags else b"\n").strip() == (kept or b"").strip()
        assert page.software == "a microscope"
        assert file.asarray().shape == (*part.shape[2:], 3)


def test_the_stack_of_another_program_becomes_one_picture(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).integers(0, 255, (4, 30, 40), np.uint8)
    for name, options in (("imagej", {"imagej": True}), ("ome", {"ome": True}), ("shaped", {})):
        tifffile.imwrite(tmp_path / "in.tif", stack, photometric="minisblack", **options)
        with pytest.warns(UserWarning, match=r"in.tif has 4 pages, of which only the first is read"):
            opened = read_photograph(tmp_path / "in.tif")
        with contextlib.nullcontext() if name == "shaped" else pytest.warns(UserWarning, match="the description"):
            write_photograph(opened, tmp_path / "out.tif")
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "out.tif"), stack[0])


def test_pages_are_read_by_their_numbers_with_their_own_descriptions(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "in.tif") as file:
        for number, picture in enumerate((FULL, SMALL)):
            file.write(picture, description=f"picture {number}", **PLAIN)
        file.write(SMALL[:10], **REDUCED)
    for page, picture in enumerate((FULL, SMALL)):
        opened = read_photograph(tmp_path / "in.tif", page=page)
        assert torch.equal(opened.pixels, photograph(picture).pixels)
        assert tags(opened.exif)[0][270] == f"picture {page}"
    with pytest.raises(ValueError, match="page must be less than the number of pictures, 2, got 2; count from 0"):
        read_photograph(tmp_path / "in.tif", page=2)


@pytest.mark.parametrize("big", [False, True])
def test_photographs_are_written_as_pages(tmp_path: Path, big: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has its size, depth, and tags of its own, whatever the byte order of the first one."""
    monkeypatch.setattr(tiff, "MAX_CLASSIC_BYTES", 0 if big else 1 << 30)
    wanted = [
        replace(
            photograph(values, exif=camera_block(order, False)),
            extras=Extras(tags=(Tag(65000, 5, np.arange(4, dtype=order + "u4").tobytes(), order),), size=(1, 1)),
        )
        for values, order in ((FULL, ">"), (SMALL[..., :1].astype(np.uint16), "<"))
    ]
    with pytest.warns(UserWarning, match="without .*EXIF of pages after the first$"):
        write_photographs(iter(wanted), tmp_path / "out.tif", 2)
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert len(file.pages) == 2
        assert file.is_bigtiff == big
        assert [page.tags[65000].value for page in file.pages] == [(0, 1, 2, 3)] * 2
        assert [page.tags[271].value for page in file.pages] == ["Maker"] * 2
    for number, page in enumerate(wanted):
        opened = read_photograph(tmp_path / "out.tif", page=number)
        assert torch.equal(opened.pixels, page.pixels)
        assert opened.depth == page.depth


ORDERS = [("<", False), (">", False), ("<", True), (">", True)]


@some.composite
def tags_of_any_type(draw: some.DrawFn) -> list[tuple[int, int, bytes]]:
    """Tags with numbers of their own, their types and their values as bytes."""
    codes = draw(some.lists(some.integers(65000, 65400), min_size=1, max_size=6, unique=True))
    kinds = [draw(some.sampled_from(sorted(LENGTHS))) for _ in codes]
    return [
        (code, kind, draw(some.binary(min_size=length, max_size=length)))
        for code, kind in zip(codes, kinds, strict=True)
        for length in [LENGTHS[kind] * draw(some.integers(1, 5))]
    ]


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(tags=tags_of_any_type(), layouts=some.tuples(some.sampled_from(ORDERS), some.sampled_from(ORDERS)))
def test_tags_of_any_type_and_count_come_out_as_they_went_in(
    tmp_path_factory: pytest.TempPathFactory, tags: list[tuple[int, int, bytes]], layouts: Any
) -> None:
    """A file in each byte order, classic or big, is read, and its tags are written in each of them."""
    path = tmp_path_factory.getbasetemp() / "any.tif"
    (order, big), (written, large) = layouts
    stored = tuple(Tag(code, kind, data, order) for code, kind, data in sorted(tags))
    pixels = np.zeros((3, 4, 3), np.uint8)
    for tags_in, (byteorder, size) in ((stored, (order, big)), (None, (written, large))):
        if tags_in is None:
            with TiffRows(path) as rows:
                assert [(tag.code, tag.kind, tag.count) for tag in rows.metadata.extras.tags] == [
                    (tag.code, tag.kind, tag.count) for tag in stored
                ]
                tags_in = tuple(
                    Tag(tag.code, tag.kind, tag.in_order(byteorder), byteorder) for tag in rows.metadata.extras.tags
                )
        header = Header(pixels.shape, pixels.dtype, False, Metadata(extras=Extras(tags=tags_in)))
        with pytest.MonkeyPatch.context() as patch, path.open("w+b") as stream:
            patch.setattr(tiff, "MAX_CLASSIC_BYTES", 0 if size else 1 << 30)
            assert not tiff.write(stream, pixels, header)
    tables = TiffTables(path.read_bytes())
    assert (tables.order, tables.big) == (written, large)
    fields = {field.code: field for field in tables.fields(tables.first)}
    for tag in stored:
        assert (fields[tag.code].kind, fields[tag.code].count) == (tag.kind, tag.count)
        assert tables.raw(fields[tag.code]) == tag.in_order(written)
