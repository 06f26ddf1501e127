"""PNG: checksums, chunks, interlacing, and every type of colours."""

import io
import struct
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from nlfilter_torch.photo.files.metadata import Header, Metadata
from nlfilter_torch.photo.files.png import ADAM7, SAMPLES, SIGNATURE, chunks, write_chunk, write_png
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph
from tests.files import cat
from tests.pairwise import each_value, pairwise

KINDS = [
    (0, 1),
    (0, 2),
    (0, 4),
    (0, 8),
    (0, 16),
    (2, 8),
    (2, 16),
    (3, 1),
    (3, 4),
    (3, 8),
    (4, 8),
    (4, 16),
    (6, 8),
    (6, 16),
]


def png(width: int, height: int, bits: int, kind: int, interlaced: bool, transparent: bool = False) -> bytes:
    """A file of random pixels, the same with and without interlacing."""
    draw = np.random.default_rng(bits + kind)
    stored = 1 if kind == 3 else SAMPLES[kind]
    numbers = draw.integers(0, min(2**bits, 16 if kind == 3 else 1 << 16), (height, width, stored))
    levels = (numbers[..., None] >> np.arange(bits)[::-1] & 1).reshape(height, width, -1).astype(np.uint8)
    passes = ADAM7 if interlaced else ((0, 0, 1, 1),)
    rows = []
    for top, left, down, across in passes:
        part = levels[top::down, left::across]
        if part.size:
            rows += [b"\0" + np.packbits(row.reshape(-1)).tobytes() for row in part]
    stream = io.BytesIO()
    stream.write(SIGNATURE)
    write_chunk(stream, b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, interlaced))
    if kind == 3:
        write_chunk(stream, b"PLTE", draw.bytes(3 * min(16, 2**bits)))
    if transparent:
        write_chunk(stream, b"tRNS", {0: b"\0\1", 2: b"\0\1\0\2\0\3", 3: b"\0\x80"}[kind])
    write_chunk(stream, b"IDAT", zlib.compress(b"".join(rows)))
    write_chunk(stream, b"IEND")
    return stream.getvalue()


@pytest.mark.parametrize(
    ("kind", "bits", "transparent", "size"),
    [
        (kind, bits, transparent, size)
        for (kind, bits), transparent, size in pairwise(KINDS, [False, True], [(13, 9), (1, 1), (3, 2)])
    ],
)
def test_interlaced_files(
    tmp_path: Path, kind: int, bits: int, transparent: bool, size: tuple[int, int], capfd: pytest.CaptureFixture[str]
) -> None:
    if transparent and kind in (4, 6):
        pytest.skip("has an alpha channel")
    pictures = []
    for interlaced in (False, True):
        (tmp_path / "in.png").write_bytes(png(*size, bits, kind, interlaced, transparent))
        opened = read_photograph(tmp_path / "in.png")
        assert opened.depth == ("uint16" if bits == 16 else "uint8")
        assert opened.size == size[::-1]
        pictures.append([plane.numpy() for plane in (opened.pixels, opened.alpha) if plane is not None])
    for plain, interlaced in zip(*pictures, strict=True):
        np.testing.assert_array_equal(plain, interlaced)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", [b"IHDR", b"tEXt", b"IDAT", b"iCCP"])
def test_a_wrong_checksum_is_damage(tmp_path: Path, name: bytes) -> None:
    info = PngImagePlugin.PngInfo()
    info.add_text("Title", "cat")
    stream = io.BytesIO()
    Image.fromarray(cat()).save(stream, "PNG", pnginfo=info, icc_profile=b"profile")
    whole = bytearray(stream.getvalue())
    stop = next(chunk.stop for chunk in chunks(bytes(whole)) if chunk.name == name)
    whole[stop] ^= 1
    (tmp_path / "in.png").write_bytes(whole)
    with pytest.raises(ValueError, match=rf"is damaged or cut short \(wrong checksum in the chunk {name.decode()}\)"):
        read_photograph(tmp_path / "in.png")


def test_texts_stay_in_png_and_are_named_elsewhere(tmp_path: Path) -> None:
    info = PngImagePlugin.PngInfo()
    info.add_text("Title", "cat")
    info.add(b"tIME", bytes(7))
    info.add(b"vpAg", b"0", after_idat=True)
    Image.fromarray(cat()).save(tmp_path / "in.png", pnginfo=info)
    opened = read_photograph(tmp_path / "in.png")
    with pytest.warns(UserWarning, match="without .*: the chunk tIME$"):
        write_photograph(opened, tmp_path / "out.png")
    stored = (tmp_path / "out.png").read_bytes()
    assert [c.name for c in chunks(stored)][:3] == [b"IHDR", b"tEXt", b"vpAg"]
    with pytest.warns(UserWarning, match="without .*: the chunk tIME, the text Title, the chunk vpAg$"):
        write_photograph(opened, tmp_path / "out.jpg")


def test_long_texts_and_profiles_are_read(tmp_path: Path) -> None:
    """Pillow refuses more than a megabyte."""
    info = PngImagePlugin.PngInfo()
    info.add_text("Title", "cat " * 500_000, zip=True)
    profile = np.random.default_rng(0).bytes(3_000_000)
    Image.fromarray(cat()).save(tmp_path / "in.png", pnginfo=info, icc_profile=profile)
    write_photograph(read_photograph(tmp_path / "in.png"), tmp_path / "out.png")
    assert read_photograph(tmp_path / "out.png").icc == profile
    np.testing.assert_array_equal(imagecodecs.png_decode((tmp_path / "out.png").read_bytes()), cat())


@pytest.mark.parametrize(
    ("depth", "shape"),
    each_value(["uint8", "uint16"], [(1, 1, 1), (1, 3000, 1), (3000, 1, 3), (2, 70_000, 4), (300, 5000, 4)]),
)
def test_noise_of_every_shape_is_written(tmp_path: Path, shape: tuple[int, int, int], depth: str) -> None:
    draw = np.random.default_rng(0)
    stream = io.BytesIO()
    values = draw.integers(0, np.iinfo(depth).max, shape, dtype=depth, endpoint=True)
    write_png(
        stream, (values[top : top + 7] for top in range(0, shape[0], 7)), Header(shape, values.dtype, False, Metadata())
    )
    np.testing.assert_array_equal(np.asarray(imagecodecs.png_decode(stream.getvalue())).reshape(shape), values)
