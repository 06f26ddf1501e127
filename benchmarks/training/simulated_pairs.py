"""Pairs by simulated cameras, and how like real ones they are: ``python -m benchmarks.training.simulated_pairs``.

``FOLDER --out OUT``: every photograph of a folder, such as the reporting set of :mod:`benchmarks.free_photographs`, is
taken by cameras with parameters that training never draws, and written as ``NAME_N_mean.png`` and ``NAME_N_real.png``,
as other sets of pairs name them. ``[FOLDER] --compare PAIRS``: statistics of the noise of cameras that take photographs
of a folder or of scikit-image, beside that of pairs of photographs.
"""

import io
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from PIL.JpegImagePlugin import get_sampling
from torch import Tensor

from benchmarks.harness import options, read_picture, save_picture
from benchmarks.photographs import pictures
from benchmarks.training.cameras import Camera
from nlfilter_torch.core.blocks import reflected
from nlfilter_torch.nn.denoiser.profile import split_colours

SCALES = (1, 2, 4, 8, 16)  # sides of blocks in pixels
SIDE = 256  # of simulated photographs
SUFFIXES = ".png", ".jpg", ".jpeg"
CLEAN = "astronaut", "motorcycle", "rocket"  # photographs of scikit-image that are noisy the least
LARGEST = 1440  # pixels of the short side of clean photographs
NAMES = {"luminance": slice(0, 1), "colour": slice(1, 3)}


@dataclass(frozen=True)
class Pair:
    """A simulated photograph and what the mean of many would be.

    Attributes:
        name: of the picture, with the number of the camera.
        clean, noisy: (3, side, side) in [0, 1].
        camera: that took it.
    """

    name: str
    clean: Tensor
    noisy: Tensor
    camera: Camera


@torch.no_grad()
def pairs(folder: Path, *, cameras: int = 1, side: int = SIDE, seed: int = 0, held_out: bool = True) -> Iterator[Pair]:
    """Pairs of all pictures of a folder, which depend on the picture, the number of the camera and the seed alone.

    Args:
        folder: of clean pictures.
        cameras: per picture.
        side: of the pairs, in pixels.
        seed: of all random numbers.
        held_out: whether the cameras are those that training never draws.
    """
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise SystemExit(f"{folder} must hold pictures (PNG or JPEG), but holds none; name another folder")
    for path in paths:
        picture = read_picture(path)
        for number in range(cameras):
            generator = torch.Generator().manual_seed(zlib.crc32(f"{path.stem} {number} {seed}".encode()))
            camera = Camera.drawn(generator, held_out=held_out)
            clean, noisy = camera.photograph(cut(picture, camera, side, generator), side, generator)
            yield Pair(f"{path.stem}_{number}", clean, noisy, camera)


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


def read_pairs(folder: Path, left_out: Sequence[str] = ()) -> dict[str, tuple[Tensor, Tensor]]:
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
    means = {name: path.with_name(path.name.replace("_real", "_mean")) for name, path in paths.items()}
    return {name: (read_picture(means[name]), read_picture(path)) for name, path in paths.items()}


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
        return read_picture(file)


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
    real = read_pairs(folder, left_out)
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Write pairs as files, or print the table that compares simulated noise to that of pairs of photographs."""
    parser = options("training.simulated_pairs", __doc__)
    add = parser.add_argument
    add("folder", type=Path, nargs="?", help="of clean pictures; where pairs are compared, default: scikit-image's")
    add("--out", type=Path, help="folder of the pairs")
    add("--cameras", type=int, default=1, help="number of cameras per picture; default %(default)s")
    add("--side", type=int, default=SIDE, help="pixels; default %(default)s")
    add("--seed", type=int, default=0, help="of all random numbers; default %(default)s")
    add("--compare", type=Path, metavar="PAIRS", help="folder of pairs NAME_real.JPG and NAME_mean.JPG")
    add("--leave-out", nargs="+", default=(), help="beginnings of names of pairs that are not read")
    add("--count", type=int, default=100, help="number of cameras to compare; default %(default)s")
    add("--held-out", action="store_true", help="compare cameras that training never draws")
    chosen = parser.parse_args(arguments)
    for name in ("cameras", "side", "count"):
        if getattr(chosen, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(chosen, name)}")
    if chosen.compare is not None:
        options_of_cameras = {"held_out": chosen.held_out, "left_out": chosen.leave_out}
        print(compared(chosen.compare, chosen.folder, chosen.count, chosen.seed, **options_of_cameras))
        return
    if chosen.folder is None or chosen.out is None:
        parser.error("FOLDER and --out must be given, or --compare; name the folders")
    count = 0
    for pair in pairs(chosen.folder, cameras=chosen.cameras, side=chosen.side, seed=chosen.seed):
        for kind, picture in (("mean", pair.clean), ("real", pair.noisy)):
            save_picture(chosen.out / f"{pair.name}_{kind}.png", picture)
        count += 1
    print(f"{count} pairs of {chosen.side}x{chosen.side} pixels are in {chosen.out}")


if __name__ == "__main__":
    main()
