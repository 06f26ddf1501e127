"""Writes the table of transformations in docs/training.md: which derivatives are right, and which are refused.

    python -m docs.transforms docs/training.md

Every cell is measured: derivatives of small filters in float64 by ``torch.func`` and ``torch.autograd.functional``,
compared with rows of ``torch.autograd.grad``. Without a file the table is printed.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
import torch.autograd.functional as functional
from torch import Tensor, func

import nlfilter_torch as nf
from docs.pages import print_or_replace

HEAD = "| derivative in | "
BOTH = "alpha, `NonlocalFilter` that learns a bandwidth"
EQUAL = {BOTH: "alpha, `NonlocalFilter` with a fixed guide"}  # the same derivatives, for comparison
COMPARED = 6  # outputs whose derivatives are compared
CLOSE, TOLERANCE = 1e-7, 1e-5  # largest relative differences, where f(W) is exact and where it has a tolerance
BY_TOLERANCE = ("exponent, `spectral_filter` with an operator", "image, `spectral_filter` with an operator")
REFUSALS = ("must not be transformed", "must have no forward-mode", "must not be differentiated twice")
Filter = Callable[[Tensor], Tensor]
Transform = Callable[[Filter, Tensor], Tensor]


def noise(*shape: int, seed: int) -> Tensor:
    """Random values in [0, 1] in float64."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


GUIDE, IMAGE = noise(1, 1, 6, 7, seed=0), noise(1, 2, 6, 7, seed=1)
ALPHA = torch.tensor([2.0, 1.5, 1.2, 1.0], dtype=torch.float64)
NUMBER = torch.tensor([0.4], dtype=torch.float64)
OPERATOR = nf.nonlocal_operator(GUIDE, num_landmarks=7, photometric_bandwidth=0.3)
SPECTRUM = OPERATOR.spectrum()
REGION = torch.zeros_like(GUIDE).index_fill(3, torch.tensor([2, 3]), 1.0)
WEIGHTED = nf.nonlocal_operator(GUIDE, num_landmarks=7, photometric_bandwidth=0.3, weights=0.5 + GUIDE)
FEATURES = noise(1, 3, 6, 7, seed=4)
FIXED, LEARNED = (
    nf.NonlocalFilter(
        ALPHA.tolist(), residual=0.7, num_landmarks=7, photometric_bandwidth=0.3, learn=("alpha", "residual", *more)
    ).double()
    for more in ((), ("photometric_bandwidth",))
)

with torch.random.fork_rng(devices=[]):  # the block draws its weights from the global generator
    torch.manual_seed(0)
    BLOCK = nf.NonlocalBlock(3, num_landmarks=7, norm="none").double()
    for weight in BLOCK.output.parameters():
        torch.nn.init.normal_(weight)


def called(name: str, value: Tensor, layer: nf.NonlocalFilter = FIXED) -> Tensor:
    """A layer with a fixed guide and this value of a parameter."""
    result: Tensor = func.functional_call(layer, {name: value}, (IMAGE, GUIDE))
    return result


def rebuilt(**arguments: Tensor) -> Tensor:
    """Filter with an operator that is built in the call."""
    options = {"num_landmarks": 7, "photometric_bandwidth": 0.3, "guide": GUIDE} | arguments
    return nf.nonlocal_operator(**options) @ IMAGE  # type: ignore[arg-type]


def in_block(name: str, value: Tensor) -> Tensor:
    """The block with this value of a parameter."""
    result: Tensor = func.functional_call(BLOCK, {name: value}, (FEATURES,))
    return result


