"""Pictures in temporary files, which take space on the disk rather than memory."""

import math
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Protocol

import numpy as np

from nlfilter_torch.photo.files.decoded import Channels
from nlfilter_torch.photo.files.exif import upright
from nlfilter_torch.photo.picture.pictures import FileRows


class StoredRows(Protocol):
    """Rows as they are stored."""

    shape: tuple[int, int, int]
    dtype: np.dtype[np.generic]

    def __getitem__(self, rows: slice, /) -> Channels:
        """Read rows (h, W, S)."""


class Scratch:
    """Rows (H, W, S) in a temporary file.

    Attributes:
        shape: (H, W, S).
        dtype: of the rows.
    """

    def __init__(self, shape: tuple[int, int, int], dtype: np.dtype[np.generic], stack: ExitStack) -> None:
        """Make a file that ``stack`` removes; raises MemoryError if the disk has no room for it."""
        self.shape, self.dtype = shape, dtype
        needed, folder = math.prod(shape) * dtype.itemsize, tempfile.gettempdir()
        free = shutil.disk_usage(folder).free
        if needed > free:  # writing to mapped memory would end the process
            raise MemoryError(
                f"a temporary file of {needed / 1e6:.0f} MB is needed for the pixels, but only {free / 1e6:.0f} MB are "
                f"free in {folder}; free some, or set TMPDIR to a folder with more"
            )
        self.stream = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115 - the stack closes it
        self.stream.truncate(needed)
        self.rows = FileRows(self.stream, shape, dtype)

    @contextmanager
    def array(self) -> Iterator[Channels]:
        """The file as an array (H, W, S) to write to, which is not in memory after the block."""
        yield np.memmap(self.stream, dtype=self.dtype, mode="r+", shape=self.shape)

    def __getitem__(self, rows: slice) -> Channels:
        return self.rows[rows]


def upright_copy(rows: StoredRows, orientation: int, step: int, stack: ExitStack) -> Scratch:
    """The upright picture of rows with an EXIF orientation, of which ``step`` are read at a time."""
    height, width, samples = rows.shape
    turned = orientation >= 5
    scratch = Scratch((width, height, samples) if turned else rows.shape, rows.dtype, stack)
    with scratch.array() as copy:
        for start in range(0, height, step):
            stop = min(start + step, height)
            # These orientations begin with the last row or column.
            place = slice(height - stop, height - start) if orientation in (3, 4, 6, 7) else slice(start, stop)
            copy[(slice(None), place) if turned else place] = upright(rows[slice(start, stop)], orientation)
    return scratch
