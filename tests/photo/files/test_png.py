"""PNG: checksums, chunks, interlacing, and every type of colours."""

import contextlib
import io
import struct
import zlib
from pathlib import Path

import hypothesis
import hypothesis.strategies as some
import imagecodecs
import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from nlfilter_torch.photo.files import rows
from nlfilter_torch.photo.files.metadata import Header, Metadata
from nlfilter_torch.photo.files.png import ADAM7, SAMPLES, SIGNATURE, XMP_TEXT, chunks, write_chunk, write_png
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph
from tests.files import PROFILE, cat, photograph, rows_of, same
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


CAT = cat(20, 30)


def with_chunks(*added: tuple[bytes, bytes], behind: bytes = b"", wrong: bytes = b"") -> bytes:
    """A file of a cat with more chunks before its pixels, bytes behind its end, and a chunk with a wrong checksum."""
    stream = io.BytesIO()
    whole = imagecodecs.png_encode(CAT)
    stream.write(SIGNATURE)
    for number, chunk in enumerate(chunks(whole)):
        for name, content in added if number == 1 else ():
            write_chunk(stream, name, content)
        write_chunk(stream, chunk.name, whole[chunk.start : chunk.stop])
    written = bytearray(stream.getvalue())
    if wrong:
        written[next(chunk.stop for chunk in chunks(bytes(written)) if chunk.name == wrong)] ^= 1
    return bytes(written) + behind


@pytest.mark.parametrize("name", [b"IHDR", b"IDAT", b"IEND"])
def test_a_wrong_checksum_of_a_critical_chunk_is_damage(tmp_path: Path, name: bytes) -> None:
    (tmp_path / "in.png").write_bytes(with_chunks(wrong=name))
    with pytest.raises(ValueError, match=rf"is damaged or cut short \(wrong checksum in the chunk {name.decode()}\)"):
        read_photograph(tmp_path / "in.png")


def profile_chunk(name: bytes = b"a profile", profile: bytes = PROFILE) -> tuple[bytes, bytes]:
    return b"iCCP", name + b"\0\0" + zlib.compress(profile)


