"""Reading of camera and phone files: RAW by rawpy, HEIC by pillow-heif. They are not written.

Needs the ``cli`` extra, and the extras ``raw`` and ``heic``.
"""

import io
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from nlfilter_torch.photo.io import colours, tiff
from nlfilter_torch.photo.io import exif as exif_tags
from nlfilter_torch.photo.io.decoded import CheckSize, Decoded

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
            exif = None
            with suppress(rawpy.LibRawError):  # no preview, or an unreadable one
                preview = raw.extract_thumb()
                if preview.format == rawpy.ThumbFormat.JPEG:
                    exif = _exif_of(bytes(preview.data))
    except rawpy.LibRawError as error:
        raise tiff.UnhandledImage(
            f"{path} cannot be read as a RAW file, or is damaged; copy it again, or convert it to DNG or TIFF"
        ) from error
    return Decoded(channels, 1, None, exif)


def _exif_of(preview: bytes) -> bytes | None:
    """Read the EXIF block of a JPEG preview, and reset its orientation, as the RAW pixels are upright."""
    return exif_tags.split(partial(_preview_fields, preview))[1]


def _preview_fields(preview: bytes) -> Image.Exif:
    """Parse the EXIF block of a JPEG file."""
    return Image.open(io.BytesIO(preview)).getexif()


def read_heic(path: Path, check_size: CheckSize) -> Decoded:
    """Read upright channels of 8 bits, or of 16 if the file has more."""
    try:
        import pillow_heif
    except ImportError as error:
        raise ValueError(
            f"{path} is an HEIC file and needs the package pillow-heif, which is not installed; "
            "install nlfilter-torch[heic]"
        ) from error
    with tiff.decoding(path):
        picture = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
        check_size(picture.size)
        info = picture.info
        numbers = info.get("nclx_profile")
        if numbers and not info.get("icc_profile"):
            colours.check_numbers(path, numbers["color_primaries"], numbers["transfer_characteristics"])
        channels = np.asarray(picture)
        if channels.dtype == np.uint16:  # the lower bits are empty
            channels = np.rint(channels * (65535 / (65536 - (1 << (16 - info["bit_depth"]))))).astype(np.uint16)
        exif = exif_tags.split(partial(_upright_fields, info.get("exif") or b""))[1]
        return Decoded(channels.reshape(*channels.shape[:2], -1), 1, info.get("icc_profile"), exif)


def _upright_fields(block: bytes) -> Image.Exif:
    """Parse an EXIF block, without its orientation since the pixels are upright already."""
    fields = Image.Exif()
    fields.load(block)
    fields.pop(ExifTags.Base.Orientation, None)
    return fields