FILTERS: dict[str, tuple[Filter, Tensor]] = {
    "alpha, `polynomial_filter`": (lambda a: nf.polynomial_filter(OPERATOR, IMAGE, a), ALPHA),
    "residual, `polynomial_filter`": (lambda r: nf.polynomial_filter(OPERATOR, IMAGE, ALPHA, residual=r), NUMBER),
    "alpha, `NonlocalFilter` with a fixed guide": (lambda a: called("sliders.alpha", a), ALPHA),
    "residual, `NonlocalFilter` with a fixed guide": (lambda r: called("sliders.residual", r), NUMBER),
    BOTH: (lambda a: called("sliders.alpha", a, LEARNED), ALPHA),
    "image": (lambda y: FIXED(y, GUIDE), IMAGE),
    "parameters of a response, `spectral_filter`": (
        lambda p: nf.spectral_filter(SPECTRUM, IMAGE, lambda s: s**p),
        NUMBER,
    ),
    "time, `diffusion_mask`": (lambda t: nf.diffusion_mask(SPECTRUM, REGION, time=t), NUMBER),
    "strokes, `propagate_strokes`": (lambda s: nf.propagate_strokes(SPECTRUM, s, REGION), IMAGE),
    "target, `fit_alpha`": (lambda y: nf.fit_alpha(OPERATOR, IMAGE, y, rounding=0.0), IMAGE),
    "guide": (lambda y: rebuilt(guide=y), GUIDE),
    "bandwidth": (lambda h: rebuilt(photometric_bandwidth=h), NUMBER),
    "bandwidth of `NonlocalFilter`": (lambda h: called("affinity.log_photometric_bandwidth", h, LEARNED), NUMBER.log()),
    "guide, eigenvalues": (
        lambda y: nf.nonlocal_operator(y, num_landmarks=7, photometric_bandwidth=0.3).spectrum().eigenvalues,
        GUIDE,
    ),
    "image, operator with `weights`": (lambda y: nf.polynomial_filter(WEIGHTED, y, ALPHA), IMAGE),
    "guide, with `weights`": (lambda y: rebuilt(guide=y, weights=0.5 + GUIDE), GUIDE),
    "exponent, `spectral_filter` with an operator": (
        lambda p: nf.spectral_filter(OPERATOR, IMAGE, lambda s: (-p * s).exp()),
        NUMBER,
    ),
    "image, `spectral_filter` with an operator": (
        lambda y: nf.spectral_filter(OPERATOR, y, lambda s: (-0.4 * s).exp()),
        IMAGE,
    ),
    "logits, `refine` with an operator": (lambda q: nf.refine(q, OPERATOR), IMAGE),
    "features, `NonlocalBlock`": (BLOCK, FEATURES),
    "output weights, `NonlocalBlock`": (lambda w: in_block("output.weight", w), BLOCK.output.weight.detach()),
    "features, `operator.at`": (lambda x: OPERATOR.at(x).scaling, 2 * noise(1, 25, 5, seed=3)),
}


def squares(function: Filter) -> Filter:
    """The sum of the squares of a filter's outputs."""
    return lambda value: function(value).square().sum()


def tracked(value: Tensor) -> Tensor:
    """A copy that requires a gradient."""
    return value.clone().requires_grad_()


def rows(function: Filter, value: Tensor) -> Tensor:
    """Jacobian of the first outputs, row by row."""
    value = tracked(value)
    outputs = function(value).flatten()[:COMPARED]
    return torch.stack([torch.autograd.grad(output, value, retain_graph=True)[0] for output in outputs])


def gradient(function: Filter, value: Tensor) -> Tensor:
    """Gradient of the sum of squares."""
    value = tracked(value)
    return torch.autograd.grad(squares(function)(value), value)[0]


def along(function: Filter, value: Tensor) -> Tensor:
    """Derivative of the first outputs along ones."""
    return rows(function, value).flatten(1).sum(1)


def curvature(function: Filter, value: Tensor) -> Tensor:
    """Hessian of the sum of squares, by two passes of ``torch.autograd.grad``."""
    value = tracked(value)
    first = torch.autograd.grad(squares(function)(value), value, create_graph=True)[0].flatten()
    columns = [torch.autograd.grad(entry, value, retain_graph=True)[0].flatten() for entry in first]
    return torch.stack(columns)


def batch(value: Tensor) -> Tensor:
    """Three values."""
    return torch.stack([value, 0.9 * value, 0.8 * value])


def repeated(compute: Transform) -> Transform:
    """Compute a result for every one of three values."""
    return lambda function, value: torch.stack([compute(function, entry) for entry in batch(value)])


def head(jacobian: Tensor, value: Tensor) -> Tensor:
    """Rows of the first outputs of a Jacobian."""
    return jacobian.reshape(-1, *value.shape)[:COMPARED]


def pullback(function: Filter, value: Tensor) -> Tensor:
    """Gradient by ``torch.func.vjp``."""
    output, backward = func.vjp(function, value)
    result: Tensor = backward(2 * output)[0]
    return result


def batched(function: Filter, value: Tensor) -> Tensor:
    """Rows of the Jacobian in one batched backward pass."""
    value = tracked(value)
    outputs = function(value).flatten()[:COMPARED]
    return torch.autograd.grad(outputs, value, torch.eye(len(outputs), dtype=outputs.dtype), is_grads_batched=True)[0]


@dataclass(frozen=True)
class Column:
    """Transforms with one cell: each with the computation whose result it must equal."""

    title: str
    pairs: tuple[tuple[Transform, Transform], ...]


