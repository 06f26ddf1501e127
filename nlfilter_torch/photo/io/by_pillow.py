"""WebP and AVIF files, by Pillow; AVIF files of more than 8 bits by imagecodecs."""

import io
import struct
from mmap import mmap
from pathlib import Path
from typing import BinaryIO

import imagecodecs
import numpy as np
from PIL import AvifImagePlugin, Image, ImageFile, WebPImagePlugin

from nlfilter_torch.photo.io import colours, xmp
from nlfilter_torch.photo.io import exif as exif_tags
from nlfilter_torch.photo.io.decoded import Channels, CheckSize, Decoded, Metadata, UnhandledImage
from nlfilter_torch.photo.io.extras import Extras

ENCODING: dict[str, dict[str, object]] = {
    "WebP": {"lossless": True, "exact": True},  # exact: also where it is transparent
    "AVIF": {"quality": 90, "subsampling": "4:4:4"},
}
MOST_AVIF, LONGEST_AVIF = 1 << 28, 1 << 15  # pixels, and those of a side, that libavif decodes
HEAD = 1 << 16  # bytes that hold the description of an AVIF file
WEBP_CHUNKS = (b"VP8 ", b"VP8L", b"VP8X", b"ALPH", b"ICCP", b"EXIF", b"XMP ", b"ANIM", b"ANMF")


def is_webp(head: bytes) -> bool:
    """Whether a file with these first bytes is WebP."""
    return head[:4] == b"RIFF" and head[8:12] == b"WEBP"


def is_avif(head: bytes) -> bool:
    """Whether a file with these first bytes is AVIF."""
    return head[4:8] == b"ftyp" and b"avi" in head


def read_by_pillow(path: Path, data: bytes | mmap, check_size: CheckSize) -> Decoded:
    """Read a WebP or AVIF file."""
    webp = is_webp(data[:16])
    if not webp:
        _check_avif_size(path, data)
    # Not Image.open, which refuses pictures of more than 179 megapixels whatever the memory.
    with (WebPImagePlugin.WebPImageFile if webp else AvifImagePlugin.AvifImageFile)(path) as image:
        frames = getattr(image, "n_frames", 1)
        if frames > 1:
            raise UnhandledImage(f"{path} is an animation of {frames} frames; save one of them as a picture")
        check_size(image.size)
        if not webp and "icc_profile" not in image.info:
            _check_colours(path, data)
        stated = list(_webp_extras(data)) if webp else [xmp.GAIN_MAP] * (b"tmap" in data[:HEAD])
        if webp:
            upright = exif_tags.read_upright(image.info.get("exif"))
        else:  # whose info holds the block as Pillow writes it anew
            block, orientation = image._decoder.get_info()[4:6]
            upright = exif_tags.read_upright(block, orientation)
        packet, named = xmp.upright(image.info.get("xmp"))
        extras = Extras(packet, left_out=(*stated, *named, *upright.left_out))
        channels = _decoded(image, data)
        metadata = Metadata(image.info.get("icc_profile"), upright.block, extras)
        return Decoded(channels.reshape(*channels.shape[:2], -1), upright.orientation, metadata)


def _decoded(image: ImageFile.ImageFile, data: bytes | mmap) -> Channels:
    """The pixels (H, W) or (H, W, S) of an open file, as 16 bits if an AVIF file has 10 or 12."""
    if image.format == "AVIF" and (bits := _bits_of_avif(data)) > 8:  # Pillow would reduce them to 8
        levels = imagecodecs.avif_decode(data)
        return np.rint(levels * (65535 / (2**bits - 1))).astype(np.uint16)
    return np.asarray(image)


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


def _check_colours(path: Path, data: bytes | mmap) -> None:
    """Check the colours of an AVIF file without a profile, see :mod:`nlfilter_torch.photo.io.colours`."""
    _, marker, numbers = data[:HEAD].partition(b"colrnclx")
    if marker and len(numbers) >= 4:
        colours.check_numbers(path, *struct.unpack(">HH", numbers[:4]))


def _bits_of_avif(data: bytes | mmap) -> int:
    """Read the bits per channel from the codec configuration, which is among the first boxes."""
    head = data[:HEAD]
    place = head.find(b"av1C") + 6  # after the version, the profile and the level
    flags = head[place] if 6 <= place < len(head) else 0
    return (12 if flags & 0x20 else 10) if flags & 0x40 else 8


def _webp_extras(data: bytes | mmap) -> list[str]:
    """Names of the chunks of a WebP file that are not copied."""
    names, place = [], 12
    while place + 8 <= len(data):
        name, length = struct.unpack_from("<4sI", data, place)
        if name not in WEBP_CHUNKS:
            names.append(f"the chunk {name.decode('latin-1').strip()}")
        place += 8 + length + length % 2
    return names


def write_by_pillow(stream: BinaryIO, kind: str, channels: Channels, metadata: Metadata) -> None:
    """Write channels (H, W) or (H, W, S) of 8 bits as a WebP or AVIF file."""
    block = metadata.exif or b""
    # Pillow writes a block with an orientation anew. It gets it under another number, which is then set right.
    hidden = exif_tags.hidden_orientation(block)
    options: dict[str, object] = {"icc_profile": metadata.icc, "exif": hidden} | ENCODING[kind]
    if metadata.extras.xmp is not None:
        options["xmp"] = metadata.extras.xmp
    encoded = io.BytesIO()
    Image.fromarray(channels).save(encoded, format=kind, **options)
    whole, place = encoded.getbuffer(), encoded.getvalue().find(hidden.removeprefix(exif_tags.PREFIX)) if block else 0
    if block:
        whole[place : place + len(block.removeprefix(exif_tags.PREFIX))] = block.removeprefix(exif_tags.PREFIX)
    stream.write(whole)
