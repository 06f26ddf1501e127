"""f(W) of any response: its error against the dense eigen-decomposition, its cost at a megapixel, and the methods.

The forms and limits of the methods were chosen on the astronaut; coffee, chelsea and camera were looked at meanwhile.
The figures are of other photographs (:data:`benchmarks.photographs.HELD_OUT`).
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.harness import Figure, seconds
from benchmarks.photographs import held_out, large, middle
from nlfilter_torch import (
    NonlocalOperator,
    apply_function,
    detail_layers,
    nonlocal_operator,
    spectral_filter,
)
from nlfilter_torch.core.rational import interval_nodes, rational_form
from nlfilter_torch.filtering.lanczos import Lanczos, gains_of
from nlfilter_torch.filtering.matrix_function import rational_product

LEVELS = 255
Response = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Setup:
    """What is measured on.

    Attributes:
        quick: small cases, whose times mean nothing.
        kodak: folder of Kodak's photographs; None takes scikit-image's.
    """

    quick: bool
    kodak: Path | None = None

    @cached_property
    def pictures(self) -> list[Tensor]:
        """Photographs (1, C, H, W)."""
        return list(held_out(self.kodak).values())[: 1 if self.quick else None]

    def middles(self, side: int) -> list[Tensor]:
        """The middle of each, (1, C, side, side)."""
        return [middle(image, side, side) for image in self.pictures]


def tenth_power(values: Tensor) -> Tensor:
    """The response of the paper's abstraction."""
    return values**0.1


def network() -> Response:
    """A small network with random weights as a response."""
    generator = torch.Generator().manual_seed(0)
    first, second, third = (4 * torch.rand(32, generator=generator, dtype=torch.float64) - 2 for _ in range(3))

    def response(values: Tensor) -> Tensor:
        return (torch.tanh(values.double().unsqueeze(-1) * first + second) @ third).to(values)

    return response


def responses() -> dict[str, Response]:
    """Powers, an exponential and a network."""
    powers: dict[str, Response] = {
        f"power {p}": (lambda values, p=p: values**p) for p in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0)
    }
    return powers | {"exp": torch.exp, "network": network()}


def step_between(values: Tensor) -> dict[str, Response]:
    """A step in the middle of the widest gap of the eigenvalues (N,), if it is at least 0.01 from both."""
    gaps = values.diff()
    place = int(gaps.argmax())
    middle = float(values[place] + values[place + 1]) / 2
    return {"step": lambda s: s > middle} if float(gaps.max()) >= 0.02 else {}


def dense_errors(image: Tensor, count: int) -> Iterator[tuple[str, float, float]]:
    """Each response with its largest error in float64 and in float32, against the dense eigen-decomposition."""
    operator = nonlocal_operator(image, num_landmarks=count, photometric_bandwidth=20 / LEVELS)
    w = operator.to_dense()[0]
    values, vectors = torch.linalg.eigh((w + w.mT) / 2)
    values = values.clamp(0, 1)
    for kind, response in (responses() | step_between(values)).items():
        gains = response(values).double()
        wanted = (image[0].flatten(1) @ vectors * gains) @ vectors.mT
        errors = [
            float(
                (apply_function(operator.to(dtype), image.to(dtype), response).image[0].flatten(1) - wanted).abs().max()
            )
            for dtype in (torch.float64, torch.float32)
        ]
        yield kind, errors[0], errors[1]


def against_dense(setup: Setup) -> Iterator[Figure]:
    """Largest errors over pictures and numbers of landmarks."""
    double: dict[str, float] = {}
    single: dict[str, float] = {}
    for image in setup.middles(32):
        for count in (20, 100) if setup.quick else (20, 100, 1024):
            for kind, error, rounded in dense_errors(image.double(), count):
                double[kind] = max(double.get(kind, 0.0), error)
                single[kind] = max(single.get(kind, 0.0), rounded)
    for kind, error in double.items():
        yield Figure(f"f(W) y against the dense one, 1,024 pixels, float64: {kind}", error, 1e-3)
    for kind, error in single.items():
        smooth = kind not in ("power 0.1", "power 0.2", "power 0.5", "step")  # of a slope up to 20
        yield Figure(f"the same in float32: {kind}", error, 1e-3 if smooth else None)


def shortest(call: Callable[[], object], repeats: int) -> float:
    """Least time of several calls."""
    return min(seconds(call) for _ in range(repeats))


@torch.no_grad()
def at_a_megapixel(setup: Setup) -> Iterator[Figure]:
    """Error and time of the power 0.1, for one channel and for three."""
    side = 128 if setup.quick else 1024
    image = large(setup.kodak, side)
    operator = nonlocal_operator(image)
    for planes in (image[:, :1], image):
        text = f"power 0.1 of {side}x{side}, {planes.shape[1]} channel(s)"
        yield from _cost(operator, planes, text, None if setup.quick else 15.0)
    planes = image[:, :1]
    result = apply_function(operator, planes, tenth_power)
    exact = apply_function(operator.to(torch.float64), planes.double(), tenth_power, tolerance=2e-6)
    error = LEVELS * float((result.image - exact.image).abs().max())
    yield Figure(f"power 0.1 of {side}x{side}: largest error", error, 0.5, "levels")