@pytest.mark.parametrize(
    "chunk",
    [(b"tEXt", b"Title\0cat"), profile_chunk(), (b"eXIf", b"II*\0"), (b"tIME", bytes(7)), (b"tRNS", bytes(6))],
)
def test_other_chunks_with_a_wrong_checksum_are_left_out_with_a_note(
    tmp_path: Path, chunk: tuple[bytes, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in.png").write_bytes(with_chunks(chunk, wrong=chunk[0]))
    note = rf"in\.png is damaged in the chunk {chunk[0].decode()}, which the picture is read without"
    with pytest.warns(UserWarning, match=note):
        opened = read_photograph(tmp_path / "in.png")
    same(opened, photograph(CAT))
    write_photograph(opened, tmp_path / "out.png")
    assert chunk[0] not in (tmp_path / "out.png").read_bytes()
    monkeypatch.setattr(rows, "TILED_MEMORY", 1000)
    with pytest.warns(UserWarning, match=note):
        np.testing.assert_array_equal(rows_of(tmp_path / "in.png"), CAT)


@pytest.mark.parametrize("chunk", [(b"iCCP", b"a\0\0nothing"), (b"zTXt", XMP_TEXT + b"\0\0nothing")])
def test_damaged_texts_and_profiles_are_left_out_with_a_note(tmp_path: Path, chunk: tuple[bytes, bytes]) -> None:
    (tmp_path / "in.png").write_bytes(with_chunks(chunk))
    with pytest.warns(UserWarning, match="is damaged in the (chunk|text)"):
        same(read_photograph(tmp_path / "in.png"), photograph(CAT))


def test_bytes_behind_the_end_are_named(tmp_path: Path) -> None:
    for behind, named in ((b"", False), (bytes(64), False), (b"PK\3\4 a file", True)):
        (tmp_path / "in.png").write_bytes(with_chunks(behind=behind))
        opened = read_photograph(tmp_path / "in.png")
        same(opened, photograph(CAT))
        assert opened.extras.left_out == (("the bytes behind the picture",) if named else ())


P3, SRGB, PQ, HLG = (bytes(numbers) for numbers in ((12, 13, 0, 1), (1, 13, 0, 1), (9, 16, 0, 1), (9, 18, 0, 1)))
GAMMA = (b"gAMA", struct.pack(">I", 100_000))


@pytest.mark.parametrize(
    ("added", "profiled", "warning"),
    [
        ([(b"cICP", SRGB), profile_chunk(), (b"sRGB", b"\0"), GAMMA], True, None),
        ([(b"cICP", SRGB), GAMMA], False, None),
        ([(b"cICP", P3), profile_chunk(), GAMMA], False, "has Display P3 without .* not say unless it is a PNG file"),
        ([profile_chunk(), (b"sRGB", b"\0"), GAMMA], True, None),
        ([(b"sRGB", b"\0"), GAMMA], False, None),
        ([GAMMA], False, "has a gamma of 1 without a colour profile, which the output will not say, so"),
        ([(b"cICP", P3[:2]), GAMMA], False, "has a gamma of 1 "),
        ([(b"gAMA", b"")], False, None),
    ],
)
def test_descriptions_of_colours_in_the_order_of_the_standard(
    tmp_path: Path, added: list[tuple[bytes, bytes]], profiled: bool, warning: str | None
) -> None:
    (tmp_path / "in.png").write_bytes(with_chunks(*added))
    with contextlib.nullcontext() if warning is None else pytest.warns(UserWarning, match=warning):
        opened = read_photograph(tmp_path / "in.png")
    same(opened, photograph(CAT, **({"icc": PROFILE} if profiled else {})))
    write_photograph(opened, tmp_path / "out.png")
    written = (tmp_path / "out.png").read_bytes()
    kept = {chunk.name: written[chunk.start : chunk.stop] for chunk in chunks(written)}
    assert kept.get(b"cICP") == dict(added).get(b"cICP")
    assert (b"iCCP" in kept) == profiled
    if b"cICP" in kept:
        with pytest.warns(UserWarning, match="without some metadata of the input: the chunk cICP"):
            write_photograph(opened, tmp_path / "out.jpg")


@pytest.mark.parametrize("by", ["numbers", "name", "tag of the profile"])
@pytest.mark.parametrize("numbers", [PQ, HLG])
def test_hdr_is_refused_with_its_reason_whatever_the_profile(
    tmp_path: Path, by: str, numbers: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = {16: b"ITUR_2100_PQ_FULL", 18: b"ITUR_2100_HLG_FULL"}[numbers[1]]
    tagged = PROFILE[:128] + struct.pack(">I4sII", 1, b"cicp", 144, 12) + b"cicp" + bytes(4) + numbers
    added = {
        "numbers": [(b"cICP", numbers), profile_chunk()],
        "name": [profile_chunk(name)],
        "tag of the profile": [profile_chunk(profile=tagged)],
    }[by]
    (tmp_path / "in.png").write_bytes(with_chunks(*added))
    monkeypatch.setattr(rows, "TILED_MEMORY", 1000)
    for read in (read_photograph, rows_of):
        with pytest.raises(
            ValueError, match=r"in\.png is an HDR picture \((PQ|HLG)\), which is not supported; convert"
        ):
            read(tmp_path / "in.png")


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(
    added=some.lists(
        some.tuples(
            some.text("abcdefghijklmnopqrstuvwxyz", min_size=2, max_size=2), some.booleans(), some.binary(max_size=40)
        ),
        max_size=5,
        unique_by=lambda chunk: chunk[:2],
    )
)
def test_unknown_chunks_come_out_as_they_went_in_or_are_named(
    tmp_path_factory: pytest.TempPathFactory, added: list[tuple[str, bool, bytes]]
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.png"
    named = [(f"{letters}X{'q' if safe else 'Q'}".encode(), body) for letters, safe, body in added]
    path.write_bytes(with_chunks(*named))
    opened = read_photograph(path)
    unsafe = tuple(f"the chunk {name.decode()}" for name, _ in named if chr(name[3]).isupper())
    assert opened.extras.left_out == unsafe
    with contextlib.nullcontext() if not unsafe else pytest.warns(UserWarning, match="without some metadata"):
        write_photograph(opened, path)
    written = path.read_bytes()
    kept = [(chunk.name, written[chunk.start : chunk.stop]) for chunk in chunks(written)]
    assert [chunk for chunk in kept if chunk[0] not in (b"IHDR", b"IDAT", b"IEND")] == [
        chunk for chunk in named if chr(chunk[0][3]).islower()
    ]


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
