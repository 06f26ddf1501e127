"""Pictures of the training: those of scikit-image, and all of a folder.

The test pictures of :mod:`benchmarks.denoising` are not among them; the left halves of ``retina`` and ``page`` are for
testing, and their right halves for training.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.denoiser_training.draws import Draws
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
