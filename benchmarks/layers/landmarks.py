"""Landmarks that are held against those chosen in every call: slopes, noise, recovered parameters, training."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from benchmarks.harness import Figure
from benchmarks.photographs import held_out, photograph
from nlfilter_torch import NonlocalFilter
from nlfilter_torch.nn.affinity import Hold
from nlfilter_torch.operator.options import Sampling

LANDMARKS = 100
BANDWIDTH = 20 / 255
STEPS = (1e-4, 1e-3, 1e-2)  # relative steps of the bandwidth
SIDE = 64
TRAINED = ("astronaut", "camera", "chelsea")  # for landmarks of new images; none of them is measured
SLIDERS = (3.0, 1.5, 2.0, 1.05)


@dataclass(frozen=True)
class Choice:
    """A way to choose landmarks, and what of them is held."""

    name: str
    landmarks: Sampling = "kmeans"
    hold: Hold | None = None

    def layer(self, guide: Tensor, *, bandwidth: float, count: int = LANDMARKS, learned: bool = True) -> NonlocalFilter:
        """A layer that learns sliders and bandwidth, in the precision of the guide."""
        layer = NonlocalFilter(
            SLIDERS,
            learn=("alpha", "photometric_bandwidth") if learned else ("alpha",),
            photometric_bandwidth=bandwidth,
            num_landmarks=count,
            landmarks=self.landmarks,
            hold=self.hold,
        ).to(guide)
        if self.hold:
            layer.renew(guide)
        return layer


ANEW = Choice("k-means in every call")
UNIFORM = Choice("uniform grid", landmarks="uniform")
ASSIGNED = Choice("assignment held", hold="assignment")
FIXED = Choice("features held", hold="features")
CHOICES = (ASSIGNED, FIXED, UNIFORM, ANEW)
HELD = (ASSIGNED, FIXED)


def crop(picture: Tensor, side: int = SIDE, *, dtype: torch.dtype = torch.float64) -> Tensor:
    """The middle of a photograph (1, C, H, W), half its size, in luminance, (1, 1, side, side)."""
    weights = torch.tensor([0.299, 0.587, 0.114] if picture.shape[1] == 3 else [1.0], dtype=torch.float64)
    grey = (picture.double() * weights.view(1, -1, 1, 1)).sum(1, keepdim=True)
    half = torch.nn.functional.avg_pool2d(grey, 2)
    top, left = ((length - side) // 2 for length in half.shape[2:])
    return half[:, :, top : top + side, left : left + side].to(dtype).contiguous()


def slope_error(choice: Choice, image: Tensor, step: float) -> float:
    """Relative difference of autograd from a central difference in the logarithm of the bandwidth."""
    layer = choice.layer(image, bandwidth=BANDWIDTH)
    logarithm = layer.affinity.log_photometric_bandwidth

    def loss() -> Tensor:
        return (layer(image) - image).square().mean()

    (slope,) = torch.autograd.grad(loss(), logarithm)
    start, values = logarithm.detach().clone(), []
    with torch.no_grad():
        for sign in (1, -1):
            logarithm.copy_(start + sign * step)
            values.append(loss())
    return abs(float((values[0] - values[1]) / (2 * step) / slope) - 1)


def answer_to_noise(choice: Choice, image: Tensor) -> float:
    """Root mean square by which noise of 1e-4 in the guide changes the smoothed image."""
    layer = choice.layer(image, bandwidth=BANDWIDTH)
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=image.dtype)
    with torch.no_grad():
        return float((layer(image, image + 1e-4 * noise) - layer(image)).square().mean().sqrt())


@dataclass
class Descent:
    """The course of an optimisation.

    Attributes:
        losses: after each evaluation.
        errors: largest absolute error of a slider or of the bandwidth, after each evaluation.
    """

    losses: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)

    @property
    def error(self) -> float:
        """The error where the loss is least."""
        return self.errors[min(range(len(self.losses)), key=self.losses.__getitem__)]


def recover(choice: Choice, image: Tensor, evaluations: int = 150) -> Descent:
    """Recover sliders and bandwidth from a target that the layer itself made, by L-BFGS."""
    layer = choice.layer(image, bandwidth=BANDWIDTH)
    target, truth, bandwidth = layer(image).detach(), layer.alpha.detach().clone(), bandwidth_of(layer)
    with torch.no_grad():
        layer.alpha.fill_(1.0)
    layer.affinity.photometric_bandwidth = 0.7 * BANDWIDTH
    course = Descent()
    optimizer = descent(layer, evaluations)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = (layer(image) - target).square().mean()
        loss.backward()
        apart = (layer.alpha.detach() - truth).abs().max()
        course.errors.append(max(float(apart), abs(bandwidth_of(layer) - bandwidth)))
        course.losses.append(loss.item())
        return loss

    optimizer.step(closure)  # type: ignore[arg-type]
    return course


def bandwidth_of(layer: NonlocalFilter) -> float:
    """The photometric bandwidth."""
    return float(torch.as_tensor(layer.photometric_bandwidth).detach())


def descent(layer: NonlocalFilter, evaluations: int) -> torch.optim.LBFGS:
    """L-BFGS with a line search, which ends only after so many evaluations or at rounding."""
    return torch.optim.LBFGS(
        layer.parameters(),
        max_iter=evaluations,
        max_eval=evaluations,
        tolerance_grad=0,
        tolerance_change=0,
        line_search_fn="strong_wolfe",
    )


def fit_to_exact(choice: Choice, image: Tensor, count: int, evaluations: int) -> list[float]:
    """Errors in grey levels of ``count`` landmarks, fitted to the output of a filter with all pixels as landmarks.

    One error for each of two fits; landmarks that are held are renewed before the second one.
    """
    pixels = image.shape[2] * image.shape[3]
    target = ANEW.layer(image, bandwidth=BANDWIDTH, count=pixels, learned=False)(image).detach()
    layer = choice.layer(image, bandwidth=0.7 * BANDWIDTH, count=count)
    errors = []
    for _ in range(2):
        if choice.hold:
            layer.renew(image)
        losses: list[float] = []
        optimizer = descent(layer, evaluations)

        def closure(optimizer: torch.optim.LBFGS = optimizer, losses: list[float] = losses) -> Tensor:
            optimizer.zero_grad()
            loss = (layer(image) - target).square().mean()
            loss.backward()
            losses.append(loss.item())
            return loss

        optimizer.step(closure)  # type: ignore[arg-type]
        errors.append(255 * min(losses) ** 0.5)
    return errors


def batch_of(pictures: Iterable[Tensor], side: int) -> Tensor:
    """Crops of pictures, (B, 1, side, side) in float32."""
    return torch.cat([crop(picture, side, dtype=torch.float32) for picture in pictures])


def noisy(image: Tensor, seed: int) -> Tensor:
    """The images with white noise of 25 grey levels."""
    return image + 25 / 255 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))


class Denoiser(nn.Module):
    """Two convolutions that compute a guide, and the filter."""

    def __init__(self, choice: Choice, count: int) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.guide = nn.Sequential(nn.Conv2d(1, 12, 5, padding=2), nn.ReLU(), nn.Conv2d(12, 6, 3, padding=1))
        self.filter = NonlocalFilter(
            (0.2, 0.4, 0.8, 1.0),
            learn=("alpha", "photometric_bandwidth", "spatial_bandwidth"),
            patch_size=1,
            photometric_bandwidth=0.2,
            spatial_bandwidth=6.0,
            num_landmarks=count,
            landmarks=choice.landmarks,
            hold=choice.hold,
        )

    def forward(self, image: Tensor) -> Tensor:
        """Denoise images (B, 1, H, W)."""
        filtered: Tensor = self.filter(image, self.guide(image))
        return filtered


def train(choice: Choice, unseen: Tensor, steps: int, count: int) -> tuple[float, float, float]:
    """Train a guide and a filter on new noise in every step; landmarks that are held are renewed every 20 steps.

    Returns:
        PSNR in dB on the pictures ``unseen`` (B, 1, side, side), the same with landmarks of each, and CPU seconds.
    """
    clean = batch_of((photograph(name) for name in TRAINED), unseen.shape[3])
    model = Denoiser(choice, count)
    optimizer, start = torch.optim.Adam(model.parameters(), lr=0.01), time.process_time()
    for step in range(steps):
        image = noisy(clean, step)
        if choice.hold and step % 20 == 0:
            model.filter.renew(model.guide(image))
        loss = (model(image) - clean).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    seconds = time.process_time() - start
    return *qualities(model, unseen, steps), seconds


@torch.no_grad()
def qualities(model: Denoiser, unseen: Tensor, seed: int) -> tuple[float, float]:
    """PSNR in dB on new pictures, and the same with landmarks of each picture."""
    values = []
    for renewed in (False, True):
        errors = []
        for number, clean in enumerate(unseen.split(1)):
            image = noisy(clean, seed + number)
            if renewed and model.filter.affinity.held is not None:
                model.filter.renew(model.guide(image))
            errors.append((model(image) - clean).square().mean())
        values.append(float(-10 * torch.stack(errors).log10().mean()))
    return values[0], values[1]


def measure(quick: bool, kodak: Path | None = None) -> Iterable[Figure]:
    """Measure every figure on scikit-image's photographs or on Kodak's; ``quick`` uses one small picture."""
    side = 24 if quick else SIDE
    pictures = list(held_out(kodak).values())
    images = [crop(picture, side) for picture in pictures[: 1 if quick else None]]
    worst = {
        "central difference against autograd, steps 1e-4 to 1e-2": (
            lambda choice, image: max(slope_error(choice, image, step) for step in STEPS),
            0.01,
        ),
        "change of the output by noise of 1e-4 in the guide": (answer_to_noise, 1e-4),
        "error of (alpha, h) recovered by L-BFGS": (lambda choice, image: recover(choice, image).error, 1e-6),
    }
    for name, (error, limit) in worst.items():
        for choice in CHOICES:
            value = max(error(choice, image) for image in images)
            yield Figure(f"{name}: {choice.name}", value, limit if choice in HELD else None)
    for choice in (ASSIGNED, UNIFORM, ANEW):
        fits = [fit_to_exact(choice, image[..., :48, :48], 50, 10 if quick else 40) for image in images]
        for name, errors in zip(("", ", fitted again"), zip(*fits, strict=True), strict=True):
            mean = sum(errors) / len(errors)
            yield Figure(f"50 landmarks fitted to a filter with all: {choice.name}{name}", mean, unit="levels")
    unseen, steps = batch_of(pictures, side), 3 if quick else 150
    for choice, count in ((FIXED, LANDMARKS), (FIXED, 3 * LANDMARKS), (UNIFORM, LANDMARKS), (ANEW, LANDMARKS)):
        quality, renewed, seconds = train(choice, unseen, steps, count)
        name = f"{choice.name}, m = {count}"
        yield Figure(f"new pictures denoised after training: {name}", quality, unit="dB")
        if choice.hold:
            yield Figure(f"the same, renewed for each picture: {name}", renewed, unit="dB")
        yield Figure(f"time of a training step: {name}", 1e3 * seconds / steps, unit="ms")
