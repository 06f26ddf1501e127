"""Rows in temporary files, which take space on the disk rather than memory."""

import math
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from threading import Lock
from typing import BinaryIO

import numpy as np

from nlfilter_torch.photo.declared.rows import Stored


@dataclass(frozen=True)
class FileRows:
    """Rows in an open file, which are read when they are needed.

    They are not mapped into memory: the system counts what was read of a mapped file as memory of the process.

    Attributes:
        stream: the file, which holds nothing else.
        shape: (H, W) or (H, W, S).
        dtype: of the rows.
        lock: held while the place in the file matters.
    """

    stream: BinaryIO
    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]
    lock: Lock = field(default_factory=Lock)

    def __getitem__(self, rows: slice) -> Stored:
        """The rows from ``rows.start`` to ``rows.stop``."""
        start, stop, _ = rows.indices(self.shape[0])
        length = math.prod(self.shape[1:]) * self.dtype.itemsize
        with self.lock:
            self.stream.seek(start * length)
            data = self.stream.read((stop - start) * length)
        return np.frombuffer(data, self.dtype).reshape(-1, *self.shape[1:])

    def part(self, rows: range, columns: range) -> Stored:
        """Some rows and columns (h, w, S) of (H, W, S), without reading the others."""
        pixel = math.prod(self.shape[2:]) * self.dtype.itemsize
        data = bytearray()
        with self.lock:
            for row in rows:
                self.stream.seek((row * self.shape[1] + columns.start) * pixel)
                data += self.stream.read(len(columns) * pixel)
        return np.frombuffer(data, self.dtype).reshape(len(rows), len(columns), *self.shape[2:])


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
    def array(self) -> Iterator[Stored]:
        """The file as an array (H, W, S) to write to, which is not in memory after the block."""
        yield np.memmap(self.stream, dtype=self.dtype, mode="r+", shape=self.shape)

    def __getitem__(self, rows: slice) -> Stored:
        return self.rows[rows]
