"""Files that other libraries decode: WebP and AVIF (Pillow, imagecodecs), RAW (rawpy) and HEIC (pillow-heif).

WebP and AVIF are written by Pillow, and read by it or, beyond its limits and its 8 bits, by imagecodecs. RAW and HEIC
are not written, and need the extras ``raw`` and ``heic``.
"""

import io
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO

import imagecodecs
import numpy as np
from PIL import AvifImagePlugin, Image

from nlfilter_torch.photo.declared.rows import Stored
from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files import exif_in_tiff, jpeg
from nlfilter_torch.photo.files.metadata import (
    DEPTH,
    FURTHER_PICTURES,
    GAIN_MAP,
    HDR,
    CheckSize,
    Decoded,
    Extras,
    Metadata,
    UnhandledImage,
    check_colour_numbers,
    decoding,
    quiet,
    upright_packet,
)
from nlfilter_torch.photo.files.tables import EXIF, TiffTables

ENCODING: dict[str, dict[str, object]] = {
    "WebP": {"lossless": True, "exact": True},  # exact: also where it is transparent
    "AVIF": {"quality": 90, "subsampling": "4:4:4"},
}
LOSSY_WEBP: dict[str, object] = {"lossless": False}  # if a quality is given
MOST_AVIF, LONGEST_AVIF = 1 << 28, 1 << 15  # pixels, and those of a side, that libavif decodes
HEAD = 1 << 16  # bytes that hold the description of an AVIF file
WEBP_PIXELS = (b"VP8 ", b"VP8L", b"ALPH", b"ANMF")
WEBP_CHUNKS = (b"VP8 ", b"VP8L", b"VP8X", b"ALPH", b"ICCP", b"EXIF", b"XMP ", b"ANIM", b"ANMF")


def is_webp(head: bytes) -> bool:
    """Whether a file with these first bytes is WebP."""
    return head[:4] == b"RIFF" and head[8:12] == b"WEBP"


def is_avif(head: bytes) -> bool:
    """Whether a file with these first bytes is AVIF."""
    return head[4:8] == b"ftyp" and b"avi" in head


def read_webp(path: Path, data: bytes | mmap, check_size: CheckSize) -> Decoded:
    """Read a WebP file. Pillow would refuse more than 179 megapixels whatever the memory."""
    chunks = _webp_chunks(data)
    if (frames := sum(name == b"ANMF" for name, _ in chunks)) > 1:
        raise UnhandledImage(f"{path} is an animation of {frames} frames; save one of them as a picture")
    by_name = dict(chunks)
    check_size(_webp_size(by_name))
    left_out = [f"the chunk {name.decode('latin-1').strip()}" for name in by_name if name not in WEBP_CHUNKS]
    upright = exif_tags.read_upright(by_name.get(b"EXIF"))
    channels = np.asarray(imagecodecs.webp_decode(data))
    return _decoded(channels, by_name.get(b"ICCP"), upright, by_name.get(b"XMP "), left_out)


def _decoded(
    channels: Stored, icc: bytes | None, upright: exif_tags.Upright, xmp: bytes | None, left_out: list[str]
) -> Decoded:
    """Decoded channels (H, W) or (H, W, S), with a profile, an EXIF block and a packet of XMP."""
    packet, stated = upright_packet(xmp, upright.orientation)
    metadata = Metadata(icc, upright.block, Extras(packet, left_out=(*stated, *left_out, *upright.left_out)))
    return Decoded(channels.reshape(*channels.shape[:2], -1), upright.orientation, metadata)


def _webp_chunks(data: bytes | mmap) -> list[tuple[bytes, bytes]]:
    """Names and contents of the chunks of a WebP file, of the pixels only the beginning."""
    chunks, place = [], 12
    while place + 8 <= len(data):
        name, length = struct.unpack_from("<4sI", data, place)
        if place + 8 + length > len(data):
            raise EOFError("it ends too early")
        chunks.append((name, bytes(data[place + 8 : place + 8 + (length if name not in WEBP_PIXELS else 16)])))
        place += 8 + length + length % 2
    return chunks


def _webp_size(chunks: dict[bytes, bytes]) -> tuple[int, int]:
    """(width, height) of a WebP file."""
    if head := chunks.get(b"VP8X"):
        return 1 + int.from_bytes(head[4:7], "little"), 1 + int.from_bytes(head[7:10], "little")
    if head := chunks.get(b"VP8L"):
        bits = int.from_bytes(head[1:5], "little")
        return 1 + bits % (1 << 14), 1 + (bits >> 14) % (1 << 14)
    width, height = struct.unpack_from("<HH", chunks[b"VP8 "], 6)
    return width % (1 << 14), height % (1 << 14)


