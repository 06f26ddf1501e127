"""Medians and quartiles of calls that take turns, so that slow periods of the machine affect all of them equally."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.utils.benchmark import Measurement, TaskSpec, set_torch_threads, timer

Call = Callable[[], Any]

UNCOUNTED = 5.0  # seconds; no uncounted call precedes a call that takes longer
SHORTEST = 0.01  # seconds; a shorter call is repeated within one sample, because of the cost of the clock
MOST = 15  # maximum number of rounds
LONG = 0.5  # seconds; a longer call is warmed up by one run


@dataclass(frozen=True)
class Timing:
    """Median and interquartile range of a call in seconds; each of the samples is a mean over so many calls."""

    median: float
    iqr: float
    samples: int
    calls: int


@dataclass(frozen=True)
class Ratio:
    """Quartiles of the time of one call relative to another, of pairs of consecutive samples."""

    lower: float
    median: float
    upper: float
    pairs: int


def take_turns(calls: Mapping[str, Call], *, threads: int, seconds: float, least: int = 3) -> dict[str, Timing]:
    """Time several calls round after round, one sample of each per round.

    Each sample of a call follows an uncounted run of the same call, unless it takes seconds, so that memory and caches
    are as in a loop over pictures. :func:`after_pauses` measures the cost of a call after idle time.

    No further round starts after ``seconds``, once there have been ``least``. The first call of each, which pays for
    imports and memory, is not counted.
    """
    samples, repeats = _rounds(calls, threads, seconds, least)
    return {name: _summary(name, samples[name], repeats[name], threads) for name in calls}


def compare(calls: Mapping[str, Call], *, threads: int, seconds: float, least: int) -> tuple[dict[str, Timing], Ratio]:
    """Time two calls in turns, A B A B, and divide each sample of B by the sample of A just before it.

    Other work on the machine slows both samples of a pair or, if it starts or ends between them, distorts one ratio of
    many, which changes the median little.

    Returns:
        A timing of each by name, and the ratio B / A.
    """
    samples, repeats = _rounds(calls, threads, seconds, least)
    first, second = ([time / repeats[name] for time in samples[name]] for name in calls)
    lower, median, upper = quartiles([after / before for before, after in zip(first, second, strict=True)])
    timings = {name: _summary(name, samples[name], repeats[name], threads) for name in calls}
    return timings, Ratio(lower, median, upper, len(first))


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile."""
    lower, median, upper = np.quantile(values, (0.25, 0.5, 0.75)).tolist()
    return lower, median, upper


def _rounds(
    calls: Mapping[str, Call], threads: int, seconds: float, least: int
) -> tuple[dict[str, list[float]], dict[str, int]]:
    """Samples by name, one of each per round, and the number of calls per sample by name."""
    samples: dict[str, list[float]] = {name: [] for name in calls}
    with set_torch_threads(threads):
        repeats = {name: _calls_per_sample(call) for name, call in calls.items()}
        start = time.perf_counter()
        for done in range(1, MOST + 1):
            for name, call in calls.items():
                if not samples[name] or samples[name][-1] < UNCOUNTED:
                    call()
                samples[name].append(_sample(call, repeats[name]))
            if done >= least and time.perf_counter() - start >= seconds:
                break
    return samples, repeats


def after_pauses(name: str, call: Call, *, threads: int, pause: float, count: int) -> Timing:
    """Time ``count`` calls, each after ``pause`` idle seconds.

    By then a virtual machine has returned freed memory to its host, and must request it again page by page.
    """
    with set_torch_threads(threads):
        call()
        times = []
        for _ in range(count):
            time.sleep(pause)
            times.append(_sample(call, 1))
    return _summary(name, times, 1, threads)


def try_once(call: Call, *, threads: int) -> float:
    """Rough time of a call in seconds: the second one, or the mean of a few short ones."""
    with set_torch_threads(threads):
        call()
        seconds = _sample(call, 1)
        count = math.ceil(SHORTEST / max(seconds, 1e-9))
        return seconds if count == 1 else _sample(call, count) / count


def _calls_per_sample(call: Call) -> int:
    """Number of calls that take :data:`SHORTEST`; also warms up, by two calls or a single long one."""
    seconds = _sample(call, 1)
    if seconds < LONG:
        seconds = _sample(call, 1)
    return max(1, math.ceil(SHORTEST / max(seconds, 1e-9)))


def _sample(call: Call, count: int) -> float:
    """Seconds that ``count`` calls take; torch's clock waits for an accelerator to finish."""
    begin = timer()
    for _ in range(count):
        call()
    return timer() - begin


def _summary(name: str, times: list[float], count: int, threads: int) -> Timing:
    measured = Measurement(count, times, TaskSpec(stmt=name, setup="", num_threads=threads))
    return Timing(measured.median, measured.iqr, len(times), count)


def discard(call: Callable[..., Any], *args: Any, **kwargs: Any) -> Call:
    """Bind arguments to a call that runs without autograd and drops its result."""

    def run() -> None:
        with torch.no_grad():
            call(*args, **kwargs)

    return run


def on_threads(call: Call, count: int) -> Call:
    """Run a call on ``count`` threads of torch, whatever the current number."""

    def run() -> None:
        with set_torch_threads(count):
            call()

    return run
