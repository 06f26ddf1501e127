"""Training of the estimate of noise: ``python -m benchmarks.denoiser_training.noise_profiles --pictures FOLDER``.

Pictures are reduced, cut and given noise of four kinds: that of simulated cameras, white noise, white noise that was
smoothed and compressed, and none. Their statistics and the true profiles are kept in parts under ``--out``, which a
later call continues: 100 pictures a part and about a minute of one core. The pictures of ``--aside``, with cameras and
a demosaicer that training never draws, make the parts held out. ``--fit`` trains the network of
:mod:`nlfilter_torch.nn.denoiser.estimate` on them in two minutes, prints its errors, and writes its weights.

The pictures of the package's weights are listed in ``noise_profiles.txt``.
"""

import argparse
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from benchmarks.denoiser_training.cameras import Camera
from benchmarks.photographs import photograph
from nlfilter_torch.nn.denoiser.estimate import statistics_of, window_pixels
from nlfilter_torch.nn.denoiser.profile import profile_of_difference

EXTENSIONS = (".jpg", ".jpeg", ".png", ".webp")
OWN = ("astronaut", "motorcycle", "rocket", "immunohistochemistry", "hubble_deep_field", "brick", "grass", "gravel")
SMALLEST, LONGEST = 700, 2000  # shortest side of a picture that is used, longest side to which it is halved
SIDES = (32, 64, 96, 160, 192, 256, 320)
PART, HELD_PARTS = 100, 5
GREY, ONCE_REDUCED = 0.3, 4.5
KINDS = {"camera": 0.44, "white": 0.18, "smoothed": 0.1, "clean": 0.28}
LARGEST_SIDE = 560  # of the crop that a camera needs


