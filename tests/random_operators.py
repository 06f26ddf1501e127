"""Random operators and the library's promises about them, each a measured value with a limit.

Guides and options are drawn from one random generator; properties of an operator are computed in float64 from its
tensors.
"""

import math
import random
import re
import traceback
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import nlfilter_torch
from benchmarks.photographs import photograph
from nlfilter_torch import NonlocalOperator, detail_layers, nonlocal_operator, polynomial_filter
from nlfilter_torch.core.kernels import definitions_only
from nlfilter_torch.operator.options import Sampling

CROPPED = ("astronaut", "camera", "chelsea", "coffee", "moon", "page", "rocket", "text")
HARD = ("checkerboard", "stripes", "two-valued", "spikes", "ramp", "photograph")  # drawn more often
SAMPLINGS: tuple[Sampling, ...] = ("kmeans", "uniform", "random")
ORDINARY = 1.5  # largest guide value for which building an operator must succeed


@dataclass(frozen=True)
class Case:
    """One operator to build.

    Attributes:
        name: content, shape and dtype of the guide.
        guide: (B, C, H, W).
        options: keyword arguments of :func:`nonlocal_operator`, except the generator.
        native: whether the C kernels may be used.
        backward: whether gradients are checked.
        seed: of the landmarks, and of the image and the sliders used in the checks.
    """

    name: str
    guide: Tensor
    options: dict[str, Any]
    native: bool
    backward: bool
    seed: int

    @property
    def ordinary(self) -> bool:
        """Whether the guide has the value range of an image, so that no error is acceptable."""
        return float(self.guide.detach().abs().max()) <= ORDINARY

    def __str__(self) -> str:
        """Describe the case in one line."""
        shown = {name: _shown(value) for name, value in self.options.items()}
        options = ", ".join(f"{name}={value}" for name, value in shown.items())
        return f"{self.name}{', backward' * self.backward}{', no C' * (not self.native)}: {options}"


def random_case(rng: random.Random, side: int) -> Case:
    """Draw a guide of at most ``side`` by ``side`` pixels, and all options."""
    batch, channels = rng.choice((1, 1, 2, 3)), rng.choice((1, 1, 2, 3, 4))
    height, width = _side(rng, side), _side(rng, side)
    dtype = rng.choice((torch.float32, torch.float32, torch.float64))
    names, images = zip(*(_content(rng, channels, height, width) for _ in range(batch)), strict=True)
    guide = torch.stack(images).to(dtype)
    patch_size = rng.choice((1, 1, 3, 5, 7))
    options: dict[str, Any] = {
        "patch_size": patch_size,
        "photometric_bandwidth": "auto" if rng.random() < 0.25 else _bandwidth(rng, 1e-3, 10.0, batch),
        "spatial_bandwidth": None if rng.random() < 0.5 else _bandwidth(rng, 0.3, 100.0, batch),
        "num_landmarks": round(log_uniform(rng, 1, 200)),
        "landmarks": rng.choice(SAMPLINGS),
        "completion": rng.choice(("diagonal", "diagonal", "none")),
        "guide_channels": rng.choice(("luminance", "all")),
    }
    if rng.random() < 0.15:
        options["tolerance"] = log_uniform(rng, 1e-8, 1e-2)
    if rng.random() < 0.05:
        weights = torch.rand(patch_size, patch_size, generator=torch.Generator().manual_seed(rng.randint(0, 99)))
        options["patch_weights"] = weights + 1e-3
    name = f"{' + '.join(names)} {tuple(guide.shape)} {str(dtype).removeprefix('torch.')}"
    return Case(name, guide, options, rng.random() < 0.7, rng.random() < 0.4, rng.randint(0, 1 << 20))


def log_uniform(rng: random.Random, least: float, most: float) -> float:
    """Draw a number whose logarithm is uniformly distributed."""
    return math.exp(rng.uniform(math.log(least), math.log(most)))


