"""PNG files: chunks, pixels by imagecodecs, and files written a few rows at a time.

Pillow reduces 16 bits to 8, ignores wrong checksums and refuses long chunks, so that it is not used here.
"""

import io
import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO, NamedTuple

import imagecodecs
import numpy as np

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.declared.rows import Stored
from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files.metadata import (
    CENTIMETRES,
    HDR,
    Extras,
    FilePart,
    Header,
    Metadata,
    UnhandledImage,
    bands,
    check_colour_numbers,
    check_png_colours,
    has_primaries,
    release,
    sound,
    turned_pair,
    upright_packet,
)

SIGNATURE = b"\x89PNG\r\n\x1a\n"
XMP_TEXT = b"XML:com.adobe.xmp"
RAW_KEY = b"Raw profile type "  # of texts in which some programs write EXIF, XMP and IPTC as hexadecimal numbers
SAMPLES = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by the type of colours
INDEXED = 3
ADAM7 = (
    (0, 0, 8, 8),
    (0, 4, 8, 8),
    (4, 0, 8, 4),
    (0, 2, 4, 4),
    (2, 0, 4, 2),
    (0, 1, 2, 2),
    (1, 0, 2, 1),
)  # y, x, steps
# Chunks that describe the pixels of the file. Colours are checked, see _profile.
STORAGE_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND", b"gAMA", b"cHRM", b"sRGB")
HDR_PROFILES = {b"ITUR_2100_PQ": 16, b"ITUR_2100_HLG": 18}  # by the names that they have in HDR files of PNG
BEHIND_END = 1 << 20  # bytes behind the end that are looked at
PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
TEXTS = (b"tEXt", b"zTXt", b"iTXt")
READ = (b"iCCP", b"eXIf", b"pHYs", b"acTL", b"fcTL", b"fdAT")
KEYS = (XMP_TEXT, RAW_KEY + b"exif", RAW_KEY + b"xmp")  # of texts that are read
LONGEST_TEXT = 1 << 28  # bytes of a text or profile
BAND = 1 << 22  # bytes that are compressed at a time
CHUNK_ROOM = 1 << 16  # bytes for chunks
INCH = CENTIMETRES / 100  # metres
LONGEST_PNG = 1_000_000  # pixels; a limit of libpng


class Chunk(NamedTuple):
    """The name of a chunk, the place of its content, and whether its checksum is right."""

    name: bytes
    start: int
    stop: int
    sound: bool = True


def chunks(data: bytes | mmap) -> Iterator[Chunk]:
    """The chunks of a file.

    Raises:
        EOFError: where one is cut short.
        ValueError: where one without which there is no picture has a wrong checksum.
    """
    place = len(SIGNATURE)
    with memoryview(data) as view:
        while place + 8 <= len(data):
            length, name = struct.unpack_from(">I4s", data, place)
            stop = place + 8 + length
            if stop + 4 > len(data):
                raise EOFError("it ends too early")
            sound = zlib.crc32(view[place + 4 : stop]) == struct.unpack_from(">I", data, stop)[0]
            chunk = Chunk(name, place + 8, stop, sound)
            if not sound and chr(name[0]).isupper():  # critical, according to the standard
                raise ValueError(f"wrong checksum in the chunk {name.decode('latin-1')}")
            yield chunk
            place = chunk.stop + 4
            if name == b"IEND":
                return


