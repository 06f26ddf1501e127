"""The operators of ``torch.ops.nlfilter`` meet torch's requirements, with and without the kernels in C."""

import ctypes
import re
from contextlib import nullcontext
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from nlfilter_torch import nonlocal_operator
from nlfilter_torch.core.kernels import clusters, columns, convolution, definitions_only, lattice, library, stencil  # noqa: F401, register
from nlfilter_torch.core.kernels.clusters import TRIALS, lloyd, pivots  # noqa: F401, registers both
from nlfilter_torch.core.kernels.tall_skinny import moment, spread, sum_grams
from nlfilter_torch.operator import build, scaling  # noqa: F401, registers two
from nlfilter_torch.operator.nystrom import inverse_cholesky, nystrom_factor
from nlfilter_torch.operator.scaling import KernelMatrix
from tests import reference
from tests.native import by_torch, needs_kernels, random

BATCH, SIZE, LANDMARKS, PIXELS, ROWS = 2, 4, 5, 33, 3
DERIVED = ("spread", "moment", "invert", "convolve", "interpolate", "solve")


def arguments(dtype: torch.dtype) -> dict[str, tuple[Any, ...]]:
    """Arguments of every operator, by name."""
    features, landmarks = random(BATCH, SIZE, PIXELS).to(dtype), random(BATCH, SIZE, LANDMARKS, seed=1).to(dtype)
    inputs = (features, landmarks, inverse_cholesky(landmarks))
    factor, norms = columns.columns(*inputs, limited=True)
    vector, rows = random(BATCH, LANDMARKS, seed=2).to(dtype), random(BATCH, ROWS, LANDMARKS, seed=3).to(dtype)
    images = random(BATCH, ROWS, PIXELS, seed=4).to(dtype)
    weights = images[:, 0].exp()
    images16, weight = random(BATCH, 16, 7, 9, seed=5).to(dtype), random(5, 16, 3, 3, seed=6).to(dtype)
    coefficients = random(1, 3, 3, 2, 3, seed=9).to(dtype)
    coefficients[:, 1, 1] = coefficients.abs().sum((1, 2))
    backward = (*inputs, True, factor, norms.clamp(min=1.0).rsqrt())
    return {
        "columns": (*inputs, True),
        "columns_backward": (*backward, [rows.mT.contiguous(), images], weights),
        "spread": (rows, factor, weights),
        "moment": (factor, images),
        "sweep": (factor, weights, vector, 2.0, weights),
        "weigh": (factor, weights, vector),
        "balance_kernel": (factor, (1 - norms).clamp(min=0.0), weights, 1e-5),
        "conjugate": (
            factor,
            weights,
            vector.double().unsqueeze(2),
            inverse_cholesky(landmarks).double() @ inverse_cholesky(landmarks).double().mT,
        ),
        "grams": (factor, weights, weights, 2),
        "pivots": (features, torch.linspace(0.1, 0.9, TRIALS * LANDMARKS, dtype=dtype).view(-1, TRIALS), 1e-4),
        "lloyd": (features, landmarks, 3, 1e-6),
        "invert": (factor @ factor.mT + torch.eye(LANDMARKS, dtype=dtype),),
        "choose": (features, [1, PIXELS], LANDMARKS, "kmeans", 2, False),
        "without": (factor, norms > norms.median()),
        "convolve": (images16, weight, random(5, seed=7).to(dtype), 2, random(BATCH, 5, 7, 9, seed=8).to(dtype)),
        "interpolate": (images.sigmoid(), random(BATCH, 3, 4, 4, 4, seed=11).to(dtype)),
        "solve": (coefficients, random(1, 2, 2, 3, seed=10).to(dtype)),
        "sinkhorn": (factor, (1 - norms).clamp(min=0.0), 1e-5, True, False),
    }


NAMES = sorted(arguments(torch.float32))


def test_every_operator_is_checked() -> None:
    registered = {
        name.split("::")[1] for name in torch._C._dispatch_get_all_op_names() if name.startswith("nlfilter::")
    }
    assert registered == set(NAMES)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")
@pytest.mark.parametrize("in_c", [True, False], ids=["C", "torch"])
@pytest.mark.parametrize("name", NAMES)
def test_opcheck(name: str, in_c: bool) -> None:
    # The kernels in C are for float32, except the solver, which works in float64 alone.
    dtype = torch.float32 if in_c and name != "solve" else torch.float64
    operator, inputs = getattr(torch.ops.nlfilter, name).default, arguments(dtype)[name]
    with nullcontext() if in_c else definitions_only():
        torch.library.opcheck(operator, inputs)
        if name in DERIVED:
            torch.library.opcheck(
                operator, tuple(t.clone().requires_grad_() if isinstance(t, Tensor) else t for t in inputs)
            )


