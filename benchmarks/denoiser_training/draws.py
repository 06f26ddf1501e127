"""Random numbers of the training data, from a generator of their own."""

import math

import torch
from torch import Tensor


class Draws:
    """Random numbers, reproducible from a seed."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, *size: int) -> Tensor:
        """Uniform numbers between 0 and 1."""
        return torch.rand(size, generator=self.generator)

    def normal(self, *size: int) -> Tensor:
        """Standard normal numbers."""
        return torch.randn(size, generator=self.generator)

    def number(self, low: float = 0.0, high: float = 1.0) -> float:
        """One uniform number between two others."""
        return low + (high - low) * float(self.uniform())

    def factor(self, low: float, high: float) -> float:
        """One number between two others, uniform in its logarithm."""
        return math.exp(self.number(math.log(low), math.log(high)))

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return self.number() < probability

    def below(self, count: int) -> int:
        """A whole number from 0 to ``count - 1``."""
        return int(torch.randint(count, (), generator=self.generator))

    def permutation(self, count: int) -> Tensor:
        """The whole numbers from 0 to ``count - 1`` in random order."""
        return torch.randperm(count, generator=self.generator)
