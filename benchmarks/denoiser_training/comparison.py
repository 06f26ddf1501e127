"""Statistics of noise, by which simulated cameras are compared to pairs of photographs."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from PIL.JpegImagePlugin import get_sampling
from torch import Tensor

from benchmarks.denoiser_training.cameras import Camera
from benchmarks.photographs import pictures
from nlfilter_torch.core.blocks import reflected
from nlfilter_torch.nn.denoiser.profile import split_colours

SCALES = (1, 2, 4, 8, 16)  # sides of blocks in pixels
SIDE = 256  # of simulated photographs
CLEAN = "astronaut", "motorcycle", "rocket"  # photographs of scikit-image that are noisy the least
LARGEST = 1440  # pixels of the short side of clean photographs
NAMES = {"luminance": slice(0, 1), "colour": slice(1, 3)}


def statistics(clean: Tensor, noisy: Tensor) -> dict[str, float]:
    """Statistics of the noise of a pair (3, H, W) in [0, 1]; levels are in steps of 8 bits."""
    noise = 255 * (noisy - clean)
    noise = noise - noise.mean((1, 2), keepdim=True)
    values = {name: float(channel.std()) for name, channel in zip(("red", "green", "blue"), noise, strict=True)}
    planes = split_colours(noise[None])
    for name, part in NAMES.items():
        levels = [scale * _deviation(F.avg_pool2d(planes[:, part], scale)) for scale in SCALES]
        values[f"{name}, level"] = levels[0]
        for scale, level in zip(SCALES[1:], levels[1:], strict=True):
            values[f"{name}, {scale} over 1"] = level / levels[0]
    values["colour over luminance"] = values["colour, level"] / values["luminance, level"]
    correlation = torch.corrcoef(noise.flatten(1))
    values |= {"red with green": float(correlation[0, 1]), "red with blue": float(correlation[0, 2])}
    values["green with blue"] = float(correlation[1, 2])
    return values | _by_brightness(clean, noise)


def _deviation(planes: Tensor) -> float:
    return float(planes.square().mean().sqrt())


def _by_brightness(clean: Tensor, noise: Tensor) -> dict[str, float]:
    """Noise of the darkest and of the brightest third of the picture over that of the middle one."""
    brightness = F.avg_pool2d(clean.mean(0)[None, None], 5, 1, 2)[0, 0]
    limits = torch.quantile(brightness.flatten()[::7], torch.tensor([1 / 3, 2 / 3]))
    which = torch.bucketize(brightness, limits)
    dark, middle, bright = (_deviation(noise[:, which == part]) for part in range(3))
    return {"dark over middle": dark / middle, "bright over middle": bright / middle}


def pairs(folder: Path, left_out: Sequence[str] = ()) -> dict[str, tuple[Tensor, Tensor]]:
    """Pairs (clean, noisy) of a folder with ``NAME_mean.*`` and ``NAME_real.*``, (3, H, W) each.

    Args:
        folder: of the pairs.
        left_out: beginnings of names that are left out, such as those of scenes.
    """
    names = {path.stem.removesuffix("_real"): path for path in sorted(folder.iterdir()) if path.stem.endswith("_real")}
    paths = {name: path for name, path in names.items() if not name.startswith(tuple(left_out))}
    if not paths:
        raise SystemExit(
            f"{folder} must hold pairs NAME_mean.JPG and NAME_real.JPG, but holds none; name another folder"
        )
    return {
        name: (read(path.with_name(path.name.replace("_real", "_mean"))), read(path)) for name, path in paths.items()
    }


def read(file: Path | io.BytesIO) -> Tensor:
    """A picture (3, H, W) in [0, 1]."""
    with Image.open(file) as image:
        return torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1).float() / 255


def simulated(
    clean: list[Tensor], count: int, seed: int, *, held_out: bool = False, like: Path | None = None
) -> list[dict[str, float]]:
    """Statistics of simulated photographs of random crops of pictures, written as files like that of a path."""
    generator = torch.Generator().manual_seed(seed)
    values = []
    for number in range(count):
        camera = Camera.drawn(generator, held_out=held_out)
        pair = camera.photograph(cut(clean[number % len(clean)], camera, SIDE, generator), SIDE, generator)
        values.append(statistics(*(picture if like is None else as_file(picture, like) for picture in pair)))
    return values


def as_file(picture: Tensor, like: Path) -> Tensor:
    """A picture (3, H, W) written and read as JPEG with the tables and subsampling of a file."""
    with Image.open(like) as example, io.BytesIO() as file:
        if example.format != "JPEG":
            return (255 * picture).round() / 255
        levels = (255 * picture).round().byte().permute(1, 2, 0).numpy()
        options = {"qtables": example.quantization, "subsampling": get_sampling(example)}
        Image.fromarray(levels).save(file, "JPEG", **options)
        return read(file)


def cut(picture: Tensor, camera: Camera, side: int, generator: torch.Generator) -> Tensor:
    """A random crop of a picture (3, H, W), as large as a camera needs; small pictures are mirrored."""
    before = camera.side_before(side)
    rows, columns = (_mirrored(length, before, generator) for length in picture.shape[-2:])
    return picture[:, rows][:, :, columns]


def _mirrored(length: int, count: int, generator: torch.Generator) -> Tensor:
    """A number of successive places from a random one on, which go back and forth where there are not so many."""
    places = torch.arange(count) + int(torch.randint(max(length - count, 0) + 1, (), generator=generator))
    return reflected(places, length)


@torch.no_grad()
def compared(
    folder: Path, photographs: Path | None, count: int, seed: int, *, held_out: bool, left_out: Sequence[str] = ()
) -> str:
    """The table of simulated noise beside that of the pairs of a folder, whose kind of file the simulated ones have."""
    real = pairs(folder, left_out)
    clean = [picture[0] for picture in pictures(photographs, LARGEST, CLEAN).values()]
    like = next(path for path in sorted(folder.iterdir()) if path.stem.endswith("_real"))
    values = simulated(clean, count, seed, held_out=held_out, like=like)
    return table([statistics(*pair) for pair in real.values()], values)


def table(real: list[dict[str, float]], camera: list[dict[str, float]]) -> str:
    """A line for each statistic: quantiles of both, and the share of real values inside the simulated spread."""
    lines = [
        f"{'':<26}{'real: 10 %':>12}{'50 %':>8}{'90 %':>8}{'simulated: 5 %':>18}{'50 %':>8}{'95 %':>8}{'inside':>9}"
    ]
    for name in real[0]:
        actual, drawn = (np.array([values[name] for values in group]) for group in (real, camera))
        low, middle, high = np.quantile(drawn, [0.05, 0.5, 0.95])
        inside = np.mean((actual >= low) & (actual <= high))
        quantiles = "".join(f"{value:8.2f}" for value in np.quantile(actual, [0.1, 0.5, 0.9]))
        lines.append(f"{name:<30}{quantiles}{low:18.2f}{middle:8.2f}{high:8.2f}{inside:9.0%}")
    return "\n".join(lines)