def _cost(operator: NonlocalOperator, planes: Tensor, text: str, limit: float | None) -> Iterator[Figure]:
    """Time in turns with that of the layers, and the number of products."""
    result = apply_function(operator, planes, tenth_power)
    pairs = [
        (
            shortest(lambda: apply_function(operator, planes, tenth_power), 1),
            shortest(lambda: detail_layers(operator, planes), 2),
        )
        for _ in range(3)
    ]
    ratio = min(function for function, _ in pairs) / min(layers for _, layers in pairs)
    yield Figure(f"{text}: time in units of detail_layers", ratio, limit)
    yield Figure(f"{text}: products with W", result.products)
    yield Figure(f"{text}: shifted systems, each a Gram matrix and a product", result.shifts)


def compared(operator: NonlocalOperator, image: Tensor, decades: int) -> Iterator[Figure]:
    """The power 0.1 by the three methods, against a rational function of 32 poles."""
    matrix, planes = operator.matrix, image.flatten(2)
    values = tenth_power(interval_nodes(decades))[None]

    def rational(degree: int, poles: int) -> Tensor:
        form = rational_form(decades, degree, poles, 1.0, 0.15)
        return rational_product(matrix, planes, form, form.coefficients(values))

    exact = rational(6, 32)
    for poles in (4, 6, 8, 12):
        error, spent = (
            LEVELS * float((rational(3, poles) - exact).abs().max()),
            shortest(lambda p=poles: rational(3, p), 1),
        )
        yield Figure(f"power 0.1, {poles} poles: largest error; seconds {spent:.2f}", error, None, "levels")
    for degree in (10, 20, 40, 80):
        error, spent = (
            LEVELS * float((rational(degree, 0) - exact).abs().max()),
            shortest(lambda d=degree: rational(d, 0), 1),
        )
        yield Figure(
            f"power 0.1, Chebyshev of degree {degree}: largest error; seconds {spent:.2f}", error, None, "levels"
        )
    iteration, spent = Lanczos(matrix, planes), 0.0
    for steps in (10, 20, 40, 80):
        start = time.perf_counter()
        iteration.extend(steps - iteration.steps)
        space = iteration.space()
        result = space.combine(gains_of(tenth_power, space.values))
        spent += time.perf_counter() - start
        error = LEVELS * float((result - exact).abs().max())
        yield Figure(
            f"power 0.1, Lanczos with {steps} products: largest error; seconds {spent:.2f}", error, None, "levels"
        )


@torch.no_grad()
def methods(setup: Setup) -> Iterator[Figure]:
    """The three methods on one picture in float64."""
    side = 96 if setup.quick else 256
    image = middle(setup.pictures[0], side, side).double()
    operator = nonlocal_operator(image, photometric_bandwidth=20 / LEVELS)
    yield from compared(operator, image, min(max(math.ceil(-math.log10(float(operator.remainder.min()))), 1), 16))


def darker(image: Tensor, result: Tensor) -> float:
    """Share of the pixels that are darker than before by more than 50 levels, in percent."""
    return 100 * float((image - result > 50 / LEVELS).double().mean())


def black(image: Tensor, result: Tensor) -> float:
    """Share of the pixels that turn black: from more than 30 levels to less than 5, in percent."""
    return 100 * float(((image > 30 / LEVELS) & (result < 5 / LEVELS)).double().mean())


@torch.no_grad()
def black_pixels(setup: Setup) -> Iterator[Figure]:
    """Pixels that the power 0.1 darkens: eq. 10, a spectrum by default, and f(W), which darkens a few itself."""
    kinds = ("eq. 10 (residual=0.0)", "a spectrum, by default", "the operator")
    darkened, blackened, beyond = dict.fromkeys(kinds, 0.0), dict.fromkeys(kinds, 0.0), 0.0
    for image in setup.middles(96 if setup.quick else 192):
        for bandwidth in (10, 20):
            operator = nonlocal_operator(image, photometric_bandwidth=bandwidth / LEVELS)
            spectrum = operator.spectrum()
            results = (
                spectral_filter(spectrum, image, tenth_power, residual=0.0),
                spectral_filter(spectrum, image, tenth_power),
                spectral_filter(operator, image, tenth_power),
            )
            for kind, result in zip(kinds, results, strict=True):
                darkened[kind] = max(darkened[kind], darker(image, result))
                blackened[kind] = max(blackened[kind], black(image, result))
            beyond = max(beyond, darker(results[2], results[1]))
    for kind in kinds:
        yield Figure(f"power 0.1: pixels darker by 50 levels, {kind}", darkened[kind], unit="%")
        yield Figure("  pixels that turn black", blackened[kind], None if "eq" in kind else 0.0, "%")
    yield Figure("  darker by 50 levels than by the operator, a spectrum, by default", beyond, 0.0, "%")


def measure(quick: bool = False, kodak: Path | None = None) -> Iterable[Figure]:
    """All figures, on scikit-image's photographs or on those in a folder of Kodak's."""
    setup = Setup(quick, kodak)
    for part in (against_dense, black_pixels, methods, at_a_megapixel):
        yield from part(setup)
