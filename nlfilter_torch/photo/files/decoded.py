"""What the readers of image files return, and the errors that they raise."""

import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from nlfilter_torch.photo.files.metadata import Metadata, UnhandledImage

if sys.platform == "linux":
    from mmap import MADV_DONTNEED

Stored = NDArray[np.generic]  # (H, W, S), in the dtype of the file


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Report any error in the block as a damaged file, since decoders have no common base class for errors."""
    try:
        yield
    except (MemoryError, UnhandledImage):
        raise
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"{path} is damaged or cut short ({reason}); copy it again from its source") from error


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the warnings of Pillow about damaged EXIF blocks, which it does not read for us."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


class Decoded(NamedTuple):
    """The content of an image file.

    Attributes:
        channels: (H, W, S), as stored, so perhaps not upright.
        orientation: EXIF orientation, 1 to 8; 1 is upright.
        metadata: what the file says about them once they are upright.
    """

    channels: Stored
    orientation: int
    metadata: Metadata


@dataclass(frozen=True)
class Header:
    """What a file to write says of its picture.

    Attributes:
        shape: (H, W, S).
        dtype: of the channels.
        alpha: whether the last channel is transparency.
        metadata: the rest.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[np.generic]
    alpha: bool
    metadata: Metadata


class CheckSize(Protocol):
    """Raises TooLarge if a picture of that size needs more memory than may be used."""

    def __call__(self, size: tuple[int, int], /, *, double: bool = False) -> None:
        """Check the size (width, height); ``double`` if the pixels are 64-bit floats."""


def release(data: bytes | mmap) -> None:
    """Give back the memory for what was read of a file that is mapped to be read; it is read again when needed."""
    if sys.platform == "linux" and isinstance(data, mmap):
        data.madvise(MADV_DONTNEED)


def bands(rows: Iterable[Stored], height: int) -> Iterator[Stored]:
    """Regroup rows (h, W, S) into pieces of the same ``height``, the last one possibly shorter.

    >>> [len(band) for band in bands([np.zeros((3, 1, 1)), np.zeros((4, 1, 1))], 2)]
    [2, 2, 2, 1]
    """
    waiting: list[Stored] = []
    for piece in rows:
        waiting.append(piece)
        while sum(map(len, waiting)) >= height:
            # A single piece may be the whole picture, which is not copied.
            whole = waiting[0] if len(waiting) == 1 else np.concatenate(waiting)
            waiting = [whole[height:]]
            yield whole[:height]
    if waiting and sum(map(len, waiting)):
        yield np.concatenate(waiting)
