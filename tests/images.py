"""Small test images: photographs that ship with scikit-image, and images that are hard for a filter."""

from functools import cache

import numpy as np
import skimage.data
from numpy.typing import NDArray
from skimage.color import rgb2gray
from skimage.transform import resize

Array = NDArray[np.float64]

PHOTOGRAPHS = ("astronaut", "camera", "chelsea", "coffee", "moon", "rocket")


@cache
def photograph(name: str, height: int | None = None, width: int | None = None) -> Array:
    """Return a grey picture of skimage.data, (H, W) in [0, 1], reduced with anti-aliasing if a size is given."""
    picture = getattr(skimage.data, name)()
    grey = rgb2gray(picture) if picture.ndim == 3 else picture / 255.0
    if height is not None and width is not None:
        grey = resize(grey, (height, width), anti_aliasing=True)
    grey = np.clip(grey, 0, 1)
    grey.setflags(write=False)  # one array is shared by all tests
    return grey


def reduced(name: str, long_side: int) -> Array:
    """A photograph in grey with its proportions kept and its long side at most ``long_side``."""
    height, width = photograph(name).shape
    scale = min(1.0, long_side / max(height, width))
    return photograph(name, round(height * scale), round(width * scale))


def two_colours(height: int = 40, width: int = 48) -> Array:
    """Left half dark, right half light."""
    image = np.full((height, width), 0.25)
    image[:, width // 2 :] = 0.75
    return image


def bright_pixel(height: int = 40, width: int = 48) -> Array:
    """Black except for one white pixel."""
    image = np.zeros((height, width))
    image[height // 2, width // 2] = 1.0
    return image


def hard_images() -> dict[str, Array]:
    """Images that make a kernel matrix singular, a row of it vanish, or a border impossible to reflect."""
    noise = np.random.default_rng(0)
    rows, columns = np.mgrid[:40, :48]
    return {
        "constant": np.full((40, 48), 0.6),
        "two colours": two_colours(),
        "checkerboard": ((rows + columns) % 2).astype(np.float64),
        "ramp": np.broadcast_to(np.linspace(0, 1, 48), (40, 48)).copy(),
        "uniform noise": noise.random((40, 48)),
        "bright pixel": bright_pixel(),
        "8x8": noise.random((8, 8)),
        "1x64": noise.random((1, 64)),
    }
