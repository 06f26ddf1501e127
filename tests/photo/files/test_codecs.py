"""AVIF, RAW and HEIC files, palettes and decompression bombs."""

import struct
import subprocess
import sys
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import skimage.data
import tifffile
import torch
from PIL import ExifTags, Image, ImageCms

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.files.codecs import is_heic
from nlfilter_torch.photo.files.formats import TooLarge
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph
from nlfilter_torch.photo.picture.pictures import stored_as
from tests.files import PROFILE, camera_block, exif_block, fields_of, photograph, rows_of, stored_values, tags


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_avif_keeps_metadata_and_looks(tmp_path: Path, channels: int) -> None:
    """Grey photographs are stored in colour."""
    ramp = np.linspace(0, 255, 64 * 64).reshape(64, 64, 1).repeat(channels, -1).round().astype(np.uint8)
    wanted = photograph(ramp, icc=PROFILE, exif=exif_block())
    write_photograph(wanted, tmp_path / "out.avif")
    opened = read_photograph(tmp_path / "out.avif")
    assert opened.depth == "uint8"
    assert (opened.pixels - wanted.pixels).abs().max() < 6 / 255
    assert (opened.alpha is None) == (channels < 4)
    assert opened.alpha is None or (opened.alpha - wanted.alpha).abs().max() < 6 / 255
    assert opened.icc == PROFILE
    assert tags(opened.exif) == tags(wanted.exif)


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_deep_avif_is_read_at_sixteen_bits(tmp_path: Path, bits: int) -> None:
    values = (np.linspace(0, 1, 64 * 48 * 3).reshape(48, 64, 3) * (2**bits - 1)).round()
    stored = imagecodecs.avif_encode(values.astype(np.uint8 if bits == 8 else np.uint16), level=100, bitspersample=bits)
    (tmp_path / "in.avif").write_bytes(stored)
    opened = read_photograph(tmp_path / "in.avif")
    assert opened.depth == ("uint8" if bits == 8 else "uint16")
    wanted = torch.from_numpy(values / (2**bits - 1)).permute(2, 0, 1)[None].float()
    assert (opened.pixels - wanted).abs().max() < 3 / 2**bits


def test_avif_is_turned_upright(tmp_path: Path) -> None:
    values = np.zeros((32, 48, 3), np.uint8)
    values[:16, :24] = 255
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(values).save(tmp_path / "in.avif", exif=exif)
    opened = read_photograph(tmp_path / "in.avif").pixels
    assert opened.shape == (1, 3, 48, 32)
    assert opened[0, 0, 12, 24] > 0.9 > 0.1 > opened[0, 0, 12, 8]


def test_palettes_and_bits_are_made_plain(tmp_path: Path) -> None:
    """Palettes, with and without a transparent entry, and bits."""
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


def test_the_limits_of_pillow_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of any size are read; pictures larger than the memory are refused, see test_photographs."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 3)
    for name in ("in.png", "in.jpg", "in.webp", "in.avif"):
        write_photograph(photograph(np.full((16, 16, 3), 90, np.uint8)), tmp_path / name)
        assert read_photograph(tmp_path / name).size == (16, 16)


@pytest.mark.parametrize("side", [17_000, 40_000])
def test_the_limits_of_libavif_are_named(tmp_path: Path, side: int) -> None:
    write_photograph(photograph(np.full((16, 16, 3), 90, np.uint8)), tmp_path / "in.avif")
    stored = (tmp_path / "in.avif").read_bytes()
    place = stored.index(b"ispe") + 8
    (tmp_path / "in.avif").write_bytes(stored[:place] + struct.pack(">II", side, side) + stored[place + 8 :])
    with pytest.raises(ValueError, match=rf"has {side}x{side} pixels, and libavif, which decodes it, takes at most"):
        read_photograph(tmp_path / "in.avif")


