"""The library's promises, each a measured value with a limit; shared by the fuzzer and the tests."""

import re
import traceback
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

import nlfilter_torch
from benchmarks.fuzz.cases import Case
from benchmarks.fuzz.truth import DENSE, Exact
from nlfilter_torch import NonlocalOperator, detail_layers, nonlocal_operator, polynomial_filter
from nlfilter_torch.core.kernels import definitions_only

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
PROMISES = (
    FINITE, RESIDUAL, ROW_SUMS, EIGENVALUES, REPORTED, ORTHONORMAL, DIAGNOSTICS, PRODUCTS, IDENTITY, REFUSED, ERRORS,
    WARNINGS,
)  # fmt: skip

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
