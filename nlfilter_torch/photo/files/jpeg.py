"""JPEG files: segments, pixels, and files written a few rows at a time."""

import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import BinaryIO, NamedTuple

import imagecodecs
import numpy as np
from PIL import JpegImagePlugin

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.declared.rows import Stored
from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files.metadata import (
    FURTHER_PICTURES,
    GAIN_MAP,
    MOTION,
    Extras,
    FilePart,
    Header,
    Metadata,
    UnhandledImage,
    bands,
    quiet,
    sound,
    turned_pair,
    upright_packet,
)

USUAL_QUALITY = 95
XMP_SEGMENT = b"http://ns.adobe.com/xap/1.0/\0"
EXTENSION_KEY = b"http://ns.adobe.com/xmp/extension/\0"
ICC_KEY = b"ICC_PROFILE\0"
LONGEST = 65_533  # bytes in a segment
ICC_PIECE = LONGEST - len(ICC_KEY) - 2
LONGEST_ICC = 255 * ICC_PIECE
START = b"\xff\xd8\xff"  # of a file
SOI, EOI, SOS, APP, COM, DRI = 0xD8, 0xD9, 0xDA, 0xE0, 0xFE, 0xDD
PLAIN_FRAMES = (0xC0, 0xC1)
FRAMES = (*range(0xC0, 0xC4), *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0))
ADOBE = APP + 14  # says how the colours are coded
LONGEST_XMP = 65_000  # bytes; longer packets are not written
BEHIND = 1 << 26  # bytes behind the first picture that are looked at
THUMBNAILS = (b"8BIM\x04\x0c", b"8BIM\x04\x09")  # of Photoshop
SEGMENT_NAMES = {
    EXTENSION_KEY: "an extension of XMP",
    b"MPF\0": FURTHER_PICTURES,
    b"urn:iso:std:iso:ts:21496:-1": GAIN_MAP,
    b"JFXX\0": "the thumbnail of JFIF",
    b"Photoshop 3.0\0": "the fields and thumbnail of Photoshop",
    b"JP": "content credentials",
}
BARE = (0x01, *range(0xD0, 0xD8))  # markers without content
MARKER = re.compile(rb"\xff+[^\0\xd0-\xd7\xff]")  # in the pixels: not a byte of 255, nor a restart
CODED_SIDE = 8  # side of the squares of pixels that are coded
CODED_ROWS = 64  # rows that are coded at a time; a multiple of CODED_SIDE


class Segment(NamedTuple):
    """A marker, and the place of its content."""

    marker: int
    start: int
    stop: int


def segments(data: bytes | mmap) -> Iterator[Segment]:
    """The segments of the first picture up to its end, or to the end of a file that is cut short."""
    place = 2
    while place + 4 <= len(data):
        if data[place] != 0xFF:
            raise ValueError("no marker where one should be")
        marker = data[place + 1]
        if marker == 0xFF or marker in BARE:
            place += 1 if marker == 0xFF else 2
            continue
        if marker == EOI:
            break
        (length,) = struct.unpack_from(">H", data, place + 2)
        yield Segment(marker, place + 4, place + 2 + length)
        place += 2 + length
        if marker == SOS:
            match = MARKER.search(data, place)
            if match is None:
                return
            place = match.end() - 2
    if data[place : place + 2] == bytes((0xFF, EOI)):
        yield Segment(EOI, place + 2, len(data))