class Random:
    """Random numbers of a generator."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def number(self, low: float = 0.0, high: float = 1.0) -> float:
        """Uniform."""
        return low + (high - low) * float(torch.rand(1, generator=self.generator))

    def factor(self, low: float, high: float) -> float:
        """Of uniform logarithm."""
        return math.exp(self.number(math.log(low), math.log(high)))

    def below(self, count: int) -> int:
        """An integer."""
        return int(torch.randint(count, (1,), generator=self.generator))

    def normal(self, like: Tensor) -> Tensor:
        """White noise."""
        return torch.randn(like.shape, generator=self.generator)


@dataclass(frozen=True)
class Pair:
    """A picture with and without noise, (3, side, side), and the kind of noise."""

    noisy: Tensor
    clean: Tensor
    kind: str


def pictures(folder: Path, *, held_out: bool) -> dict[str, Image.Image]:
    """Pictures by name, halved if they are large; for training also those of scikit-image."""
    loaded = {}
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in EXTENSIONS):
        picture = Image.open(path).convert("RGB")
        if min(picture.size) >= SMALLEST:
            longest = min(max(picture.size) // 2, LONGEST)
            picture.thumbnail((longest, longest), Image.Resampling.LANCZOS)
            loaded[str(path.relative_to(folder))] = picture
    if not held_out:
        for name in OWN:
            planes = photograph(name)[0].expand(3, -1, -1)
            loaded[name] = Image.fromarray(_bytes(planes))
    return loaded


class Pairs:
    """Random pairs, reproducible from a seed.

    Args:
        folder: of pictures.
        held_out: whether pictures and cameras are those that training never draws.
    """

    def __init__(self, folder: Path, *, held_out: bool) -> None:
        self.held_out = held_out
        self.pictures = pictures(folder, held_out=held_out)

    def drawn(self, seed: int) -> Iterator[Pair]:
        """Pairs without end."""
        random = Random(seed)
        while True:
            side, kind = SIDES[random.below(len(SIDES))], _chosen(random.number())
            pair = self.camera(random, side) if kind == "camera" else getattr(self, f"_{kind}")(random, side)
            if pair is not None:
                grey = random.number() < GREY
                for variant in self._variants(random, pair):
                    yield _grey(variant) if grey else variant

    def _variants(self, random: Random, pair: Pair) -> Iterator[Pair]:
        """The pair; in training, also with less and more of its noise, and the mean of a camera's shots as clean."""
        yield pair
        if self.held_out or pair.kind == "clean":
            return
        for factor in (random.number(0.3, 0.8), random.number(1.3, 2.5)):
            noisy = pair.clean + factor * (pair.noisy - pair.clean)
            yield Pair(noisy if pair.kind == "white" else _rounded(noisy), pair.clean, pair.kind)
        if pair.kind == "camera":
            yield Pair(_rounded(pair.clean), _rounded(pair.clean), "clean")

    def _crop(self, random: Random, side: int) -> Tensor | None:
        """A random square of a random picture, reduced at random, if the picture is large enough."""
        picture = list(self.pictures.values())[random.below(len(self.pictures))]
        most = min(picture.size) / side
        if most < 1:
            return None
        square = int(side * min(most, 1 + ONCE_REDUCED * random.number() ** 2))
        left, top = (random.below(length - square + 1) for length in picture.size)
        part = picture.crop((left, top, left + square, top + square)).resize((side, side), Image.Resampling.LANCZOS)
        return _tensor(part).rot90(random.below(4), (1, 2))

    def camera(self, random: Random, side: int, *, noise: bool = True) -> Pair | None:
        """A photograph by a random camera, with noise or without, unless it needs a larger picture."""
        camera = Camera.drawn(random.generator, held_out=self.held_out)
        camera = camera if noise else camera.without_noise()
        crop = self._crop(random, camera.side_before(side)) if camera.side_before(side) <= LARGEST_SIDE else None
        if crop is None:
            return None
        clean, noisy = camera.photograph(crop, side, random.generator)
        return Pair(noisy, clean, "camera") if noise else Pair(noisy, noisy, "clean")

    def _white(self, random: Random, side: int) -> Pair | None:
        """White noise, the same everywhere or growing with the light, in 8 bits or not limited."""
        clean = self._crop(random, side)
        if clean is None:
            return None
        level = random.factor(0.7, 60) / 255
        share = random.number() if random.number() < 0.5 else 1.0
        deviation = level * (share + 2 * (1 - share) * _blurred(clean.mean(0, keepdim=True), 1.0)).sqrt()
        noisy = clean + deviation * random.normal(clean)
        return Pair(_rounded(noisy) if random.number() < 0.6 else noisy, clean, "white")

    def _smoothed(self, random: Random, side: int) -> Pair | None:
        """White noise that was smoothed, colour more than luminance, and often compressed."""
        clean = self._crop(random, side)
        if clean is None:
            return None
        luminance, colour = random.normal(clean[:1]), random.normal(clean)
        luminance = _blurred(luminance, random.number(0, 1.2))
        colour = _blurred(colour - colour.mean(0, keepdim=True), random.number(0, 3))
        noise = luminance / luminance.std() + random.number(0.2, 1) * colour / colour.std()
        noisy = _rounded(clean + random.factor(0.7, 20) / 255 * noise)
        return Pair(_compressed(random, noisy, 70) if random.number() < 0.7 else noisy, clean, "smoothed")

    def _clean(self, random: Random, side: int) -> Pair | None:
        """No noise: from a camera without any, compressed, enlarged, or as it is."""
        if random.number() < 0.4:
            return self.camera(random, side, noise=False)
        enlarged = random.number(1.2, 3) if random.number() < 0.2 else 1.0
        crop = self._crop(random, int(side / enlarged))
        if crop is None:
            return None
        crop = F.interpolate(crop[None], (side, side), mode="bicubic")[0] if enlarged > 1 else crop
        clean = _compressed(random, crop, 75) if random.number() < 0.6 else _rounded(crop)
        return Pair(clean, clean, "clean")