@dataclass(frozen=True)
class Png:
    """A PNG file whose pixels are not decoded yet.

    Attributes:
        size: (width, height).
        samples: channels after palettes and transparent colours are made plain.
        dtype: of these.
        in_passes: whether it is interlaced, so that decoding needs memory for all pixels.
        orientation: EXIF orientation.
        metadata: of the upright picture.
        parts: all sound chunks.
    """

    size: tuple[int, int]
    samples: int
    dtype: np.dtype[np.generic]
    in_passes: bool
    orientation: int
    metadata: Metadata
    parts: tuple[Chunk, ...]

    def decode_into(self, data: bytes | mmap, out: Stored) -> None:
        """Decode the channels (H, W, S) of a file without interlacing into an array."""
        with tempfile.TemporaryFile() as stream:
            self._copy_pixels(data, stream)
            stream.flush()
            release(data)
            with mmap(stream.fileno(), 0, access=ACCESS_READ) as pixels:
                imagecodecs.png_decode(pixels, out=out[..., 0] if self.samples == 1 else out)

    def decode(self, data: bytes | mmap) -> Stored:
        """The channels (H, W, S) as stored."""
        shape = (self.size[1], self.size[0], self.samples)
        if self.in_passes:
            return _interlaced(data, self.parts, shape, self.dtype)
        stream = io.BytesIO()
        self._copy_pixels(data, stream)
        return np.asarray(imagecodecs.png_decode(stream.getvalue())).reshape(shape)

    def _copy_pixels(self, data: bytes | mmap, stream: BinaryIO) -> None:
        """Write the file without its metadata, of which libpng would print warnings."""
        stream.write(SIGNATURE)
        with memoryview(data) as view:
            for chunk in self.parts:
                if chunk.name in PIXEL_CHUNKS:
                    stream.write(view[chunk.start - 8 : chunk.stop + 4])


def open_png(path: Path, data: bytes | mmap) -> Png:
    """Read everything but the pixels, and check the colours.

    Raises:
        UnhandledImage: if it is an animation, or an HDR picture.
        ValueError, EOFError: if it is damaged.
    """
    found = list(chunks(data))
    parts = tuple(chunk for chunk in found if chunk.sound)
    names = [chunk.name for chunk in parts]
    if not parts or names[0] != b"IHDR" or b"IDAT" not in names:
        raise ValueError("it has no picture")
    width, height, bits, kind, _, _, interlace = struct.unpack_from(">IIBBBBB", data, parts[0].start)
    if max(width, height) > LONGEST_PNG:
        raise UnhandledImage(
            f"{path} has {width}x{height} pixels, and libpng, which decodes it, takes at most {LONGEST_PNG} per side; "
            "convert it to TIFF"
        )
    contents = [(chunk.name, bytes(data[chunk.start : chunk.stop])) for chunk in parts if chunk.name != b"IDAT"]
    by_name = dict(contents)
    if b"acTL" in by_name and (frames := struct.unpack_from(">I", by_name[b"acTL"])[0]) > 1:
        raise UnhandledImage(f"{path} is an animation of {frames} frames; save one of them as a picture")
    damaged = [f"the chunk {chunk.name.decode('latin-1')}" for chunk in found if not chunk.sound]
    end = found[-1].stop + 4
    behind = bytes(data[end : end + BEHIND_END]) if names[-1] == b"IEND" else b""
    profile = _profile(path, by_name, damaged)
    orientation, metadata = _metadata(contents, damaged, ["the bytes behind the picture"] * bool(behind.strip(b"\0")))
    metadata = replace(metadata, icc=profile)
    if damaged:
        warn(f"{path} is damaged in {', '.join(damaged)}, which the picture is read without")
    samples = SAMPLES.get(kind, 1) + (b"tRNS" in names and kind not in (4, 6))
    dtype = np.dtype(np.uint16 if bits == 16 else np.uint8)
    return Png((width, height), samples, dtype, bool(interlace), orientation, metadata, parts)


def _profile(path: Path, contents: dict[bytes, bytes], damaged: list[str]) -> bytes | None:
    """The colour profile, or None; colours without one are checked.

    The numbers of cICP come before the profile, that before sRGB, and that before gAMA and cHRM, according to the
    standard. A profile that contradicts the numbers is left out.

    Raises:
        UnhandledImage: if it is an HDR picture.
    """
    profile = None
    if content := contents.get(b"iCCP"):
        name, _, packed = content.partition(b"\0")
        for prefix, transfer in HDR_PROFILES.items():
            if name.startswith(prefix):
                check_colour_numbers(path, 2, transfer)
        try:
            profile = _inflated(packed[1:])
        except (ValueError, zlib.error):
            damaged.append("the chunk iCCP")
    if len(numbers := contents.get(b"cICP", b"")) == 4:
        if profile is not None and numbers[1] not in HDR and has_primaries(profile, numbers[0]):
            return profile
        check_colour_numbers(path, numbers[0], numbers[1], " unless it is a PNG file")
        return None
    if profile is None and b"sRGB" not in contents:
        gamma, corners = contents.get(b"gAMA", b""), contents.get(b"cHRM", b"")
        check_png_colours(
            path,
            struct.unpack(">I", gamma)[0] / 100_000 if len(gamma) == 4 else None,
            [number / 100_000 for number in struct.unpack(">8I", corners)] if len(corners) == 32 else None,
        )
    return profile


