"""Reading of camera and phone files: RAW by rawpy, HEIC by pillow-heif. They are not written.

Needs the ``cli`` extra, and the extras ``raw`` and ``heic``.
"""

import struct
from contextlib import suppress
from mmap import ACCESS_READ, mmap
from pathlib import Path

import numpy as np

from nlfilter_torch.photo.files import colours, exif_in_tiff, jpeg, xmp
from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files.decoded import CheckSize, Decoded, Metadata, UnhandledImage, decoding
from nlfilter_torch.photo.files.extras import Extras
from nlfilter_torch.photo.files.tables import EXIF, Tables

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
                preview = raw.extract_thumb() if exif is None or not _has_details(exif) else None
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
            return exif_in_tiff.block_of(Tables(data))
    except (ValueError, struct.error):
        return None, False


def _has_details(exif: bytes) -> bool:
    tables = exif_tags.parsed(exif)
    return tables is not None and any(field.code == EXIF for field in tables.fields(tables.first))


def read_heic(path: Path, check_size: CheckSize) -> Decoded:
    """Read upright channels of 8 bits, or of 16 if the file has more."""
    try:
        import pillow_heif
    except ImportError as error:
        raise ValueError(
            f"{path} is an HEIC file and needs the package pillow-heif, which is not installed; "
            "install nlfilter-torch[heic]"
        ) from error
    with decoding(path):
        picture = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
        check_size(picture.size)
        info = picture.info
        numbers = info.get("nclx_profile")
        if numbers and not info.get("icc_profile"):
            colours.check_numbers(path, numbers["color_primaries"], numbers["transfer_characteristics"])
        channels = np.asarray(picture)
        if channels.dtype == np.uint16:  # the lower bits are empty
            channels = np.rint(channels * (65535 / (65536 - (1 << (16 - info["bit_depth"]))))).astype(np.uint16)
        # The pixels are upright already.
        upright = exif_tags.read_upright(info.get("exif"), 1)
        packet, left_out = xmp.upright(info.get("xmp"))
        left_out += [xmp.PICTURES] * (len(picture) > 1) + [xmp.DEPTH] * bool(info.get("depth_images"))
        left_out += [xmp.PICTURES] * bool(info.get("aux"))
        extras = Extras(packet, left_out=(*left_out, *upright.left_out))
        metadata = Metadata(info.get("icc_profile"), upright.block, extras)
        return Decoded(channels.reshape(*channels.shape[:2], -1), 1, metadata)