def part_of(pairs: Pairs, seed: int) -> dict[str, Tensor]:
    """Statistics, shares, true levels and kinds of :data:`PART` pairs."""
    rows: dict[str, list[Tensor]] = {"statistics": [], "shares": [], "levels": [], "kind": []}
    for pair, _ in zip(pairs.drawn(seed), range(PART), strict=False):
        places = window_pixels((pair.noisy.shape[-2], pair.noisy.shape[-1]))
        statistics, shares = statistics_of(pair.noisy.flatten(1)[:, places].transpose(0, 1))
        values = (
            statistics.half(),
            shares,
            profile_of_difference(pair.noisy[None], pair.clean[None]).levels[0],
            torch.tensor(list(KINDS).index(pair.kind)),
        )
        for name, value in zip(rows, values, strict=True):
            rows[name].append(value)
    return {name: torch.stack(values) for name, values in rows.items()}


def _chosen(number: float) -> str:
    """The kind of noise at a number between 0 and 1."""
    kinds, shares = list(KINDS), torch.tensor(list(KINDS.values()))
    return kinds[min(int(torch.searchsorted(shares.cumsum(0), number)), len(kinds) - 1)]


def _grey(pair: Pair) -> Pair:
    noisy, clean = (planes.mean(0, keepdim=True) for planes in (pair.noisy, pair.clean))
    noisy = noisy if pair.kind == "white" else _rounded(noisy)
    return Pair(noisy, noisy if pair.kind == "clean" else clean, pair.kind)


def _rounded(planes: Tensor) -> Tensor:
    return (255 * planes.clamp(0, 1)).round() / 255


def _bytes(planes: Tensor) -> np.ndarray:
    return (255 * planes.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()


def _tensor(picture: Image.Image) -> Tensor:
    return torch.from_numpy(np.array(picture)).permute(2, 0, 1).float() / 255


def _compressed(random: Random, planes: Tensor, worst: int) -> Tensor:
    """JPEG, with any of its three ways to store colour."""
    content = io.BytesIO()
    quality, subsampling = worst + random.below(99 - worst), random.below(3)
    Image.fromarray(_bytes(planes)).save(content, "JPEG", quality=quality, subsampling=subsampling)
    return _tensor(Image.open(content))


def _blurred(planes: Tensor, radius: float) -> Tensor:
    """Gaussian blur of planes (C, H, W)."""
    if radius < 0.2:
        return planes
    reach = int(3 * radius + 1)
    weights = torch.exp(-torch.arange(-reach, reach + 1).square() / (2 * radius**2))
    padded = F.pad(planes[:, None], (reach,) * 4, mode="reflect")
    weights = weights / weights.sum()
    return F.conv2d(F.conv2d(padded, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))[:, 0]


def main(arguments: Sequence[str] | None = None) -> None:
    """Make parts, or train on them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.denoiser_training.noise_profiles")
    parser.add_argument("--pictures", type=Path, help="folder of pictures; with it, parts are made")
    parser.add_argument("--aside", type=Path, help="folder of other pictures, of the parts held out")
    parser.add_argument("--out", type=Path, default=Path("profiles"), help="folder of the parts")
    parser.add_argument("--parts", type=int, default=200, help="of training")
    parser.add_argument("--fit", type=Path, help="train, and write the weights to this file")
    options = parser.parse_args(arguments)
    if options.pictures is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        folders = ("held", options.aside, HELD_PARTS), ("train", options.pictures, options.parts)
        for name, folder, count in folders if options.aside is not None else folders[1:]:
            held_out = name == "held"
            missing = [n for n in range(count) if not (options.out / f"{name}{n}.pt").exists()]
            pairs = Pairs(folder, held_out=held_out) if missing else None
            for number in missing:
                assert pairs is not None
                torch.save(part_of(pairs, number + 10_000 * held_out), options.out / f"{name}{number}.pt")
                print(f"{name} {number + 1} of {count}", flush=True)
    if options.fit is not None:
        from benchmarks.denoiser_training.profile_fit import fit

        fit(options.out, options.fit)


if __name__ == "__main__":
    main()
