"""The kernels in C and the definitions in torch that they are compared with, over sizes and instruction sets."""

from collections.abc import Callable
from itertools import product
from typing import TypeVar

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.kernels import definitions_only, library

Result = TypeVar("Result")

LEVELS = [
    pytest.param(level, id=name) for level, name in enumerate(instruction_sets.NAMES) if 0 < level <= library.level
]
needs_kernels = pytest.mark.skipif(not library.level, reason="this installation or processor has no kernels in C")


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def sizes(pixels: list[int], marks: list[int], most: int = 8_000_000) -> list[tuple[int, int]]:
    """Return the pairs except those of two large sizes; the others already have full blocks of either kind."""
    return [pair for pair in product(pixels, marks) if pair[0] * pair[1] <= most]


def by_torch(function: Callable[..., Result], *arguments: object) -> Result:
    """Compute a result by the definition in torch."""
    with definitions_only():
        return function(*arguments)
