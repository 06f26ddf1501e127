"""Sizes and repetitions of the measurements, and the records they produce."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from benchmarks.speed.cases import Case
from benchmarks.speed.floor import floor_calls, floor_summary
from benchmarks.speed.probe import rounding_error
from benchmarks.speed.timing import Call, Timing, take_turns

# Results of one case in JSON types: suite, label, case, timings by name and, where they apply, the floor, the rounding
# error, the peak memory and notes about peers that are not installed. A comparison has two timings and, as "ratio",
# median and quartiles of the second over the first.
Record = dict[str, Any]
# A whole run: its machine, whether it was quick, and its records under "results".
Results = dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """Sizes and repetitions of the measurements."""

    side: int = 1024  # of the main image
    landmarks: int = 100  # of the main operator
    # Heights and widths of the series over pixels, and of images compared in pairs, each with twice the pixels before.
    sizes: tuple[tuple[int, int], ...] = ((64, 64), (128, 128), (256, 256), (512, 512), (1024, 1024), (2048, 2048))
    doublings: tuple[tuple[int, int], ...] = ((512, 512), (512, 1024), (1024, 1024), (1024, 2048), (2048, 2048))
    counts: tuple[int, ...] = (25, 50, 100, 200, 400)  # m of the series over landmarks
    counts_side: int = 384  # of the image of that series, and of those over patches and data types
    growth: tuple[int, int] = (50, 200)  # the two m compared on the main image
    many: tuple[int, int] = (250, 1000)  # the two m compared beyond the usual range
    many_side: int = 256  # of the image of that comparison
    patches: tuple[int, ...] = (1, 3, 5, 7, 11)
    crops: tuple[int, int, int] = (16, 128, 64)  # number and side of the crops in a batch, and m
    dense_side: int = 256  # of the image for the dense filter
    pictures: tuple[str, ...] = ("retina", "astronaut", "camera", "coffee", "hubble_deep_field")
    seconds: float = 2.0  # for which a group of calls takes turns, if longer than ``least`` rounds
    claimed_seconds: float = 20.0  # likewise for the main group, on which claims rest
    least: int = 3
    pair_seconds: float = 5.0  # for which two compared calls alternate, if longer than ``pairs`` pairs
    pairs: int = 3
    pause: float = 3.0  # idle seconds before each call in the suite ``pauses``
    processes: int = 5  # that measure the time of an import
    probes: int = 5  # cases whose memory is measured
    threads: tuple[int, ...] = ()  # to measure; if empty, one and all
    device: str = "cpu"

    def case(self, **changes: Any) -> Case:
        """The main case, or one that differs from it."""
        main = Case(height=self.side, width=self.side, landmarks=self.landmarks, device=self.device)
        return replace(main, **changes)

    def thread_counts(self) -> tuple[int, ...]:
        """The numbers of threads to measure, ascending."""
        return self.threads or tuple(sorted({1, torch.get_num_threads()}))


QUICK = Plan(
    side=64,
    landmarks=12,
    sizes=((32, 32), (64, 64)),
    doublings=((32, 32), (32, 64)),
    counts=(8, 16),
    counts_side=48,
    growth=(8, 16),
    many=(16, 32),
    many_side=32,
    patches=(1, 3),
    crops=(4, 16, 8),
    dense_side=32,
    pictures=("retina", "camera"),
    seconds=0.0,
    claimed_seconds=0.0,
    least=1,
    pair_seconds=0.0,
    pairs=1,
    pause=0.0,
    processes=1,
    probes=2,
    threads=(1, 2),
)


def record(suite: str, case: Case, timings: Mapping[str, Timing], **facts: Any) -> Record:
    """Make the record of one case."""
    floor = {"floor": floor_summary(timings)} if any(": " in name for name in timings) else {}
    return {
        "suite": suite,
        "label": case.label(),
        "case": asdict(case) | {"threads": case.used_threads},
        "timings": {name: asdict(timing) for name, timing in timings.items()},
        **floor,
        **facts,
    }


def measured(
    suite: str, case: Case, calls: Mapping[str, Call], *, seconds: float, least: int, error: bool = False, **facts: Any
) -> Record:
    """Time ``calls`` in turns with the floor of the case."""
    timings = take_turns({**calls, **floor_calls(case)}, threads=case.used_threads, seconds=seconds, least=least)
    if error:
        facts["error"] = rounding_error(case, case.image())
    return record(suite, case, timings, **facts)


def records_of(results: Results, suite: str) -> list[Record]:
    """The records of one suite, in the order in which they were measured."""
    return [entry for entry in results["results"] if entry["suite"] == suite]