def read_avif(path: Path, data: bytes | mmap, check_size: CheckSize) -> Decoded:
    """Read an AVIF file."""
    _check_avif_size(path, data)
    with quiet(), _parsing(path, data, "libavif"):
        image = AvifImagePlugin.AvifImageFile(path)
    with image:
        if (frames := image.n_frames) > 1:
            raise UnhandledImage(f"{path} is an animation of {frames} frames; save one of them as a picture")
        check_size(image.size)
        _check_colours(path, data, "icc_profile" in image.info)
        # The block as stored: image.info may hold one that Pillow wrote anew.
        block, orientation = image._decoder.get_info()[4:6]
        upright = exif_tags.read_upright(block, orientation)
        left_out = [GAIN_MAP] * (b"tmap" in data[:HEAD])
        if (bits := _bits_of_avif(data)) > 8:  # Pillow would reduce them to 8
            channels = np.rint(imagecodecs.avif_decode(data) * (65535 / (2**bits - 1))).astype(np.uint16)
        else:
            channels = np.asarray(image)
        return _decoded(channels, image.info.get("icc_profile"), upright, image.info.get("xmp"), left_out)


def _check_avif_size(path: Path, data: bytes | mmap) -> None:
    """Raise UnhandledImage if a picture is larger than libavif decodes."""
    _, marker, size = data[:HEAD].partition(b"ispe")
    if not marker or len(size) < 12:
        return
    width, height = struct.unpack_from(">II", size, 4)
    if width * height > MOST_AVIF or max(width, height) > LONGEST_AVIF:
        raise UnhandledImage(
            f"{path} has {width}x{height} pixels, and libavif, which decodes it, takes at most {MOST_AVIF}, and "
            f"{LONGEST_AVIF} per side; convert it to TIFF or PNG"
        )


def _check_colours(path: Path, data: bytes | mmap, profiled: bool) -> None:
    """Check the colours of an AVIF file, see :func:`_check_numbers`."""
    _, marker, numbers = data[:HEAD].partition(b"colrnclx")
    if marker and len(numbers) >= 4:
        primaries, transfer = struct.unpack(">HH", numbers[:4])
        _check_numbers(path, primaries, transfer, profiled)


def _check_numbers(path: Path, primaries: int, transfer: int, profiled: bool) -> None:
    """Check the numbers of colours, see :func:`check_colour_numbers`; a profile comes before them, but for HDR."""
    if not profiled or transfer in HDR:
        check_colour_numbers(path, primaries, transfer)


@contextmanager
def _parsing(path: Path, data: bytes | mmap, library: str) -> Iterator[None]:
    """Report that a library fails to parse a file as its limit where all boxes of the file are whole.

    Raises:
        UnhandledImage: then. Otherwise, the library's error is raised.
    """
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        place = 0
        while place + 8 <= len(data):
            size, name = struct.unpack_from(">I4s", data, place)
            if size == 1 and place + 16 <= len(data):
                (size,) = struct.unpack_from(">Q", data, place + 8)
            elif size == 0:  # up to the end
                size = len(data) - place
            if size < 8 or not name.isalnum():
                raise
            place += size
        if place != len(data):
            raise
        raise UnhandledImage(
            f"{path} is stored in a way that {library}, which reads it, does not support ({error}); convert it to PNG "
            "or TIFF"
        ) from error


def _bits_of_avif(data: bytes | mmap) -> int:
    """Read the bits per channel from the codec configuration, which is among the first boxes."""
    head = data[:HEAD]
    place = head.find(b"av1C") + 6  # after the version, the profile and the level
    flags = head[place] if 6 <= place < len(head) else 0
    return (12 if flags & 0x20 else 10) if flags & 0x40 else 8


