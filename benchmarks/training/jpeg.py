"""JPEG of a noisy shot, and what the mean of the files of many shots of the same scene would be."""

import io
import math
from functools import cache

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

#: Pixels per sample of colour, down and across.
SUBSAMPLINGS = {"4:4:4": (1, 1), "4:2:2": (1, 2), "4:2:0": (2, 2)}
TERMS = 10  # of the Fourier series of the mean of rounded values
SMALLEST = 0.05  # deviation, in steps of quantisation, that these terms can represent


def to_luminance(shots: Tensor) -> Tensor:
    """Planes Y, Cb, Cr (2, 3, H, W) of RGB (ITU-R BT.601); Cb and Cr are 0 where there is no colour."""
    return torch.einsum("pc,bchw->bphw", _matrix().to(shots), shots)


def from_luminance(planes: Tensor) -> Tensor:
    """Invert :func:`to_luminance`."""
    return torch.einsum("cp,bphw->bchw", torch.linalg.inv(_matrix()).to(planes), planes)


def compressed(planes: Tensor, quality: int, subsampling: str) -> Tensor:
    """Planes Y, Cb, Cr (2, 3, H, W) after JPEG; H and W are multiples of 16.

    The second shot is quantised. The first becomes the expected value of what the second is quantised to, over shots
    whose coefficients have the deviation that these two shots show: this is the mean of many files.
    """
    factors = SUBSAMPLINGS[subsampling]
    tables = _tables(quality)
    light = _quantised(planes[:, :1], tables[0])
    colour = F.avg_pool2d(planes[:, 1:], factors) if max(factors) > 1 else planes[:, 1:]
    colour = _quantised(colour, tables[1])
    if max(factors) > 1:
        colour = F.interpolate(colour, planes.shape[-2:], mode="bilinear", align_corners=False)
    return torch.cat([light, colour], dim=1)


def _quantised(planes: Tensor, table: Tensor) -> Tensor:
    height, width = planes.shape[-2:]
    basis = _basis().to(planes)
    blocks = planes.unflatten(-1, (width // 8, 8)).unflatten(-3, (height // 8, 8)).transpose(-2, -3)
    steps = table.to(planes) / 255
    coefficients = basis @ blocks @ basis.mT / steps
    deviation = (coefficients[1] - coefficients[0]).square().mean((1, 2), keepdim=True).sqrt()
    mean = mean_of_rounded(coefficients[0], deviation)
    rounded = torch.stack([mean, coefficients[1].round()])
    blocks = basis.mT @ (rounded * steps) @ basis
    return blocks.transpose(-2, -3).flatten(-2).flatten(-3, -2)


def mean_of_rounded(values: Tensor, deviation: Tensor) -> Tensor:
    """Expected value of ``values`` rounded to whole numbers after normal noise of a deviation is added."""
    damping = (-2 * (math.pi * deviation.clamp(min=SMALLEST)).square()).exp()
    angle = 2 * math.pi * values
    double_cosine, wave, before = 2 * torch.cos(angle), torch.sin(angle), torch.zeros_like(values)
    mean = values
    for term in range(1, TERMS + 1):
        mean = mean + damping ** (term * term) * (-1) ** term / (math.pi * term) * wave
        wave, before = double_cosine * wave - before, wave
    return mean


@cache
def _tables(quality: int) -> tuple[Tensor, Tensor]:
    """The tables of quantisation of luminance and of colour, (8, 8), as libjpeg scales them."""
    with io.BytesIO() as file:
        Image.new("RGB", (8, 8)).save(file, "JPEG", quality=quality)
        tables = Image.open(file).quantization
    light, colour = (torch.tensor(tables[number]).view(8, 8).float() for number in (0, 1))
    return light, colour


def _basis() -> Tensor:
    """The orthonormal cosine transform of 8 values."""
    places = torch.arange(8, dtype=torch.float64)
    waves = torch.cos(math.pi * (2 * places + 1) * places[:, None] / 16) / 2
    waves[0] /= math.sqrt(2)
    return waves


def _matrix() -> Tensor:
    red, blue = 0.299, 0.114
    light = torch.tensor([red, 1 - red - blue, blue], dtype=torch.float64)
    identity = torch.eye(3, dtype=torch.float64)
    return torch.stack([light, (identity[2] - light) / (2 - 2 * blue), (identity[0] - light) / (2 - 2 * red)])
