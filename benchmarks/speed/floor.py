"""The least that an operator's matrix products cost on this machine, measured beside it.

Three products cannot be avoided on the way from features (D, N) to a spectrum: landmarks (M, D) with features, the
whitening (M, M) of the affinities, and the Gram matrix of the factor (M, N): N x D x M and twice N x M x M. Balancing
adds reads of the factor, taken as ten. Each of the four is timed in several ways and the quickest counts, so that the
floor is not slow by a clumsy choice:

- a product as one call on the whole, into memory that was used before, and in blocks of 4096 pixels that never leave
  the cache;
- a read as ``factor.sum()``, as ``factor @ vector`` and as ``vector @ factor``.

The exponential, the features, the landmarks, the writing of the factor and the memory for it are not in the floor.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.cases import Case
from benchmarks.speed.timing import Call, Timing, take_turns

READS = 10
BLOCK = 4096


PARTS = ("affinity", "whitening", "gram", "read")


def floor_calls(case: Case) -> dict[str, Call]:
    """The quickest way of every part, found by trying each twice; named ``part: way``."""
    ways = _ways(case)
    every = {f"{part}: {way}": call for part, choices in ways.items() for way, call in choices.items()}
    tried = take_turns(every, threads=case.used_threads, seconds=0.0, least=2, most=2)
    best = [min((name for name in every if name.startswith(part)), key=lambda n: tried[n].median) for part in PARTS]
    return {name: every[name] for name in best}


def floor_summary(timings: Mapping[str, Timing]) -> dict[str, Any]:
    """Seconds of the floor, of its products and of one read, from timings of :func:`floor_calls` among others."""
    parts = {part: name for name in timings for part in PARTS if name.startswith(f"{part}: ")}
    median = {part: timings[name].median for part, name in parts.items()}
    products = median["affinity"] + median["whitening"] + median["gram"]
    return {
        "seconds": products + READS * median["read"],
        "products": products,
        "read": median["read"],
        "ways": {part: name.split(": ")[1] for part, name in parts.items()},
    }


def _ways(case: Case) -> dict[str, dict[str, Call]]:
    """All ways to do every part, on random numbers; they share their memory."""
    marks, pixels, batch = case.landmarks, case.pixels, case.batch
    numbers = torch.Generator(case.device).manual_seed(0)

    def random(*shape: int) -> Tensor:
        empty = torch.empty(batch, *shape, dtype=case.working_dtype, device=case.device)
        if case.device == "cpu":  # numpy asks the system for huge pages, in which a read is quicker
            empty = torch.from_numpy(np.empty(empty.shape, str(case.working_dtype).removeprefix("torch.")))
        return empty.uniform_(generator=numbers)

    features, points = random(case.patch_size**2, pixels), random(marks, case.patch_size**2)
    whitening, factor, result = random(marks, marks), random(marks, pixels), random(marks, pixels)
    column, row, small = random(pixels, 1), random(1, marks), random(marks, marks)
    # The blocks of a batch are as long together as the one of a single image.
    length = min(pixels, max(1, BLOCK // batch))
    first, second = random(marks, length), random(marks, length)
    starts = range(0, pixels - length + 1, length)

    def affinity_blocks() -> None:
        for start in starts:
            torch.bmm(points, features[:, :, start : start + length], out=first)

    def whitening_blocks() -> None:
        for _ in starts:
            torch.bmm(whitening, first, out=second)

    def gram_blocks() -> None:
        for start in starts:
            block = factor[:, :, start : start + length]
            small.baddbmm_(block, block.mT)

    return {
        "affinity": {
            "whole": lambda: torch.bmm(points, features, out=result),
            "blocks": affinity_blocks,
        },
        "whitening": {
            "whole": lambda: torch.bmm(whitening, factor, out=result),
            "blocks": whitening_blocks,
        },
        "gram": {
            "whole": lambda: torch.bmm(factor, factor.mT, out=small),
            "blocks": gram_blocks,
        },
        "read": {
            "sum": lambda: factor.sum(),
            "matrix-vector": lambda: factor @ column,
            "vector-matrix": lambda: row @ factor,
        },
    }
