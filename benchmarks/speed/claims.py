"""What the project promises of its speed, each with its limit and what a run measured."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from benchmarks.memory import MIB
from benchmarks.speed.plan import Plan, Record, Results, records_of

MAIN = Plan()


@dataclass(frozen=True)
class Claim:
    """One promise.

    Attributes:
        text: what is compared.
        at_most: whether the limit is an upper one.
        limit: the limit.
        measured: None where this run did not measure it.
        unit: of both; empty for ratios.
    """

    text: str
    at_most: bool
    limit: float
    measured: float | None
    unit: str = ""

    @property
    def holds(self) -> bool | None:
        """Whether the promise was kept; None where nothing was measured."""
        if self.measured is None:
            return None
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit


def claims(results: Results) -> list[Claim]:
    """All promises, judged by the medians of one run; a quick run keeps and breaks none."""
    measured = {"results": [] if results["quick"] else results["results"]}
    main = _first(measured, "main")
    operator = _median(main, "operator")
    floor, read = (main["floor"][name] if main else None for name in ("seconds", "read"))
    slider = _median(main, "slider, layers held")
    side = f"{MAIN.side}x{MAIN.side}, m = {MAIN.landmarks}"
    shape = {"height": MAIN.side, "width": MAIN.side, "landmarks": MAIN.landmarks, "batch": 1}
    probes = [
        r for r in records_of(measured, "memory") if r["work"] == "operator" and r["case"].items() >= shape.items()
    ]
    memory = probes[0]["memory"]["added_mib"] if probes else None
    allowed = 1.3 * MAIN.case().factor_bytes / MIB + 200e6 / MIB
    pixels = [_median(record, "operator") for record in records_of(measured, "growth in pixels")]
    steps = [_median(record, "training step") for record in records_of(measured, "batches")]
    imported = _first(measured, "imports")
    return [
        Claim(f"operator ({side}), as a multiple of the floor", True, 1.6, _ratio(operator, floor)),
        Claim(
            "operator / OpenCV fastNlMeans 7/21", True, 1.0, _ratio(operator, _median(main, "OpenCV fastNlMeans 7/21"))
        ),
        Claim("operator / scikit-image NLM 5/6", True, 0.5, _ratio(operator, _median(main, "scikit-image NLM 5/6"))),
        Claim("slider move, layers held / one read of the factor", True, 0.5, _ratio(slider, read)),
        Claim("OpenCV detailEnhance / slider move", False, 10.0, _ratio(_median(main, "OpenCV detailEnhance"), slider)),
        Claim(
            "any other response, coefficients held / one read of the factor",
            True,
            2.0,
            _ratio(_median(main, "response, coefficients held"), read),
        ),
        Claim("peak memory of the operator", True, allowed, memory, "MiB"),
        Claim(
            "time of twice the pixels, worst of 0.25 to 4 MP",
            True,
            2.2,
            max((after / before for before, after in pairwise(pixels)), default=None),
        ),
        Claim(f"exponent of m in the time, m = {MAIN.growth[0]} to {MAIN.growth[-1]}", True, 1.6, _exponent(measured)),
        Claim(
            "training step on {0} crops of {1}x{1}, m = {2} / on one image of as many pixels".format(*MAIN.crops),
            True,
            1.3,
            _ratio(steps[0], steps[1]) if len(steps) == 2 else None,
        ),
        Claim(
            "import of the package, after that of torch",
            True,
            0.3,
            _median(imported, "nlfilter_torch"),
            "s",
        ),
    ]


def _first(results: Results, suite: str) -> Record | None:
    return next(iter(records_of(results, suite)), None)


def _median(record: Record | None, name: str) -> Any:
    """Seconds of a call; None where the record lacks it."""
    return record["timings"].get(name, {}).get("median") if record else None


def _ratio(above: float | None, below: float | None) -> float | None:
    return above / below if above is not None and below is not None else None


def _exponent(results: Results) -> float | None:
    """Slope between the first and the last of the series over landmarks, on logarithmic axes."""
    series = records_of(results, "growth in landmarks")
    if len(series) < 2:
        return None
    first, last = series[0], series[-1]
    return math.log(_median(last, "operator") / _median(first, "operator")) / math.log(
        last["case"]["landmarks"] / first["case"]["landmarks"]
    )
