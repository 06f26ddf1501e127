"""Every type and depth keeps exact values, alpha, EXIF and profile; bad files and outputs get one sentence."""

import contextlib
import io
import itertools
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import numpy as np
import psutil
import pytest
import tifffile
import torch
from PIL import ExifTags, Image

from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.files import CHANNELS, INTEGERS, PROFILE, exif_block, photograph, same, stored_values, tags
from tests.pairwise import each_value

LOSSLESS = [
    *itertools.product([".png"], INTEGERS, CHANNELS),
    *itertools.product([".tif"], ["uint8", "uint16", "float16", "float32", "float64"], CHANNELS),
    *itertools.product([".webp"], ["uint8"], [3, 4]),
]


@pytest.mark.parametrize(("suffix", "depth", "channels"), LOSSLESS)
def test_round_trip_is_exact(tmp_path: Path, suffix: str, depth: str, channels: int) -> None:
    for fields in ({}, {"icc": PROFILE, "exif": exif_block()}):
        wanted = photograph(stored_values(channels, depth), **fields)
        write_photograph(wanted, tmp_path / f"out{suffix}")
        same(read_photograph(tmp_path / f"out{suffix}"), wanted)
        assert [file.name for file in tmp_path.iterdir()] == [f"out{suffix}"]


@pytest.mark.parametrize(("channels", "depth"), each_value(CHANNELS, INTEGERS))
def test_png_of_other_writers(tmp_path: Path, channels: int, depth: str) -> None:
    values = stored_values(channels, depth)
    (tmp_path / "in.png").write_bytes(imagecodecs.png_encode(values))
    same(read_photograph(tmp_path / "in.png"), photograph(values))


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("depth", INTEGERS)
def test_our_png_and_tiff_are_read_by_others(tmp_path: Path, channels: int, depth: str) -> None:
    values = stored_values(channels, depth)
    wanted = photograph(values, icc=PROFILE, exif=exif_block())
    write_photograph(wanted, tmp_path / "out.png")
    write_photograph(wanted, tmp_path / "out.tif")
    decoded = imagecodecs.png_decode((tmp_path / "out.png").read_bytes())
    assert np.array_equal(decoded.reshape(values.shape), values)
    assert np.array_equal(tifffile.imread(tmp_path / "out.tif").reshape(values.shape), values)
    for name in ("out.png", "out.tif") if depth == "uint8" else ("out.png",):
        with Image.open(tmp_path / name) as image:
            assert image.info["icc_profile"] == PROFILE
            assert image.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.LensModel] == "a lens with a long name"


@pytest.mark.parametrize("channels", [1, 3])
def test_jpeg_keeps_metadata_and_looks(tmp_path: Path, channels: int) -> None:
    ramp = np.linspace(0, 255, 64 * 64).reshape(64, 64, 1).repeat(channels, -1).round().astype(np.uint8)
    wanted = photograph(ramp, icc=PROFILE, exif=exif_block())
    write_photograph(wanted, tmp_path / "out.JPG")
    opened = read_photograph(tmp_path / "out.JPG")
    assert opened.depth == "uint8"
    assert (opened.pixels - wanted.pixels).abs().max() < 6 / 255
    assert opened.icc == PROFILE
    assert tags(opened.exif) == tags(wanted.exif)


def test_integers_are_clipped_and_rounded_floats_are_not(tmp_path: Path) -> None:
    pixels = torch.tensor([-0.5, 0.4999 / 255, 0.5001 / 255, 1.5]).view(1, 1, 1, 4)
    write_photograph(Photograph(pixels), tmp_path / "out.png")
    assert (255 * read_photograph(tmp_path / "out.png").pixels).round().flatten().tolist() == [0, 0, 1, 255]
    write_photograph(Photograph(pixels, "float32"), tmp_path / "out.tif")
    assert torch.equal(read_photograph(tmp_path / "out.tif").pixels, pixels)


def test_with_pixels_detaches_and_keeps_the_dtype() -> None:
    original = Photograph(torch.zeros(1, 1, 2, 2), exif=exif_block())
    edited = original.with_pixels(torch.ones(1, 1, 2, 2, dtype=torch.float64, requires_grad=True))
    assert edited.exif == original.exif
    assert edited.pixels.dtype == torch.float32
    assert not edited.pixels.requires_grad


NOISE = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
#: Write each kind of file that must be refused.
BAD_FILES: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.touch(),
    "folder": lambda path: path.mkdir(),
    "text": lambda path: path.write_text("not an image at all, but long enough to have a header"),
    "headless TIFF": lambda path: path.write_bytes(b"II*\0\x08\0\0\0"),
    "gif": lambda path: Image.fromarray(NOISE).save(path, format="GIF"),
    "animation": lambda path: Image.fromarray(NOISE).save(
        path, format="WEBP", save_all=True, append_images=[Image.fromarray(NOISE).rotate(90)]
    ),
    "cmyk": lambda path: Image.fromarray(NOISE).convert("CMYK").save(path, format="JPEG"),
    "cmyk TIFF": lambda path: tifffile.imwrite(path, stored_values(4, "uint8"), photometric="separated"),
    "int16 TIFF": lambda path: tifffile.imwrite(path, stored_values(3, "uint8").astype(np.int16), photometric="rgb"),
    "12 bit TIFF": lambda path: tifffile.imwrite(
        path, stored_values(3, "uint8")[..., 0].astype(np.uint16), photometric="minisblack", bitspersample=12
    ),
    "five channel TIFF": lambda path: tifffile.imwrite(
        path, np.zeros((4, 4, 5), np.uint8), photometric="rgb", planarconfig="contig", extrasamples=[0, 0]
    ),
    "volume TIFF": lambda path: tifffile.imwrite(
        path, np.zeros((32, 32, 32), np.uint8), volumetric=True, tile=(16, 16, 16)
    ),
    "nan TIFF": lambda path: tifffile.imwrite(path, np.full((4, 4), np.nan, np.float32)),
}


