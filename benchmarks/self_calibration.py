"""How well the filter judges and tunes itself without the truth: ``python -m benchmarks.self_calibration FOLDER``.

W compares patches of the noisy picture itself, slightly blurred, and three sliders are fitted by ``fit_alpha``. Printed
are, for white noise of several levels, for noise of a sensor (its variance grows with the light), for photographs of
simulated cameras, and for these with noise that is drawn from the profiles of the cameras' noise:

- the squared error that ``sure`` estimates over the true one, of whole pictures, with sliders fitted to the noise;
- on the middle of each picture, 256x256 pixels, how far bandwidth and sliders found by the gradient of the estimate lie
  below the best of a grid of bandwidths with sliders fitted to the truth, in dB, how many evaluations they took, and
  the time, beside that of scikit-image's ``calibrate_denoiser`` for its non-local means over a grid of equal size.

Nothing was chosen on the pictures of Kodak.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize
from skimage.restoration import calibrate_denoiser, denoise_nl_means
from torch import Tensor

from benchmarks.denoising.cases import psnr
from benchmarks.harness import Figure, options, report
from benchmarks.photographs import CHOOSING, pictures
from benchmarks.training.cameras import Camera
from nlfilter_torch import NoiseProfile, fit_alpha, nonlocal_operator, polynomial_filter, profile_of_difference, sure
from nlfilter_torch.operator.features import blur
from nlfilter_torch.operator.operator import NonlocalOperator

LEVELS = (10, 25, 50)  # grey levels
FLOOR, GAIN = (3 / 255) ** 2, (25 / 255) ** 2  # variance of a sensor's noise in the dark, and its growth up to white
START = 1.2  # bandwidth over the noise level
BOUNDS = (0.3, 4.0)  # of that ratio
GRID = 13  # bandwidths of the grids
MOST = 15  # evaluations
LEAST = 1e-3  # error over the variance of the noise; estimates may be negative
SIDE, CAMERA_SIDE = 256, 320
GUIDE_BLUR, LANDMARKS, STEP = 0.7, 100, 0.05
NEAR, SMALL_LOSS = 0.03, 0.1  # relative error of the estimate, and loss in dB
WHOLE = 10**6  # pixels of the short side


@dataclass(frozen=True)
class Case:
    """A noisy picture (1, 3, H, W) with the truth, its noise, and the noise's mean deviation."""

    name: str
    clean: Tensor
    noisy: Tensor
    noise: float | Tensor | NoiseProfile
    level: float

    def middle(self, side: int) -> "Case":
        """The middle of the picture."""
        top, left = ((length - side) // 2 for length in self.clean.shape[-2:])
        window = (..., slice(top, top + side), slice(left, left + side))
        noise = self.noise[window] if isinstance(self.noise, Tensor) else self.noise
        return Case(self.name, self.clean[window], self.noisy[window], noise, self.level)

    def held(self) -> "Held":
        """The filter of the noisy picture, with its landmarks."""
        return Held(self, nonlocal_operator(blur(self.noisy, GUIDE_BLUR), **self.options(START * self.level)))

    @staticmethod
    def options(bandwidth: float | Tensor) -> dict[str, object]:
        """Of the filter."""
        return {"photometric_bandwidth": bandwidth, "spatial_bandwidth": 25.0, "num_landmarks": LANDMARKS}


@dataclass(frozen=True)
class Held:
    """A picture with the operator whose landmarks are held."""

    case: Case
    first: NonlocalOperator

    def build(self, bandwidth: float | Tensor) -> Callable[[Tensor], NonlocalOperator]:
        """A function that builds W from a picture."""
        chosen = Case.options(bandwidth) | {"landmarks": self.first}
        return lambda image: nonlocal_operator(blur(image, GUIDE_BLUR), **chosen)

    def fitted(self, bandwidth: float) -> tuple[Tensor, Tensor]:
        """Filtered picture with sliders fitted to the noise, and the estimate of its squared error."""
        build, case = self.build(bandwidth), self.case
        alpha = fit_alpha(build, case.noisy, noise=case.noise, order=2)
        output = polynomial_filter(build(case.noisy), case.noisy, alpha)
        return output, sure(lambda y: polynomial_filter(build(y), y, alpha), case.noisy, case.noise, step=STEP)

    def found(self) -> tuple[Tensor, int]:
        """Filtered picture with bandwidth and sliders by the gradient of the estimate, and the evaluations it took."""
        case, count = self.case, 0

        def evaluate(logarithm: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal count
            count += 1
            free = torch.tensor(logarithm[0], dtype=torch.float32, requires_grad=True)
            build = self.build(case.level * free.exp())
            with torch.no_grad():
                alpha = fit_alpha(build, case.noisy, noise=case.noise, order=2)
            value = sure(lambda y: polynomial_filter(build(y), y, alpha), case.noisy, case.noise, step=STEP)
            # Decreases are judged as shares: the error may be a small part of the noise.
            logarithm_of_error = (value.sum() / case.level**2).clamp(min=LEAST).log()
            logarithm_of_error.backward()
            return float(logarithm_of_error.detach()), free.grad.double().numpy()[None]

        chosen = {"maxfun": 9, "maxls": 4, "ftol": 1e-3}  # a line search ends after the limit
        limits = [tuple(np.log(BOUNDS))]
        result = minimize(evaluate, np.log([START]), jac=True, method="L-BFGS-B", bounds=limits, options=chosen)
        build = self.build(case.level * float(np.exp(result.x[0])))
        alpha = fit_alpha(build, case.noisy, noise=case.noise, order=2)
        return polynomial_filter(build(case.noisy), case.noisy, alpha), count + 1

    def best(self) -> float:
        """PSNR of the best bandwidth of a grid, with sliders fitted to the truth."""
        results = []
        for ratio in np.geomspace(*BOUNDS, GRID):
            operator, case = self.build(self.case.level * float(ratio))(self.case.noisy), self.case
            alpha = fit_alpha(operator, case.noisy, case.clean, order=2, rounding=0.0)
            results.append(psnr(polynomial_filter(operator, case.noisy, alpha), case.clean))
        return max(results)


def white(images: dict[str, Tensor], level: float) -> Iterator[Case]:
    """Pictures with white noise of so many grey levels."""
    for number, (name, clean) in enumerate(images.items()):
        noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1000 + number)) * level / 255
        yield Case(name, clean, clean + noise, level / 255, level / 255)