def _functional_hessian(vectorize: bool) -> Transform:
    return lambda f, x: functional.hessian(squares(f), x, vectorize=vectorize).reshape(x.numel(), -1)  # type: ignore[no-untyped-call]


def _functional_jacobian(vectorize: bool, strategy: str = "reverse-mode") -> Transform:
    return lambda f, x: head(functional.jacobian(f, x, vectorize=vectorize, strategy=strategy), x)  # type: ignore[no-untyped-call]


COLUMNS = (
    Column(
        "`grad`, `vjp`, `jacrev`",
        (
            (lambda f, x: func.grad(squares(f))(x), gradient),
            (pullback, gradient),
            (lambda f, x: head(func.jacrev(f)(x), x), rows),
        ),
    ),
    Column(
        "`jvp`, `jacfwd`",
        (
            (lambda f, x: func.jvp(f, (x,), (torch.ones_like(x),))[1].flatten()[:COMPARED], along),
            (lambda f, x: head(func.jacfwd(f)(x), x), rows),
        ),
    ),
    Column("`hessian`", ((lambda f, x: func.hessian(squares(f))(x).reshape(x.numel(), -1), curvature),)),
    Column(
        "`vmap`, `vmap(grad)`",
        (
            (lambda f, x: func.vmap(f)(batch(x)), repeated(lambda f, x: f(x).detach())),
            (lambda f, x: func.vmap(func.grad(squares(f)))(batch(x)), repeated(gradient)),
        ),
    ),
    Column(
        "`functional`: `jacobian`, `vjp`; `is_grads_batched`",
        (
            (_functional_jacobian(False), rows),
            (_functional_jacobian(True), rows),
            (lambda f, x: functional.vjp(squares(f), x)[1], gradient),  # type: ignore[no-untyped-call]
            (batched, rows),
        ),
    ),
    Column(
        "`functional`: `jvp`, forward mode",
        (
            (lambda f, x: functional.jvp(f, x, torch.ones_like(x))[1].flatten()[:COMPARED], along),  # type: ignore[no-untyped-call]
            (_functional_jacobian(True, "forward-mode"), rows),
        ),
    ),
    Column(
        "`functional`: `hessian`, `hvp`, `vhp`",
        (
            (_functional_hessian(False), curvature),
            (_functional_hessian(True), curvature),
            (
                lambda f, x: functional.hvp(squares(f), x, torch.ones_like(x))[1].flatten(),  # type: ignore[no-untyped-call]
                lambda f, x: curvature(f, x).sum(1),
            ),
            (
                lambda f, x: functional.vhp(squares(f), x, torch.ones_like(x))[1].flatten(),  # type: ignore[no-untyped-call]
                lambda f, x: curvature(f, x).sum(0),
            ),
        ),
    ),
)


@cache
def reference_of(reference: Transform, name: str) -> Tensor:
    """What a transform must give, computed once for all with the same reference."""
    return reference(FILTERS[EQUAL.get(name, name)][0], FILTERS[name][1])


def measured(transform: Transform, reference: Transform, name: str) -> str:
    """``"yes"`` if a transform is right, ``"refused"`` by a sentence of this library, or what went wrong."""
    function, value = FILTERS[name]
    try:
        result = transform(function, value)
    except (RuntimeError, TypeError, ValueError, NotImplementedError) as error:
        return "refused" if any(words in str(error) for words in REFUSALS) else f"error: {error}"
    expected = reference_of(reference, name)
    scale = max(float(expected.abs().max()), 1e-3)  # layers of a constant are 0
    difference = float((result - expected).abs().max()) / scale
    limit = TOLERANCE if name in BY_TOLERANCE else CLOSE
    return "yes" if difference < limit else f"wrong by {difference:.1e}"


def cell(column: Column, name: str) -> str:
    """What holds for the transforms of a column, separated by commas where they differ."""
    return ", ".join(dict.fromkeys(measured(*pair, name) for pair in column.pairs))


def cells() -> dict[tuple[str, str], str]:
    """Every cell of the table, by what is derived and the title of the column."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {(name, column.title): cell(column, name) for name in FILTERS for column in COLUMNS}


def table() -> str:
    """The table in Markdown."""
    values = cells()
    lines = [f"{HEAD}{' | '.join(column.title for column in COLUMNS)} |", "|---" * (len(COLUMNS) + 1) + "|"]
    lines += [f"| {name} | {' | '.join(values[name, column.title] for column in COLUMNS)} |" for name in FILTERS]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the table, or replace the table in a page."""
    print_or_replace(__doc__, HEAD, table())


if __name__ == "__main__":
    main()
