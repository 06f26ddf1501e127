"""What the benchmarks share: figures with limits, tables, options, times of calls that take turns, and memory."""

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from nlfilter_torch.photo.files.writing import open_beside

MIB = 2**20


@dataclass(frozen=True)
class Figure:
    """A measured figure.

    Attributes:
        name: what was measured, in a few words.
        value: the measured value.
        limit: the value promised, or None for a figure that is only reported, such as that of a peer.
        unit: of both; empty for a ratio.
        at_most: whether the value must be at most the limit, or at least.
        quartiles: of the value, if two calls alternated.
    """

    name: str
    value: float
    limit: float | None = None
    unit: str = ""
    at_most: bool = True
    quartiles: tuple[float, float] | None = None

    @property
    def holds(self) -> bool:
        """Whether the value is finite, and keeps the limit if there is one."""
        if not math.isfinite(self.value):
            return False
        return self.limit is None or (self.value <= self.limit if self.at_most else self.value >= self.limit)

    def __str__(self) -> str:
        """A line for the terminal."""
        bound = "" if self.limit is None else f"{'at most' if self.at_most else 'at least'} {self.limit:.4g}"
        verdict = "FALLS SHORT" if not self.holds else "" if self.limit is None else "holds"
        return f"{self.name:<78} {self.value:>10.4g} {self.unit:<7} {bound:<18} {verdict}".rstrip()


def report(figures: Iterable[Figure], *, quick: bool = False) -> int:
    """Print figures as they come; return 1 if one falls short of its limit, which those of a ``quick`` run may."""
    short = 0
    for figure in figures:
        print(figure, flush=True)
        short |= not figure.holds
    return int(short and not quick)


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, with the first column aligned left and the others right."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rule, *rows))


def row(name: str, cells: Iterable[object], width: int = 9, first: int = 26) -> str:
    """A line of a table for the terminal: a name, and cells of a width, right-aligned."""
    return f"{name:{first}}" + "".join(f"{cell!s:>{width}}" for cell in cells)


def options(name: str, description: str | None, quick: str | None = None) -> argparse.ArgumentParser:
    """A parser of the command line of a benchmark, with ``--quick`` if it is told what that does."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if quick:
        parser.add_argument("--quick", action="store_true", help=f"{quick}, to see that everything runs")
    return parser


def save_json(path: Path | None, content: object) -> None:
    """Write a JSON file completely or not at all, if there is to be one."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open_beside(path) as stream:
            stream.write((json.dumps(content, indent=1) + "\n").encode())


def as_picture(planes: Tensor) -> Image.Image:
    """A picture of 8 bits from planes (3, H, W) or (1, 3, H, W) in [0, 1]."""
    levels = (255 * planes.reshape(3, *planes.shape[-2:]).clamp(0, 1)).round().byte()
    return Image.fromarray(levels.permute(1, 2, 0).contiguous().numpy())


def from_picture(picture: Image.Image) -> Tensor:
    """Planes (3, H, W) in [0, 1] of a picture."""
    return torch.from_numpy(np.array(picture.convert("RGB"))).permute(2, 0, 1).float() / 255


def save_picture(path: Path, planes: Tensor) -> None:
    """Write planes (3, H, W) or (1, 3, H, W) in [0, 1] as a file of 8 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    as_picture(planes).save(path)


def read_picture(file: Any) -> Tensor:
    """Planes (3, H, W) in [0, 1] of a file of 8 bits."""
    with Image.open(file) as picture:
        return from_picture(picture)


def seconds(call: Callable[[], object], *, processor: bool = False) -> float:
    """Time of one call by the clock, or of the processor over all threads."""
    clock = time.process_time if processor else time.perf_counter
    start = clock()
    call()
    return clock() - start


def medians(calls: Mapping[str, Callable[[], object]], repeats: int, *, processor: bool = False) -> dict[str, float]:
    """Median seconds of several calls, which take turns."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            times[name].append(seconds(call, processor=processor))
    return {name: median(taken) for name, taken in times.items()}


def strength_of(gain: Callable[[float], float], wanted: float, strongest: float, steps: int = 16) -> float | None:
    """The strength at which a method has a gain, which grows with it, by bisection; None if it never reaches it."""
    low, high = 0.0, 1.0
    while gain(high) < wanted:
        low, high = high, 2 * high
        if high > strongest:
            return None
    for _ in range(steps):
        middle = (low + high) / 2
        low, high = (middle, high) if gain(middle) < wanted else (low, middle)
    return high


def resident(field: str) -> float:
    """Memory of this process in MiB: ``VmRSS`` now, or ``VmHWM`` at the peak, which misses nothing (Linux only)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f"/proc/self/status has no {field}")


def forget_peak() -> float:
    """Reset the peak to the memory that is resident now, and return that in MiB."""
    Path("/proc/self/clear_refs").write_text("5")
    return resident("VmRSS")


def peak(call: Callable[[], object]) -> float:
    """Memory in MiB that a call takes at its peak, beyond what the process holds."""
    before = forget_peak()
    call()
    return resident("VmHWM") - before


def in_fresh_process(module: str, *arguments: object) -> Any:
    """Run a benchmark in a process of its own, and return the JSON of the last line that it prints.

    Raises:
        RuntimeError: if it fails, with what it said.
    """
    command = [sys.executable, "-m", f"benchmarks.{module}", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[2:])} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])
