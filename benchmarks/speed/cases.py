"""Images of the measurements, and options of the operator."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import skimage.data
import torch
from skimage.color import rgb2gray
from skimage.transform import resize
from torch import Tensor

from nlfilter_torch import NonlocalOperator, nonlocal_operator

PICTURE = "retina"  # 1411 x 1411, the largest photograph that comes with scikit-image
TOLERANCE = 1e-4  # of the row sums


@dataclass(frozen=True)
class Case:
    """Size and options of one operator; the defaults are the case that all others vary."""

    height: int = 1024
    width: int = 1024
    batch: int = 1
    landmarks: int = 100
    patch_size: int = 5
    dtype: str = "float32"
    threads: int = 0
    picture: str = PICTURE
    device: str = "cpu"

    @property
    def pixels(self) -> int:
        """Number of pixels of one image."""
        return self.height * self.width

    @property
    def working_dtype(self) -> torch.dtype:
        """Precision of the operator: float64 for float64, else float32."""
        return torch.float64 if self.dtype == "float64" else torch.float32

    @property
    def factor_bytes(self) -> int:
        """Size of the operator's factor, in bytes."""
        return self.batch * self.pixels * self.landmarks * self.working_dtype.itemsize

    @property
    def used_threads(self) -> int:
        """Number of torch threads: all, unless set."""
        return self.threads or torch.get_num_threads()

    def label(self) -> str:
        """A short description that distinguishes cases."""
        count = f"{self.batch} x " if self.batch > 1 else ""
        return (
            f"{count}{self.height}x{self.width}, m = {self.landmarks}, {self.patch_size}x{self.patch_size}, "
            f"{self.dtype}, {self.used_threads} thread{'s' if self.used_threads > 1 else ''}"
        )

    def image(self) -> Tensor:
        """Image (B, 1, H, W): the resized picture or, for a batch, its tiles."""
        rows = int(self.batch**0.5)
        while self.batch % rows:
            rows -= 1
        columns = self.batch // rows
        whole = grey(self.picture, rows * self.height, columns * self.width)
        tiles = whole.reshape(rows, self.height, columns, self.width).transpose(0, 2, 1, 3)
        image = torch.from_numpy(np.ascontiguousarray(tiles)).reshape(self.batch, 1, self.height, self.width)
        return image.to(self.device, getattr(torch, self.dtype))

    def options(self) -> dict[str, Any]:
        """Keyword arguments of :func:`nonlocal_operator`."""
        return {"num_landmarks": self.landmarks, "patch_size": self.patch_size, "tolerance": TOLERANCE}

    def operator(self, image: Tensor) -> NonlocalOperator:
        """Build the operator of an image with these options."""
        return nonlocal_operator(image, **self.options())


@functools.cache
def colour(name: str, height: int, width: int) -> np.ndarray:
    """A photograph of scikit-image as (H, W, 3) float32 in [0, 1], resized; read-only."""
    photograph = getattr(skimage.data, name)()
    photograph = np.stack([photograph] * 3, axis=-1) if photograph.ndim == 2 else photograph
    scaled = resize(photograph, (height, width), anti_aliasing=True).astype(np.float32)
    scaled.setflags(write=False)
    return scaled


def grey(name: str, height: int, width: int) -> np.ndarray:
    """The photograph of :func:`colour` in grey, (H, W)."""
    return np.ascontiguousarray(rgb2gray(colour(name, height, width)), dtype=np.float32)
