"""Pairs by cameras kept aside: ``python -m benchmarks.denoiser_training.simulated_pairs FOLDER --out OUT``.

Every photograph of a folder, such as the reporting set of :mod:`benchmarks.denoiser_training.free_photographs`, is
taken by cameras with parameters that training never draws. The command writes ``NAME_N_mean.png`` and
``NAME_N_real.png``, as other sets of pairs name them; :func:`pairs` gives the same pairs without files.
"""

import argparse
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from benchmarks.denoiser_training.cameras import Camera
from benchmarks.denoiser_training.comparison import cut, read

SIDE = 256
SUFFIXES = ".png", ".jpg", ".jpeg"


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
        picture = read(path)
        for number in range(cameras):
            generator = torch.Generator().manual_seed(zlib.crc32(f"{path.stem} {number} {seed}".encode()))
            camera = Camera.drawn(generator, held_out=held_out)
            clean, noisy = camera.photograph(cut(picture, camera, side, generator), side, generator)
            yield Pair(f"{path.stem}_{number}", clean, noisy, camera)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the pairs as files."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.denoiser_training.simulated_pairs", description=main.__doc__
    )
    parser.add_argument("folder", type=Path, help="folder of clean pictures")
    parser.add_argument("--out", type=Path, required=True, help="folder of the pairs")
    parser.add_argument("--cameras", type=int, default=1, help="number of cameras per picture; default %(default)s")
    parser.add_argument("--side", type=int, default=SIDE, help="pixels; default %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers; default %(default)s")
    options = parser.parse_args(arguments)
    for name in ("cameras", "side"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(options, name)}")
    options.out.mkdir(parents=True, exist_ok=True)
    count = 0
    for pair in pairs(options.folder, cameras=options.cameras, side=options.side, seed=options.seed):
        for kind, picture in (("mean", pair.clean), ("real", pair.noisy)):
            levels = (255 * picture).round().byte().permute(1, 2, 0).numpy()
            Image.fromarray(levels).save(options.out / f"{pair.name}_{kind}.png")
        count += 1
    print(f"{count} pairs of {options.side}x{options.side} pixels are in {options.out}")


if __name__ == "__main__":
    main()
