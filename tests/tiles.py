"""Pictures read by rows in tests: sources, edits in tiles, and the same edits in memory."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import skimage.data
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.photo.picture.colour import edit_luminance
from tests.streams import stream_detail

Array = NDArray[Any]
ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.05])
LEVEL = 1 / 255
PLAIN: dict[str, Any] = {  # the filter as it is, as by nonlocal_operator
    "limits": "none",
    "threshold": 0.0,
    "photometric_bandwidth": "auto",
    "spatial_bandwidth": "none",
    "num_landmarks": 100,
}
FEW = 1 << 27  # bytes that allow one row at a time


def cat(height: int, width: int) -> Array:
    """(height, width, 3) of a photograph with fur, floats in [0, 1]."""
    return skimage.data.chelsea()[20 : 20 + height, 90 : 90 + width].astype(np.float32) / np.float32(255)


def in_memory(picture: Array, alpha: Tensor = ALPHA, residual: float | None = None, **options: Any) -> Array:
    """Return the result of `nlfilter-torch detail` for a picture in memory."""
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    operator = nonlocal_operator(image, **{"tolerance": 1e-6, **options})
    edited = edit_luminance(image, lambda planes: polynomial_filter(operator, planes, alpha, residual=residual))
    return edited[0].permute(1, 2, 0).numpy()


def streamed(picture: Array, alpha: Tensor = ALPHA, *, kind: str | None = None, **options: Any) -> Array:
    edited = np.empty(picture.shape, kind or picture.dtype)
    stream_detail(picture, edited, alpha, **(PLAIN | options))
    return edited


@dataclass
class Rows:
    """A source that counts the rows read, and allows only a few rows at once."""

    picture: Array
    most: int
    read: int = 0
    shape: tuple[int, ...] = field(init=False)
    dtype: Any = field(init=False)

    def __post_init__(self) -> None:
        self.shape, self.dtype = self.picture.shape, self.picture.dtype

    def __getitem__(self, rows: slice) -> Array:
        assert rows.stop - rows.start <= self.most
        self.read += rows.stop - rows.start
        return self.picture[rows]


def spots(height: int, width: int) -> Array:
    """Two regions (height, width, 2), one of them of half weight."""
    regions = np.zeros((height, width, 2), np.float32)
    regions[10:20, 15:30, 0] = 1
    regions[30:40, 60:70, 1] = 0.5
    return regions


class Shrinking(Rows):
    """A file that is truncated after it was opened."""

    def __getitem__(self, rows: slice) -> Array:
        return super().__getitem__(rows)[: 5 if self.read > 40 else None]