def _metadata(contents: list[tuple[bytes, bytes]], damaged: list[str], left_out: list[str]) -> tuple[int, Metadata]:
    """The orientation, and the metadata of the upright picture without its profile; names what is ``damaged``."""
    by_name, texts = dict(contents), dict[bytes, bytes]()
    for name, content in contents:
        try:
            texts.update(_text(name, content))
        except (ValueError, zlib.error):
            damaged.append(_described(name, content))
    exif, packet = by_name.get(b"eXIf"), texts.get(XMP_TEXT)
    orientation, exif, unsound = exif_tags.read_upright(exif or _from_hexadecimal(texts.get(RAW_KEY + b"exif")))
    packet, stated = upright_packet(packet or _from_hexadecimal(texts.get(RAW_KEY + b"xmp")), orientation)
    left_out = [*stated, *left_out]
    kept = []
    for name, content in contents:
        if name in STORAGE_CHUNKS or name in READ or (name in TEXTS and _key(content) in KEYS):
            continue
        if name == b"cICP" or chr(name[3]).islower():  # safe to copy, according to the standard
            kept.append(FilePart("PNG", _described(name, content), struct.pack(">4s", name) + content))
        else:
            left_out.append(_described(name, content))
    dpi = None
    if (size := by_name.get(b"pHYs")) is not None and len(size) == 9:
        across, down, unit = struct.unpack(">IIB", size)
        dpi = sound(turned_pair((across * INCH, down * INCH), orientation)) if unit == 1 else None
        if unit == 0 and across != down:
            left_out.append("the aspect of pixels")
    return orientation, Metadata(None, exif, Extras(packet, dpi, parts=tuple(kept), left_out=(*left_out, *unsound)))


def _key(content: bytes) -> bytes:
    return content.partition(b"\0")[0]


