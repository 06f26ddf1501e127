"""Image files: every type and depth keeps exact values, alpha, EXIF and profile; bad files get one sentence."""

import contextlib
import io
import itertools
import os
import stat
from pathlib import Path

import imagecodecs
import numpy as np
import psutil
import pytest
import tifffile
import torch
from PIL import ExifTags, Image, ImageCms, ImageOps

from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.io.writing import check_folder

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
INTEGERS = ("uint8", "uint16")
CHANNELS = (1, 2, 3, 4)  # grey, grey + alpha, RGB, RGBA


def stored_values(channels: int, depth: str) -> np.ndarray:
    """Pseudo-random values (5, 7, channels) of ``depth``, including the extremes."""
    draw = np.random.default_rng(channels)
    if depth.startswith("float"):
        return draw.normal(0.5, 1, (5, 7, channels)).astype(depth)
    limit = np.iinfo(depth).max
    values = draw.integers(0, limit, (5, 7, channels), dtype=depth, endpoint=True)
    values[0, :2] = [[0], [limit]]
    return values


def photograph(values: np.ndarray, **fields: bytes) -> Photograph:
    """The photograph expected from a file with ``values``."""
    integer = np.issubdtype(values.dtype, np.integer)
    kind = np.float64 if values.dtype == np.float64 else np.float32
    scaled = values.astype(kind) / (np.iinfo(values.dtype).max if integer else 1)
    planes = torch.from_numpy(scaled.astype(kind)).permute(2, 0, 1)[None]
    colours = 3 if planes.shape[1] >= 3 else 1
    alpha = planes[:, colours:] if planes.shape[1] > colours else None
    return Photograph(planes[:, :colours], values.dtype.name, alpha, **fields)  # type: ignore[arg-type]


def exif_block(orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    exif[ExifTags.Base.Orientation] = orientation
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.ExifImageWidth] = 7
    details[ExifTags.Base.ExifImageHeight] = 5
    details[ExifTags.Base.LensModel] = "a lens with a long name"
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    return exif.tobytes()


def tags(block: bytes | None) -> tuple[dict[int, object], dict[int, object], dict[int, object]]:
    exif = Image.Exif()
    exif.load(block or b"")
    folders = (int(ExifTags.IFD.Exif), int(ExifTags.IFD.GPSInfo))
    main = {code: value for code, value in exif.items() if code not in folders}
    return main, dict(exif.get_ifd(folders[0])), dict(exif.get_ifd(folders[1]))


def same(found: Photograph, wanted: Photograph) -> None:
    assert found.depth == wanted.depth
    assert found.pixels.dtype == wanted.pixels.dtype
    assert torch.equal(found.pixels, wanted.pixels)
    assert (found.alpha is None) == (wanted.alpha is None)
    assert found.alpha is None or torch.equal(found.alpha, wanted.alpha)
    assert found.icc == wanted.icc
    assert tags(found.exif) == tags(wanted.exif)


LOSSLESS = [
    *itertools.product([".png"], INTEGERS, CHANNELS),
    *itertools.product([".tif"], ["uint8", "uint16", "float16", "float32", "float64"], CHANNELS),
    *itertools.product([".webp"], ["uint8"], [3, 4]),
]


