"""What the readers of image files return, and the check that they call before they decode."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Channels = NDArray[np.generic]  # (H, W, S), in the dtype of the file


class Decoded(NamedTuple):
    """The content of an image file.

    Attributes:
        channels: (H, W, S), as stored, so perhaps not upright.
        orientation: EXIF orientation, 1 to 8; 1 is upright.
        icc: colour profile, or None.
        exif: EXIF block with orientation 1, or None.
    """

    channels: Channels
    orientation: int
    icc: bytes | None
    exif: bytes | None


class CheckSize(Protocol):
    """Raises TooLarge if a picture of that size needs more memory than may be used."""

    def __call__(self, size: tuple[int, int], /, *, double: bool = False) -> None:
        """Check the size (width, height); ``double`` if the pixels are 64-bit floats."""
