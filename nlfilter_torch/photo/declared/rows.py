"""Rows of pixels as files store them, which files and pictures both know: their protocol, and which of them count."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

WHITE = {"uint8": 255, "uint16": 65535}  # the integer that stands for 1.0
Stored = NDArray[np.generic]  # rows (h, W, S) of a picture, in the dtype of its file


class RowSource(Protocol):
    """Rows (H, W) or (H, W, S) to read; a slice of them can be converted to a numpy array."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W) or (H, W, S)."""

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """A numpy dtype."""

    def __getitem__(self, rows: slice, /) -> ArrayLike:
        """The rows from ``rows.start`` to ``rows.stop``."""


@dataclass(frozen=True)
class NodataRows:
    """Rows of a picture without transparency, and one more channel: 0 where they hold no data, white elsewhere.

    Attributes:
        rows: (H, W) or (H, W, S).
        nodata: the value of pixels without data, see :func:`lacks_data`.
    """

    rows: RowSource
    nodata: float

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W, S + 1)."""
        height, width, *samples = self.rows.shape
        return height, width, (samples[0] if samples else 1) + 1

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Of the rows."""
        return self.rows.dtype

    def __getitem__(self, rows: slice) -> Stored:
        """The rows from ``rows.start`` to ``rows.stop``."""
        stored = np.asarray(self.rows[rows])
        stored = stored.reshape(*stored.shape[:2], -1)
        white = stored.dtype.type(WHITE.get(stored.dtype.name, 1))
        counts = np.where(lacks_data(stored, self.nodata), stored.dtype.type(0), white)
        return np.concatenate([stored, counts[..., None]], axis=2)


def lacks_data(stored: Stored, nodata: float) -> NDArray[np.bool_]:
    """Where pixels (..., S) hold no data, (...).

    These are the pixels all of whose channels have the value ``nodata``; of floats, all pixels with such a channel.
    """
    if stored.dtype.kind != "f":
        return (stored == nodata).all(-1)
    with np.errstate(over="ignore"):  # a value that the dtype does not hold
        value = np.asarray(nodata).astype(stored.dtype)
    return np.any(np.isnan(stored) if np.isnan(nodata) else np.equal(stored, value), axis=-1)


def is_hidden(stored: Stored) -> NDArray[np.bool_]:
    """Where pixels (..., S), whose last channel is transparency, are hidden, (...)."""
    return np.less_equal(stored[..., -1], 0)


def keep_apart(values: Stored, hidden: NDArray[np.bool_], nodata: float) -> None:
    """Move the values of pixels (h, W, C) that are not hidden by a step if they say that there is no data."""
    if np.isnan(nodata):
        return
    taken = lacks_data(values, nodata) & ~hidden
    if not taken.any():
        return
    if values.dtype.kind != "f":
        values[taken] = nodata + 1 if nodata < np.iinfo(values.dtype.name).max else nodata - 1
        return
    pixels, value = values[taken], np.asarray(nodata).astype(values.dtype)
    beside = np.nextafter(value, np.asarray(0 if nodata else 1).astype(values.dtype))
    values[taken] = np.where(pixels == value, beside, pixels)
