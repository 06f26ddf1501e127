"""Minimum cost of an operator's matrix products with torch, measured on the same machine alongside the operator.

Computing a spectrum from features (D, N) takes at least three products: landmarks (M, D) with features, the inverse
Cholesky factor (M, M) with the affinities, and the Gram matrix of the factor (M, N): N x D x M and twice N x M x M.
Balancing adds reads of the factor, counted as ten. Each of the four parts is timed in several ways, of which the
fastest counts:

- a product as one call on the whole, into memory that was used before, and in blocks of 4080 and 16368 pixels whose
  results stay in the cache;
- a read as ``factor.sum()``, as ``factor @ vector`` and as ``vector @ factor``.

The C kernels (:mod:`nlfilter_torch.core.kernels`) compute only half of the product with the inverse Cholesky factor,
which is triangular, so the operator may be faster than the floor. The floor excludes the exponential, the features, the
landmarks, and allocating and writing the factor.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.cases import Case
from benchmarks.speed.timing import Call, Timing, try_once

READS = 10
BLOCKS = (4080, 16368)  # an odd number of cache lines, see nlfilter_torch.core.blocks


PARTS = ("affinity", "whitening", "gram", "read")


def floor_calls(case: Case) -> dict[str, Call]:
    """The fastest way of every part, found by one warm trial of each; named ``part: way``."""
    ways = _ways(case)
    every = {f"{part}: {way}": call for part, choices in ways.items() for way, call in choices.items()}
    tried = {name: try_once(call, threads=case.used_threads) for name, call in every.items()}
    best = [min((name for name in every if name.startswith(part)), key=lambda n: tried[n]) for part in PARTS]
    return {name: every[name] for name in best}


def floor_summary(timings: Mapping[str, Timing]) -> dict[str, Any]:
    """Seconds of the floor, of its products and of one read, from timings that include :func:`floor_calls`."""
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
    """All ways to compute every part, on the same random tensors."""
    marks, pixels, batch = case.landmarks, case.pixels, case.batch
    numbers = torch.Generator(case.device).manual_seed(0)

    def empty(*shape: int) -> Tensor:
        if case.device == "cpu":  # numpy requests huge pages, which make reads faster
            return torch.from_numpy(np.empty((batch, *shape), str(case.working_dtype).removeprefix("torch.")))
        return torch.empty(batch, *shape, dtype=case.working_dtype, device=case.device)

    def random(*shape: int) -> Tensor:
        return empty(*shape).uniform_(generator=numbers)

    features, points = random(case.patch_size**2, pixels), random(marks, case.patch_size**2)
    whitening, factor, result = random(marks, marks), random(marks, pixels), empty(marks, pixels)
    column, row, small = random(pixels, 1), random(1, marks), random(marks, marks)
    ways: dict[str, dict[str, Call]] = {
        "affinity": {"whole": lambda: torch.bmm(points, features, out=result)},
        "whitening": {"whole": lambda: torch.bmm(whitening, factor, out=result)},
        "gram": {"whole": lambda: torch.bmm(factor, factor.mT, out=small)},
        "read": {
            "sum": lambda: factor.sum(),
            "matrix-vector": lambda: factor @ column,
            "vector-matrix": lambda: row @ factor,
        },
    }
    for block in BLOCKS:
        length = block // batch  # so that the total over the batch is ``block``
        if length < pixels:
            first, second = random(marks, length), random(marks, length)
            blocks = [slice(start, start + length) for start in range(0, pixels - length + 1, length)]
            ways["affinity"][f"blocks of {block}"] = _in_blocks(points, features, first, blocks)
            ways["whitening"][f"blocks of {block}"] = _repeated(whitening, first, second, len(blocks))
            ways["gram"][f"blocks of {block}"] = _summed(factor, small, blocks)
    return ways


def _in_blocks(left: Tensor, right: Tensor, out: Tensor, blocks: list[slice]) -> Call:
    def run() -> None:
        for block in blocks:
            torch.bmm(left, right[:, :, block], out=out)

    return run


def _repeated(left: Tensor, right: Tensor, out: Tensor, times: int) -> Call:
    def run() -> None:
        for _ in range(times):
            torch.bmm(left, right, out=out)

    return run


def _summed(factor: Tensor, out: Tensor, blocks: list[slice]) -> Call:
    def run() -> None:
        out.zero_()
        for block in blocks:
            out.baddbmm_(factor[:, :, block], factor[:, :, block].mT)

    return run
