"""Alternating measurements, A B A B, of two sizes or variants, for the claims about ratios of times."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from itertools import pairwise

import torch
from torch import Tensor

from benchmarks.speed.cases import Case
from benchmarks.speed.floor import floor_calls
from benchmarks.speed.plan import Plan, Record, record
from benchmarks.speed.probe import ALPHA, training_step
from benchmarks.speed.timing import Call, compare, discard, on_threads
from nlfilter_torch import NonlocalOperator, PolynomialSliders, detail_layers, spectral_filter

SUITE = "comparisons"
# Labels by which the claims find the records.
DOUBLED = "twice the pixels"
GROWTH = "growth in landmarks"
MANY = "many landmarks"
CROPS = "a training step on crops"
DOUBLE_PRECISION = "float64 against float32"
THREADS = "one thread against all"
SLIDER = "a slider move against a read"
RESPONSE = "another response against a read"


def comparisons(plan: Plan) -> Iterator[Record]:
    """Yield all comparisons, each a record with two timings and their ratio."""
    for smaller, larger in pairwise(plan.doublings):
        cases = [plan.case(height=height, width=width) for height, width in (smaller, larger)]
        yield _operators(plan, DOUBLED, *cases)
    yield _operators(plan, GROWTH, *(plan.case(landmarks=count) for count in plan.growth))
    many = {"height": plan.many_side, "width": plan.many_side}
    yield _operators(plan, MANY, *(plan.case(landmarks=count, **many) for count in plan.many))
    yield from _crops(plan)
    small = {"height": plan.counts_side, "width": plan.counts_side}
    yield _operators(plan, DOUBLE_PRECISION, *(plan.case(dtype=dtype, **small) for dtype in ("float32", "float64")))
    yield from _threads(plan)
    yield from _reads(plan)


def held_calls(operator: NonlocalOperator, image: Tensor) -> dict[str, Call]:
    """A slider move with cached layers, and another response with cached coefficients."""
    spectrum, layers = operator.spectrum(), detail_layers(operator, image)
    sliders = PolynomialSliders(ALPHA).to(image.device)
    held = spectrum.coefficients(image)
    return {
        "slider, layers held": discard(sliders.combine, layers),
        "response, coefficients held": discard(spectral_filter, spectrum, image, power, coefficients=held),
    }


def power(eigenvalues: Tensor) -> Tensor:
    """A response that is not a polynomial."""
    return eigenvalues**0.1


def step_call(case: Case) -> Call:
    """A training step on the image of a case."""
    image = case.image()
    return lambda: training_step(case, image.detach())


def _compared(plan: Plan, label: str, case: Case, calls: Mapping[str, Call]) -> Record:
    timings, ratio = compare(calls, threads=case.used_threads, seconds=plan.pair_seconds, least=plan.pairs)
    return record(SUITE, case, timings, ratio=asdict(ratio)) | {"label": label}


def _operators(plan: Plan, label: str, first: Case, second: Case) -> Record:
    """Compare the operators of two cases."""
    calls = {case.label(): discard(case.operator, case.image()) for case in (first, second)}
    return _compared(plan, label, second, calls)


def _crops(plan: Plan) -> Iterator[Record]:
    """Compare a training step and an operator of one image with those of a batch of crops with as many pixels."""
    count, side, marks = plan.crops
    across = round(count**0.5)
    whole = plan.case(height=across * side, width=across * side, landmarks=marks)
    batch = plan.case(batch=count, height=side, width=side, landmarks=marks)
    yield _compared(plan, CROPS, batch, {case.label(): step_call(case) for case in (whole, batch)})
    yield _operators(plan, "an operator of crops", whole, batch)


def _threads(plan: Plan) -> Iterator[Record]:
    """Compare the main operator on the fewest threads and on the most, if the two differ."""
    counts = plan.thread_counts()
    if len(counts) > 1:
        most, fewest = plan.case(threads=counts[-1]), plan.case(threads=counts[0])
        image = most.image()
        calls = {case.label(): on_threads(discard(case.operator, image), case.threads) for case in (most, fewest)}
        yield _compared(plan, THREADS, most, calls)


def _reads(plan: Plan) -> Iterator[Record]:
    """Compare calls that use cached results with one read of the factor."""
    case = plan.case()
    image = case.image()
    with torch.no_grad():
        calls = held_calls(case.operator(image), image)
    read = next(call for name, call in floor_calls(case).items() if name.startswith("read: "))
    for label, (name, call) in zip((SLIDER, RESPONSE), calls.items(), strict=True):
        yield _compared(plan, label, case, {"one read of the factor": read, name: call})
