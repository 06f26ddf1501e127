"""Time of operators of small images, and of many landmarks, in floors: what a floor is, see benchmarks.speed.floor."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from benchmarks.harness import Figure
from benchmarks.speed.cases import Case
from benchmarks.speed.floor import floor_calls, floor_summary
from benchmarks.speed.plan import QUICK, Plan
from benchmarks.speed.timing import discard, take_turns

SMALL = 128  # side of the small image


def floors(case: Case, seconds: float, least: int) -> float:
    """Time of an operator divided by its floor, both measured in turns."""
    image = case.image()
    calls = {"operator": discard(case.operator, image)} | floor_calls(case)
    timings = take_turns(calls, threads=case.used_threads, seconds=seconds, least=least)
    return timings["operator"].median / floor_summary(timings)["seconds"]


def measure(quick: bool) -> Iterator[Figure]:
    """Floors with one thread, and with all."""
    plan = QUICK if quick else Plan()
    side = plan.side if quick else SMALL
    seconds, least = (0.1, 1) if quick else (4.0, 3)
    for threads in sorted({1, torch.get_num_threads()}):
        case = plan.case(height=side, width=side, threads=threads)
        on = f"on {threads} thread{'s' if threads > 1 else ''}"
        value = floors(case, seconds, least)
        yield Figure(f"operator of {side}x{side}, {on}", value, None if quick else 2.0, "floors")
        large = plan.case(height=plan.many_side, width=plan.many_side, threads=threads)
        few, many = (floors(replace(large, landmarks=landmarks), seconds, least) for landmarks in plan.many)
        shown = f"operator of {plan.many_side}x{plan.many_side}, {on}, {plan.many[1]} landmarks"
        yield Figure(shown, many, None, "floors")
        yield Figure(f"{shown}: floors, of those with {plan.many[0]}", many / few, None if quick else 1.3)