def _text(name: bytes, content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The key and the text of a text chunk; nothing of another chunk."""
    if name not in TEXTS:
        return
    key, _, text = content.partition(b"\0")
    packed = name == b"zTXt"
    if name == b"iTXt":
        packed, text = text[:1] == b"\1", text[2:].split(b"\0", 2)[-1]
    elif packed:
        text = text[1:]
    if key == XMP_TEXT or key.startswith(RAW_KEY):
        yield key, _inflated(text) if packed else text


def _inflated(content: bytes) -> bytes:
    """The content of a compressed chunk; raises ValueError if it is damaged, or of an unlikely size."""
    stream = zlib.decompressobj()
    whole = stream.decompress(content, LONGEST_TEXT)
    if not stream.eof:
        raise ValueError(f"a compressed chunk is cut short, or longer than {LONGEST_TEXT} bytes")
    return whole


def _from_hexadecimal(text: bytes | None) -> bytes | None:
    """The content of a text with a profile: a name, a length, and hexadecimal numbers."""
    if text is None:
        return None
    try:
        return bytes.fromhex("".join(text.decode("latin-1").split()[2:]))
    except ValueError:
        return None


def _described(name: bytes, content: bytes) -> str:
    if name in TEXTS:
        return f"the text {_key(content).decode('latin-1')}"
    return f"the chunk {name.decode('latin-1')}"


def _interlaced(
    data: bytes | mmap, parts: tuple[Chunk, ...], shape: tuple[int, int, int], dtype: np.dtype[np.generic]
) -> Stored:
    """The channels of an interlaced file, each pass of which is decoded as a file of its own.

    imagecodecs decodes interlaced files, but libpng then prints a warning.
    """
    height, width, bits, kind = _header(data, parts)
    stream = zlib.decompressobj()
    packed = b"".join(bytes(data[chunk.start : chunk.stop]) for chunk in parts if chunk.name == b"IDAT")
    before = [
        (chunk.name, bytes(data[chunk.start : chunk.stop])) for chunk in parts if chunk.name in (b"PLTE", b"tRNS")
    ]
    channels = np.empty(shape, dtype)
    stored = 1 if kind == INDEXED else SAMPLES[kind]
    for top, left, down, across in ADAM7:
        rows, columns = -(-(height - top) // down), -(-(width - left) // across)
        if rows <= 0 or columns <= 0:
            continue
        length = rows * (1 + -(-columns * stored * bits // 8))
        content = stream.decompress(packed, length)
        packed = stream.unconsumed_tail
        if len(content) < length:
            raise EOFError("it ends too early")
        small = io.BytesIO()
        small.write(SIGNATURE)
        header = struct.pack(">IIBBBBB", columns, rows, bits, kind, 0, 0, 0)
        for name, body in [(b"IHDR", header), *before, (b"IDAT", zlib.compress(content, 0)), (b"IEND", b"")]:
            write_chunk(small, name, body)
        decoded = np.asarray(imagecodecs.png_decode(small.getvalue()))
        channels[top::down, left::across] = decoded.reshape(rows, columns, shape[2])
    return channels


def _header(data: bytes | mmap, parts: tuple[Chunk, ...]) -> tuple[int, int, int, int]:
    """Height, width, bits and type of colours."""
    width, height, bits, kind = struct.unpack_from(">IIBB", data, parts[0].start)
    return height, width, bits, kind


def write_chunk(stream: BinaryIO, name: bytes, *content: bytes) -> None:
    """Write a chunk, whose content may be given in pieces."""
    checksum = zlib.crc32(name)
    stream.write(struct.pack(">I4s", sum(map(len, content)), name))
    for piece in content:
        checksum = zlib.crc32(piece, checksum)
        stream.write(piece)
    stream.write(struct.pack(">I", checksum))


def write_png(
    stream: BinaryIO,
    rows: Iterable[Stored],
    header: Header,
) -> None:
    """Write rows (h, W, S) of a picture of uint8 or uint16 as they arrive."""
    (height, width, samples), dtype = header.shape, header.dtype
    length = 1 + width * samples * dtype.itemsize
    stream.write(SIGNATURE)
    colour = {1: 0, 2: 4, 3: 2, 4: 6}[samples]
    write_chunk(stream, b"IHDR", struct.pack(">IIBBBBB", width, height, 8 * dtype.itemsize, colour, 0, 0, 0))
    for name, content in _written(header.metadata):
        write_chunk(stream, name, content)
    packer = zlib.compressobj(6, strategy=zlib.Z_FILTERED)
    above: Stored | None = None
    for band in bands(rows, max(1, BAND // length)):
        # libpng chooses the filters, which need the row above.
        part = np.ascontiguousarray(band if above is None else np.concatenate([above, band]))
        room = bytearray(part.nbytes + part.nbytes // 64 + 16 * len(part) + CHUNK_ROOM)  # imagecodecs' own is too small
        encoded = bytes(imagecodecs.png_encode(part, level=0, out=room))
        filtered = zlib.decompress(b"".join(encoded[c.start : c.stop] for c in chunks(encoded) if c.name == b"IDAT"))
        packed = packer.compress(memoryview(filtered)[0 if above is None else length :])
        if packed:
            write_chunk(stream, b"IDAT", packed)
        above = band[-1:]
    write_chunk(stream, b"IDAT", packer.flush())
    write_chunk(stream, b"IEND")


def _written(metadata: Metadata) -> Iterator[tuple[bytes, bytes]]:
    """The chunks between header and pixels."""
    extras = metadata.extras
    if metadata.icc is not None:
        yield b"iCCP", b"ICC Profile\0\0" + zlib.compress(metadata.icc)
    if metadata.exif is not None:
        yield b"eXIf", metadata.exif.removeprefix(exif_tags.PREFIX)
    if extras.dpi is not None:
        yield b"pHYs", struct.pack(">IIB", *(round(value / INCH) for value in extras.dpi), 1)
    if extras.xmp is not None:
        yield b"iTXt", XMP_TEXT + bytes(5) + extras.xmp
    for part in extras.parts:
        if part.kind == "PNG":
            yield part.data[:4], part.data[4:]
