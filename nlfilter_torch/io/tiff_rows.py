"""TIFF files read by rows: strips or tiles are decoded as they are needed, and forgotten."""

import os
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray

from nlfilter_torch.io import tiff

KEPT = 2  # bands of strips or tiles: rows that two tiles of a picture share lie in two at most


class TiffRows:
    """The first page of a TIFF file, upright, as rows (H, W, S).

    Attributes:
        shape: (H, W, S).
        dtype: in the machine's order of bytes.
        icc: the colour profile, or None.
        exif: the EXIF block, or None.
        alpha: that the last channel is one.
    """

    def __init__(self, path: Path) -> None:
        """Read the header.

        Raises:
            UnhandledTiff: if it is a picture of a kind that is not handled.
        """
        self.path = path
        self.stream: BinaryIO = path.open("rb")
        try:
            self.file = tifffile.TiffFile(self.stream, name=str(path))
            page: Any = self.file.pages.first
            tiff.check_page(page)
            self.orientation, self.icc, self.exif = tiff.notes(self.file, path)
        except BaseException:
            self.stream.close()
            raise
        self.page = page
        self.stamp = self._look()
        self.shape = (page.imagelength, page.imagewidth, page.samplesperpixel)
        self.dtype = page.dtype.newbyteorder("=")
        self.alpha = bool(page.extrasamples)
        # (height, width) of a strip or tile; strips may say that they are higher than the picture.
        self.segment = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
        self.segment = (min(self.segment[0], self.shape[0]), self.segment[1])
        self.bands: dict[int, NDArray[Any]] = {}

    def __enter__(self) -> "TiffRows":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stream.close()

    @property
    def turned(self) -> bool:
        """That the rows of the upright picture are stored as columns."""
        return self.orientation >= 5

    @property
    def held(self) -> int:
        """Bytes of decoded strips or tiles that are held while rows are read."""
        return 0 if self._raw else (KEPT + 1) * self.segment[0] * self.shape[1] * self.shape[2] * self.dtype.itemsize

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """The rows from ``rows.start`` to ``rows.stop``.

        Raises:
            ValueError: if the file has changed since it was opened, or is damaged.
        """
        start, stop, height = rows.start, rows.stop, self.shape[0]
        flipped = self.orientation in (3, 4)
        first, last = (height - stop, height - start) if flipped else (start, stop)
        read: Callable[[int, int], NDArray[Any]] = self._read_raw if self._raw else self._decode
        try:
            stored = read(first, last)
        except Exception as error:  # decoders have no common class for damage
            self._check_unchanged()
            raise ValueError(
                f"{self.path} is damaged or cut short ({error or type(error).__name__}); copy it again from its source"
            ) from error
        self._check_unchanged()
        plain = tiff.plain(self.page, stored)
        return plain[:: -1 if flipped else 1, :: -1 if self.orientation in (2, 3) else 1]

    @property
    def _raw(self) -> bool:
        """That rows lie in the file one after the other, as they are."""
        contiguous: bool = self.page.is_contiguous and self.page.planarconfig == tifffile.PLANARCONFIG.CONTIG
        return contiguous and self.page.compression == tifffile.COMPRESSION.NONE and not self.page.is_tiled

    def _read_raw(self, first: int, last: int) -> NDArray[Any]:
        length = self.shape[1] * self.shape[2] * self.dtype.itemsize
        self.stream.seek(self.page.dataoffsets[0] + first * length)
        data = self.stream.read((last - first) * length)
        stored = self.page.dtype.newbyteorder(self.file.byteorder)
        return np.frombuffer(data, stored).reshape(last - first, *self.shape[1:])

    def _decode(self, first: int, last: int) -> NDArray[Any]:
        height = self.segment[0]
        wanted = range(first // height, -(-last // height))
        for band in wanted:
            if band not in self.bands:
                self.bands[band] = self._band(band)
        whole = np.concatenate([self.bands[band] for band in wanted])
        for band in sorted(self.bands)[: -KEPT or None]:
            del self.bands[band]
        return whole[first - wanted.start * height : last - wanted.start * height]

    def _band(self, band: int) -> NDArray[Any]:
        """One row of tiles, or one strip, (h, W, S)."""
        height, width, samples = self.shape
        top = band * self.segment[0]
        result = np.full((min(self.segment[0], height - top), width, samples), self.page.nodata, self.page.dtype)
        down, across = -(-height // self.segment[0]), -(-width // self.segment[1])
        apart = self.page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and samples > 1
        for plane in range(samples if apart else 1):
            for column in range(across):
                index = (plane * down + band) * across + column
                self.stream.seek(self.page.dataoffsets[index])
                count = self.page.databytecounts[index]
                data = self.stream.read(count) if count else None
                if data is not None and len(data) < count:
                    raise EOFError("it ends too early")
                segment, _, _ = self.page.decode(data, index, jpegtables=self.page.jpegtables)
                if segment is None:
                    continue  # left out, as sparse files do
                left = column * self.segment[1]
                part = segment[0, : result.shape[0], : width - left]
                channels = slice(plane, plane + 1) if apart else slice(None)
                result[: part.shape[0], left : left + part.shape[1], channels] = part
        return result

    def _look(self) -> tuple[int, int]:
        status = os.fstat(self.stream.fileno())
        return status.st_size, status.st_mtime_ns

    def _check_unchanged(self) -> None:
        if self._look() != self.stamp:
            raise ValueError(
                f"{self.path} changed while it was read, from {self.stamp[0]} to {self._look()[0]} bytes; "
                "let nothing write to it meanwhile, and start again"
            )