def write_by_pillow(
    stream: BinaryIO, kind: str, channels: Stored, metadata: Metadata, quality: int | None = None
) -> None:
    """Write channels (H, W) or (H, W, S) of 8 bits as a WebP file, lossless without a quality, or AVIF."""
    block = metadata.exif or b""
    # Pillow writes a block with an orientation anew. It gets it under another number, which is then set right.
    hidden = exif_tags.hidden_orientation(block)
    options: dict[str, object] = {"icc_profile": metadata.icc, "exif": hidden} | ENCODING[kind]
    if quality is not None:
        options |= {"quality": quality} | (LOSSY_WEBP if kind == "WebP" else {})
    if metadata.extras.xmp is not None:
        options["xmp"] = metadata.extras.xmp
    encoded = io.BytesIO()
    Image.fromarray(channels).save(encoded, format=kind, **options)
    whole, place = encoded.getbuffer(), encoded.getvalue().find(hidden.removeprefix(exif_tags.PREFIX)) if block else 0
    if block:
        whole[place : place + len(block.removeprefix(exif_tags.PREFIX))] = block.removeprefix(exif_tags.PREFIX)
    stream.write(whole)


#: Suffixes of RAW files, most of which begin like TIFF files.
RAWS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")


def is_raw(path: Path) -> bool:
    """Whether a path has the suffix of a RAW file."""
    return path.suffix.lower() in RAWS


def is_heic(head: bytes) -> bool:
    """Whether a file with these first bytes is HEIC."""
    return head[4:8] == b"ftyp" and head[8:12] in BRANDS and b"avif" not in head


def read_raw(path: Path, check_size: CheckSize) -> Decoded:
    """Read upright 16-bit channels in sRGB, with the camera's white balance and no brightening."""
    try:
        import rawpy
    except ImportError as error:
        raise ValueError(
            f"{path} is a RAW file and needs the package rawpy, which is not installed; install nlfilter-torch[raw]"
        ) from error
    try:
        with rawpy.imread(str(path)) as raw:
            check_size((raw.sizes.iwidth, raw.sizes.iheight))
            channels = raw.postprocess(output_bps=16, use_camera_wb=True, no_auto_bright=True)
            exif, moved = _own_exif(path)
            with suppress(rawpy.LibRawError, ValueError, EOFError):  # no preview, or an unreadable one
                tables = exif_tags.parsed(exif)
                detailed = tables is not None and any(field.code == EXIF for field in tables.fields(tables.first))
                preview = None if detailed else raw.extract_thumb()
                if preview is not None and preview.format == rawpy.ThumbFormat.JPEG:
                    exif = jpeg.open_jpeg(path, bytes(preview.data)).metadata.exif or exif
    except rawpy.LibRawError as error:
        raise UnhandledImage(
            f"{path} cannot be read as a RAW file, or is damaged; copy it again, or convert it to DNG or TIFF"
        ) from error
    # The pixels are upright, and of another size than the preview.
    exif = exif_tags.read_upright(exif, 1, channels.shape[1::-1]).block
    return Decoded(channels, 1, Metadata(exif=exif, extras=Extras(left_out=(exif_in_tiff.MOVED,) * moved)))


def _own_exif(path: Path) -> tuple[bytes | None, bool]:
    """The EXIF block of a RAW file that is a TIFF file, and whether its maker note was moved."""
    try:
        with path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
            return exif_in_tiff.block_of(TiffTables(data))
    except (ValueError, struct.error):
        return None, False


def read_heic(path: Path, check_size: CheckSize) -> Decoded:
    """Read upright channels of 8 bits, or of 16 if the file has more."""
    try:
        import pillow_heif
    except ImportError as error:
        raise ValueError(
            f"{path} is an HEIC file and needs the package pillow-heif, which is not installed; "
            "install nlfilter-torch[heic]"
        ) from error
    with decoding(path), path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
        with _parsing(path, data, "libheif"):
            picture = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
        check_size(picture.size)
        info = picture.info
        numbers = info.get("nclx_profile")
        if numbers:
            profiled = bool(info.get("icc_profile"))
            _check_numbers(path, numbers["color_primaries"], numbers["transfer_characteristics"], profiled)
        channels = np.asarray(picture)
        if channels.dtype == np.uint16:  # the lower bits are empty
            channels = np.rint(channels * (65535 / (65536 - (1 << (16 - info["bit_depth"]))))).astype(np.uint16)
        # The pixels are upright already.
        upright = exif_tags.read_upright(info.get("exif"), 1)
        left_out = [FURTHER_PICTURES] * (len(picture) > 1) + [DEPTH] * bool(info.get("depth_images"))
        left_out += [FURTHER_PICTURES] * bool(info.get("aux"))
        return _decoded(channels, info.get("icc_profile"), upright, info.get("xmp"), left_out)
