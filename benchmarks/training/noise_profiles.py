"""Training of the estimate of noise: ``python -m benchmarks.training.noise_profiles --pictures FOLDER``.

Pictures are reduced, cut and given noise of four kinds: that of simulated cameras, white noise, white noise that was
smoothed and compressed, and none. Their statistics and the true profiles are kept in parts under ``--out``, which a
later call continues: 100 pictures a part and about a minute of one core. The pictures of ``--aside``, with cameras and
a demosaicer that training never draws, make the parts held out. ``--fit`` trains the network of
:mod:`nlfilter_torch.nn.denoiser.estimate` on them in two minutes, prints its errors, and writes its weights.

The pictures of the package's weights are listed in ``noise_profiles.txt``.
"""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from benchmarks.harness import as_picture, from_picture, options, read_picture
from benchmarks.photographs import photograph
from benchmarks.training.cameras import Camera
from benchmarks.training.development import blurred
from benchmarks.training.pictures import Draws
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
            loaded[name] = as_picture(planes)
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
        random = Draws(seed)
        while True:
            side, kind = SIDES[random.below(len(SIDES))], _chosen(random.number())
            pair = self.camera(random, side) if kind == "camera" else getattr(self, f"_{kind}")(random, side)
            if pair is not None:
                grey = random.number() < GREY
                for variant in self._variants(random, pair):
                    yield _grey(variant) if grey else variant

    def _variants(self, random: Draws, pair: Pair) -> Iterator[Pair]:
        """The pair; in training, also with less and more of its noise, and the mean of a camera's shots as clean."""
        yield pair
        if self.held_out or pair.kind == "clean":
            return
        for factor in (random.number(0.3, 0.8), random.number(1.3, 2.5)):
            noisy = pair.clean + factor * (pair.noisy - pair.clean)
            yield Pair(noisy if pair.kind == "white" else _rounded(noisy), pair.clean, pair.kind)
        if pair.kind == "camera":
            yield Pair(_rounded(pair.clean), _rounded(pair.clean), "clean")

    def crop(self, random: Draws, side: int) -> Tensor | None:
        """A random square of a random picture, reduced at random, if the picture is large enough."""
        picture = list(self.pictures.values())[random.below(len(self.pictures))]
        most = min(picture.size) / side
        if most < 1:
            return None
        square = int(side * min(most, 1 + ONCE_REDUCED * random.number() ** 2))
        left, top = (random.below(length - square + 1) for length in picture.size)
        part = picture.crop((left, top, left + square, top + square)).resize((side, side), Image.Resampling.LANCZOS)
        return from_picture(part).rot90(random.below(4), (1, 2))

    def camera(self, random: Draws, side: int, *, noise: bool = True) -> Pair | None:
        """A photograph by a random camera, with noise or without, unless it needs a larger picture."""
        camera = Camera.drawn(random.generator, held_out=self.held_out)
        camera = camera if noise else camera.without_noise()
        crop = self.crop(random, camera.side_before(side)) if camera.side_before(side) <= LARGEST_SIDE else None
        if crop is None:
            return None
        clean, noisy = camera.photograph(crop, side, random.generator)
        return Pair(noisy, clean, "camera") if noise else Pair(noisy, noisy, "clean")

    def _white(self, random: Draws, side: int) -> Pair | None:
        """White noise, the same everywhere or growing with the light, in 8 bits or not limited."""
        clean = self.crop(random, side)
        if clean is None:
            return None
        level = random.factor(0.7, 60) / 255
        share = random.number() if random.number() < 0.5 else 1.0
        deviation = level * (share + 2 * (1 - share) * blurred(clean.mean(0, keepdim=True), 1.0)).sqrt()
        noisy = clean + deviation * random.normal(*clean.shape)
        return Pair(_rounded(noisy) if random.number() < 0.6 else noisy, clean, "white")

    def _smoothed(self, random: Draws, side: int) -> Pair | None:
        """White noise that was smoothed, colour more than luminance, and often compressed."""
        clean = self.crop(random, side)
        if clean is None:
            return None
        luminance, colour = random.normal(*clean[:1].shape), random.normal(*clean.shape)
        luminance = _softened(luminance, random.number(0, 1.2))
        colour = _softened(colour - colour.mean(0, keepdim=True), random.number(0, 3))
        noise = luminance / luminance.std() + random.number(0.2, 1) * colour / colour.std()
        noisy = _rounded(clean + random.factor(0.7, 20) / 255 * noise)
        return Pair(_compressed(random, noisy, 70) if random.number() < 0.7 else noisy, clean, "smoothed")

    def _clean(self, random: Draws, side: int) -> Pair | None:
        """No noise: from a camera without any, compressed, enlarged, or as it is."""
        if random.number() < 0.4:
            return self.camera(random, side, noise=False)
        enlarged = random.number(1.2, 3) if random.number() < 0.2 else 1.0
        crop = self.crop(random, int(side / enlarged))
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


def _softened(planes: Tensor, radius: float) -> Tensor:
    return planes if radius < 0.2 else blurred(planes, radius)


def _compressed(random: Draws, planes: Tensor, worst: int) -> Tensor:
    """JPEG, with any of its three ways to store colour."""
    content = io.BytesIO()
    quality, subsampling = worst + random.below(99 - worst), random.below(3)
    as_picture(planes).save(content, "JPEG", quality=quality, subsampling=subsampling)
    return read_picture(content)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make parts, or train on them."""
    parser = options("training.noise_profiles", __doc__)
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of pictures; with it, parts are made")
    add("--aside", type=Path, help="folder of other pictures, of the parts held out")
    add("--out", type=Path, default=Path("profiles"), help="folder of the parts")
    add("--parts", type=int, default=200, help="of training")
    add("--fit", type=Path, help="train, and write the weights to this file")
    chosen = parser.parse_args(arguments)
    if chosen.pictures is not None:
        chosen.out.mkdir(parents=True, exist_ok=True)
        folders = ("held", chosen.aside, HELD_PARTS), ("train", chosen.pictures, chosen.parts)
        for name, folder, count in folders if chosen.aside is not None else folders[1:]:
            held_out = name == "held"
            missing = [n for n in range(count) if not (chosen.out / f"{name}{n}.pt").exists()]
            pairs = Pairs(folder, held_out=held_out) if missing else None
            for number in missing:
                assert pairs is not None
                torch.save(part_of(pairs, number + 10_000 * held_out), chosen.out / f"{name}{number}.pt")
                print(f"{name} {number + 1} of {count}", flush=True)
    if chosen.fit is not None:
        from benchmarks.training.profile_fit import fit

        fit(chosen.out, chosen.fit)


if __name__ == "__main__":
    main()
