"""XMP and the print resolution are copied between all file types; XMP and colours claim only what is in the file.

Errors of decoders become one sentence, and rows are regrouped.
"""

import contextlib
import io
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image, PngImagePlugin

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.files.jpeg import LONGEST_XMP
from nlfilter_torch.photo.files.metadata import (
    FURTHER_PICTURES,
    GAIN_MAP,
    MARKED_REGIONS,
    MOTION,
    Extras,
    UnhandledImage,
    bands,
    decoding,
    quiet,
    upright_packet,
)
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.files import photograph, stored_values
from tests.problems import cat

XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description tiff:Orientation="6" xmp:Rating="4"/>'
    b"<tiff:Orientation>3</tiff:Orientation></rdf:RDF></x:xmpmeta>"
)
UPRIGHT = XMP.replace(b'Orientation="6"', b'Orientation="1"').replace(b">3<", b">1<")
EXTRAS = Extras(UPRIGHT, (240.0, 300.0))
KINDS = [("a.jpg", "uint8"), ("a.png", "uint8"), ("a.png", "uint16"), ("a.tif", "uint16"), ("a.webp", "uint8")]
KINDS += [("a.avif", "uint8")]


def check(path: Path) -> None:
    extras = read_photograph(path).extras
    assert extras.xmp == UPRIGHT
    if path.suffix not in (".webp", ".avif"):  # have no such field
        assert extras.dpi == pytest.approx((240, 300), abs=0.02)


@pytest.mark.parametrize(("name", "depth"), KINDS)
def test_files_hold_them(tmp_path: Path, name: str, depth: str) -> None:
    path = tmp_path / name
    lacking = path.suffix in (".webp", ".avif")
    with pytest.warns(UserWarning, match="without .* the print resolution") if lacking else contextlib.nullcontext():
        write_photograph(Photograph(cat(4), depth, extras=EXTRAS), path)  # type: ignore[arg-type]
    check(path)
    with Image.open(path) as opened:  # as read by another program
        opened.load()


def test_what_other_programs_wrote(tmp_path: Path) -> None:
    picture = Image.fromarray((cat(4)[0].permute(1, 2, 0).numpy() * 255).astype(np.uint8))
    picture.save(tmp_path / "a.jpg", xmp=XMP, dpi=(240, 300))
    check(tmp_path / "a.jpg")
    for unit, factor in ((2, 1.0), (3, 2.54)):
        resolution = (240 / factor, 300 / factor)
        tag = [(700, "B", len(XMP), XMP, True)]
        tifffile.imwrite(
            tmp_path / "a.tif", np.asarray(picture), resolution=resolution, resolutionunit=unit, extratags=tag
        )
        check(tmp_path / "a.tif")
    picture.save(tmp_path / "plain.png")
    assert read_photograph(tmp_path / "plain.png").extras == Extras()
    tifffile.imwrite(tmp_path / "plain.tif", np.asarray(picture))
    assert read_photograph(tmp_path / "plain.tif").extras == Extras()


@pytest.mark.parametrize("depth", ["uint8", "uint16"])
def test_xmp_behind_the_pixels_of_a_png(tmp_path: Path, depth: str) -> None:
    path = tmp_path / "a.png"
    write_photograph(Photograph(cat(4), depth), path)  # type: ignore[arg-type]
    whole, text = path.read_bytes(), io.BytesIO()
    PngImagePlugin.putchunk(text, b"iTXt", b"XML:com.adobe.xmp" + bytes(5) + XMP)
    path.write_bytes(whole[:-12] + text.getvalue() + whole[-12:])
    assert read_photograph(path).extras.xmp == UPRIGHT


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize(("name", "depth"), [("in.tif", "uint16"), ("in.jpg", "uint8")])
def test_commands_carry_them(tmp_path: Path, name: str, depth: str) -> None:
    write_photograph(Photograph(cat(4), depth, extras=EXTRAS), tmp_path / name)  # type: ignore[arg-type]
    for out in ("out.tif", "out.png"):
        assert main(["tone", str(tmp_path / name), str(tmp_path / out), "--landmarks", "20"]) == 0
        check(tmp_path / out)