def _side(rng: random.Random, most: int) -> int:
    return min(int(log_uniform(rng, 1, most + 1)), most) if rng.random() < 0.6 else rng.randint(1, most)


def _bandwidth(rng: random.Random, least: float, most: float, batch: int) -> float | Tensor:
    if rng.random() < 0.8:
        return log_uniform(rng, least, most)
    return torch.tensor([log_uniform(rng, least, most) for _ in range(batch)], dtype=torch.float64)


def _shown(value: object) -> str:
    if isinstance(value, Tensor):
        return f"tensor({value.tolist()})" if value.ndim < 2 else f"tensor of {tuple(value.shape)}"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def _content(rng: random.Random, channels: int, height: int, width: int) -> tuple[str, Tensor]:
    """Draw an image: the name of its content, and its values (C, H, W) in float64."""
    name = rng.choice(HARD if rng.random() < 0.4 else tuple(CONTENTS))
    image = CONTENTS[name](rng, channels, height, width)
    return name, image.expand(channels, height, width).double()


def _noise(rng: random.Random, *shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(rng.randint(0, 1 << 20)), dtype=torch.float64)


def _grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    return torch.arange(height)[:, None], torch.arange(width)[None]


def _pair(rng: random.Random, mask: Tensor) -> Tensor:
    """Draw two values, one inside a mask and one outside."""
    low, high = rng.choice(((0.0, 1.0), (0.25, 0.75), (0.5, 0.5 + log_uniform(rng, 1e-4, 0.1))))
    return torch.where(mask, high, low)


