"""Rows between two steps of an edit, in a temporary file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np

from nlfilter_torch.tiled.pictures import Rows, RowSource


@contextmanager
def intermediate(rows: Rows, size: tuple[int, int], folder: Path | None) -> Iterator[RowSource]:
    """Write rows (h, W, S) of floats to a temporary file, and yield it as a source of rows.

    Args:
        rows: of a picture, in order.
        size: (H, W) of the picture.
        folder: for the file; None is the system's folder for temporary files.

    Raises:
        OSError: if the file does not fit.
    """
    with TemporaryFile(dir=folder) as file:
        shape, kind = (*size, 0), np.dtype(np.float32)
        for _, values in rows:
            shape, kind = (*size, values.shape[2]), values.dtype
            try:
                file.write(np.ascontiguousarray(values).tobytes())
            except OSError as error:
                gigabytes = kind.itemsize * np.prod(shape) / 1e9
                reason = f"{error.strerror}, for a temporary file of {gigabytes:.1f} GB between two steps of the edit"
                raise OSError(error.errno, reason, str(folder)) from error
        file.flush()
        yield np.memmap(file, kind, "r", shape=shape)
