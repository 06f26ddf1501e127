"""Running cases by number, in worker processes."""

import math
import multiprocessing
import random
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import torch

from benchmarks.fuzz.cases import random_case
from benchmarks.fuzz.checks import Figure, Findings, check_case
from benchmarks.fuzz.functions import check_call, random_call
from benchmarks.fuzz.pictures import check_picture, pictures


@dataclass(frozen=True)
class Result:
    """One case: its number, its description, its figures (the worst of each promise) and its warnings."""

    number: int
    what: str
    figures: list[Figure]
    warned: list[str]


Check = Callable[[int], tuple[str, Findings]]


def operator_case(seed: int, number: int) -> tuple[str, Findings]:
    """Check random operator ``number``."""
    case = random_case(random.Random(f"{seed}:{number}"))
    return str(case), check_case(case)


def picture_case(seed: int, number: int) -> tuple[str, Findings]:
    """Check picture ``number``."""
    picture = pictures(seed)[number]
    return str(picture), check_picture(picture)


def function_case(seed: int, number: int) -> tuple[str, Findings]:
    """Check random call ``number``."""
    call = random_call(random.Random(f"{seed}:call:{number}"))
    return str(call), check_call(call)


def run(check: Check, number: int) -> Result:
    """Check one case and keep the worst figure of each promise: the one that exceeds its limit most."""
    what, findings = check(number)
    worst: dict[str, Figure] = {}
    for figure in findings.figures:
        if figure.promise not in worst or rank(figure) > rank(worst[figure.promise]):
            worst[figure.promise] = figure
    return Result(number, what, list(worst.values()), findings.warned)


def rank(figure: Figure) -> tuple[bool, float]:
    """Sort key of figures, largest for the worst."""
    return figure.broken, figure.value - figure.limit if figure.value == figure.value else math.inf


def results(check: Check, numbers: Iterable[int], workers: int) -> Iterator[Result]:
    """Yield the results of all cases, in order."""
    if workers == 1:
        yield from map(partial(run, check), numbers)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_one_thread) as executor:
        yield from executor.map(partial(run, check), numbers, chunksize=8)


def _one_thread() -> None:
    torch.set_num_threads(1)
