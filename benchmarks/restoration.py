"""How well the filter restores photographs as a prior, beside others: ``python -m benchmarks.restoration FOLDER``.

Four tasks on crops of 96x96 pixels from the middle of photographs, with noise of 0.01: a blur, a motion blur, half of
the pixels missing, and every second pixel of every second row after a slight blur. The prior minimises
``|A x - y|^2 / 2 + strength x^T (I - W) x / 2`` by conjugate gradients, with W of a result of total variation. That
method has the best of five strengths for each picture. The denoisers (the trained one, and the bilateral and median
filters of deepinv, if it is installed) stand in the same loop: a step on the measurements, and a denoiser whose sigma
falls. Then sigma is fixed and the loop is averaged, with weights that fall by half, so that it converges for any
denoiser; the slope of a step and the distance of the result from a fixed point are measured. Settings were chosen on
crops of scikit-image's photographs, the default.
"""

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.harness import Figure, options, report
from benchmarks.photographs import photograph
from nlfilter_torch import NonlocalDenoiser, NonlocalPrior, nonlocal_operator
from nlfilter_torch.photo import read_photograph
from tests.torchvision import make_importable

SIDE = 96
NOISE = 0.01
STRENGTHS = (5e-4, 1e-3, 2e-3, 4e-3, 1e-2)  # of total variation
LEAST = {"prior": 0.5, "trained denoiser": 1.5}
FIDELITY = 0.25  # weight of the measurements against the denoiser
FALLING, AVERAGED = 8, 4  # steps
SIGMA = {"blur": 0.02, "motion blur": 0.02, "inpainting": 0.02, "super-resolution": 0.02}
Map = Callable[[Tensor], Tensor]
OPERATORS: list[object] = []  # declared ones of torchvision, which live as long as this
Denoiser = Callable[[Tensor, float], Tensor]


@dataclass(frozen=True)
class Settings:
    """Of the prior: its strength, the strength of total variation before it, and options of the operator."""

    strength: float
    pilot: float
    patch_size: int
    photometric_bandwidth: float
    spatial_bandwidth: float
    num_landmarks: int


PRIOR = {
    "blur": Settings(0.04, 5e-4, 5, 0.05, 12.0, 800),
    "motion blur": Settings(0.4, 1e-3, 3, 0.04, 12.0, 800),
    "inpainting": Settings(0.2, 4e-3, 5, 0.03, 12.0, 1200),
    "super-resolution": Settings(0.05, 5e-4, 3, 0.05, 12.0, 800),
}


@dataclass(frozen=True)
class Task:
    """A linear measurement of images (1, 3, SIDE, SIDE), with noise."""

    name: str
    forward: Map
    transpose: Map
    start: Map  # a first estimate from measurements

    def observed(self, image: Tensor) -> Tensor:
        """What is measured of an image; places without a measurement are 0."""
        clean = self.forward(image)
        noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
        return clean + NOISE * noise * (clean != 0)


def convolved(kernel: Tensor, name: str) -> Task:
    """A circular convolution with a kernel (SIDE, SIDE), centred at its first entry."""
    response = torch.fft.rfft2(kernel)

    def apply(image: Tensor, gain: Tensor) -> Tensor:
        return torch.fft.irfft2(torch.fft.rfft2(image) * gain, s=image.shape[-2:])

    wiener = response.conj() / (response.abs().square() + 0.01)
    return Task(name, lambda x: apply(x, response), lambda y: apply(y, response.conj()), lambda y: apply(y, wiener))


