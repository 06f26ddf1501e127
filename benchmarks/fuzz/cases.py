"""Random guides and options of an operator, each drawn from one random generator."""

import math
import random
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks.photographs import photograph
from nlfilter_torch.operator.options import Sampling

SIDE = 64
CROPPED = ("astronaut", "camera", "chelsea", "coffee", "moon", "page", "rocket", "text")
HARD = ("checkerboard", "stripes", "two-valued", "spikes", "ramp", "photograph")  # drawn more often
SAMPLINGS: tuple[Sampling, ...] = ("kmeans", "uniform", "random")
ORDINARY = 1.5  # largest guide value for which building an operator must succeed


@dataclass(frozen=True)
class Case:
    """One operator to build.

    Attributes:
        name: content, shape and dtype of the guide.
        guide: (B, C, H, W).
        options: keyword arguments of :func:`nonlocal_operator`, except the generator.
        native: whether the C kernels may be used.
        backward: whether gradients are checked.
        seed: of the landmarks, and of the image and the sliders used in the checks.
    """

    name: str
    guide: Tensor
    options: dict[str, Any]
    native: bool
    backward: bool
    seed: int

    @property
    def ordinary(self) -> bool:
        """Whether the guide has the value range of an image, so that no error is acceptable."""
        return float(self.guide.detach().abs().max()) <= ORDINARY

    def __str__(self) -> str:
        """Describe the case in one line."""
        shown = {name: _shown(value) for name, value in self.options.items()}
        options = ", ".join(f"{name}={value}" for name, value in shown.items())
        return f"{self.name}{', backward' * self.backward}{', no C' * (not self.native)}: {options}"


def random_case(rng: random.Random, side: int = SIDE) -> Case:
    """Draw a guide of at most ``side`` by ``side`` pixels, and all options."""
    batch, channels = rng.choice((1, 1, 2, 3)), rng.choice((1, 1, 2, 3, 4))
    height, width = _side(rng, side), _side(rng, side)
    dtype = rng.choice((torch.float32, torch.float32, torch.float64))
    names, images = zip(*(_content(rng, channels, height, width) for _ in range(batch)), strict=True)
    guide = torch.stack(images).to(dtype)
    patch_size = rng.choice((1, 1, 3, 5, 7))
    options: dict[str, Any] = {
        "patch_size": patch_size,
        "photometric_bandwidth": "auto" if rng.random() < 0.25 else _bandwidth(rng, 1e-3, 10.0, batch),
        "spatial_bandwidth": None if rng.random() < 0.5 else _bandwidth(rng, 0.3, 100.0, batch),
        "num_landmarks": round(log_uniform(rng, 1, 200)),
        "landmarks": rng.choice(SAMPLINGS),
        "completion": rng.choice(("diagonal", "diagonal", "none")),
        "guide_channels": rng.choice(("luminance", "all")),
    }
    if rng.random() < 0.15:
        options["tolerance"] = log_uniform(rng, 1e-8, 1e-2)
    if rng.random() < 0.05:
        weights = torch.rand(patch_size, patch_size, generator=torch.Generator().manual_seed(rng.randint(0, 99)))
        options["patch_weights"] = weights + 1e-3
    name = f"{' + '.join(names)} {tuple(guide.shape)} {str(dtype).removeprefix('torch.')}"
    return Case(name, guide, options, rng.random() < 0.7, rng.random() < 0.4, rng.randint(0, 1 << 20))


def log_uniform(rng: random.Random, least: float, most: float) -> float:
    """Draw a number whose logarithm is uniformly distributed."""
    return math.exp(rng.uniform(math.log(least), math.log(most)))


def _side(rng: random.Random, most: int) -> int:
    return min(int(log_uniform(rng, 1, most + 1)), most) if rng.random() < 0.6 else rng.randint(1, most)


def _bandwidth(rng: random.Random, least: float, most: float, batch: int) -> float | Tensor:
    if rng.random() < 0.8:
        return log_uniform(rng, least, most)
    return torch.tensor([log_uniform(rng, least, most) for _ in range(batch)], dtype=torch.float64)