def of_sensors(images: dict[str, Tensor]) -> Iterator[Case]:
    """Pictures with noise whose variance is linear in the light, and known as a map."""
    for number, (name, clean) in enumerate(images.items()):
        deviation = (FLOOR + GAIN * clean).sqrt()
        noise = deviation * torch.randn(clean.shape, generator=torch.Generator().manual_seed(2000 + number))
        yield Case(name, clean, clean + noise, deviation, float(deviation.mean()))


def of_cameras(images: dict[str, Tensor]) -> Iterator[Case]:
    """Photographs of the middle of pictures by simulated cameras, with the profile of their noise."""
    for number, (name, picture) in enumerate(images.items()):
        generator = torch.Generator().manual_seed(3000 + number)
        while True:
            camera = Camera.drawn(generator, held_out=True)
            side, before = min(CAMERA_SIDE, *picture.shape[-2:]), camera.side_before(CAMERA_SIDE)
            if before > min(picture.shape[-2:]):
                side = side // 2
                before = camera.side_before(side)
            if before > min(picture.shape[-2:]):
                continue
            top, left = ((length - before) // 2 for length in picture.shape[-2:])
            crop = picture[0, :, top : top + before, left : left + before]
            clean, noisy = (part[None] for part in camera.photograph(crop, side, generator))
            profile = profile_of_difference(noisy, clean)
            if 255 * float(profile.level) > 2:
                yield Case(name, clean, noisy, profile, float(profile.level))
                break


def of_profiles(images: dict[str, Tensor]) -> Iterator[Case]:
    """The photographs of :func:`of_cameras` with normal noise that their profiles describe in full."""
    for number, case in enumerate(of_cameras(images)):
        assert isinstance(case.noise, NoiseProfile)
        noise = case.noise.draw(case.clean, torch.Generator().manual_seed(4000 + number))
        yield replace(case, noisy=case.clean + noise)


def judged(kind: str, cases: Iterator[Case]) -> Figure:
    """Share of the pictures whose estimated error is near the true one."""
    ratios, unexplained = [], []
    for case in cases:
        output, estimate = case.held().fitted(START * case.level)
        true = float((output - case.clean).square().mean())
        ratios.append(float(estimate) / true)
        if not isinstance(case.noise, NoiseProfile):  # the part of the error that no estimate can know
            power = (case.noisy - case.clean).square().mean() - torch.as_tensor(case.noise).square().mean()
            unexplained.append((float(estimate - power)) / true)
    apart = [abs(ratio - 1) for ratio in ratios]
    middle = statistics.median(ratios)
    print(f"{kind}: estimated over true error {min(ratios):.3f} to {max(ratios):.3f}, median {middle:.3f}")
    if unexplained:
        inside = sum(abs(ratio - 1) <= NEAR for ratio in unexplained)
        print(f"  with the power of the noise itself known: {inside} of {len(unexplained)} within 3 %")
    near = sum(ratio <= NEAR for ratio in apart)
    wanted = len(ratios) - len(ratios) // 24
    return Figure(f"{kind}: of {len(ratios)} pictures, estimates within 3 %", near, wanted, at_most=False)


def tuned(kind: str, cases: Iterator[Case]) -> Iterator[Figure]:
    """Losses of what is found without the truth, evaluations, and times."""
    losses, counts, times, peers = [], [], [], []
    for whole in cases:
        case = whole.middle(min(SIDE, *whole.clean.shape[-2:]))
        held = case.held()
        start = time.perf_counter()
        found, count = held.found()
        times.append(time.perf_counter() - start)
        losses.append(held.best() - psnr(found, case.clean))
        counts.append(count)
        array = case.noisy[0].permute(1, 2, 0).double().numpy()
        grid = {"h": list(case.level * np.geomspace(*BOUNDS, GRID)), "channel_axis": [-1], "fast_mode": [True]}
        start = time.perf_counter()
        calibrate_denoiser(array, denoise_nl_means, grid)
        peers.append(time.perf_counter() - start)
    print(f"{kind}: loss {statistics.mean(losses):.3f} dB in the mean; evaluations {statistics.mean(counts):.1f}")
    print(f"  median seconds {statistics.median(times):.1f}; calibrate_denoiser {statistics.median(peers):.1f}")
    yield Figure(f"{kind}: largest loss to bandwidth and sliders chosen with the truth", max(losses), SMALL_LOSS, "dB")
    yield Figure(f"{kind}: most evaluations", max(counts), MOST)


def figures(images: dict[str, Tensor], parts: Sequence[str]) -> Iterator[Figure]:
    """All figures, one after another."""
    kinds = {f"white noise of {level}": lambda level=level: white(images, level) for level in LEVELS}
    kinds |= {"sensors": lambda: of_sensors(images), "cameras": lambda: of_cameras(images)}
    kinds |= {"profiles of cameras": lambda: of_profiles(images)}
    for kind, cases in kinds.items():
        if "judge" in parts:
            yield judged(kind, cases())
        if "tune" in parts:
            yield from tuned(kind, cases())


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure."""
    parser = options("self_calibration", __doc__, "two pictures, reduced")
    parser.add_argument("folder", type=Path, nargs="?", help="of pictures; default: those of scikit-image")
    parser.add_argument("--only", choices=("judge", "tune"), help="one half of the figures")
    chosen = parser.parse_args(arguments)
    images = pictures(chosen.folder, 64 if chosen.quick else WHOLE, CHOOSING)
    if chosen.quick:
        images = dict(list(images.items())[:2])
    return report(figures(images, [chosen.only] if chosen.only else ["judge", "tune"]), quick=chosen.quick)


if __name__ == "__main__":
    raise SystemExit(main())