def tasks() -> list[Task]:
    """The four tasks; none has a norm of A above 1."""
    places = torch.arange(SIDE)
    places = torch.minimum(places, SIDE - places).float()

    def gaussian(deviation: float) -> Tensor:
        profile = torch.exp(-places.square() / (2 * deviation**2))
        kernel = profile[:, None] * profile
        return kernel / kernel.sum()

    line = torch.zeros(SIDE, SIDE)
    for step in range(-4, 5):
        line[step // 2, step] = 1.0  # 9 pixels, at an angle
    known = (torch.rand(1, 1, SIDE, SIDE, generator=torch.Generator().manual_seed(1)) < 0.5).float()
    grid = torch.zeros(1, 1, SIDE, SIDE)
    grid[..., ::2, ::2] = 1.0
    anti_alias = convolved(gaussian(1.0), "")

    def filled(y: Tensor, places: Tensor) -> Tensor:
        near = convolved(gaussian(1.0), "").forward
        return torch.where(places > 0, y, near(y) / near(places).clamp(min=1e-6))

    return [
        convolved(gaussian(1.6), "blur"),
        convolved(line / line.sum(), "motion blur"),
        Task("inpainting", lambda x: known * x, lambda y: known * y, lambda y: filled(y, known)),
        Task(
            "super-resolution",
            lambda x: grid * anti_alias.forward(x),
            lambda y: anti_alias.transpose(grid * y),
            lambda y: filled(y, grid),
        ),
    ]


def conjugate_gradients(apply: Map, right: Tensor, start: Tensor, steps: int) -> Tensor:
    """Solution of ``apply(x) = right`` for a symmetric positive map, after so many steps."""
    x, residual = start, right - apply(start)
    direction, square = residual, residual.square().sum()
    for _ in range(steps):
        product = apply(direction)
        length = square / (direction * product).sum().clamp(min=1e-30)
        x, residual = x + length * direction, residual - length * product
        square, before = residual.square().sum(), square
        direction = residual + square / before.clamp(min=1e-30) * direction
    return x


def total_variation(task: Task, observed: Tensor, strength: float, steps: int = 200) -> Tensor:
    """Minimise |A x - y|^2 / 2 + strength TV(x), by the method of Condat, 2013; colours share their edges."""
    x = task.start(observed)
    tau, sigma = 1 / 2.5, 0.24  # 1 / tau - 8 sigma is at least |A|^2 / 2
    dual = torch.zeros(2, *x.shape[1:])
    for _ in range(steps):
        across, down = dual
        divergence = (across - across.roll(1, -1)) + (down - down.roll(1, -2))
        following = x - tau * (task.transpose(task.forward(x) - observed) - divergence)
        ahead = (2 * following - x)[0]
        dual = dual + sigma * torch.stack([ahead.roll(-1, -1) - ahead, ahead.roll(-1, -2) - ahead])
        dual = dual / (dual.square().sum((0, 1), keepdim=True).sqrt() / strength).clamp(min=1.0)
        x = following
    return x


def by_prior(task: Task, observed: Tensor) -> Tensor:
    """The minimum for W of a result of total variation, with a strength that leaves it texture."""
    settings = PRIOR[task.name]
    x = total_variation(task, observed, settings.pilot)
    operator = nonlocal_operator(
        x,
        patch_size=settings.patch_size,
        guide_channels="all",
        photometric_bandwidth=settings.photometric_bandwidth,
        spatial_bandwidth=settings.spatial_bandwidth,
        num_landmarks=settings.num_landmarks,
    )
    gradient = NonlocalPrior(operator).gradient
    return conjugate_gradients(
        lambda z: task.transpose(task.forward(z)) + settings.strength * gradient(z), task.transpose(observed), x, 30
    )


def by_denoiser(denoiser: Denoiser, task: Task, observed: Tensor) -> tuple[Tensor, float, float]:
    """The loop with a denoiser; the largest slope of its averaged steps; the last change that a step asked for, levels.

    A slope is the ratio of the changes after and before a step.
    """
    x, right, slope = task.start(observed), task.transpose(observed), 0.0
    last: tuple[Tensor, Tensor] | None = None

    def step(x: Tensor, sigma: float) -> Tensor:
        weight = FIDELITY * NOISE**2 / sigma**2
        near = conjugate_gradients(lambda z: task.transpose(task.forward(z)) + weight * z, right + weight * x, x, 12)
        return denoiser(near, sigma)

    for sigma in torch.logspace(math.log10(0.15), math.log10(SIGMA[task.name]), FALLING).tolist():
        x = step(x, sigma)
    for number in range(AVERAGED):
        following = step(x, SIGMA[task.name])
        if last is not None:
            slope = max(slope, float((following - last[1]).norm() / (x - last[0]).norm().clamp(min=1e-12)))
        last = x, following
        x = torch.lerp(x, following, 0.5**number)
    return x, slope, 255 * float((x - last[1]).square().mean().sqrt())


def decibels(image: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio."""
    return float(-10 * (image.clamp(0, 1) - truth).square().mean().log10())


def denoisers() -> dict[str, Denoiser]:
    """The trained denoiser, and those of deepinv."""
    found: dict[str, Denoiser] = {"trained denoiser": NonlocalDenoiser.trained()}
    if find_spec("deepinv") is None:
        return found
    OPERATORS.append(make_importable())
    from deepinv.models import BilateralFilter, MedianFilter

    bilateral, median = BilateralFilter(), MedianFilter(kernel_size=3)
    found["deepinv's bilateral"] = lambda x, sigma: bilateral(x, sigma_d=1.5, sigma_r=2 * sigma, window_size=5)
    found["deepinv's median"] = lambda x, sigma: median(x)
    return found


def crops(folder: Path | None) -> list[Tensor]:
    """The middle of six photographs of a folder, or of three of scikit-image's."""
    if folder is None:
        places = (("astronaut", 40, 170), ("coffee", 100, 200), ("chelsea", 80, 150))
        return [photograph(name)[..., y : y + SIDE, x : x + SIDE] for name, y, x in places]
    paths = sorted(folder.glob("*.png"))
    chosen = [read_photograph(path).pixels for path in paths[:: max(len(paths) // 6, 1)][:6]]
    middles = [((p.shape[2] - SIDE) // 2, (p.shape[3] - SIDE) // 2) for p in chosen]
    return [p[..., y : y + SIDE, x : x + SIDE] for p, (y, x) in zip(chosen, middles, strict=True)]


@torch.no_grad()
def measure(folder: Path | None, methods: list[str], names: list[str], quick: bool) -> Iterator[Figure]:
    """Mean PSNR of every method and task, and gains over total variation."""
    pictures = crops(folder)[: 1 if quick else None]
    loops = denoisers()
    for task in tasks()[-1:] if quick else [task for task in tasks() if task.name in names]:
        observed = [task.observed(picture) for picture in pictures]
        rows: dict[str, list[float]] = {
            "start": [decibels(task.start(y), x) for y, x in zip(observed, pictures, strict=True)]
        }
        rows["total variation"] = [
            max(decibels(total_variation(task, y, strength), x) for strength in STRENGTHS)
            for y, x in zip(observed, pictures, strict=True)
        ]
        if "prior" in methods:
            rows["prior"] = [decibels(by_prior(task, y), x) for y, x in zip(observed, pictures, strict=True)]
        for name, denoiser in loops.items():
            if name in methods:
                done = [by_denoiser(denoiser, task, y) for y in observed]
                rows[name] = [decibels(image, x) for (image, *_), x in zip(done, pictures, strict=True)]
                yield Figure(f"{task.name}, slope of the loop, {name}", max(slope for _, slope, _ in done))
                yield Figure(f"{task.name}, last change of the loop, {name}", max(c for *_, c in done), unit="levels")
        means = {name: sum(values) / len(values) for name, values in rows.items()}
        for name, mean in means.items():
            yield Figure(f"{task.name}, {name}", mean, unit="dB")
        for name, least in LEAST.items():
            if name in means:
                gain = means[name] - means["total variation"]
                yield Figure(f"{task.name}, {name} above total variation", gain, least, "dB", at_most=False)


def main() -> int:
    """Command line."""
    parser = options("restoration", __doc__, "one task on one picture")
    parser.add_argument("folder", type=Path, nargs="?", help="photographs (PNG); default: those of scikit-image")
    parser.add_argument("--methods", nargs="+", default=["prior", *denoisers()], help="methods beside total variation")
    parser.add_argument("--tasks", nargs="+", default=list(PRIOR), help="default: all")
    arguments = parser.parse_args()
    figures = measure(arguments.folder, arguments.methods, arguments.tasks, arguments.quick)
    return report(figures, quick=arguments.quick)


if __name__ == "__main__":
    sys.exit(main())
