"""The suites of measurements: functions from a plan to records."""

import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch

from benchmarks.speed import peers
from benchmarks.speed.cases import Case
from benchmarks.speed.comparisons import SUITE, comparisons, held_calls, power, step_call
from benchmarks.speed.plan import Plan, Record, measured, record
from benchmarks.speed.probe import ALPHA, peak_memory
from benchmarks.speed.timing import Call, Timing, after_pauses, discard, quartiles, take_turns
from nlfilter_torch import NonlocalFilter, detail_layers, estimate_bandwidth, polynomial_filter, spectral_filter
from nlfilter_torch.core.kernels import definitions_only

Suite = Callable[[Plan], Iterator[Record]]
COMPARED = 1 << 27  # bytes of the largest factor that is compared with float64; the main case always is


def filter_calls(case: Case, *, backward: bool) -> dict[str, Call]:
    """The operator, one filtering with it, and the backward pass of both."""
    image = case.image()
    operator = case.operator(image)
    alpha = torch.tensor(ALPHA, device=case.device)
    calls = {
        "operator": discard(case.operator, image),
        "apply": discard(polynomial_filter, operator, image, alpha),
    }
    return calls | ({"backward": backward_call(case)} if backward else {})


def backward_call(case: Case) -> Call:
    """Gradient of a filtered image with respect to alpha and the image, also its guide; excludes the forward pass."""
    image = case.image().requires_grad_()
    layer = NonlocalFilter(ALPHA, **case.options()).to(case.device)
    filtered = layer(image)
    incoming = torch.randn(filtered.shape, generator=torch.Generator().manual_seed(0)).to(filtered)
    return lambda: torch.autograd.grad(filtered, [image, *layer.parameters()], incoming, retain_graph=True)


def main_case(plan: Plan) -> Iterator[Record]:
    """The main operator, its sliders and the peers, taking turns on one image."""
    case = plan.case()
    image = case.image()
    operator = case.operator(image)
    spectrum = operator.spectrum()
    build = discard(case.operator, image)

    def slower() -> None:
        with definitions_only():
            build()

    calls: dict[str, Call] = {
        "operator": build,
        "operator, without the kernels in C": slower,
        "spectrum": discard(operator.spectrum),
        "detail_layers": discard(detail_layers, operator, image),
        "new alpha, operator held": discard(polynomial_filter, operator, image, torch.tensor(ALPHA)),
        "response, spectrum held": discard(spectral_filter, spectrum, image, power),
    }
    others, missing = peers.prepare_all(peers.QUICK_PEERS, case)
    yield measured(
        "main",
        case,
        calls | held_calls(operator, image) | others,
        seconds=plan.claimed_seconds,
        least=plan.least,
        error=True,
        missing=missing,
        does={peer.name: peer.does for peer in peers.QUICK_PEERS},
        steps=operator.balancing_steps,
        residual=operator.residual.max().item(),
    )


def pauses(plan: Plan) -> Iterator[Record]:
    """The main operator in a loop, and after idle seconds."""
    case = plan.case()
    call = discard(case.operator, case.image())
    timings = take_turns({"operator, in a loop": call}, threads=case.used_threads, seconds=0.0, least=plan.least)
    name = "operator, after a pause"
    timings[name] = after_pauses(name, call, threads=case.used_threads, pause=plan.pause, count=plan.least)
    yield record("pauses", case, timings)


def slow_peers(plan: Plan) -> Iterator[Record]:
    """A peer that takes many times as long, alongside the operator."""
    case = plan.case()
    others, missing = peers.prepare_all((peers.NLM_7_11,), case)
    calls = {"operator": discard(case.operator, case.image())} | others
    timings = take_turns(calls, threads=case.used_threads, seconds=0.0, least=min(2, plan.least))
    yield record("slow", case, timings, missing=missing, does={peers.NLM_7_11.name: peers.NLM_7_11.does})


def dense(plan: Plan) -> Iterator[Record]:
    """The dense filter (N x N affinities), alongside operator and product, on a small image."""
    case = plan.case(height=plan.dense_side, width=plan.dense_side)
    image = case.image()
    operator = case.operator(image)
    others, missing = peers.prepare_all((peers.DENSE,), case)
    calls = {"operator": discard(case.operator, image), "product W y": discard(operator.matmul, image)} | others
    timings = take_turns(calls, threads=case.used_threads, seconds=plan.seconds, least=min(2, plan.least))
    yield record("dense", case, timings, missing=missing, does={peers.DENSE.name: peers.DENSE.does})


