"""Writing of masks as PFM files, with one channel of floats, which darktable and ART read as raster masks."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlfilter_torch.photo.files.writing import open_beside

PFM = ".pfm"


def write_pfm(path: Path, plane: NDArray[np.float32]) -> None:
    """Write a plane (H, W), bottom row first as the format requires; the file appears complete or not at all."""
    height, width = plane.shape
    with open_beside(path) as stream:
        stream.write(f"Pf\n{width} {height}\n-1.0\n".encode())  # negative: little-endian
        stream.write(np.ascontiguousarray(plane[::-1], "<f4").tobytes())
