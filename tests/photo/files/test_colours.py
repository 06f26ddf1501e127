"""Colours that PNG and AVIF files describe by numbers in place of a profile."""

import io
import struct
from pathlib import Path

import pytest
import torch
from PIL import Image, PngImagePlugin

from nlfilter_torch.photo.files.photographs import read_photograph
from tests.files import photograph, stored_values


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


@pytest.mark.parametrize(
    ("name", "content"),
    [
        (b"gAMA", struct.pack(">I", 45_455)),
        (b"gAMA", bytes(4)),
        (b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)),
        (b"cICP", bytes((1, 13, 0, 1))),
        (b"cICP", bytes((2, 2, 0, 1))),
    ],
)
def test_usual_colours_of_png_cause_no_warning(tmp_path: Path, name: bytes, content: bytes) -> None:
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