@pytest.mark.parametrize(("suffix", "depth", "channels"), LOSSLESS)
@pytest.mark.parametrize("metadata", [False, True])
def test_round_trip_is_exact(tmp_path: Path, suffix: str, depth: str, channels: int, metadata: bool) -> None:
    fields = {"icc": PROFILE, "exif": exif_block()} if metadata else {}
    wanted = photograph(stored_values(channels, depth), **fields)
    write_photograph(wanted, tmp_path / f"out{suffix}")
    same(read_photograph(tmp_path / f"out{suffix}"), wanted)
    assert [file.name for file in tmp_path.iterdir()] == [f"out{suffix}"]


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("depth", INTEGERS)
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
    found = read_photograph(tmp_path / "out.JPG")
    assert found.depth == "uint8"
    assert (found.pixels - wanted.pixels).abs().max() < 6 / 255
    assert found.icc == PROFILE
    assert tags(found.exif) == tags(wanted.exif)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_avif_keeps_metadata_and_looks(tmp_path: Path, channels: int) -> None:
    """Grey photographs are stored in colour."""
    ramp = np.linspace(0, 255, 64 * 64).reshape(64, 64, 1).repeat(channels, -1).round().astype(np.uint8)
    wanted = photograph(ramp, icc=PROFILE, exif=exif_block())
    write_photograph(wanted, tmp_path / "out.avif")
    found = read_photograph(tmp_path / "out.avif")
    assert found.depth == "uint8"
    assert (found.pixels - wanted.pixels).abs().max() < 6 / 255
    assert (found.alpha is None) == (channels < 4)
    assert found.alpha is None or (found.alpha - wanted.alpha).abs().max() < 6 / 255
    assert found.icc == PROFILE
    assert tags(found.exif) == tags(wanted.exif)


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_deep_avif_is_read_at_sixteen_bits(tmp_path: Path, bits: int) -> None:
    values = (np.linspace(0, 1, 64 * 48 * 3).reshape(48, 64, 3) * (2**bits - 1)).round()
    stored = imagecodecs.avif_encode(values.astype(np.uint8 if bits == 8 else np.uint16), level=100, bitspersample=bits)
    (tmp_path / "in.avif").write_bytes(stored)
    found = read_photograph(tmp_path / "in.avif")
    assert found.depth == ("uint8" if bits == 8 else "uint16")
    wanted = torch.from_numpy(values / (2**bits - 1)).permute(2, 0, 1)[None].float()
    assert (found.pixels - wanted).abs().max() < 3 / 2**bits


def test_avif_is_turned_upright(tmp_path: Path) -> None:
    values = np.zeros((32, 48, 3), np.uint8)
    values[:16, :24] = 255
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(values).save(tmp_path / "in.avif", exif=exif)
    found = read_photograph(tmp_path / "in.avif").pixels
    assert found.shape == (1, 3, 48, 32)
    assert found[0, 0, 12, 24] > 0.9 > 0.1 > found[0, 0, 12, 8]


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_exif_orientation_is_applied_and_reset(tmp_path: Path, orientation: int, suffix: str) -> None:
    values = stored_values(3, "uint8")
    image, exif = Image.fromarray(values), exif_block(orientation)
    image.save(tmp_path / f"in{suffix}", exif=exif)
    image.save(tmp_path / "with_tag.png", exif=exif)
    with Image.open(tmp_path / "with_tag.png") as stored:
        upright = np.asarray(ImageOps.exif_transpose(stored))
    found = read_photograph(tmp_path / f"in{suffix}")
    assert torch.equal(found.pixels, photograph(upright).pixels)
    main, details, gps = tags(found.exif)
    assert main == {ExifTags.Base.Make: "Maker", ExifTags.Base.Orientation: 1}
    height, width = found.pixels.shape[-2:]
    assert (details[ExifTags.Base.ExifImageWidth], details[ExifTags.Base.ExifImageHeight]) == (width, height)
    assert details[ExifTags.Base.LensModel] == "a lens with a long name"
    assert gps == {ExifTags.GPS.GPSLatitudeRef: "N"}
    write_photograph(found, tmp_path / f"again{suffix}")
    same(read_photograph(tmp_path / f"again{suffix}"), found)


def test_stored_kinds_are_made_plain(tmp_path: Path) -> None:
    """Palettes (with and without a transparent entry), bits, inverted grey, premultiplied alpha, separate planes."""
    palette = Image.fromarray(stored_values(3, "uint8")).quantize(4)
    palette.save(tmp_path / "palette.png")
    palette.save(tmp_path / "transparent.png", transparency=1)
    Image.fromarray(np.eye(4, dtype=bool)).save(tmp_path / "bits.png")
    assert torch.equal(
        read_photograph(tmp_path / "palette.png").pixels, photograph(np.asarray(palette.convert("RGB"))).pixels
    )
    clear = read_photograph(tmp_path / "transparent.png").alpha
    assert clear is not None
    assert torch.equal(clear[0, 0], torch.from_numpy(np.asarray(palette) != 1).float())
    assert torch.equal(read_photograph(tmp_path / "bits.png").pixels[0, 0], torch.eye(4))

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


