"""EXIF blocks, and rotation of pictures by their EXIF orientation."""

import warnings
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray
from PIL import ExifTags, Image, TiffImagePlugin

PREFIX = b"Exif\0\0"
FOLDERS: tuple[int, ...] = (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)  # fields that point to a nested table


def upright(channels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Rotate or flip an array (H, W, S) stored with an EXIF orientation to the upright position.

    >>> import numpy as np
    >>> upright(np.array([[[1], [2]]]), 6)[..., 0].tolist()
    [[1], [2]]
    """
    if orientation >= 5:
        channels = channels.swapaxes(0, 1)
    return channels[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def split(read: Callable[[], Image.Exif]) -> tuple[int, bytes | None]:
    """Return the orientation, and the other fields as an EXIF block with orientation 1, or None if there are none.

    ``read`` returns the block. Width and height fields are swapped if the orientation swaps them. Invalid fields are
    dropped, since they do not affect the pixels.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns about damaged blocks
        try:
            exif = read()
            fields = dict(exif)
        except Exception:  # Pillow has no common base class for these errors
            return 1, None
        orientation = orientation_of(fields.get(ExifTags.Base.Orientation))
        if set(fields) <= {ExifTags.Base.Orientation}:
            return orientation, None
        exif[ExifTags.Base.Orientation] = 1
        folders: dict[int, dict[int, Any]] = {
            code: folder for code in FOLDERS if code in fields and (folder := _folder(exif, code))
        }
        width, height = ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight
        details = folders.get(ExifTags.IFD.Exif, {})
        if orientation >= 5 and width in details and height in details:
            details[width], details[height] = details[height], details[width]
        try:
            return orientation, exif.tobytes()
        except Exception:  # Pillow does not say which field is invalid
            return orientation, _sound(fields, folders).tobytes()


def orientation_of(value: Any) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (upright) if ``value`` is invalid.

    >>> orientation_of(6), orientation_of("upside down")
    (6, 1)
    """
    return int(value) if isinstance(value, int) and 1 <= value <= 8 else 1


def _folder(exif: Image.Exif, code: int) -> dict[int, Any]:
    try:
        return exif.get_ifd(code)
    except Exception:
        return {}


def _sound(fields: dict[int, Any], folders: dict[int, dict[int, Any]]) -> Image.Exif:
    """Build an EXIF block from the fields that can be written."""
    block = Image.Exif()
    for code, value in fields.items():
        if code not in FOLDERS and is_writable(code, value):
            block[code] = value
    block[ExifTags.Base.Orientation] = 1
    for code, folder in folders.items():
        block.get_ifd(code).update({key: value for key, value in folder.items() if is_writable(key, value)})
    return block


def is_writable(code: int, value: Any) -> bool:
    """Whether Pillow can write a field with that value."""
    table = TiffImagePlugin.ImageFileDirectory_v2()
    try:
        table[code] = value
        table.tobytes()
    except Exception:
        return False
    return True
