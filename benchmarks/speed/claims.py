"""Claims about speed, each with its limit and the measured value."""

import math
from dataclasses import dataclass
from typing import Any

from benchmarks.harness import MIB
from benchmarks.speed.comparisons import CROPS, DOUBLE_PRECISION, DOUBLED, GROWTH, MANY, RESPONSE, SLIDER, SUITE
from benchmarks.speed.plan import Plan, Record, Results, records_of

MAIN = Plan()


@dataclass(frozen=True)
class Claim:
    """One claim.

    Attributes:
        text: what is compared.
        at_most: whether the limit is an upper bound.
        limit: the limit.
        measured: the measured value; None if this run did not measure it.
        unit: of limit and measured value; empty for ratios.
        quartiles: of the measured value, if two calls alternated.
    """

    text: str
    at_most: bool
    limit: float
    measured: float | None
    unit: str = ""
    quartiles: tuple[float, float] | None = None

    @property
    def holds(self) -> bool | None:
        """Whether the claim holds; None if it was not measured."""
        if self.measured is None:
            return None
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit


def claims(results: Results) -> list[Claim]:
    """All claims, judged by the medians of one run; a quick run judges none.

    Claims that compare two sizes or variants are judged by the median ratio of calls that alternated.
    """
    measured = {"results": [] if results["quick"] else results["results"]}
    main = _first(measured, "main")
    operator = _median(main, "operator")
    floor = main["floor"]["seconds"] if main else None
    slider = _median(main, "slider, layers held")
    side = f"{MAIN.side}x{MAIN.side}, m = {MAIN.landmarks}"
    shape = {"height": MAIN.side, "width": MAIN.side, "landmarks": MAIN.landmarks, "batch": 1}
    probes = [
        r for r in records_of(measured, "memory") if r["work"] == "operator" and r["case"].items() >= shape.items()
    ]
    memory = probes[0]["memory"]["added_mib"] if probes else None
    allowed = 1.3 * MAIN.case().factor_bytes / MIB + 200e6 / MIB
    imported = _first(measured, "imports")

    def compared(text: str, limit: float, label: str) -> Claim:
        """Claim that the largest ratio of the comparisons with this label is at most the limit."""
        ratios = [record["ratio"] for record in records_of(measured, SUITE) if record["label"] == label]
        if not ratios:
            return Claim(text, True, limit, None)
        worst = max(ratios, key=lambda ratio: ratio["median"])
        return Claim(text, True, limit, worst["median"], quartiles=(worst["lower"], worst["upper"]))

    return [
        Claim(f"operator ({side}), as a multiple of the floor", True, 1.6, _ratio(operator, floor)),
        Claim(
            "operator / OpenCV fastNlMeans 7/21", True, 1.0, _ratio(operator, _median(main, "OpenCV fastNlMeans 7/21"))
        ),
        Claim("operator / scikit-image NLM 5/6", True, 0.5, _ratio(operator, _median(main, "scikit-image NLM 5/6"))),
        compared("slider move, layers held / one read of the factor", 0.5, SLIDER),
        Claim("OpenCV detailEnhance / slider move", False, 10.0, _ratio(_median(main, "OpenCV detailEnhance"), slider)),
        compared("any other response, coefficients held / one read of the factor", 2.0, RESPONSE),
        Claim("peak memory of the operator", True, allowed, memory, "MiB"),
        compared("time of twice the pixels, worst of 0.25 to 4 MP", 2.2, DOUBLED),
        _exponent(compared("", math.inf, GROWTH)),
        compared("operator of {0}x{0}: m = {2} / m = {1}".format(MAIN.many_side, *MAIN.many), 12.0, MANY),
        compared(f"operator of {MAIN.counts_side}x{MAIN.counts_side}: float64 / float32", 3.0, DOUBLE_PRECISION),
        compared(
            "training step on {0} crops of {1}x{1}, m = {2} / on one image of as many pixels".format(*MAIN.crops),
            1.3,
            CROPS,
        ),
        Claim("import of the package, after that of torch", True, 0.3, _median(imported, "nlfilter_torch"), "s"),
    ]


def _first(results: Results, suite: str) -> Record | None:
    return next(iter(records_of(results, suite)), None)


def _median(record: Record | None, name: str) -> Any:
    """Median seconds of a call; None if the record lacks it."""
    return record["timings"].get(name, {}).get("median") if record else None


def _ratio(above: float | None, below: float | None) -> float | None:
    return above / below if above is not None and below is not None else None


def _exponent(ratio: Claim) -> Claim:
    """Exponent of m in the time, from the ratio of the times at two numbers of landmarks."""
    first, last = MAIN.growth

    def slope(value: float) -> float:
        return math.log(value) / math.log(last / first)

    measured = None if ratio.measured is None else slope(ratio.measured)
    spread = None if ratio.quartiles is None else (slope(ratio.quartiles[0]), slope(ratio.quartiles[1]))
    return Claim(f"exponent of m in the time, m = {first} to {last}", True, 1.6, measured, quartiles=spread)