def test_accelerators_have_the_definitions() -> None:
    for name in NAMES:
        assert torch._C._dispatch_has_computed_kernel_for_dispatch_key(f"nlfilter::{name}", "CUDA")


def swept(factor: Tensor, diagonal: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    return KernelMatrix(factor, diagonal).sweep(total)


@pytest.fixture(params=[False, True], ids=["threads of torch", "threads of its own"])
def own_threads(request: pytest.FixtureRequest):
    openmp = library._openmp()
    assert openmp is not None, "torch's OpenMP library was not found"
    library.share_threads(library._library, None if request.param else openmp)
    yield
    library.share_threads(library._library, openmp)


class Exhausted:
    """A library whose kernels cannot allocate memory."""

    def __getattr__(self, name: str) -> Any:
        return lambda *_: -1


def test_denormal_numbers_are_zero_in_kernels_only(level: int, threads: Any) -> None:
    threads(2)
    tiny, scaling = torch.full((1, 2, 200_000), 1e-39), torch.full((1, 200_000), 1e30)
    assert (sum_grams(tiny, scaling, None, 1) == 0).all()
    assert (sum_grams(100 * tiny, scaling, None, 1) > 0).all()
    assert (0.5 * tiny > 0).all()  # on both threads


def test_tensors_of_any_layout(level: int) -> None:
    factor, vectors, images = random(1, 300, 6).mT, random(1, 6, 3).mT, random(1, 300, 3).mT
    torch.testing.assert_close(spread(vectors, factor), vectors @ factor)
    torch.testing.assert_close(moment(factor, images), factor.double() @ images.double().mT, atol=1e-4, rtol=0)
    torch.testing.assert_close(spread(vectors, factor[..., 5:205:2]), vectors @ factor[..., 5:205:2])
    z, x, diagonal = random(1, 7, 4).mT, random(1, 300, 4).mT, random(1, 600)[:, ::2].sigmoid()
    arguments = (x, z, inverse_cholesky(z), "diagonal")
    torch.testing.assert_close(nystrom_factor(*arguments), by_torch(nystrom_factor, *arguments))
    arguments = (factor.sigmoid(), diagonal, random(1, 6, 2).double()[..., :1] ** 2)
    result, expected = swept(*arguments), by_torch(swept, *arguments)
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=0)


@pytest.mark.usefixtures("own_threads")
@pytest.mark.parametrize("count", [2, 3, 7])
def test_any_number_of_threads(level: int, count: int, threads: Any) -> None:
    guide = random(1, 1, 150, 131).sigmoid()
    features = random(1, 4, 60_000)
    marks = features[:, :, ::1000]

    def results() -> list[Tensor]:
        factor, diagonal = nystrom_factor(features, marks, inverse_cholesky(marks), "diagonal")
        scaling, result = swept(factor, diagonal, factor.double().sum(2, keepdim=True))
        return [factor, scaling, result, sum_grams(factor, scaling, diagonal, 2)]

    threads(1)
    alone, operator = results(), nonlocal_operator(guide, num_landmarks=30)
    threads(count)
    for expected, many, again in zip(alone, results(), results(), strict=True):
        torch.testing.assert_close(expected, many, rtol=1e-5, atol=1e-6)  # sums are divided differently
        assert torch.equal(many, again)
    torch.testing.assert_close(nonlocal_operator(guide, num_landmarks=30).scaling, operator.scaling)


def test_an_operator_is_that_of_the_dense_reference(level: int) -> None:
    image = random(1, 1, 24, 31).sigmoid()
    operator = nonlocal_operator(image, photometric_bandwidth=0.4, num_landmarks=24 * 31, completion="diagonal")
    exact = torch.from_numpy(reference.filter_matrix(image[0, 0].double().numpy(), 5, 0.4))
    torch.testing.assert_close(operator.to_dense()[0].double(), exact, atol=2e-5, rtol=0)


@needs_kernels
def test_without_memory_for_its_buffers_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "_library", Exhausted())
    x = random(1, 2, 9)
    with pytest.raises(MemoryError, match="use a smaller image"):
        nystrom_factor(x, x[:, :, :3], inverse_cholesky(x[:, :, :3]), "diagonal")


