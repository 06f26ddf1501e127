"""What small tensors cost: ``python -m benchmarks.launches [calls] [times] [--base CHECKOUT] [--quick]``.

Calls are operations of torch without views and allocations; each launches a kernel on an accelerator. With the kernels
in C they are those that a dispatch mode sees, with the definitions alone the leaves of a profile. Times of the library
and of what it is compared with take turns.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from kornia.filters import guided_blur
from torch import Tensor
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.gpu import picture
from benchmarks.harness import Figure, options, report
from benchmarks.speed import peers
from benchmarks.speed.cases import Case
from benchmarks.speed.floor import floor_calls, floor_summary
from benchmarks.speed.timing import compare, discard, take_turns
from nlfilter_torch import NonlocalFilter, nonlocal_operator
from nlfilter_torch.core.kernels import definitions_only

VIEWS = {"as_strided", "view", "_reshape_alias", "alias", "detach", "lift_fresh"}
VIEWS |= {"to", "result_type", "resolve_conj", "resolve_neg"}  # which do nothing here
ROUNDS, PARTS = 15, 8  # of calls in two checkouts, and of calls in a round
STEP = """
import sys, time, torch
from nlfilter_torch import NonlocalFilter
torch.set_num_threads(1)
layer, image = NonlocalFilter(), torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0)).requires_grad_()
for line in sys.stdin:
    start = time.perf_counter()
    for _ in range(int(line)):
        layer(image).square().mean().backward()
    print(time.perf_counter() - start, flush=True)
"""


class _Calls(TorchDispatchMode):
    """Counts operations that compute something."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        views = (result.alias_info for result in func._schema.returns)
        self.count += not any(alias and not alias.is_write for alias in views) and "empty" not in func.name()
        return func(*args, **(kwargs or {}))


def calls(call: Callable[[], object]) -> int:
    """Number of operations that a dispatch mode sees in the second of two calls."""
    call()
    with _Calls() as seen:
        call()
    return seen.count


def leaves(call: Callable[[], object]) -> int:
    """Number of operations in a call with the definitions in place of the kernels: the leaves of a profile."""
    with definitions_only():
        call()
        with profile(activities=[ProfilerActivity.CPU]) as seen:
            call()
    names = [event.name.removeprefix("aten::") for event in seen.events() if not event.cpu_children]
    return sum(name not in VIEWS and "empty" not in name and "resize" not in name for name in names)


def step(layer: Callable[[Tensor], Tensor], image: Tensor) -> None:
    """A forward and a backward pass."""
    layer(image.detach().requires_grad_()).square().mean().backward()


def counted(quick: bool) -> Iterator[Figure]:
    """Calls of an operator, and of an operator with a filter and the backward pass."""
    small, large = (picture(side, side, "cpu")[:, :1] for side in (32 if quick else 128, 64 if quick else 1024))
    layer, colours = NonlocalFilter(), picture(*small.shape[2:], "cpu")
    for image in (small, large):
        name = f"calls of an operator, {image.shape[2]}x{image.shape[3]}"
        yield Figure(name, calls(discard(nonlocal_operator, image)), 250)
    yield Figure("calls of operator, filter and backward", calls(partial(step, layer, colours)), 500)
    yield Figure("calls with definitions only: operator", leaves(discard(nonlocal_operator, small)), 600)
    yield Figure("calls with definitions only: operator, filter, backward", leaves(partial(step, layer, colours)), 1200)


def against(base: Path) -> float:
    """Time of a small step in this checkout relative to that in another one, as the median of alternating rounds."""
    folders = (Path(__file__).parents[1], base)
    commands = [sys.executable, "-c", STEP]
    workers = [
        subprocess.Popen(
            commands, cwd=path, env={**os.environ, "PYTHONPATH": str(path)}, text=True, stdin=-1, stdout=-1
        )
        for path in folders
    ]
    ratios = []
    for _ in range(ROUNDS + 1):
        taken = []
        for worker in workers:
            assert worker.stdin is not None  # for mypy
            assert worker.stdout is not None
            print(PARTS, file=worker.stdin, flush=True)
            taken.append(float(worker.stdout.readline()))
        ratios.append(taken[0] / taken[1])
    for worker in workers:
        worker.communicate()
    return median(ratios[1:])  # the first round imports


def timed(quick: bool, base: Path | None) -> Iterator[Figure]:
    """Times in floors, and beside other calls."""
    turns: dict[str, Any] = {"seconds": 0.1 if quick else 4.0, "least": 1 if quick else 7}
    if base is not None:
        yield Figure("1x3x32x32 forward and backward / that of the other checkout", against(base), 0.35)
    side = 32 if quick else 128
    for threads, limit in ((1, 1.0), (2, 1.3)):
        case = Case(height=side, width=side, threads=threads)
        every = {"operator": discard(case.operator, case.image()), **floor_calls(case)}
        seen = take_turns(every, threads=threads, **turns)
        value = seen["operator"].median / floor_summary(seen)["seconds"]
        yield Figure(f"operator of {side}x{side} in floors, {threads} threads", value, limit)

    def ratio(name: str, limit: float, first: Callable[[], object], second: Callable[[], object]) -> Figure:
        both = {"first": first, "second": second}
        found = compare(both, threads=torch.get_num_threads(), **turns)[1]
        return Figure(name, found.median, limit, quartiles=(found.lower, found.upper))

    one, crops = Case(height=4 * side, width=4 * side), Case(height=side, width=side, batch=16)
    operators = [discard(case.operator, case.image()) for case in (one, crops)]
    yield ratio(f"16 crops of {side}x{side} / one picture of as many pixels", 1.2, *operators)
    layer, batch = NonlocalFilter(), picture(side, side, "cpu", 8)

    def guided(image: Tensor) -> Tensor:
        return guided_blur(image, image, (11, 11), 0.01)

    name = f"NonlocalFilter, 8x3x{side}x{side} / kornia's guided filter"
    yield ratio(f"{name}, forward", 1.5, discard(guided, batch), discard(layer, batch))
    yield ratio(f"{name}, with backward", 1.0, partial(step, guided, batch), partial(step, layer, batch))
    case = Case(height=64, width=64) if quick else Case()
    every = {"operator": discard(case.operator, case.image()), "opencv": peers.opencv_nlm(case), **floor_calls(case)}
    seen = take_turns(every, threads=case.used_threads, **turns)
    name = f"operator of {case.height}x{case.width}, {case.used_threads} threads"
    yield Figure(f"{name}, in floors", seen["operator"].median / floor_summary(seen)["seconds"], 0.3)
    yield Figure(f"{name} / OpenCV's nonlocal means", seen["operator"].median / seen["opencv"].median, 0.7)


def main(arguments: list[str] | None = None) -> int:
    """Print the figures."""
    parser = options("launches", __doc__, "small sizes")
    parser.add_argument("topics", nargs="*", default=["calls", "times"], help="calls, times (default: both)")
    parser.add_argument("--base", type=Path, help="another checkout, against which a small step is timed")
    chosen = parser.parse_args(arguments)
    short = report(counted(chosen.quick), quick=chosen.quick) if "calls" in chosen.topics else 0
    return short | (report(timed(chosen.quick, chosen.base), quick=chosen.quick) if "times" in chosen.topics else 0)


if __name__ == "__main__":
    sys.exit(main())
