"""AVIF and palettes, decompression bombs, and colours that a file describes by numbers."""

import struct
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from nlfilter_torch.photo.files.photographs import read_photograph, write_photograph
from tests.files import PROFILE, exif_block, photograph, stored_values, tags


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