def _shown(value: object) -> str:
    if isinstance(value, Tensor):
        return f"tensor({value.tolist()})" if value.ndim < 2 else f"tensor of {tuple(value.shape)}"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def _content(rng: random.Random, channels: int, height: int, width: int) -> tuple[str, Tensor]:
    """Draw an image: the name of its content, and its values (C, H, W) in float64."""
    name = rng.choice(HARD if rng.random() < 0.4 else tuple(CONTENTS))
    image = CONTENTS[name](rng, channels, height, width)
    return name, image.expand(channels, height, width).double()


def _noise(rng: random.Random, *shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(rng.randint(0, 1 << 20)), dtype=torch.float64)


def _grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    return torch.arange(height)[:, None], torch.arange(width)[None]


def _pair(rng: random.Random, mask: Tensor) -> Tensor:
    """Draw two values, one inside a mask and one outside."""
    low, high = rng.choice(((0.0, 1.0), (0.25, 0.75), (0.5, 0.5 + log_uniform(rng, 1e-4, 0.1))))
    return torch.where(mask, high, low)


def _constant(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return torch.full((channels, height, width), rng.choice((0.0, 0.5, 1.0, rng.random())))


def _nearly_constant(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return 0.5 + log_uniform(rng, 1e-8, 1e-2) * _noise(rng, channels, height, width)


def _two_valued(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _pair(rng, _noise(rng, channels, height, width) < rng.choice((0.5, 0.1, 0.01)))


def _checkerboard(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    period = rng.choice((1, 2, 3, 4, 8))
    return _pair(rng, (rows // period + columns // period) % 2 == 0)[None]


def _stripes(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    period, levels = rng.choice((1, 2, 3, 5)), rng.choice((2, 3, 4))
    phase = rng.choice((0, 1, 1, 2)) * rows + rng.choice((1, 1, 0, 3)) * columns
    return (phase // period % levels)[None] / (levels - 1)


def _spikes(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    image = torch.full((channels, height, width), rng.choice((0.0, 0.5)), dtype=torch.float64)
    for _ in range(rng.choice((1, 1, 2, 5))):
        image[:, rng.randint(0, height - 1), rng.randint(0, width - 1)] = rng.random()
    return image


def _ramp(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    plane = rng.choice((0, 1)) * rows + columns
    return plane[None] * (log_uniform(rng, 1e-3, 1.0) / max(int(plane.max()), 1))


def _denormal(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) * 1e-40


def _tiny(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) * log_uniform(rng, 1e-30, 1e-3)


def _huge(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) * log_uniform(rng, 10.0, 1e37)


def _offset(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) + log_uniform(rng, 1.0, 1e6)


def _repeated(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = rng.randint(1, 8), rng.randint(1, 8)
    tile = _noise(rng, channels, rows, columns)
    return tile.repeat(1, -(-height // rows), -(-width // columns))[:, :height, :width]


def _smooth(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    waves = [torch.sin(rng.uniform(0, 0.4) * rows + rng.uniform(0, 0.4) * columns + rng.uniform(0, 6)) for _ in "abc"]
    return 0.5 + torch.stack(waves).sum(0, keepdim=True) / 6


def _any_noise(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    levels = rng.choice((3, 10, 1 << 20))
    return (_noise(rng, channels, height, width) * levels).floor() / levels


def _photograph(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    picture = photograph(rng.choice(CROPPED))[0]
    step = rng.choice((1, 2))
    picture = picture[:, ::step, ::step]
    top, left = rng.randint(0, picture.shape[1] - height), rng.randint(0, picture.shape[2] - width)
    return picture[torch.arange(channels) % len(picture), top : top + height, left : left + width]


CONTENTS = {
    "constant": _constant,
    "nearly constant": _nearly_constant,
    "two-valued": _two_valued,
    "checkerboard": _checkerboard,
    "stripes": _stripes,
    "spikes": _spikes,
    "ramp": _ramp,
    "denormal": _denormal,
    "tiny": _tiny,
    "huge": _huge,
    "offset": _offset,
    "repeated patches": _repeated,
    "smooth": _smooth,
    "noise": _any_noise,
    "photograph": _photograph,
}
