"""What a training step takes in time and memory, compared with plain autograd: ``python -m benchmarks.gradients``.

The gradient of a weighted sum of the filtered image with respect to guide, alpha and bandwidth, on one grey picture in
float32. The comparison is with :mod:`tests.plain_autograd`, the same filter in plain tensor operations, differentiated
through 14 steps of balancing. Each method runs in its own process, so that memory is measured separately; peaks are the
kernel's high-water mark minus the resident memory before the first step (Linux only).
"""

import argparse
import json
import statistics
import sys
import time

import torch
from torch import Tensor

from benchmarks.harness import MIB, Figure, forget_peak, in_fresh_process, options, report, resident, row
from benchmarks.photographs import retina
from nlfilter_torch import nonlocal_operator, polynomial_filter
from tests.plain_autograd import plain_filter

BANDWIDTH = 20 / 255
ALPHA = (3.0, 3.0, 4.0, 1.05)
MOST_BACKWARD = 2.5  # times the forward's time
MOST_MEMORY = 4.0  # times the factor
LEAST_SPEEDUP, MOST_SHARE = 3.0, 1 / 3  # against plain autograd


def library(guide: Tensor, bandwidth: Tensor, alpha: Tensor, landmarks: int) -> Tensor:
    """The filter of this package."""
    operator = nonlocal_operator(guide, photometric_bandwidth=bandwidth, num_landmarks=landmarks)
    return polynomial_filter(operator, guide, alpha)


def plain(guide: Tensor, bandwidth: Tensor, alpha: Tensor, landmarks: int) -> Tensor:
    """The same filter with plain autograd."""
    return plain_filter(guide, guide, alpha, photometric_bandwidth=bandwidth, num_landmarks=landmarks)


METHODS = {"library": library, "plain": plain}


def measure(method: str, side: int, landmarks: int, repeats: int) -> dict[str, float | list[float]]:
    """Measure peak memory of the first step in MiB, and times of the following steps in seconds."""
    guide = retina(side).requires_grad_()
    leaves = (guide, torch.tensor(BANDWIDTH, requires_grad=True), torch.tensor(ALPHA, requires_grad=True))
    weights = torch.randn(guide.shape, generator=torch.Generator().manual_seed(0))
    small = retina(64).requires_grad_()  # starts threads and lazy imports before measuring
    (METHODS[method](small, leaves[1], leaves[2], 10) * weights[..., :64, :64]).sum().backward()

    before = forget_peak()
    forward, backward, peak = [], [], 0.0
    for step in range(1 + repeats):
        for leaf in leaves:
            leaf.grad = None
        start = time.perf_counter()
        loss = (METHODS[method](*leaves, landmarks) * weights).sum()
        middle = time.perf_counter()
        loss.backward()
        end = time.perf_counter()
        if step == 0:
            peak = resident("VmHWM") - before
        else:
            forward.append(middle - start)
            backward.append(end - middle)
    return {"forward": forward, "backward": backward, "peak": peak}


def figures(method: str, *arguments: int) -> dict[str, float]:
    """Measure one method in a fresh process; median times and peak memory."""
    record = in_fresh_process("gradients", "--child", method, *arguments)
    ratios = [b / f for f, b in zip(record["forward"], record["backward"], strict=True)]
    medians = {name: statistics.median(record[name]) for name in ("forward", "backward")}
    return medians | {"ratio": statistics.median(ratios), "peak": record["peak"]}


def main() -> int:
    """Print the table and the claims; return 1 if one falls short."""
    parser = options("gradients", __doc__, "a small picture")
    parser.add_argument("--side", type=int, default=512, help="height and width of the picture")
    parser.add_argument("--landmarks", type=int, default=100, help="number of landmarks m")
    parser.add_argument("--repeats", type=int, default=9, help="timed steps after the first")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.quick:
        chosen.side, chosen.repeats = 96, 2
    if chosen.child:
        print(json.dumps(measure(chosen.child[0], *map(int, chosen.child[1:]))))
        return 0
    factor = chosen.side**2 * chosen.landmarks * 4 / MIB
    rows = {method: figures(method, chosen.side, chosen.landmarks, chosen.repeats) for method in METHODS}
    print(
        f"{chosen.side}x{chosen.side} grey, m = {chosen.landmarks}, k = {len(ALPHA) - 1}, float32, "
        f"{torch.get_num_threads()} threads, torch {torch.__version__}, median of {chosen.repeats} steps; "
        f"factor {factor:.0f} MiB"
    )
    print(row("", ["forward s", "backward s", "ratio", "peak MiB", "of factor"], 11, 10))
    for method, told in rows.items():
        cells = [f"{told['forward']:.3f}", f"{told['backward']:.3f}", f"{told['ratio']:.2f}", f"{told['peak']:.0f}"]
        print(row(method, [*cells, f"{told['peak'] / factor:.2f}"], 11, 10))
    ours, plain = rows["library"], rows["plain"]
    speedup = (plain["forward"] + plain["backward"]) / (ours["forward"] + ours["backward"])
    claims = (
        Figure("backward / forward", ours["ratio"], MOST_BACKWARD),
        Figure("peak / factor", ours["peak"] / factor, MOST_MEMORY),
        Figure("times faster than plain autograd", speedup, LEAST_SPEEDUP, at_most=False),
        Figure("memory / that of plain autograd", ours["peak"] / plain["peak"], MOST_SHARE),
    )
    return report(claims, quick=chosen.quick)


if __name__ == "__main__":
    sys.exit(main())