@dataclass(frozen=True)
class Jpeg:
    """A JPEG file whose pixels are not decoded yet.

    Attributes:
        path: the file.
        size: (width, height).
        samples: channels, 1 or 3.
        whole: whether it has an end.
        in_passes: whether it is progressive, so that decoding needs memory for all pixels.
        orientation: EXIF orientation.
        metadata: of the upright picture.
    """

    path: Path
    size: tuple[int, int]
    samples: int
    whole: bool
    in_passes: bool
    orientation: int
    metadata: Metadata

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Of the channels."""
        return np.dtype(np.uint8)

    def _opened(self) -> JpegImagePlugin.JpegImageFile:
        # Not Image.open, which refuses pictures of more than 179 megapixels whatever the memory.
        with quiet():
            return JpegImagePlugin.JpegImageFile(self.path)

    def decode(self) -> Stored:
        """The channels (H, W, S) as stored; raises OSError if some are missing."""
        with self._opened() as image:
            channels = np.asarray(image).reshape(self.size[1], self.size[0], self.samples)
        self._warn_of_end()
        return channels

    def decode_into(self, data: bytes | mmap, out: Stored) -> None:
        """Decode the channels (H, W, S) into an array, such as a file mapped into memory; raises as :meth:`decode`."""
        if not self.whole:  # libjpeg fills what is missing, Pillow does not
            with self._opened() as image:
                image.draft(image.mode, (1, 1))  # an eighth of the sides
                image.load()
        imagecodecs.jpeg8_decode(data, out=out[..., 0] if self.samples == 1 else out)
        self._warn_of_end()

    def _warn_of_end(self) -> None:
        if not self.whole:
            warn(f"{self.path} has no end, so its last rows may be damaged: look at them, or copy it again")


def open_jpeg(path: Path, data: bytes | mmap) -> Jpeg:
    """Read everything but the pixels.

    Raises:
        UnhandledImage: if the colours are neither grey nor those of RGB, or not of 8 bits.
        ValueError: if it is damaged.
    """
    parts = list(segments(data))
    frame = next((part for part in parts if part.marker in FRAMES), None)
    if frame is None:
        raise EOFError("it has no picture")
    bits, height, width, samples = struct.unpack_from(">BHHB", data, frame.start)
    if samples not in (1, 3):
        kind = "CMYK" if samples == 4 else f"{samples}-channel"
        raise UnhandledImage(f"{path} is stored in {kind} colours, which are not supported; convert it to grey or RGB")
    if bits != 8:
        raise UnhandledImage(f"{path} has {bits} bits per channel, which is not supported in JPEG; convert it to TIFF")
    end = next((part for part in parts if part.marker == EOI), None)
    contents = [(part.marker, bytes(data[part.start : part.stop])) for part in parts if part.marker not in (EOI, SOS)]
    orientation, metadata = _metadata(contents, b"" if end is None else data[end.start : end.start + BEHIND])
    progressive = frame.marker not in PLAIN_FRAMES
    return Jpeg(path, (width, height), samples, end is not None, progressive, orientation, metadata)


def _metadata(contents: list[tuple[int, bytes]], behind: bytes) -> tuple[int, Metadata]:
    """The orientation, and the metadata of the upright picture; ``behind`` is what follows it in the file."""
    blocks, profile, packet, dpi = [], {}, None, None
    parts, left_out = [], []
    for marker, content in contents:
        if marker == APP and content.startswith(b"JFIF\0"):
            dpi = stored_dpi(content)
        elif marker == APP + 1 and content.startswith(exif_tags.PREFIX):
            blocks.append(content.removeprefix(exif_tags.PREFIX))
        elif marker == APP + 1 and content.startswith(XMP_SEGMENT):
            packet = content.removeprefix(XMP_SEGMENT)
        elif marker == APP + 2 and content.startswith(ICC_KEY):
            profile[content[len(ICC_KEY)]] = content[len(ICC_KEY) + 2 :]
        elif marker == COM or (marker == APP + 13 and not any(key in content for key in THUMBNAILS)):
            name = "the comment" if marker == COM else "IPTC fields"
            parts.append(FilePart("JPEG", name, bytes((0xFF, marker)) + struct.pack(">H", len(content) + 2) + content))
        elif APP <= marker < APP + 16 and marker != ADOBE:
            left_out.append(_described(marker, content))
    orientation, exif, damaged = exif_tags.read_upright(exif_tags.PREFIX + b"".join(blocks) if blocks else None)
    packet, stated = upright_packet(packet, orientation)
    dpi = sound(dpi) or sound(exif_tags.resolution(exif))
    extras = Extras(
        packet,
        None if dpi is None else turned_pair(dpi, orientation),
        parts=tuple(parts),
        left_out=(*left_out, *damaged, *stated, *_behind(behind)),
    )
    icc = b"".join(profile[number] for number in sorted(profile)) or None
    return orientation, Metadata(icc, exif, extras)


def stored_dpi(content: bytes) -> tuple[float, float] | None:
    """The pixels per inch in the header of JFIF, or None."""
    if len(content) < 12 or (scale := exif_tags.IN_INCHES.get(content[7] + 1)) is None:  # TIFF counts from 1
        return None
    across, down = struct.unpack_from(">HH", content, 8)
    return across * scale, down * scale


def _described(marker: int, content: bytes) -> str:
    """What a segment holds, in words."""
    for key, name in SEGMENT_NAMES.items():
        if content.startswith(key):
            return name
    return f"the segment APP{marker - APP}"


def _behind(content: bytes) -> Iterator[str]:
    """What follows the first picture of a file."""
    if not content.strip(b"\0\xff"):
        return
    further, film = START in content, b"ftyp" in content
    if further:
        yield FURTHER_PICTURES
    if film:
        yield MOTION
    if not further and not film:
        yield "the bytes behind the picture"


def write_jpeg(
    stream: BinaryIO,
    rows: Iterable[Stored],
    header: Header,
    quality: int = USUAL_QUALITY,
) -> None:
    """Write rows (h, W, S) of 8 bits as they arrive, without chroma subsampling.

    Strips are coded alone and joined by restart markers, after which a decoder begins anew.
    """
    height, width, _ = header.shape
    for number, strip in enumerate(bands(rows, CODED_ROWS)):
        picture = strip[..., 0] if strip.shape[2] == 1 else strip
        encoded = bytes(imagecodecs.jpeg8_encode(np.ascontiguousarray(picture), level=quality, subsampling="444"))
        parts = list(segments(encoded))
        scan = next(part for part in parts if part.marker == SOS)
        if number:
            stream.write(bytes((0xFF, 0xD0 + (number - 1) % 8)))
        else:
            stream.write(bytes((0xFF, SOI)))
            for marker, content in _written(header.metadata):
                _write_segment(stream, marker, content)
            for part in parts:
                content = encoded[part.start : part.stop]
                if part.marker in PLAIN_FRAMES:
                    content = content[:1] + struct.pack(">H", height) + content[3:]
                if part.marker == SOS and height > CODED_ROWS:
                    _write_segment(stream, DRI, struct.pack(">H", -(-width // CODED_SIDE) * (CODED_ROWS // CODED_SIDE)))
                if part.marker not in (APP, EOI) and part.start <= scan.start:
                    _write_segment(stream, part.marker, content)
        stream.write(memoryview(encoded)[scan.stop : -2])
    stream.write(bytes((0xFF, EOI)))


def _written(metadata: Metadata) -> Iterator[tuple[int, bytes]]:
    """The segments of metadata."""
    extras, icc = metadata.extras, metadata.icc or b""
    yield APP, jfif(extras.dpi)
    if metadata.exif is not None:
        yield APP + 1, exif_tags.PREFIX + metadata.exif.removeprefix(exif_tags.PREFIX)
    if extras.xmp is not None and len(extras.xmp) <= LONGEST_XMP:
        yield APP + 1, XMP_SEGMENT + extras.xmp
    pieces = [icc[start : start + ICC_PIECE] for start in range(0, len(icc), ICC_PIECE)]
    for number, piece in enumerate(pieces, 1):
        yield APP + 2, ICC_KEY + bytes((number, len(pieces))) + piece
    for part in extras.parts:
        if part.kind == "JPEG":
            yield part.data[1], part.data[4:]


def jfif(dpi: tuple[float, float] | None) -> bytes:
    """The header of JFIF, whose density is whole numbers, in the unit that rounds less; see :func:`stored_dpi`."""
    if dpi is None:
        return b"JFIF\0\1\1" + struct.pack(">BHHH", 0, 1, 1, 0)
    lost = {
        unit: sum(abs(value / scale - round(value / scale)) * scale for value in dpi)
        for unit, scale in exif_tags.IN_INCHES.items()
    }
    unit = min(lost, key=lost.__getitem__)
    numbers = (max(1, round(value / exif_tags.IN_INCHES[unit])) for value in dpi)
    return b"JFIF\0\1\1" + struct.pack(">BHHH", unit - 1, *numbers, 0)


def _write_segment(stream: BinaryIO, marker: int, content: bytes) -> None:
    stream.write(bytes((0xFF, marker)) + struct.pack(">H", len(content) + 2) + content)