SCENE = skimage.data.astronaut()[60:124, 130:210]
SRGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
# From CIE XYZ to linear sRGB, the colour space of this camera.
SRGB = np.linalg.inv([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def write_dng(path: Path, scene: np.ndarray, orientation: int = 1) -> None:
    """Write a scene in sRGB as the file of a camera with a Bayer filter and white at 16,000."""
    light = scene / 255.0
    light = np.where(light <= 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)
    mosaic = light[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = light[::2, ::2, 0], light[1::2, 1::2, 2]
    matrix = [part for value in SRGB.ravel() for part in (round(value * 10000), 10000)]
    tags = [
        (274, "H", 1, orientation, True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, (0, 1, 1, 2), True),
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "Synthetic", True),
        (50717, "I", 1, 16000, True),
        (50721, "2i", 9, matrix, True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
        (50778, "H", 1, 21, True),
    ]
    data = np.rint(16000 * mosaic).astype(np.uint16)
    tifffile.imwrite(path, data, photometric=32803, extratags=tags, metadata=None)


def test_raw_is_developed_at_sixteen_bits(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "in.dng", SCENE)
    opened = read_photograph(tmp_path / "in.dng")
    assert opened.depth == "uint16"
    pixels = opened.pixels[0].permute(1, 2, 0).numpy()
    assert pixels.shape == SCENE.shape
    # LibRaw develops with the curve of BT.709, whose middle tones are darker than those of sRGB.
    assert np.corrcoef(pixels.ravel(), SCENE.ravel())[0, 1] > 0.98
    assert np.abs(pixels.mean((0, 1)) - SCENE.mean((0, 1)) / 255).max() < 0.06
    write_dng(tmp_path / "turned.dng", SCENE, orientation=6)
    turned = read_photograph(tmp_path / "turned.dng").pixels[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(turned, np.rot90(pixels, -1), atol=1e-6)
    with pytest.raises(TooLarge, match="80x64 pixels"):
        read_photograph(tmp_path / "in.dng", bytes_per_pixel=100, memory=1000)


def test_raw_is_developed_whatever_the_suffix_and_in_tiles_too(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    for suffix in (".dng", ".tif"):
        write_dng(tmp_path / f"in{suffix}", SCENE)
    wanted = read_photograph(tmp_path / "in.dng")
    assert torch.equal(read_photograph(tmp_path / "in.tif").pixels, wanted.pixels)
    for suffix in (".dng", ".tif"):
        np.testing.assert_array_equal(rows_of(tmp_path / f"in{suffix}"), stored_as(wanted.pixels, "uint16"))


def test_a_command_takes_raw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "in.dng", SCENE)
    options = ["--landmarks", "20"]
    assert main(["tone", str(tmp_path / "in.dng"), str(tmp_path / "out.png"), *options]) == 0
    assert read_photograph(tmp_path / "out.png").depth == "uint16"
    assert main(["tone", str(tmp_path / "in.dng"), str(tmp_path / "out.jpg"), *options]) == 2
    assert "JPEG has no 16 bits per channel; write a PNG or TIFF file or choose" in capsys.readouterr().err
    assert main(["tone", str(tmp_path / "in.dng"), str(tmp_path / "out.jpg"), *options, "--depth", "8"]) == 0
    assert main(["tone", str(tmp_path / "in.dng"), str(tmp_path / "out.dng"), *options]) == 2
    assert "must end in .png, .jpg, .webp, .avif or .tif, got '.dng'" in capsys.readouterr().err
    (tmp_path / "bad.cr2").write_bytes(b"II*\0 nothing of a camera")
    assert main(["tone", str(tmp_path / "bad.cr2"), str(tmp_path / "out.png")]) == 2
    assert "bad.cr2 cannot be read as a RAW file, or is damaged" in capsys.readouterr().err


def test_heic_is_read_upright_with_its_notes(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Make] = 6, "A camera"
    heif.from_pillow(Image.fromarray(SCENE)).save(tmp_path / "in.heic", quality=95, exif=exif.tobytes())
    opened = read_photograph(tmp_path / "in.heic")
    assert opened.depth == "uint8"
    pixels = opened.pixels[0].permute(1, 2, 0).numpy()
    assert np.abs(pixels - np.rot90(SCENE, -1) / 255).mean() < 4 / 255
    kept = Image.Exif()
    kept.load(opened.exif or b"")
    assert kept[ExifTags.Base.Make] == "A camera"
    assert kept.get(ExifTags.Base.Orientation, 1) == 1
    with pytest.raises(TooLarge, match="64x80 pixels"):
        read_photograph(tmp_path / "in.heic", bytes_per_pixel=100, memory=1000)
    whole = (tmp_path / "in.heic").read_bytes()
    (tmp_path / "cut.heic").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut\.heic"):
        read_photograph(tmp_path / "cut.heic")


def test_deep_heic_is_read_at_sixteen_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heif = pytest.importorskip("pillow_heif")
    monkeypatch.setattr(heif.options, "SAVE_HDR_TO_12_BIT", False)
    grey = np.linspace(0, 65535, 64 * 80).reshape(64, 80, 1).repeat(3, 2).astype(np.uint16)
    heif.encode("RGB;16", (80, 64), grey.tobytes(), tmp_path / "in.heic", quality=-1)
    opened = read_photograph(tmp_path / "in.heic")
    assert opened.depth == "uint16"
    assert np.abs(opened.pixels[0].permute(1, 2, 0).numpy() - grey / 65535).max() < 4 / 1023
    assert float(opened.pixels.max()) == 1


def test_colours_that_heic_describes_by_numbers(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    picture = heif.from_pillow(Image.fromarray(SCENE))
    picture.save(tmp_path / "a.heic", color_primaries=12, transfer_characteristics=13)
    with pytest.warns(
        UserWarning, match=r"a\.heic has Display P3 without a colour profile, which the output will not say"
    ):
        assert read_photograph(tmp_path / "a.heic").icc is None
    picture.save(tmp_path / "b.heic", color_primaries=9, transfer_characteristics=16)
    with pytest.raises(ValueError, match=r"b\.heic is an HDR picture \(PQ\), which is not supported; convert it"):
        read_photograph(tmp_path / "b.heic")
    with_profile = Image.fromarray(SCENE)
    with_profile.info["icc_profile"] = SRGB_PROFILE
    heif.from_pillow(with_profile).save(tmp_path / "c.heic")
    assert read_photograph(tmp_path / "c.heic").icc == SRGB_PROFILE


@pytest.mark.parametrize("first", ["nlfilter_torch.photo.picture.photographs", "pillow_heif"])
def test_xmp_of_heic_does_not_depend_on_imports(tmp_path: Path, first: str) -> None:
    heif = pytest.importorskip("pillow_heif")
    packet = b'<x:xmpmeta xmp:Rating="4"/>'
    heif.from_pillow(Image.fromarray(SCENE)).save(tmp_path / "in.heic", xmp=packet, exif=camera_block(thumbnail=False))
    code = f"import {first}\nfrom nlfilter_torch.photo.picture.photographs import read_photograph\n"
    code += f"p = read_photograph({str(tmp_path / 'in.heic')!r})\nprint(p.extras.xmp, len(p.exif))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == f"{packet!r} {len(camera_block(thumbnail=False))}"


def test_exif_and_gps_of_dng_are_kept(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "in.dng", SCENE)
    whole = (tmp_path / "in.dng").read_bytes()
    start = struct.unpack("<I", whole[4:8])[0]
    count = struct.unpack("<H", whole[start : start + 2])[0]
    entries = [whole[start + 2 + 12 * number : start + 14 + 12 * number] for number in range(count)]
    version, place = b"0231", len(whole) + len(whole) % 2
    details = struct.pack("<H", 1) + struct.pack("<HHI", 36864, 7, 4) + version + bytes(4)
    gps = struct.pack("<H", 1) + struct.pack("<HHI", 1, 2, 2) + b"N\0\0\0" + bytes(4)
    entries += [struct.pack("<HHII", code, 4, 1, at) for code, at in ((34665, place), (34853, place + len(details)))]
    entries.sort(key=lambda entry: struct.unpack("<H", entry[:2]))
    table = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    whole = whole.ljust(place, b"\0") + details + gps + table
    first = struct.pack("<I", place + len(details + gps))
    (tmp_path / "in.dng").write_bytes(whole[:4] + first + whole[8:])
    found = fields_of(read_photograph(tmp_path / "in.dng").exif)
    assert found[36864, 7] == version
    assert found[1, 2] == b"N\0"


def test_avif_is_no_heic() -> None:
    assert is_heic(b"\0\0\0\x1cftypheic\0\0\0\0mif1heic")
    assert not is_heic(b"\0\0\0\x1cftypmif1\0\0\0\0mif1avif")
    assert not is_heic(b"II*\0")


@pytest.mark.parametrize(("name", "package", "extra"), [("a.nef", "rawpy", "raw"), ("a.heic", "pillow_heif", "heic")])
def test_without_the_extra_it_says_so(
    tmp_path: Path, name: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(b"\0\0\0\x1cftypheic\0\0\0\0mif1heic" + bytes(40))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=rf"which is not installed; install nlfilter-torch\[{extra}\]"):
        read_photograph(tmp_path / name)


def test_what_libraries_do_not_parse_is_no_damage(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    write_photograph(photograph(np.full((16, 16, 3), 90, np.uint8)), tmp_path / "in.avif")
    whole = (tmp_path / "in.avif").read_bytes()
    heif.from_pillow(Image.fromarray(SCENE)).save(tmp_path / "in.heic")
    for name, stored in (("in.avif", whole), ("in.heic", (tmp_path / "in.heic").read_bytes())):
        (tmp_path / name).write_bytes(stored.replace(b"pitm", b"pxtm"))
        with pytest.raises(
            ValueError, match=r"is stored in a way that lib(avif|heif), which reads it, does not support"
        ):
            read_photograph(tmp_path / name)
        (tmp_path / name).write_bytes(stored[: len(stored) // 2].replace(b"pitm", b"pxtm"))
        with pytest.raises(ValueError, match="is damaged or cut short"):
            read_photograph(tmp_path / name)


def test_hdr_of_avif_is_refused_whatever_the_profile(tmp_path: Path) -> None:
    Image.fromarray(SCENE).save(tmp_path / "in.avif", icc_profile=SRGB_PROFILE)
    stored = (tmp_path / "in.avif").read_bytes()
    place = stored.index(b"colrnclx") + 8
    for numbers in ((9, 16), (9, 18)):
        (tmp_path / "in.avif").write_bytes(stored[:place] + struct.pack(">HH", *numbers) + stored[place + 4 :])
        with pytest.raises(ValueError, match=r"in\.avif is an HDR picture \((PQ|HLG)\), which is not supported"):
            read_photograph(tmp_path / "in.avif")
    (tmp_path / "in.avif").write_bytes(stored[:place] + struct.pack(">HH", 12, 13) + stored[place + 4 :])
    assert read_photograph(tmp_path / "in.avif").icc == SRGB_PROFILE


def test_the_primary_picture_of_heic_is_read(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    pictures = heif.from_pillow(Image.fromarray(SCENE[:32, :32]))
    pictures.add_from_pillow(Image.fromarray(SCENE))
    pictures.save(tmp_path / "in.heic", primary_index=1)
    opened = read_photograph(tmp_path / "in.heic")
    assert opened.size == SCENE.shape[:2]
    assert opened.extras.left_out == ("further pictures",)