@needs_kernels
@pytest.mark.filterwarnings("ignore:.torch.jit.script")  # torch's own forward derivatives
def test_which_tensors_the_dispatcher_sends_to_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "_library", Exhausted())
    rows, factor = random(1, 2, 3), random(1, 3, 8)

    def in_c(rows: Tensor, factor: Tensor) -> bool:
        try:
            result = spread(rows, factor)
        except MemoryError:
            return True
        torch.testing.assert_close(result, rows @ factor)
        return False

    leaf = rows.clone().requires_grad_()
    assert in_c(rows, factor)
    assert in_c(rows.mT.contiguous().mT, torch.nn.Parameter(factor).detach())
    assert in_c(torch.imag(torch.complex(rows, rows).conj()), factor)
    assert not in_c(rows.double(), factor.double())
    assert not in_c(random(2, 2, 3), random(2, 3, 0))
    assert not in_c(leaf, factor)
    with torch.no_grad():
        assert in_c(leaf, factor)
    with torch.inference_mode():
        assert in_c(rows, factor)
    with definitions_only():
        assert not in_c(rows, factor)
    assert in_c(rows, factor)
    assert spread(rows.to("meta"), factor.to("meta")).is_meta
    mapped = torch.vmap(lambda part: spread(part, factor))(rows.expand(4, 1, 2, 3))
    torch.testing.assert_close(mapped, (rows @ factor).expand(4, 1, 2, 8))
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(rows, rows)
        tangent = torch.autograd.forward_ad.unpack_dual(spread(dual, factor)).tangent
        torch.testing.assert_close(tangent, rows @ factor)


@needs_kernels
def test_negated_views_are_resolved() -> None:
    rows, factor = random(1, 2, 3), random(1, 3, 8)
    negated = torch.imag(torch.complex(rows, rows).conj())
    assert negated.is_neg()
    torch.testing.assert_close(spread(negated, factor), -rows @ factor)


def parameters_of(prototype: str) -> list[object]:
    """Types of ctypes for the parameters in a prototype of C."""
    types = {"int": ctypes.c_int, "long": ctypes.c_long, "float": ctypes.c_float, "double": ctypes.c_double}
    parts = [part.strip().removeprefix("const ") for part in prototype.split(",")]
    return [ctypes.c_void_p if "*" in part else types[part.split()[0]] for part in parts]


@needs_kernels
def test_ctypes_converts_to_the_types_that_the_header_declares() -> None:
    header = Path(library.__file__).with_name("interface.h").read_text(encoding="utf-8")
    prototypes = dict(re.findall(r"^int (nlfilter_\w+)\(([^)]*)\);", header, flags=re.MULTILINE))
    assert prototypes.pop("nlfilter_level") == "void"
    assert len(prototypes) == 13
    for name, prototype in prototypes.items():
        assert getattr(library._library, name).argtypes == parameters_of(" ".join(prototype.split())), name
        assert getattr(library._library, name).restype is ctypes.c_int


def test_constants_in_c_are_those_of_the_definitions() -> None:
    header = Path(library.__file__).with_name("interface.h").read_text(encoding="utf-8")
    found = re.findall(r"^#define (\w+) ([-.e\d]+)f?", header, flags=re.MULTILINE)
    assert len(found) == 14
    for name, value in found:
        assert float(value) == getattr(clusters if hasattr(clusters, name) else scaling, name), name


@needs_kernels
def test_a_library_of_an_earlier_version_says_what_to_do() -> None:
    before = library._library
    with pytest.raises(ImportError, match="one without nlfilter_share_threads; install the package again"):
        library.use(cast(ctypes.CDLL, SimpleNamespace()), 1)
    assert library._library is before


@needs_kernels
def test_threads_that_overlap_use_the_kernels_again_when_the_last_has_left() -> None:
    """One thread may turn the kernels off while another is on its way into one: the instruction set stays."""
    entered, leave = Event(), Event()

    def work() -> None:
        with definitions_only():
            entered.set()
            assert leave.wait(10)

    calls = []

    class Counting:
        def __getattr__(self, name: str) -> object:
            calls.append(name)
            return getattr(compiled, name)

    compiled, level = library._library, library.level
    thread = Thread(target=work)
    library._library = Counting()
    try:
        with definitions_only():
            thread.start()
            assert entered.wait(10)
        spread(random(1, 1, 5), random(1, 5, 64))
        assert not calls
        assert library.level == level
        leave.set()
        thread.join(10)
        spread(random(1, 1, 5), random(1, 5, 64))
        assert calls == ["nlfilter_spread"]
    finally:
        library._library = compiled
