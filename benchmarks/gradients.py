"""Time and memory of a training step, compared with plain autograd: ``python -m benchmarks.gradients [--quick]``.

The gradient of a weighted sum of the filtered image with respect to guide, alpha and bandwidth, on one grey picture in
float32. The comparison is with :mod:`tests.plain_autograd`, the same filter in plain tensor operations, differentiated
through 14 steps of balancing. Each method runs in its own process, so that memory is measured separately; peaks are the
kernel's high-water mark minus the resident memory before the first step (Linux only).
"""

import argparse
import json
import statistics
import subprocess
import sys
import time

import torch
from torch import Tensor

from benchmarks.memory import MIB, forget_peak, picture, resident
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
    guide = picture(side).requires_grad_()
    leaves = (guide, torch.tensor(BANDWIDTH, requires_grad=True), torch.tensor(ALPHA, requires_grad=True))
    weights = torch.randn(guide.shape, generator=torch.Generator().manual_seed(0))
    small = picture(64).requires_grad_()  # starts threads and lazy imports before measuring
    (METHODS[method](small, leaves[1], leaves[2], 10) * weights[..., :64, :64]).sum().backward()

    forget_peak()
    before = resident("VmRSS")
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


def in_fresh_process(method: str, options: argparse.Namespace) -> dict[str, float]:
    """Measure one method in a fresh process; return median times and peak memory."""
    command = [sys.executable, "-m", "benchmarks.gradients", "--child", method]
    for name in ("side", "landmarks", "repeats"):
        command += [f"--{name}", str(getattr(options, name))]
    record = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    ratios = [b / f for f, b in zip(record["forward"], record["backward"], strict=True)]
    return {
        "forward": statistics.median(record["forward"]),
        "backward": statistics.median(record["backward"]),
        "ratio": statistics.median(ratios),
        "peak": record["peak"],
    }


def verdict(holds: bool) -> str:
    """Text for whether a limit is kept."""
    return "holds" if holds else "FALLS SHORT"


def main() -> None:
    """Print the table and the claims."""
    parser = argparse.ArgumentParser(description="Time and memory of a training step, compared with plain autograd.")
    parser.add_argument("--side", type=int, default=512, help="height and width of the picture")
    parser.add_argument("--landmarks", type=int, default=100, help="number of landmarks m")
    parser.add_argument("--repeats", type=int, default=9, help="timed steps after the first")
    parser.add_argument("--quick", action="store_true", help="a small picture, to check that it runs")
    parser.add_argument("--child", choices=tuple(METHODS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.quick:
        options.side, options.repeats = 96, 2
    if options.child:
        print(json.dumps(measure(options.child, options.side, options.landmarks, options.repeats)))
        return

    factor = options.side**2 * options.landmarks * 4 / MIB
    rows = {method: in_fresh_process(method, options) for method in METHODS}
    print(
        f"{options.side}x{options.side} grey, m = {options.landmarks}, k = {len(ALPHA) - 1}, float32, "
        f"{torch.get_num_threads()} threads, torch {torch.__version__}, median of {options.repeats} steps; "
        f"factor {factor:.0f} MiB"
    )
    print(f"{'':10} {'forward s':>10} {'backward s':>11} {'ratio':>6} {'peak MiB':>9} {'of factor':>10}")
    for method, row in rows.items():
        print(
            f"{method:10} {row['forward']:10.3f} {row['backward']:11.3f} {row['ratio']:6.2f} {row['peak']:9.0f} "
            f"{row['peak'] / factor:10.2f}"
        )
    ours, peer = rows["library"], rows["plain"]
    speedup = (peer["forward"] + peer["backward"]) / (ours["forward"] + ours["backward"])
    share = ours["peak"] / peer["peak"]
    times = ours["peak"] / factor
    print(
        f"backward / forward    {ours['ratio']:5.2f}  limit {MOST_BACKWARD}   {verdict(ours['ratio'] <= MOST_BACKWARD)}"
    )
    print(f"peak / factor         {times:5.2f}  limit {MOST_MEMORY}   {verdict(times <= MOST_MEMORY)}")
    print(f"faster than plain     {speedup:5.2f}  at least {LEAST_SPEEDUP}   {verdict(speedup >= LEAST_SPEEDUP)}")
    print(f"memory beside plain   {share:5.2f}  limit {MOST_SHARE:.2f}  {verdict(share <= MOST_SHARE)}")


if __name__ == "__main__":
    main()