def bad_file(folder: Path, kind: str) -> Path:
    """A file that must be refused."""
    values, path = stored_values(3, "uint8"), folder / f"{kind.replace(' ', '_')}.png"
    whole = io.BytesIO()
    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    if kind == "empty":
        path.touch()
    elif kind == "folder":
        path.mkdir()
    elif kind == "text":
        path.write_text("not an image at all, but long enough to have a header")
    elif kind.startswith("truncated"):
        if kind.endswith("16 bit PNG"):
            whole.write(imagecodecs.png_encode(np.asarray(image).astype(np.uint16) * 257))
        elif kind.endswith("packed TIFF"):
            tifffile.imwrite(whole, np.asarray(image), photometric="rgb", compression="zlib")
        else:
            image.save(whole, format=kind.split()[-1])
        path.write_bytes(whole.getvalue()[: len(whole.getvalue()) * 2 // 3])
    elif kind == "headless TIFF":
        path.write_bytes(b"II*\0\x08\0\0\0")
    elif kind == "gif":
        image.save(path, format="GIF")
    elif kind == "animation":
        image.save(path, format="WEBP", save_all=True, append_images=[image.rotate(90)])
    elif kind == "cmyk":
        image.convert("CMYK").save(path, format="JPEG")
    elif kind == "cmyk TIFF":
        tifffile.imwrite(path, stored_values(4, "uint8"), photometric="separated")
    elif kind == "int16 TIFF":
        tifffile.imwrite(path, values.astype(np.int16), photometric="rgb")
    elif kind == "12 bit TIFF":
        tifffile.imwrite(path, values[..., 0].astype(np.uint16), photometric="minisblack", bitspersample=12)
    elif kind == "five channel TIFF":
        five = np.zeros((4, 4, 5), np.uint8)
        tifffile.imwrite(path, five, photometric="rgb", planarconfig="contig", extrasamples=[0, 0])
    elif kind == "volume TIFF":
        tifffile.imwrite(path, np.zeros((32, 32, 32), np.uint8), volumetric=True, tile=(16, 16, 16))
    elif kind == "nan TIFF":
        tifffile.imwrite(path, np.full((4, 4), np.nan, np.float32))
    return path


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
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
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, kind: str, sentence: str) -> None:
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


def test_a_decompression_bomb_is_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "in.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 30)  # between this limit and twice as much, Pillow warns
    read_photograph(tmp_path / "in.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 3)
    with pytest.raises(MemoryError, match="is too large"):
        read_photograph(tmp_path / "in.png")


@pytest.mark.parametrize(
    ("name", "depth", "channels", "sentence"),
    [
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
    ],
)
def test_outputs_that_cannot_hold_the_picture(
    tmp_path: Path, name: str, depth: str, channels: int, sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        write_photograph(photograph(stored_values(channels, depth)), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_folder_is_no_output(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a folder; add a file name to it"):
        write_photograph(photograph(stored_values(3, "uint8")), tmp_path)


def test_a_read_only_folder_is_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write anywhere
    with pytest.raises(ValueError, match="is read-only; choose another"):
        write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "out.png")
    with pytest.raises(ValueError, match="is read-only; choose another"):
        check_folder(tmp_path)


def test_a_read_only_file_is_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "out.png").write_bytes(b"kept")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).is_dir())  # root may write anywhere
    with pytest.raises(ValueError, match=r"out\.png is read-only; allow writing to it, or choose another name"):
        write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "out.png")
    assert (tmp_path / "out.png").read_bytes() == b"kept"
    write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "new.png")


def test_output_folders(tmp_path: Path) -> None:
    check_folder(tmp_path)
    check_folder(tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is a file, not a folder"):
        check_folder(tmp_path / "file")
    with pytest.raises(ValueError, match="does not exist; make it first"):
        check_folder(tmp_path / "new" / "newer")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.png"
    path.write_bytes(b"old")

    def fail(self: Image.Image, stream: io.BufferedRandom, **options: object) -> None:
        stream.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        write_photograph(photograph(stored_values(3, "uint8")), path)
    assert [file.name for file in tmp_path.iterdir()] == ["out.png"]
    assert path.read_bytes() == b"old"


def test_written_files_have_the_usual_permissions(tmp_path: Path) -> None:
    write_photograph(photograph(stored_values(3, "uint8")), tmp_path / "out.png")
    (tmp_path / "plain").touch()
    modes = {stat.S_IMODE(file.stat().st_mode) for file in tmp_path.iterdir()}
    assert len(modes) == 1