def test_fields_without_sense_are_dropped(tmp_path: Path) -> None:
    pixels = (cat(4)[0].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", pixels, extratags=[(296, "s", 0, "inches", True), (700, "s", 0, "", True)])
    assert read_photograph(tmp_path / "a.tif").extras == Extras()
    assert read_photograph(tmp_path / "a.tif").extras == Extras()


def test_what_a_file_cannot_hold_is_left_out(tmp_path: Path) -> None:
    long = Extras(b"<x>" + b" " * LONGEST_XMP + b"</x>")
    with pytest.warns(UserWarning, match="XMP of 65007 bytes, as JPEG holds at most 65000"):
        write_photograph(Photograph(cat(4), extras=long), tmp_path / "a.jpg")
    assert read_photograph(tmp_path / "a.jpg").extras == Extras()
    write_photograph(Photograph(cat(4), extras=long), tmp_path / "a.png")
    assert read_photograph(tmp_path / "a.png").extras.xmp == long.xmp


PACKET = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description
 xmlns:h="http://ns.adobe.com/hdr-gain-map/1.0/" xmlns:GCamera="http://ns.google.com/photos/1.0/camera/"
 xmlns:Container="http://ns.google.com/photos/1.0/container/" xmlns:Item="http://ns.google.com/photos/1.0/container/item/"
 h:Version="1.0" GCamera:MotionPhoto="1" GCamera:MotionPhotoVersion='1' GCamera:Other="2" xmp:Rating="4">
<Container:Directory><rdf:Seq><rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="Primary"/></rdf:li>
<rdf:li rdf:parseType="Resource"><Container:Item Item:Length="3"/></rdf:li></rdf:Seq></Container:Directory>
<h:Max>1</h:Max></rdf:Description></rdf:RDF></x:xmpmeta>"""


def test_statements_about_other_pictures_are_removed() -> None:
    packet, named = upright_packet(PACKET)
    assert packet is not None
    assert named == [GAIN_MAP, MOTION, FURTHER_PICTURES]
    for gone in (b"hdr-gain-map", b"h:", b"MotionPhoto", b"Container", b"Item"):
        assert gone not in packet.replace(b"xmp", b"").replace(b"http:", b"").replace(b"adobe:ns", b"")
    assert b'GCamera:Other="2" xmp:Rating="4"' in packet
    assert packet.count(b"xmlns:GCamera") == 1
    assert upright_packet(packet) == (packet, [])


def test_usual_prefixes_need_no_declaration() -> None:
    packet, named = upright_packet(b'<rdf:Description hdrgm:Version="1.0" GCamera:MotionPhoto="1" a:b="c"/>')
    assert packet == b'<rdf:Description a:b="c"/>'
    assert named == [GAIN_MAP, MOTION]
    assert upright_packet(None) == upright_packet(b" \n") == (None, [])


FACES = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description xmlns:MP="http://ns.microsoft.com/photo/1.2/"
 xmlns:mwg="http://www.metadataworkinggroup.com/schemas/regions/" xmlns:stArea="http://ns.adobe.com/xmp/sType/Area#"
 xmp:Rating="4"><mwg:Regions rdf:parseType="Resource"><mwg:RegionList><rdf:Bag><rdf:li><rdf:Description mwg:Name="Ann">
<mwg:Area stArea:x="0.2" stArea:y="0.3"/></rdf:Description></rdf:li></rdf:Bag></mwg:RegionList></mwg:Regions>
<MP:RegionInfo><rdf:li/></MP:RegionInfo></rdf:Description></rdf:RDF></x:xmpmeta>"""


def test_places_in_a_turned_picture_are_removed() -> None:
    assert upright_packet(FACES) == (FACES, [])
    packet, named = upright_packet(FACES, 6)
    assert packet is not None
    assert set(named) == {MARKED_REGIONS}
    assert b"Area " not in packet
    assert b"mwg" not in packet
    assert b"MP:" not in packet
    assert b'xmp:Rating="4"' in packet


def test_long_padding_takes_little_time() -> None:
    packet = PACKET.replace(b"</x:xmpmeta>", b" " * 1_000_000 + b"</x:xmpmeta>")  # quadratic time would be an hour
    assert upright_packet(packet)[1] == [GAIN_MAP, MOTION, FURTHER_PICTURES]


def with_chunk(path: Path, name: bytes, content: bytes) -> None:
    """Write a PNG file with a chunk before the pixels."""
    Image.fromarray(stored_values(3, "uint8")).save(path)
    chunk, whole = io.BytesIO(), path.read_bytes()
    PngImagePlugin.putchunk(chunk, name, content)
    path.write_bytes(whole[:33] + chunk.getvalue() + whole[33:])


WIDE = (31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        (b"gAMA", struct.pack(">I", 100_000), "has a gamma of 1 without a colour profile, which the output will not"),
        (b"cHRM", struct.pack(">8I", *WIDE), "has other primaries than sRGB without a colour profile"),
        (b"cICP", bytes((12, 13, 0, 1)), "has Display P3 without a colour profile"),
        (b"cICP", bytes((9, 8, 0, 1)), "has BT.2020 and linear light without a colour profile"),
    ],
)
def test_colours_that_png_describes_by_numbers(tmp_path: Path, name: bytes, content: bytes, sentence: str) -> None:
    path = tmp_path / "in.png"
    with_chunk(path, name, content)
    with pytest.warns(UserWarning, match=sentence):
        opened = read_photograph(path)
    assert torch.equal(opened.pixels, photograph(stored_values(3, "uint8")).pixels)


