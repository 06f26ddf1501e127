"""Medians and quartiles of calls that take turns, so that slow minutes of the machine affect all of them equally."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch.utils.benchmark import Measurement, TaskSpec, set_torch_threads, timer

Call = Callable[[], Any]

UNCOUNTED = 5.0  # seconds; a call that takes more comes to its own memory and caches on its way
SHORTEST = 0.01  # seconds; a call that takes less is repeated within one sample, or the clock would count, too
MOST = 15  # rounds
LONG = 0.5  # seconds; a call that takes more is warm after one


@dataclass(frozen=True)
class Timing:
    """Seconds of one call.

    Attributes:
        median: of the samples.
        iqr: between the quartiles of the samples.
        samples: how many there are.
        calls: in each sample, which is their mean.
    """

    median: float
    iqr: float
    samples: int
    calls: int

    def to_json(self) -> dict[str, float]:
        """As a plain dictionary."""
        return asdict(self)


@dataclass(frozen=True)
class Ratio:
    """How many times as long one call takes as another, from samples taken right after each other.

    Attributes:
        lower: quartile of the ratios.
        median: of the ratios.
        upper: quartile of the ratios.
        pairs: how many ratios there are.
    """

    lower: float
    median: float
    upper: float
    pairs: int

    def to_json(self) -> dict[str, float]:
        """As a plain dictionary."""
        return asdict(self)


def take_turns(calls: Mapping[str, Call], *, threads: int, seconds: float, least: int = 3) -> dict[str, Timing]:
    """Time several calls round after round, one sample of each per round.

    Each sample comes after a call that is not counted, so that memory and caches are the call's own, as in a loop over
    pictures, unless it takes seconds. What it costs to come after something else is measured by :func:`after_pauses`.

    Args:
        calls: what to time, by name.
        threads: of torch.
        seconds: start no further round after so many, once there have been ``least``.
        least: rounds.

    Returns:
        A timing by name. The first call of each, which pays for imports and memory, is not counted.
    """
    samples, repeats = _rounds(calls, threads, seconds, least)
    return {name: _summary(name, samples[name], repeats[name], threads) for name in calls}


def compare(calls: Mapping[str, Call], *, threads: int, seconds: float, least: int) -> tuple[dict[str, Timing], Ratio]:
    """Time two calls in turns, A B A B, and divide each sample of B by the sample of A just before it.

    Other work on the machine slows both samples of a pair or, if it starts or ends between them, spoils one ratio of
    many, which moves the median little.

    Args:
        calls: A and B, by name, in this order.
        threads: of torch.
        seconds: start no further pair after so many, once there have been ``least``.
        least: pairs.

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
    lower, median, upper = torch.tensor(values, dtype=torch.float64).quantile(
        torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
    )
    return lower.item(), median.item(), upper.item()


def _rounds(
    calls: Mapping[str, Call], threads: int, seconds: float, least: int
) -> tuple[dict[str, list[float]], dict[str, int]]:
    """Samples by name, one of each per round, and how many calls each sample of a name consists of."""
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
    """Time ``count`` calls of which each follows ``pause`` idle seconds.

    By then a virtual machine has given freed memory back to its host, and must ask for it again, page by page.
    """
    with set_torch_threads(threads):
        call()
        times = []
        for _ in range(count):
            time.sleep(pause)
            times.append(_sample(call, 1))
    return _summary(name, times, 1, threads)


def try_once(call: Call, *, threads: int) -> float:
    """Seconds of a call, roughly: the second one, or the mean of a few short ones."""
    with set_torch_threads(threads):
        call()
        seconds = _sample(call, 1)
        count = math.ceil(SHORTEST / max(seconds, 1e-9))
        return seconds if count == 1 else _sample(call, count) / count


def _calls_per_sample(call: Call) -> int:
    """Enough calls to take :data:`SHORTEST`; warms up on the way, twice unless once took long."""
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
    """A call without arguments, outside of autograd, whose result is dropped."""

    def run() -> None:
        with torch.no_grad():
            call(*args, **kwargs)

    return run


def on_threads(call: Call, count: int) -> Call:
    """The same call on so many threads of torch, whatever it runs on otherwise."""

    def run() -> None:
        with set_torch_threads(count):
            call()

    return run
