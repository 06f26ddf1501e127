"""EXIF blocks: what they say of a picture's orientation, and the picture turned upright."""

from typing import Any

from numpy.typing import NDArray
from PIL import ExifTags, Image

PREFIX = b"Exif\0\0"
# (transpose, turn upside down, mirror), in that order, for each orientation of the EXIF standard.
_TURNS = {
    1: (False, False, False),
    2: (False, False, True),
    3: (False, True, True),
    4: (False, True, False),
    5: (True, False, False),
    6: (True, False, True),
    7: (True, True, True),
    8: (True, True, False),
}


def upright(channels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """An array (H, W, S) stored with an EXIF orientation, as it is meant to be seen.

    >>> import numpy as np
    >>> upright(np.array([[[1], [2]]]), 6)[..., 0].tolist()
    [[1], [2]]
    """
    transpose, upside_down, mirror = _TURNS.get(orientation, _TURNS[1])
    if transpose:
        channels = channels.swapaxes(0, 1)
    return channels[:: -1 if upside_down else 1, :: -1 if mirror else 1]


def split(exif: Image.Exif) -> tuple[int, bytes | None]:
    """The orientation, and the rest as a block that says "upright"; None where there is nothing to say.

    The sizes that some cameras note are swapped if the picture is to be turned on its side.
    """
    orientation = int(exif.get(ExifTags.Base.Orientation, 1))
    if set(exif) <= {ExifTags.Base.Orientation}:
        return orientation, None
    exif[ExifTags.Base.Orientation] = 1
    details = exif.get_ifd(ExifTags.IFD.Exif)
    width, height = ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight
    if orientation >= 5 and width in details and height in details:
        details[width], details[height] = details[height], details[width]
    return orientation, exif.tobytes()