def _constant(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return torch.full((channels, height, width), rng.choice((0.0, 0.5, 1.0, rng.random())))


def _nearly_constant(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return 0.5 + log_uniform(rng, 1e-8, 1e-2) * _noise(rng, channels, height, width)


def _two_valued(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _pair(rng, _noise(rng, channels, height, width) < rng.choice((0.5, 0.1, 0.01)))


def _checkerboard(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    period = rng.choice((1, 2, 3, 4, 8))
    return _pair(rng, (rows // period + columns // period) % 2 == 0)[None]


def _stripes(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    period, levels = rng.choice((1, 2, 3, 5)), rng.choice((2, 3, 4))
    phase = rng.choice((0, 1, 1, 2)) * rows + rng.choice((1, 1, 0, 3)) * columns
    return (phase // period % levels)[None] / (levels - 1)


def _spikes(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    image = torch.full((channels, height, width), rng.choice((0.0, 0.5)), dtype=torch.float64)
    for _ in range(rng.choice((1, 1, 2, 5))):
        image[:, rng.randint(0, height - 1), rng.randint(0, width - 1)] = rng.random()
    return image


def _ramp(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    plane = rng.choice((0, 1)) * rows + columns
    return plane[None] * (log_uniform(rng, 1e-3, 1.0) / max(int(plane.max()), 1))


def _denormal(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) * 1e-40


def _tiny(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) * log_uniform(rng, 1e-30, 1e-3)


def _huge(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) * log_uniform(rng, 10.0, 1e37)


def _offset(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    return _noise(rng, channels, height, width) + log_uniform(rng, 1.0, 1e6)


def _repeated(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = rng.randint(1, 8), rng.randint(1, 8)
    tile = _noise(rng, channels, rows, columns)
    return tile.repeat(1, -(-height // rows), -(-width // columns))[:, :height, :width]


def _smooth(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    rows, columns = _grid(height, width)
    waves = [torch.sin(rng.uniform(0, 0.4) * rows + rng.uniform(0, 0.4) * columns + rng.uniform(0, 6)) for _ in "abc"]
    return 0.5 + torch.stack(waves).sum(0, keepdim=True) / 6


def _any_noise(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    levels = rng.choice((3, 10, 1 << 20))
    return (_noise(rng, channels, height, width) * levels).floor() / levels


def _photograph(rng: random.Random, channels: int, height: int, width: int) -> Tensor:
    picture = photograph(rng.choice(CROPPED))[0]
    step = rng.choice((1, 2))
    picture = picture[:, ::step, ::step]
    top, left = rng.randint(0, picture.shape[1] - height), rng.randint(0, picture.shape[2] - width)
    return picture[torch.arange(channels) % len(picture), top : top + height, left : left + width]


CONTENTS = {
    "constant": _constant,
    "nearly constant": _nearly_constant,
    "two-valued": _two_valued,
    "checkerboard": _checkerboard,
    "stripes": _stripes,
    "spikes": _spikes,
    "ramp": _ramp,
    "denormal": _denormal,
    "tiny": _tiny,
    "huge": _huge,
    "offset": _offset,
    "repeated patches": _repeated,
    "smooth": _smooth,
    "noise": _any_noise,
    "photograph": _photograph,
}


DENSE = 320  # pixels up to which all eigenvalues are computed
STEPS = 25  # limit of the iteration for the largest eigenvalue, which takes 3 to 6


@dataclass(frozen=True)
class Exact:
    """``W = F^T F + diag(D)`` in float64.

    Attributes:
        factor: F, (B, M, N).
        diagonal: D, (B, N).
    """

    factor: Tensor
    diagonal: Tensor

    @staticmethod
    def of(operator: NonlocalOperator) -> "Exact":
        """Read W from an operator, for every image of its batch."""
        factor, scaling, remainder = (
            t.detach().double() for t in (operator.factor, operator.scaling, operator.remainder)
        )
        return Exact(factor * scaling.unsqueeze(1), remainder)

    def product(self, planes: Tensor) -> Tensor:
        """``W y`` for y (B, R, N)."""
        return (planes @ self.factor.mT) @ self.factor + self.diagonal.unsqueeze(1) * planes

    def dense(self) -> Tensor:
        """W, (B, N, N)."""
        return self.factor.mT @ self.factor + torch.diag_embed(self.diagonal)

    def row_sum_errors(self) -> Tensor:
        """Largest deviation of a row sum from 1, (B,)."""
        return (self.product(torch.ones_like(self.diagonal).unsqueeze(1)) - 1).abs().amax((1, 2))

    def eigenvalue_range(self) -> tuple[Tensor, Tensor]:
        """Smallest and largest eigenvalue, (B,) each; for large images, a lower bound of the smallest."""
        if self.diagonal.shape[1] <= DENSE:
            values = torch.linalg.eigvalsh(self.dense())
            return values[:, 0], values[:, -1]
        pairs = zip(self.factor, self.diagonal, strict=True)
        return self.diagonal.amin(1), torch.stack([_largest(*pair) for pair in pairs])


def _largest(factor: Tensor, diagonal: Tensor) -> Tensor:
    """The largest eigenvalue of ``F^T F + diag(D)``, for F (M, N) and D (N,).

    For l above D, an eigenvector x of eigenvalue l is ``x = (l - D)^-1 F^T v``, where ``S(l) v = v`` and
    ``S(l) = F (l - D)^-1 F^T`` is M x M. For the leading eigenvector v of any S(l), with eigenvalue m, the Rayleigh
    quotient of this x is ``l + (m - 1) m / |x|^2``, the next l. No Rayleigh quotient exceeds the largest eigenvalue.
    """
    floor = diagonal.max()
    best = (factor.square().sum(0) + diagonal).max()  # nor does a diagonal entry of W
    value = torch.maximum(best, torch.ones_like(best)) * (1 + 1e-6)
    for _ in range(STEPS):
        inverse = (value - diagonal).reciprocal()
        values, vectors = torch.linalg.eigh((factor * inverse) @ factor.mT)
        m, x = values[-1], inverse * (vectors[:, -1] @ factor)
        if not x.any():
            break
        before, best = best, torch.maximum(best, value + (m - 1) * m / x.square().sum())
        value = torch.maximum(best, floor + 1e-10 * (1 + floor.abs()))
        if best - before <= 1e-9 * best:
            break
    return best


FINITE = "non-finite values"
RESIDUAL = "false residuals"
ROW_SUMS = "row sums out of tolerance without a warning"
EIGENVALUES = "eigenvalues outside [0, 1.0001]"
REPORTED = "reported eigenvalues outside [0, 1]"
ORTHONORMAL = "eigenvectors not orthonormal to 1e-3"
DIAGNOSTICS = "diagnostics or certificates that are false"
PRODUCTS = "products that are not those of W"
IDENTITY = "alpha = 1 changes the image"
REFUSED = "errors on legal input"
ERRORS = "exceptions that are not one-sentence ValueError or TypeError"
WARNINGS = "warnings that name no remedy"

SLACK = {torch.float32: 2e-5, torch.float64: 1e-10}  # allowed beyond a reported residual
UNNOTICED = {torch.float32: 1e-4, torch.float64: 1e-9}  # row-sum errors that need no warning
ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-12}
PACKAGE = str(Path(nlfilter_torch.__file__).parent)


@dataclass(frozen=True)
class Figure:
    """A value measured for one promise, which is kept if the value is at most its limit."""

    promise: str
    value: float
    limit: float = 0.0
    detail: str = ""

    @property
    def broken(self) -> bool:
        """Whether the promise is broken; NaN breaks it."""
        return not self.value <= self.limit


@dataclass
class Findings:
    """All figures of one case, and its warnings."""

    figures: list[Figure] = field(default_factory=list)
    warned: list[str] = field(default_factory=list)

    def note(self, promise: str, value: float | Tensor, limit: float = 0.0, detail: str = "") -> bool:
        """Add a figure; return whether the promise is kept."""
        figure = Figure(promise, float(value), limit, detail)
        self.figures.append(figure)
        return not figure.broken

    def finite(self, tensor: Tensor, name: str) -> bool:
        """Note the number of non-finite values of a tensor; return whether there are none."""
        values = tensor.detach()
        values = values if values.layout == torch.strided else values.to_dense()
        return self.note(FINITE, int((~values.isfinite()).sum()), 0, f"in {name} {tuple(tensor.shape)}")

    @property
    def broken(self) -> list[Figure]:
        """Figures of the broken promises."""
        return [figure for figure in self.figures if figure.broken]


@contextmanager
def judged(findings: Findings, *, legal: bool, completed: bool = False) -> Iterator[None]:
    """Judge the exceptions and warnings of a block.

    Args:
        findings: receives the figures and the warnings.
        legal: whether the arguments are legal, so that no exception is acceptable.
        completed: whether the diagonal correction is in use, so that no warning may suggest it as a remedy.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            detail = f"{type(error).__name__}: {str(error)[:300]!r} ({Path(last.filename).name}:{last.lineno})"
            findings.note(ERRORS, 0 if is_sentence(error) else 1, 0, detail)
            findings.note(REFUSED, 1 if legal and is_sentence(error) else 0, 0, detail)
        else:
            findings.note(ERRORS, 0)
            findings.note(REFUSED, 0)
    for warning in caught:
        text = str(warning.message)
        findings.warned.append(text)
        remedy = text.partition("; ")[2]
        kept = warning.category is UserWarning and remedy and not (completed and "completion='diagonal'" in remedy)
        findings.note(WARNINGS, 0 if kept else 1, 0, f"{warning.category.__name__}: {text!r}")


def is_sentence(error: Exception) -> bool:
    """Whether it is a ValueError or TypeError of this package, in one sentence with requirement and remedy."""
    raised_in = traceback.extract_tb(error.__traceback__)[-1].filename
    one_sentence = re.fullmatch(r"\S[^\n]* must [^\n]*; [^\n]*\S", str(error)) is not None
    return type(error) in (ValueError, TypeError) and raised_in.startswith(PACKAGE) and one_sentence


def kernels(used: bool) -> AbstractContextManager[None]:
    """Disable the C kernels unless ``used``."""
    return nullcontext() if used else definitions_only()


def check_case(case: Case) -> Findings:
    """Build the operator of a case, and check all its promises."""
    findings = Findings()
    guide = case.guide.clone().requires_grad_(case.backward)
    generator = torch.Generator().manual_seed(case.seed)
    completed = case.options["completion"] == "diagonal"
    operator = None
    with kernels(case.native), judged(findings, legal=case.ordinary, completed=completed):
        operator = nonlocal_operator(guide, generator=generator, **case.options)
    if operator is None:
        return findings
    image = torch.rand(case.guide.shape, generator=generator, dtype=torch.float64).to(case.guide)
    with kernels(case.native), judged(findings, legal=True, completed=completed):
        with torch.no_grad():
            sound = check_operator(findings, operator, image, case.options.get("tolerance"))
        if sound and case.backward:
            check_gradient(findings, operator, guide, image, generator)
    return findings


def check_gradient(
    findings: Findings, operator: NonlocalOperator, guide: Tensor, image: Tensor, generator: torch.Generator
) -> None:
    """Check that the gradients of a filtered image and of the eigenvalues are finite."""
    filtered = polynomial_filter(operator, image, torch.randn(4, generator=generator).to(image))
    values = operator.spectrum().eigenvalues
    outputs = [
        (output * torch.randn(output.shape, generator=generator).to(output)).sum() for output in (filtered, values)
    ]
    for name, output in zip(("polynomial_filter", "eigenvalues"), outputs, strict=True):
        (gradient,) = torch.autograd.grad(output, guide, retain_graph=True)
        findings.finite(gradient, f"gradient of {name}")


def check_operator(findings: Findings, operator: NonlocalOperator, image: Tensor, tolerance: float | None) -> bool:
    """Check an operator and its effect on an image (B, C, H, W); return whether its tensors are finite."""
    for name in ("factor", "diagonal", "scaling", "remainder", "residual"):
        if not findings.finite(getattr(operator, name), name):
            return False
    exact, dtype = Exact.of(operator), operator.factor.dtype
    errors = exact.row_sum_errors()
    _check_residual(findings, RESIDUAL, errors, operator.residual.double(), dtype)
    # A tolerance below the working precision cannot be attained.
    if not any("row sum" in text for text in findings.warned):
        detail = f"reported {operator.residual.max():.1e}"
        findings.note(ROW_SUMS, errors.max(), max(tolerance or 0.0, UNNOTICED[dtype]), detail)
    least, most = exact.eigenvalue_range()
    findings.note(EIGENVALUES, -least.min(), 1e-4, "smallest")
    # Row sums of 1 + tolerance, if so requested, imply an eigenvalue of that size.
    findings.note(EIGENVALUES, most.max(), 1 + max(tolerance or 0.0, 1e-4), "largest")
    _check_spectrum(findings, operator, exact, most)
    _check_certificate(findings, operator, errors, least, most)

    scale = most.clamp(min=1.0).max()
    precision = 1e-4 if dtype == torch.float32 else 1e-9
    planes = image.double().flatten(2)
    apart = (operator @ image).double().flatten(2) - exact.product(planes)
    findings.note(PRODUCTS, apart.norm() / planes.norm() / scale, precision, "operator @ image")
    if exact.diagonal.shape[1] <= DENSE:
        apart = (operator.to_dense().double() - exact.dense()).abs().amax()
        findings.note(PRODUCTS, apart / scale, precision, "to_dense")
    same = polynomial_filter(operator, image, image.new_ones(4))
    findings.note(IDENTITY, (same - image).abs().max(), ROUNDING[dtype], "polynomial_filter")
    findings.note(IDENTITY, (detail_layers(operator, image).sum(1) - image).abs().max(), ROUNDING[dtype], "layers")
    for residual in (None, 0.0, 1.0):
        edited = polynomial_filter(operator, image, image.new_tensor([3.0, 3.0, 4.0, 1.05]), residual=residual)
        findings.finite(edited, f"polynomial_filter, residual={residual}")
    return True


def _check_residual(findings: Findings, promise: str, errors: Tensor, reported: Tensor, dtype: torch.dtype) -> None:
    excess = errors - (1.5 * reported + SLACK[dtype])
    worst = int(excess.nan_to_num(nan=torch.inf).argmax())
    findings.note(promise, excess[worst], 0.0, f"row sums off by {errors[worst]:.1e}, reported {reported[worst]:.1e}")


def _check_spectrum(findings: Findings, operator: NonlocalOperator, exact: Exact, most: Tensor) -> None:
    """Check eigenvalues and eigenvectors, and the figures of :class:`Diagnostics`."""
    spectrum = operator.spectrum()
    if not spectrum.eigenvalues.numel() or not findings.finite(spectrum.eigenvalues, "eigenvalues"):
        return  # there are none if no pixel is similar to any other
    findings.note(REPORTED, -spectrum.eigenvalues.min(), 0.0, "smallest")
    findings.note(REPORTED, spectrum.eigenvalues.max(), 1.0, "largest")
    vectors = spectrum.eigenvectors.double().flatten(2)  # (B, R, N)
    if not findings.finite(vectors, "eigenvectors"):
        return
    gram = vectors @ vectors.mT
    occupied = torch.diag_embed((gram.diagonal(dim1=1, dim2=2) != 0).double())  # padded eigenvectors are zero
    apart = (gram - occupied).abs().amax((1, 2))
    findings.note(ORTHONORMAL, apart.max(), 1e-3)

    errors = exact.row_sum_errors()
    residual = (exact.product(vectors) - spectrum.eigenvalues.double().unsqueeze(2) * vectors).norm(dim=2).amax(1)
    told = operator.diagnostics()
    for name, true in (
        ("largest_eigenvalue", most),
        ("orthogonality", apart),
        ("eigenvector_residual", residual),
    ):
        reported = torch.tensor(getattr(told, name), dtype=torch.float64)
        off = (reported - true).abs() / most.clamp(min=1.0)
        worst = int(off.nan_to_num(nan=torch.inf).argmax())
        findings.note(
            DIAGNOSTICS, off[worst], _known(errors), f"{name} {true[worst]:.6g}, reported {reported[worst]:.6g}"
        )
    sums = torch.tensor(told.row_sum_residual, dtype=torch.float64)
    _check_residual(findings, DIAGNOSTICS, errors, sums, operator.factor.dtype)


def _known(errors: Tensor) -> float:
    """Accuracy required of reported eigenvalues: the largest may be reported as 1 if row sums are off by less."""
    return max(1e-3, float(errors.max()))


def _check_certificate(
    findings: Findings, operator: NonlocalOperator, errors: Tensor, least: Tensor, most: Tensor
) -> None:
    """Check :meth:`NonlocalOperator.certify`: its bounds hold, and the upper one is close to the true value."""
    told = operator.certify()
    findings.note(DIAGNOSTICS, max(told.symmetry), ROUNDING[operator.factor.dtype], "certified symmetry")
    sums = torch.tensor(told.row_sums, dtype=torch.float64)
    _check_residual(findings, DIAGNOSTICS, errors, sums, operator.factor.dtype)
    low, high = (
        torch.tensor(getattr(told, f"{name}_eigenvalue"), dtype=torch.float64) for name in ("smallest", "largest")
    )
    detail = f"certified eigenvalues {low.min():.6g} to {high.max():.6g}, true {least.min():.6g} to {most.max():.6g}"
    findings.note(DIAGNOSTICS, (low - least).max(), 1e-4, detail)
    findings.note(DIAGNOSTICS, ((high - most).abs() / most.clamp(min=1.0)).max(), _known(errors), detail)
