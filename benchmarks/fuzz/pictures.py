"""Grey pictures that ship with scikit-image, over sizes, bandwidths, samplings and numbers of landmarks."""

import random
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
import skimage.data
import torch
from skimage.color import rgb2gray
from skimage.transform import resize
from skimage.util import img_as_float64

from benchmarks.fuzz.cases import SAMPLINGS
from benchmarks.fuzz.checks import Findings, check_operator, judged
from nlfilter_torch import nonlocal_operator
from nlfilter_torch.operator.options import Sampling

# All pictures that load without a download.
PICTURES = (
    "astronaut", "brick", "camera", "cell", "chelsea", "clock", "coffee", "coins", "colorwheel", "grass", "gravel",
    "horse", "hubble_deep_field", "immunohistochemistry", "logo", "microaneurysms", "moon", "page", "retina", "rocket",
    "shepp_logan_phantom", "stereo_motorcycle", "text",
)  # fmt: skip
SIDES = (64, 96, 160, 256)
BANDWIDTHS = (1, 2, 4, 10, 25, 100)  # grey levels
LANDMARKS = (5, 20, 50, 100, 200)


@dataclass(frozen=True)
class Picture:
    """A picture and the options of its operator."""

    name: str
    side: int
    bandwidth: int
    landmarks: Sampling
    num_landmarks: int

    def __str__(self) -> str:
        """Describe the picture and its options in one line."""
        return (
            f"{self.name} {self.side}x{self.side}: photometric_bandwidth={self.bandwidth} / 255, "
            f"landmarks={self.landmarks!r}, num_landmarks={self.num_landmarks}"
        )


@cache
def pictures(seed: int) -> list[Picture]:
    """All combinations in random order, so that the first few are a sample."""
    everything = [Picture(*values) for values in product(PICTURES, SIDES, BANDWIDTHS, SAMPLINGS, LANDMARKS)]
    random.Random(seed).shuffle(everything)
    return everything


@cache
def grey(name: str, side: int) -> torch.Tensor:
    """A picture (1, 1, side, side), resized regardless of its aspect ratio."""
    picture = getattr(skimage.data, name)()
    picture = img_as_float64(picture[0] if isinstance(picture, tuple) else picture)
    picture = rgb2gray(picture[..., :3]) if picture.ndim == 3 else picture
    reduced = resize(picture, (side, side), anti_aliasing=True).clip(0, 1)
    return torch.from_numpy(np.ascontiguousarray(reduced))[None, None].float()


def check_picture(picture: Picture) -> Findings:
    """Build the operator of a picture, and check all its promises."""
    findings = Findings()
    image = grey(picture.name, picture.side)
    operator = None
    with torch.no_grad(), judged(findings, legal=True, completed=True):
        operator = nonlocal_operator(
            image,
            photometric_bandwidth=picture.bandwidth / 255,
            landmarks=picture.landmarks,
            num_landmarks=picture.num_landmarks,
        )
    if operator is None:
        return findings
    with torch.no_grad(), judged(findings, legal=True, completed=True):
        check_operator(findings, operator, image, None)
    return findings