def autograd(plan: Plan) -> Iterator[Record]:
    """A training step, alongside the same filter written as plain tensor operations under autograd."""
    from tests.plain_autograd import plain_filter

    case = plan.case(height=plan.counts_side, width=plan.counts_side)
    image = case.image()
    bandwidth = estimate_bandwidth(image).item()
    alpha = torch.tensor(ALPHA)

    def plain(guide: torch.Tensor) -> torch.Tensor:
        return plain_filter(
            guide,
            guide,
            alpha,
            patch_size=case.patch_size,
            photometric_bandwidth=bandwidth,
            num_landmarks=case.landmarks,
        )

    def plain_step() -> None:
        leaf = image.detach().requires_grad_()
        plain(leaf).square().mean().backward()

    calls = {
        "operator and filter": discard(NonlocalFilter(ALPHA, **case.options()), image),
        "plain operations": discard(plain, image),
        "training step": step_call(case),
        "training step, plain autograd": plain_step,
    }
    timings = take_turns(calls, threads=case.used_threads, seconds=plan.seconds, least=min(2, plan.least))
    yield record("autograd", case, timings)


def series(suite: str, cases: Callable[[Plan], Iterable[Case]]) -> Suite:
    """A suite of the operator, one filtering with it and the backward pass over cases; with the error if it is small.

    The backward pass of images above a megapixel is left out.
    """

    def measure(plan: Plan) -> Iterator[Record]:
        for case in cases(plan):
            calls = filter_calls(case, backward=case.pixels <= 1 << 20)
            error = suite != "threads" and case.factor_bytes <= COMPARED
            yield measured(suite, case, calls, seconds=plan.seconds, least=plan.least, error=error)

    return measure


def small(plan: Plan, **changes: Any) -> Case:
    """The case of the series over landmarks, or one that differs from it."""
    return plan.case(height=plan.counts_side, width=plan.counts_side, **changes)


SERIES: dict[str, Callable[[Plan], Iterable[Case]]] = {
    "sizes": lambda plan: (plan.case(height=height, width=width) for height, width in plan.sizes),
    "landmarks": lambda plan: (small(plan, landmarks=count) for count in plan.counts),
    "patches": lambda plan: (small(plan, patch_size=size) for size in plan.patches),
    "dtypes": lambda plan: (small(plan, dtype=dtype) for dtype in ("float32", "float64", "bfloat16")),
    "threads": lambda plan: (plan.case(threads=count) for count in plan.thread_counts()),
}


def pictures(plan: Plan) -> Iterator[Record]:
    """The main operator of several photographs: only the number of balancing steps depends on what they show."""
    series = [plan.case(picture=name) for name in plan.pictures]
    calls = {case.picture: discard(case.operator, case.image()) for case in series}
    timings = take_turns(calls, threads=series[0].used_threads, seconds=plan.seconds, least=plan.least)
    for case in series:
        operator = case.operator(case.image())
        facts = {"steps": operator.balancing_steps, "residual": operator.residual.max().item()}
        yield record("pictures", case, {"operator": timings[case.picture]}, **facts)


def memory(plan: Plan) -> Iterator[Record]:
    """Peak memory in fresh processes."""
    half = plan.counts_side
    cases = [
        ("operator", plan.case()),
        ("training step", plan.case(height=half, width=half)),
        ("training step", plan.case()),
        ("operator", plan.case(landmarks=2 * plan.landmarks)),
        ("operator", plan.case(height=2 * plan.side, width=2 * plan.side)),
    ]
    for work, case in cases[: plan.probes]:
        yield record("memory", case, {}, work=work, memory=peak_memory(case, work))


def imports(plan: Plan) -> Iterator[Record]:
    """Time of ``import nlfilter_torch`` after ``import torch``, in fresh processes."""
    runs = [_import_seconds() for _ in range(plan.processes + 1)][1:]  # the first reads from disk
    timings = {}
    for name, times in zip(("torch", "nlfilter_torch"), zip(*runs, strict=True), strict=True):
        low, middle, high = quartiles(times)
        timings[name] = Timing(middle, high - low, plan.processes, 1)
    yield record("imports", plan.case(), timings)


def _import_seconds() -> list[float]:
    program = (
        "from time import perf_counter as now; a = now(); import torch; b = now(); import nlfilter_torch; c = now(); "
        "print(b - a, c - b)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return [float(figure) for figure in done.stdout.split()]


SUITES: dict[str, Suite] = {
    "main": main_case,
    SUITE: comparisons,
    "pictures": pictures,
    "memory": memory,
    "pauses": pauses,
    "imports": imports,
    "slow": slow_peers,
    "dense": dense,
    "autograd": autograd,
    **{name: series(name, cases) for name, cases in SERIES.items()},
}
