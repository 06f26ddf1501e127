"""EXIF blocks, and rotation of pictures by their EXIF orientation."""

import warnings
from collections.abc import Callable, MutableMapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, TiffImagePlugin

Scalar = TypeVar("Scalar", bound=np.generic)
Fields = dict[int, object]  # values of a table by their tags

PREFIX = b"Exif\0\0"
FOLDERS: tuple[int, ...] = (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)  # fields that point to a nested table
INTEROP = int(ExifTags.IFD.Interop)  # a field of the first of these that points to another table


class Latin1(str):
    """Text of a field that Pillow writes as the bytes that it was read from.

    Pillow reads text as latin-1, which keeps the bytes of any encoding, but writes it as ASCII with question marks.
    """

    __slots__ = ()

    def encode(self, encoding: str = "latin-1", errors: str = "replace") -> bytes:
        """Encode as latin-1, whatever encoding is asked for."""
        return super().encode("latin-1", "replace")


def writable(value: object) -> object:
    """The value of a field in the form in which Pillow writes it unchanged."""
    return Latin1(value) if isinstance(value, str) else value


def upright(channels: NDArray[Scalar], orientation: int) -> NDArray[Scalar]:
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
        folders: dict[int, Fields] = {
            code: folder for code in FOLDERS if code in fields and (folder := _folder(exif, code))
        }
        width, height = ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight
        details = folders.get(ExifTags.IFD.Exif, {})
        if orientation >= 5 and width in details and height in details:
            details[width], details[height] = details[height], details[width]
        _keep_bytes(exif, *folders.values())
        try:
            return orientation, exif.tobytes()
        except Exception:  # Pillow does not say which field is invalid
            return orientation, _sound(fields, folders).tobytes()


def _keep_bytes(*tables: MutableMapping[int, object]) -> None:
    """Make Pillow write the texts of tables as they were read."""
    for table in tables:
        for code, value in list(table.items()):
            table[code] = writable(value)


def without_orientation(block: bytes) -> bytes:
    """Remove the orientation from an EXIF block; empty if nothing else is in it."""
    exif = Image.Exif()
    exif.load(block)
    exif.pop(ExifTags.Base.Orientation, None)
    _keep_bytes(exif, *(_folder(exif, code) for code in FOLDERS if code in exif))
    return exif.tobytes() if exif else b""


def orientation_of(value: object) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (upright) if ``value`` is invalid.

    >>> orientation_of(6), orientation_of("upside down")
    (6, 1)
    """
    return int(value) if isinstance(value, int) and 1 <= value <= 8 else 1


def _folder(exif: Image.Exif, code: int) -> Fields:
    try:
        return exif.get_ifd(code)
    except Exception:
        return {}


def tables(exif: Image.Exif) -> dict[int, Fields]:
    """The nested tables of a block, each with the tables inside it in place of pointers to them."""
    folders = {code: dict(folder) for code in FOLDERS if (folder := _folder(exif, code))}
    for folder in folders.values():
        if folder.pop(INTEROP, None) is not None and (inner := _folder(exif, INTEROP)):
            folder[INTEROP] = inner
    return folders


def _sound(fields: Fields, folders: dict[int, Fields]) -> Image.Exif:
    """Build an EXIF block from the fields that can be written."""
    block = Image.Exif()
    for code, value in fields.items():
        if code not in FOLDERS and is_writable(code, value):
            block[code] = writable(value)
    block[ExifTags.Base.Orientation] = 1
    for code, folder in folders.items():
        block.get_ifd(code).update(
            {key: writable(value) for key, value in folder.items() if key != INTEROP and is_writable(key, value)}
        )
    return block


def is_writable(code: int, value: object) -> bool:
    """Whether Pillow can write a field with that value."""
    table = TiffImagePlugin.ImageFileDirectory_v2()
    try:
        table[code] = writable(value)
        table.tobytes()
    except Exception:
        return False
    return True
