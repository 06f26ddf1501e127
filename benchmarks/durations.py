"""How long the stages of edits take in tiles: ``python -m benchmarks.durations``, about half an hour on a core.

Prints the content of ``nlfilter_torch/photo/picture/durations.json``, in seconds of the processor with one thread, of
which the time left of an edit is estimated. Each edit runs on ``benchmarks.streaming``'s mosaic in two sizes up to the
viewing size, and two larger ones; what a stage takes is linear in between. Each run is in a process of its own, like a
command, which loads what it needs, and memory that it never used before. ``--quick`` takes small pictures, to see that
everything runs.
"""

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from statistics import median

import numpy as np
import torch

from benchmarks.streaming import mosaic
from nlfilter_torch.photo import Step, Stroke
from nlfilter_torch.photo.edits.recipe import edit_rows
from nlfilter_torch.photo.picture.tiles import Passes

SIZES = {"small": (0.5, 1.4), "large": (2.0, 12.0)}  # megapixels
SLOW = {"denoise": {"small": (0.5, 1.4), "large": (2.0, 4.0)}}  # of edits that take many seconds for each
QUICK = {"small": (0.005, 0.006), "large": (0.007, 0.008)}
Timed = tuple[str, float, float]
HALF = 0.5  # a stage of which less is reported is one of a few large tiles, of which the report comes at the end

OBJECT, IN = Stroke(((0.2, 0.2), (0.24, 0.2)), 0.03, "#ff2020"), Stroke(((0.2, 0.2), (0.24, 0.2)), 0.03, "in")
DETAIL = Step("detail", alpha=(2.0, 1.5, 1.0, 1.0))
STEPS = {
    "detail": DETAIL,
    "detail of a region": Step("detail", (IN,), alpha=(1.0, 1.0, 1.0, 1.0), inside=(2.0, 1.5, 1.0, 1.0)),
    "sharpen": Step("sharpen"),
    "denoise": Step("denoise"),
    "tone": Step("tone", contrast=1.3),
    "abstract": Step("abstract"),
    "defocus": Step("defocus", (IN,)),
    "recolor": Step("recolor", (OBJECT,)),
    "colorize": Step("colorize", (OBJECT,)),
    "look": Step("look", alpha=(1.5, 1.2, 1.0, 1.0)),
}


@dataclass
class Measured:
    """A stage as it ran: when it began, when the last report came and when it ended, and the share of that report."""

    name: str
    begun: float
    last: float
    ended: float
    share: float


class Recorder:
    """Takes reports of progress, and the time of the processor at each."""

    def __init__(self) -> None:
        self.stages: list[Measured] = []

    def __call__(self, name: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units of a stage are complete."""
        now, share = time.process_time(), done / max(total, 1)
        current = self.stages[-1] if self.stages else None
        if current is None or current.name != name or share < current.share:
            self.end(now)
            self.stages.append(Measured(name, now, now, now, share))
        elif share > current.share:
            current.last, current.share = now, share

    def end(self, now: float) -> None:
        """The last stage ends."""
        if self.stages:
            self.stages[-1].ended = now


def stages_of(step: Step, megapixels: float, repeats: int) -> list[Timed]:
    """The stages of a step; of several runs, the median of the times of each stage counts."""
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as processes:
        runs = [processes.submit(stages_of_run, step, megapixels).result() for _ in range(repeats)]
    usual = []
    for stages in zip(*runs, strict=True):
        names, seconds, rest = zip(*stages, strict=True)
        usual.append((names[0], median(seconds), median(rest)))
    return usual


def stages_of_run(step: Step, megapixels: float) -> list[Timed]:
    """Names of the stages of a step, the seconds until their last reports and those after them."""
    torch.set_num_threads(1)
    side, record = round((megapixels * 1e6) ** 0.5), Recorder()
    rows = np.concatenate(list(mosaic(side, side)))
    for _ in edit_rows(Passes("uint8", report=record), rows, [step], "mosaic"):
        pass
    record.end(time.process_time())
    stages = []
    for stage in record.stages:
        last = stage.last if stage.share >= HALF else stage.ended
        stages.append((stage.name, last - stage.begun, stage.ended - last))
    return stages


def line(sizes: tuple[float, float], seconds: tuple[float, float]) -> list[float]:
    """Seconds of no megapixels, and of each, from those of two sizes; neither is negative."""
    slope = max(0.0, (seconds[1] - seconds[0]) / (sizes[1] - sizes[0]))
    first = seconds[0] - slope * sizes[0]
    if first < 0:
        first, slope = 0.0, sum(seconds) / sum(sizes)
    return [round(first, 3), round(slope, 3)]


def merged(stages: list[Timed]) -> list[Timed]:
    """Stages with all but the first of successive ones of the same name as the rest of it."""
    kept: list[Timed] = []
    for name, seconds, rest in stages:
        if kept and kept[-1][0] == name:
            kept[-1] = name, kept[-1][1], kept[-1][2] + seconds + rest
        else:
            kept.append((name, seconds, rest))
    return kept


def lines(step: Step, sizes: tuple[float, float], repeats: int) -> list[list[str | float]]:
    """The lines of the file for a step and two sizes."""
    less, more = (stages_of(step, size, repeats) for size in sizes)
    if [name for name, *_ in less] != [name for name, *_ in more]:
        less, more = merged(less), merged(more)
    rows: list[list[str | float]] = []
    for (name, *small), (_, *large) in zip(less, more, strict=True):
        both = [line(sizes, pair) for pair in zip(small, large, strict=True)]
        rows.append([name, *both[0], *both[1]])
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.durations", description=__doc__)
    parser.add_argument("steps", nargs="*", metavar="STEP", help="default: all")
    parser.add_argument("--quick", action="store_true", help="small pictures, to see that everything runs")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    repeats = 1 if options.quick else options.repeats
    entries = []
    for name in options.steps or STEPS:
        kinds = []
        for kind, sizes in (QUICK if options.quick else SLOW.get(name, SIZES)).items():
            rows = ",\n".join(f"      {json.dumps(row)}" for row in lines(STEPS[name], sizes, repeats))
            kinds.append(f'    "{kind}": [\n{rows}\n    ]')
        entries.append(f'  "{name}": {{\n' + ",\n".join(kinds) + "\n  }")
        print(name, file=sys.stderr, flush=True)
    print("{\n" + ",\n".join(entries) + "\n}")


if __name__ == "__main__":
    main()
