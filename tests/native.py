"""The kernels in C and the definitions in torch that they are compared with, over sizes and instruction sets."""

from collections.abc import Callable
from typing import TypeVar

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.kernels import definitions_only, library

Result = TypeVar("Result")

LEVELS = range(1, library.level + 1)
needs_kernels = pytest.mark.skipif(not library.level, reason="this installation or processor has no kernels in C")


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def by_torch(function: Callable[..., Result], *arguments: object) -> Result:
    """Compute a result by the definition in torch."""
    with definitions_only():
        return function(*arguments)
