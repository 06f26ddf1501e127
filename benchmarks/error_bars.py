"""What standard errors of denoised pixels promise: ``python -m benchmarks.error_bars --kodak FOLDER --pairs FOLDER``.

For each picture, the share of its values that 1.645 standard errors to either side of the denoised ones hold, for all
pixels and for thirds of them by local contrast and by brightness of the truth, and how much better the mean interval
score (width, and 20 times what lies outside of the interval) is than that of the best single width for the picture.

Pictures of ``--kodak`` get white noise of three known levels. Pairs of ``--pairs`` have real noise, whose profile is
estimated (those of ``benchmarks/camera_noise.txt`` on which nothing was chosen). ``--filter`` denoises by the filter
alone. Nothing was chosen on these pictures.
"""

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.harness import Figure, options, report, row
from benchmarks.photographs import CHOOSING, pictures
from benchmarks.real_noise import listed, pairs_of
from nlfilter_torch import NoiseProfile, NonlocalDenoiser, noise_profile, standard_error
from nlfilter_torch.operator.features import blur
from nlfilter_torch.photo import denoise

LEVELS = (10, 25, 50)  # grey levels
NORMAL, OUTSIDE = 1.645, 0.1
NEAR, NEAR_IN_THIRDS, GAIN = 0.02, 0.05, 0.15
CONTRAST = 3.0  # pixels, the width of the neighbourhood whose contrast divides the pixels
UNREDUCED = 10**6  # pixels of the short side


@dataclass(frozen=True)
class Row:
    """Figures of a picture: coverage of all values and of thirds by contrast and brightness, and the gain."""

    name: str
    covered: float
    thirds: list[float]
    gain: float

    @classmethod
    def of(cls, name: str, function: Callable[[Tensor], Tensor], noisy: Tensor, clean: Tensor, noise: object) -> "Row":
        """Measure a picture."""
        with torch.no_grad():
            error = (function(noisy) - clean).abs()
        width = NORMAL * standard_error(function, noisy, noise)  # type: ignore[arg-type]
        inside = (error <= width).double()
        light = clean.mean(1, keepdim=True)
        contrast = blur(light.square(), CONTRAST) - blur(light, CONTRAST).square()
        per_pixel = inside.mean(1).flatten()
        orders = [values.flatten().argsort().tensor_split(3) for values in (contrast, light)]
        thirds = [float(per_pixel[part].mean()) for parts in orders for part in parts]
        one_width = error.flatten().kthvalue(round((1 - OUTSIDE) * error.numel())).values
        gain = 1 - float(score(error, width) / score(error, one_width))
        return cls(name, float(inside.mean()), thirds, gain)


def score(error: Tensor, width: Tensor) -> Tensor:
    """Mean interval score."""
    return (2 * width + 2 / OUTSIDE * (error - width).clamp(min=0)).mean()


def of_white_noise(images: dict[str, Tensor], level: int, *, alone: bool) -> Iterator[Row]:
    """Pictures with white noise of so many grey levels."""
    network, noise = NonlocalDenoiser.trained().requires_grad_(False), level / 255
    function = partial(denoise, noise_level=noise, method="rule") if alone else partial(network, noise=noise)
    for number, (name, clean) in enumerate(images.items()):
        field = torch.randn(clean.shape, generator=torch.Generator().manual_seed(4000 + number))
        yield Row.of(name, function, clean + noise * field, clean, noise)


def of_pairs(folder: Path, part: str, side: int) -> Iterator[Row]:
    """Pairs with real noise, which is estimated from the whole photograph."""
    network = NonlocalDenoiser.trained().requires_grad_(False)
    for name, noisy, clean in pairs_of(folder, listed(part)):
        noise: NoiseProfile = noise_profile(noisy)
        lit = clean + (noisy - clean).mean((2, 3), keepdim=True)  # the light of shots differs a little
        yield Row.of(name, partial(network, noise=noise), middle(noisy, side), middle(lit, side), noise)


def middle(picture: Tensor, side: int) -> Tensor:
    """The middle of a picture, at most so many pixels wide and high."""
    top, left = (max(0, length - side) // 2 for length in picture.shape[-2:])
    return picture[..., top : top + side, left : left + side]


def judged(kind: str, rows: Iterator[Row]) -> Iterator[Figure]:
    """Print the pictures, and give the figures."""
    print(row(kind, ("all", "flat", "medium", "textured", "dark", "middle", "bright", "gain"), 9, 36))
    each = []
    for one in rows:
        each.append(one)
        print(row(one.name, [f"{value:.3f}" for value in (one.covered, *one.thirds, one.gain)], 9, 36), flush=True)
    near = sum(abs(one.covered - 0.9) <= NEAR for one in each)
    evenly = sum(all(abs(share - 0.9) <= NEAR_IN_THIRDS for share in one.thirds) for one in each)
    mean = statistics.mean(one.gain for one in each)
    yield Figure(f"{kind}: of {len(each)}, pictures covered to 88 to 92 %", near, len(each), at_most=False)
    yield Figure(
        f"{kind}: of {len(each)}, pictures covered to 85 to 95 % in all thirds", evenly, len(each), at_most=False
    )
    yield Figure(f"{kind}: mean gain in the interval score", mean, GAIN, at_most=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure."""
    parser = options("error_bars", __doc__, "two small pictures")
    add = parser.add_argument
    add("--kodak", type=Path, help="folder of pictures; default without --pairs: those of scikit-image")
    add("--pairs", type=Path, help="folder of pairs with real noise")
    add("--set", choices=("choosing", "reporting"), default="reporting", help="which of the pairs")
    add("--side", type=int, default=UNREDUCED, help="of the middle of pictures that is measured, in pixels")
    add("--filter", action="store_true", help="denoise by the filter alone")
    chosen = parser.parse_args(arguments)
    side = 48 if chosen.quick else chosen.side
    images = {name: middle(image, side) for name, image in pictures(chosen.kodak, UNREDUCED, CHOOSING).items()}
    images = dict(list(images.items())[:2]) if chosen.quick else images
    sets = {}
    if chosen.kodak is not None or chosen.pairs is None:
        sets = {f"white noise of {level}": of_white_noise(images, level, alone=chosen.filter) for level in LEVELS}
    if chosen.pairs is not None:
        sets["real noise"] = of_pairs(chosen.pairs, chosen.set, side)
    return report((figure for kind, rows in sets.items() for figure in judged(kind, rows)), quick=chosen.quick)


if __name__ == "__main__":
    raise SystemExit(main())