def truncated(kind: str) -> bytes:
    """Two thirds of a file of a type."""
    whole = io.BytesIO()
    if kind == "16 bit PNG":
        whole.write(imagecodecs.png_encode(NOISE.astype(np.uint16) * 257))
    elif kind == "packed TIFF":
        tifffile.imwrite(whole, NOISE, photometric="rgb", compression="zlib")
    else:
        Image.fromarray(NOISE).save(whole, format=kind)
    return whole.getvalue()[: len(whole.getvalue()) * 2 // 3]


def bad_file(folder: Path, kind: str) -> Path:
    """A file that must be refused."""
    path = folder / f"{kind.replace(' ', '_')}.png"
    if kind.startswith("truncated "):
        path.write_bytes(truncated(kind.removeprefix("truncated ")))
    else:
        BAD_FILES[kind](path)
    return path


REFUSED_FILES = [
    ("missing", "does not exist"),
    ("folder", "is a folder"),
    ("empty", "is empty"),
    ("text", "is not a PNG, JPEG, TIFF, WebP or AVIF image"),
    ("gif", "is not a PNG, JPEG, TIFF, WebP or AVIF image"),
    ("truncated PNG", "is damaged or cut short"),
    ("truncated 16 bit PNG", "is damaged or cut short"),
    ("truncated JPEG", "is damaged or cut short"),
    ("truncated WEBP", "is damaged or cut short"),
    ("truncated TIFF", "is damaged or cut short"),
    ("truncated packed TIFF", "is damaged or cut short"),
    ("headless TIFF", "is damaged or cut short"),
    ("animation", "is an animation of 2 frames"),
    ("cmyk", "is stored in CMYK colours"),
    ("cmyk TIFF", "is stored in SEPARATED colours"),
    ("int16 TIFF", "stores its channels as int16"),
    ("12 bit TIFF", "has 12 bits per channel"),
    ("five channel TIFF", "has 5 channels"),
    ("volume TIFF", "has the axes"),
    ("nan TIFF", "holds NaN or infinite pixels"),
]


def test_bad_files_are_refused_in_one_sentence(tmp_path: Path) -> None:
    for kind, sentence in REFUSED_FILES:
        path = bad_file(tmp_path, kind)
        with pytest.raises((ValueError, FileNotFoundError), match=sentence) as caught:
            read_photograph(path)
        assert str(caught.value).startswith(str(path))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_too_large_is_refused_before_decoding(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"in{suffix}"
    write_photograph(photograph(stored_values(3, "uint8")), path)
    free = psutil.virtual_memory()._replace(available=35 * 1000 - 1)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    read_photograph(path, bytes_per_pixel=999)
    with pytest.raises(MemoryError, match=r"has 7x5 pixels and needs about 0 MB of memory"):
        read_photograph(path, bytes_per_pixel=1000)


def test_floats_of_64_bits_need_twice_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = psutil.virtual_memory()._replace(available=35 * 1000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    for depth, fits in (("float32", True), ("float64", False)):
        write_photograph(photograph(stored_values(3, depth)), tmp_path / "in.tif")
        with contextlib.nullcontext() if fits else pytest.raises(MemoryError, match="use fewer landmarks"):
            read_photograph(tmp_path / "in.tif", bytes_per_pixel=600)


REFUSED_OUTPUTS = [
    ("nowhere/out.png", "uint8", 3, "because the folder .* does not exist; make it first"),
    ("out.gif", "uint8", 3, r"must end in .png, .jpg, .webp, .avif or .tif, got '.gif'"),
    ("out", "uint8", 3, r"must end in .*, got ''"),
    ("out.jpg", "uint8", 4, "JPEG has no alpha channel; write a PNG, TIFF, WebP or AVIF file"),
    (
        "out.jpeg",
        "uint16",
        3,
        "JPEG has no 16 bits per channel; write a PNG or TIFF file or choose a depth of 8 bits",
    ),
    ("out.webp", "uint16", 3, "WebP has no 16 bits per channel"),
    ("out.avif", "uint16", 3, "AVIF has no 16 bits per channel"),
    ("out.png", "float32", 3, "PNG has no floats per channel; write a TIFF file or choose a depth of 16 bits"),
]


def test_outputs_that_cannot_hold_the_picture(tmp_path: Path) -> None:
    for name, depth, channels, sentence in REFUSED_OUTPUTS:
        with pytest.raises(ValueError, match=sentence):
            write_photograph(photograph(stored_values(channels, depth)), tmp_path / name)
        assert not list(tmp_path.iterdir())
