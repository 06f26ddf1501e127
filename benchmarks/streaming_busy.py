"""Tiles beside busy processes, against alone: ``python -m benchmarks.streaming_busy``.

The mosaic of ``benchmarks.streaming`` is edited in tiles, from 8 bits to 8 bits, alone and beside processes that keep a
core busy each, in turn. A machine that is shared evenly gives a thread half of a core that a neighbour keeps busy, so
twice the time is what a program takes that never waits for itself; threads that wait for each other take more. Without
neighbours the same table shows what a second thread brings. ``--quick`` runs it on a part of a megapixel.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median

import numpy as np
import torch

from benchmarks.streaming import mosaic
from benchmarks.streaming_cpu import Edit, ways

BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"  # it ends with its parent


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """So many processes that compute without end."""
    started = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        time.sleep(0.5 if count else 0.0)  # they are there
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def times(edit: Edit) -> tuple[float, float]:
    """Seconds by the clock, and of the processor over all threads."""
    began, used = time.perf_counter(), time.process_time()
    edit()
    return time.perf_counter() - began, time.process_time() - used


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description="Time of tiled edits beside busy processes, compared with alone.")
    parser.add_argument("--quick", action="store_true", help="a fraction of a megapixel, to check that it runs")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[6.0])
    parser.add_argument("--edits", nargs="+", choices=("detail", "recolor"), default=["detail", "recolor"])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument(
        "--neighbours", type=int, default=os.cpu_count() or 1, help="busy processes (default: one per core)"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--memory", type=float, default=1.0, help="memory limit of tiles in gigabytes")
    options = parser.parse_args()
    print(
        f"{options.neighbours} busy processes on {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before",
        flush=True,
    )
    print("| edit | MP | threads | alone, s | CPU, s | beside, s | CPU, s | beside / alone | 1 thread / n |")
    print("|---|---|---|---|---|---|---|---|---|")
    for megapixels in [0.04] if options.quick else options.megapixels:
        side = round((megapixels * 1e6) ** 0.5)
        picture = np.concatenate(list(mosaic(side, side)))
        for verb in options.edits:
            _, edit = ways(verb, picture, int(options.memory * 1e9))
            edit()  # what is read or compiled when it is first needed
            runs: dict[tuple[int, int], list[tuple[float, float]]] = {}
            for _ in range(1 if options.quick else options.repeats):
                for count in (0, options.neighbours):
                    with neighbours(count):
                        for threads in options.threads:
                            torch.set_num_threads(threads)
                            runs.setdefault((threads, count), []).append(times(edit))
            first = [wall for wall, _ in runs[options.threads[0], 0]]
            for threads in options.threads:
                alone, beside = runs[threads, 0], runs[threads, options.neighbours]
                columns = [
                    median(run[part] for run in runs_of_way) for runs_of_way in (alone, beside) for part in (0, 1)
                ]
                ratio = median(b[0] / a[0] for a, b in zip(alone, beside, strict=True))
                gain = median(single / several[0] for single, several in zip(first, alone, strict=True))
                figures = " | ".join(f"{value:.2f}" for value in (*columns, ratio, gain))
                print(f"| {verb} | {megapixels:g} | {threads} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
