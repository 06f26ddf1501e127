"""XMP and the print resolution are copied from every file type to every other, in memory and in tiles."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, PngImagePlugin

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.files.extras import Extras
from nlfilter_torch.photo.files.jpeg import LONGEST_XMP
from nlfilter_torch.photo.files.photographs import Photograph, read_photograph, write_photograph
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
