"""Claims about speed, each with its limit and the measured value."""

import math
from collections.abc import Callable
from typing import Any

from benchmarks.harness import MIB, Figure
from benchmarks.speed.comparisons import CROPS, DOUBLE_PRECISION, DOUBLED, GROWTH, MANY, RESPONSE, SLIDER, SUITE
from benchmarks.speed.plan import Plan, Record, Results, records_of

MAIN = Plan()
SMALL = 128  # side of the small image
UNKNOWN = {"lower": math.nan, "median": math.nan, "upper": math.nan}


def claims(results: Results) -> list[Figure]:
    """The claims that a run has measured, judged by its medians; a quick run judges none.

    Claims that compare two sizes or variants are judged by the median ratio of calls that alternated.
    """
    measured = {"results": [] if results["quick"] else results["results"]}
    main = _first(measured, "main")
    operator, slider = (_median(main, name) for name in ("operator", "slider, layers held"))
    small = _first(measured, "sizes", height=SMALL, width=SMALL)
    side = f"{MAIN.side}x{MAIN.side}, m = {MAIN.landmarks}"
    shape = {"height": MAIN.side, "width": MAIN.side, "landmarks": MAIN.landmarks, "batch": 1}
    building, training = (_first(measured, "memory", work, **shape) for work in ("operator", "training step"))
    allowed = 1.3 * MAIN.case().factor_bytes / MIB + 200e6 / MIB
    crops = "training step on {0} crops of {1}x{1}, m = {2} / on one image of as many pixels".format(*MAIN.crops)
    first, last = MAIN.growth

    def compared(text: str, limit: float, label: str, of: Callable[[float], float] = float) -> Figure:
        """That the largest ratio of the comparisons with this label, or a function of it, is at most the limit."""
        ratios = [record["ratio"] for record in records_of(measured, SUITE) if record["label"] == label]
        worst = max(ratios, key=lambda ratio: ratio["median"], default=UNKNOWN)
        lower, median, upper = (of(worst[name]) for name in ("lower", "median", "upper"))
        return Figure(text, median, limit, quartiles=(lower, upper))

    figures = [
        Figure(f"operator ({side}), as a multiple of the floor", operator / _floor(main), 1.6),
        Figure(
            f"operator of {SMALL}x{SMALL}, as a multiple of the floor", _median(small, "operator") / _floor(small), 2.0
        ),
        Figure("operator / OpenCV fastNlMeans 7/21", operator / _median(main, "OpenCV fastNlMeans 7/21"), 1.0),
        Figure("operator / scikit-image NLM 5/6", operator / _median(main, "scikit-image NLM 5/6"), 0.5),
        compared("slider move, layers held / one read of the factor", 0.5, SLIDER),
        Figure("OpenCV detailEnhance / slider move", _median(main, "OpenCV detailEnhance") / slider, 10.0, "", False),
        compared("any other response, coefficients held / one read of the factor", 2.0, RESPONSE),
        Figure("peak memory of the operator", _added(building), allowed, "MiB"),
        Figure("peak memory of a training step", _added(training), 4.0 * MAIN.case().factor_bytes / MIB, "MiB"),
        compared("time of twice the pixels, worst of 0.25 to 4 MP", 2.2, DOUBLED),
        compared(
            f"exponent of m in the time, m = {first} to {last}",
            1.6,
            GROWTH,
            lambda ratio: math.log(ratio) / math.log(last / first),
        ),
        compared("operator of {0}x{0}: m = {2} / m = {1}".format(MAIN.many_side, *MAIN.many), 12.0, MANY),
        compared(f"operator of {MAIN.counts_side}x{MAIN.counts_side}: float64 / float32", 3.0, DOUBLE_PRECISION),
        compared(crops, 1.3, CROPS),
        Figure(
            "import of the package, after that of torch",
            _median(_first(measured, "imports"), "nlfilter_torch"),
            0.3,
            "s",
        ),
    ]
    return [figure for figure in figures if not math.isnan(figure.value)]


def _first(results: Results, suite: str, work: str | None = None, **case: int) -> Record | None:
    """The first record of a suite, of a work and with parts of its case, if there is one."""
    fitting = (
        record
        for record in records_of(results, suite)
        if record.get("work") == work and record["case"].items() >= case.items()
    )
    return next(fitting, None)


def _median(record: Record | None, name: str) -> Any:
    """Median seconds of a call; not a number if the record lacks it."""
    return record["timings"].get(name, {}).get("median", math.nan) if record else math.nan


def _floor(record: Record | None) -> Any:
    return record["floor"]["seconds"] if record else math.nan


def _added(record: Record | None) -> Any:
    return record["memory"]["added_mib"] if record else math.nan