USUAL = [
    (b"gAMA", struct.pack(">I", 45_455)),
    (b"gAMA", bytes(4)),
    (b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)),
    (b"cICP", bytes((1, 13, 0, 1))),
    (b"cICP", bytes((2, 2, 0, 1))),
]


def test_usual_colours_of_png_cause_no_warning(tmp_path: Path) -> None:
    for name, content in USUAL:
        with_chunk(tmp_path / "in.png", name, content)
        read_photograph(tmp_path / "in.png")


def test_colours_that_avif_describes_by_numbers(tmp_path: Path) -> None:
    path = tmp_path / "in.avif"
    Image.fromarray(stored_values(3, "uint8")).save(path)
    whole = path.read_bytes()
    place = whole.index(b"colrnclx") + 8
    path.write_bytes(whole[:place] + struct.pack(">HH", 12, 13) + whole[place + 4 :])
    with pytest.warns(UserWarning, match=r"in\.avif has Display P3 without a colour profile"):
        read_photograph(path)
    path.write_bytes(whole[:place] + struct.pack(">HH", 9, 18) + whole[place + 4 :])
    with pytest.raises(ValueError, match=r"in\.avif is an HDR picture \(HLG\), which is not supported; convert it"):
        read_photograph(path)


def test_errors_of_decoders_are_damage() -> None:
    with (
        pytest.raises(ValueError, match=r"^a\.png is damaged or cut short \(bad\); copy it again"),
        decoding(Path("a.png")),
    ):
        raise OSError("bad")
    with pytest.raises(ValueError, match="EOFError"), decoding(Path("a.png")):
        raise EOFError
    for kept in (UnhandledImage("of another kind"), MemoryError("too large")):
        with pytest.raises(type(kept), match=str(kept)), decoding(Path("a.png")):
            raise kept


def test_rows_are_regrouped() -> None:
    rows = np.arange(23).reshape(23, 1, 1)
    pieces = list(bands((rows[top : top + 5] for top in range(0, 23, 5)), 4))
    assert [len(piece) for piece in pieces] == [4, 4, 4, 4, 4, 3]
    np.testing.assert_array_equal(np.concatenate(pieces), rows)
    assert list(bands([], 4)) == []


def test_warnings_of_pillow_are_suppressed() -> None:
    with quiet():
        warnings.warn("damaged EXIF", stacklevel=1)
