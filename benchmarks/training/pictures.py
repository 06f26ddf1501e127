"""Pictures of the training, those of scikit-image and all of a folder, and random numbers that choose among them.

The test pictures of :mod:`benchmarks.denoising` are not among them; the left halves of ``retina`` and ``page`` are for
testing, and their right halves for training.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.photographs import photograph
from nlfilter_torch.photo.picture.photographs import read_photograph

#: How often each picture of scikit-image is drawn; photographs more often than textures and drawings.
PICTURES = {
    "astronaut": 4.0,
    "motorcycle": 6.0,
    "rocket": 4.0,
    "retina": 3.0,
    "page": 2.0,
    "hubble_deep_field": 1.0,
    "immunohistochemistry": 1.0,
    "coins": 1.0,
    "brick": 1.0,
    "grass": 1.0,
    "gravel": 1.0,
    "text": 1.0,
    "clock": 1.0,
    "moon": 0.5,
    "cell": 0.5,
}
RIGHT_HALVES = ("retina", "page")
OF_SCIKIT_IMAGE = 0.15  # share of the crops that are from scikit-image if there is a folder
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
LONGEST = 1536  # pixels of the longer side; larger pictures are reduced
SMALLEST = 0.28  # reduction of a picture for a crop, at most; 1 is not reduced
EVERY_ASIDE = 16  # every so many pictures of the folder is set aside for choosing


class Draws:
    """Random numbers, reproducible from a seed."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, *size: int) -> Tensor:
        """Uniform numbers between 0 and 1."""
        return torch.rand(size, generator=self.generator)

    def normal(self, *size: int) -> Tensor:
        """Standard normal numbers."""
        return torch.randn(size, generator=self.generator)

    def number(self, low: float = 0.0, high: float = 1.0) -> float:
        """One uniform number between two others."""
        return low + (high - low) * float(self.uniform())

    def factor(self, low: float, high: float) -> float:
        """One number between two others, uniform in its logarithm."""
        return math.exp(self.number(math.log(low), math.log(high)))

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return self.number() < probability

    def below(self, count: int) -> int:
        """A whole number from 0 to ``count - 1``."""
        return int(torch.randint(count, (), generator=self.generator))

    def permutation(self, count: int) -> Tensor:
        """The whole numbers from 0 to ``count - 1`` in random order."""
        return torch.randperm(count, generator=self.generator)


@dataclass(frozen=True)
class Pictures:
    """Pictures (C, H, W) with C = 1 or 3, in 8 bits to save memory, and how often each is drawn."""

    pictures: list[Tensor]
    weights: Tensor

    def cut(self, draws: Draws, side: int) -> Tensor:
        """A crop (C, side, side) in [0, 1], reduced, rotated and mirrored at random."""
        picture = self.pictures[int(torch.multinomial(self.weights, 1, generator=draws.generator))]
        shortest = min(picture.shape[-2:])
        scale = 1.0 if draws.chance(0.25) else draws.factor(max(SMALLEST, min(1.0, side / shortest)), 1.0)
        size = min(shortest, round(side / scale))
        row, column = (draws.below(length - size + 1) for length in picture.shape[-2:])
        crop = picture[:, row : row + size, column : column + size].float() / 255
        if size != side:
            crop = F.interpolate(crop[None], (side, side), mode="bicubic", antialias=True)[0].clamp(0, 1)
        crop = torch.rot90(crop, draws.below(4), (1, 2))
        return crop.flip(2) if draws.chance(0.5) else crop


def read_pictures(folder: Path | None) -> tuple[Pictures, Pictures]:
    """Pictures for training, and others for choosing; without a folder both are those of scikit-image."""
    standard = []
    for name in PICTURES:
        picture = photograph(name)[0]
        standard.append(_in_bytes(picture[..., picture.shape[-1] // 2 :] if name in RIGHT_HALVES else picture))
    weights = torch.tensor(list(PICTURES.values()))
    if folder is None:
        return (Pictures(standard, weights),) * 2
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise SystemExit(f"--pictures must be a folder of pictures, but {folder} holds none; name another")
    own = [_in_bytes(_reduced(read_photograph(path).pixels[0, :3])) for path in paths]
    aside = own[EVERY_ASIDE - 1 :: EVERY_ASIDE]
    trained = [picture for number, picture in enumerate(own) if (number + 1) % EVERY_ASIDE]
    share = OF_SCIKIT_IMAGE / (1 - OF_SCIKIT_IMAGE) * len(trained) / weights.sum()
    both = Pictures(trained + standard, torch.cat([torch.ones(len(trained)), share * weights]))
    return both, Pictures(aside, torch.ones(len(aside))) if aside else both


def _reduced(picture: Tensor) -> Tensor:
    """Reduce a picture (C, H, W) whose longer side exceeds :data:`LONGEST`."""
    scale = LONGEST / max(picture.shape[-2:])
    if scale >= 1:
        return picture
    size = [max(1, round(length * scale)) for length in picture.shape[-2:]]
    return F.interpolate(picture[None], size, mode="bicubic", antialias=True)[0]


def _in_bytes(picture: Tensor) -> Tensor:
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8)
