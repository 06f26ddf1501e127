"""How many landmarks ``num_landmarks="auto"`` takes, and its time: ``python -m benchmarks.coverage FOLDER``.

For bandwidths of 5 to 40 grey levels it prints M, the share of badly covered pixels, and the time over that of the same
number asked for at once, in turns. The same for a pattern that repeats, and, for noise of 25 levels, what the filter
alone loses or gains in dB with that number beside 100 landmarks. Nothing was chosen on the pictures of Kodak.
"""

import statistics
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.denoising.cases import psnr
from benchmarks.harness import Figure, options, report
from benchmarks.photographs import CHOOSING, pictures
from nlfilter_torch import fit_alpha, nonlocal_operator, polynomial_filter
from nlfilter_torch.operator.features import blur

BANDWIDTHS = (5, 7, 10, 20, 40)  # grey levels
FROM = 10  # levels from which the aim counts
WANTED, LATER = 0.03, 1.5  # share, and time over that of the number asked for at once
NOISE, BLUR = 25 / 255, 0.7


def tried(picture: Tensor, bandwidth: float) -> tuple[int, float, float]:
    """M, the share, and the relative time."""
    seconds = []
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the limit is reached is what is measured
        operator = nonlocal_operator(picture, photometric_bandwidth=bandwidth, num_landmarks="auto")
    seconds.append(time.perf_counter() - start)
    count, share = operator.landmarks.shape[2], float(operator.badly_covered())
    del operator
    start = time.perf_counter()
    nonlocal_operator(picture, photometric_bandwidth=bandwidth, num_landmarks=count)
    seconds.append(time.perf_counter() - start)
    return count, share, seconds[0] / seconds[1]


def denoised(picture: Tensor, count: object) -> float:
    """PSNR of the filter alone, with sliders fitted to the noise."""
    noisy = picture + NOISE * torch.randn(picture.shape, generator=torch.Generator().manual_seed(5))
    chosen = {"photometric_bandwidth": NOISE, "spatial_bandwidth": 25.0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = nonlocal_operator(blur(noisy, BLUR), num_landmarks=count, **chosen)
    alpha = fit_alpha(lambda y: nonlocal_operator(blur(y, BLUR), landmarks=first, **chosen), noisy, noise=NOISE)
    return psnr(polynomial_filter(first, noisy, alpha), picture)


def figures(images: dict[str, Tensor]) -> Iterator[Figure]:
    """All figures."""
    tile = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    reached = dict.fromkeys(images, True)
    times = []
    for name, picture in {**images, "a repeated tile": tile.repeat(1, 1, 12, 16)}.items():
        cells = []
        for level in BANDWIDTHS:
            count, share, ratio = tried(picture, level / 255)
            cells.append(f"{level}: {count} {share:.1%} ({ratio:.1f})")
            if name in images and level >= FROM:
                reached[name] &= share <= WANTED
                times.append(ratio)
        print(f"{name:16}", "  ".join(cells), flush=True)
    gains = [denoised(picture, "auto") - denoised(picture, 100) for picture in images.values()]
    print(f"denoising by the filter alone: mean gain over 100 landmarks {statistics.mean(gains):+.2f} dB", end="")
    print(f", least {min(gains):+.2f} dB")
    wanted = len(images) - len(images) // 12
    name = f"pictures of {len(images)} covered at every bandwidth from 10"
    yield Figure(name, sum(reached.values()), wanted, at_most=False)
    yield Figure("median time over that of the number asked for at once", statistics.median(times), LATER)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure."""
    parser = options("coverage", __doc__, "two pictures of 64 pixels")
    parser.add_argument("folder", type=Path, nargs="?", help="of pictures; default: those of scikit-image")
    parser.add_argument("--side", type=int, default=256, help="short side in pixels to which pictures are reduced")
    chosen = parser.parse_args(arguments)
    images = pictures(chosen.folder, 64 if chosen.quick else chosen.side, CHOOSING)
    return report(figures(dict(list(images.items())[:2]) if chosen.quick else images), quick=chosen.quick)


if __name__ == "__main__":
    raise SystemExit(main())
