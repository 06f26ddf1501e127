"""Parameters that cannot leave their range, however large the optimiser's steps are."""

import math
from collections.abc import Collection, Sequence
from typing import overload

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_number, check_positive, described


class Positive(nn.Module):
    """A positive number that trains: the exponential of a parameter, so that steps are relative.

    Attributes:
        logarithm: parameter of shape ().
    """

    def __init__(self, start: float, name: str) -> None:
        super().__init__()
        check_number(start, name, "pass the number to start from")
        check_positive(start, name)
        self.logarithm = nn.Parameter(torch.tensor(math.log(start)))

    def forward(self) -> Tensor:
        """The number, of shape ()."""
        return self.logarithm.exp()

    def extra_repr(self) -> str:
        """The number as it is now."""
        return f"{math.exp(self.logarithm.item()):.4g}"


class UnitWindow(nn.Module):
    """Positive weights of unit sum that train: the softmax of a parameter.

    Attributes:
        logits: parameter (p, p).
    """

    SMALLEST = 1e-6  # where a weight of zero starts from; it could not leave zero

    def __init__(self, start: Tensor) -> None:
        super().__init__()
        self.logits = nn.Parameter(start.clamp(min=self.SMALLEST).log().to(torch.get_default_dtype()))

    def forward(self) -> Tensor:
        """The weights, (p, p)."""
        return self.logits.flatten().softmax(0).view_as(self.logits)

    def extra_repr(self) -> str:
        """The size of the window."""
        return "x".join(map(str, self.logits.shape))


def check_learn(learn: Collection[str], choices: Sequence[str]) -> frozenset[str]:
    """The names in ``learn``; raise ValueError if one of them is not among ``choices``."""
    if (
        not isinstance(learn, Collection)
        or isinstance(learn, Tensor)
        or any(not isinstance(name, str) for name in learn)
    ):
        raise TypeError(f"learn must be a list of names, got {described(learn)}; choose from {', '.join(choices)}")
    names = frozenset([learn] if isinstance(learn, str) else learn)
    unknown = sorted(map(repr, names.difference(choices)))
    if unknown:
        raise ValueError(
            f"learn must name {', '.join(map(repr, choices))} or none of them, got {', '.join(unknown)}; "
            "choose from these"
        )
    return names


def start_or_positive(start: float, name: str, learn: frozenset[str]) -> float | Positive:
    """``start`` itself, checked, or a parameter that starts from it if ``learn`` has its ``name``."""
    if name in learn:
        return Positive(start, name)
    check_positive(start, name)
    return start


@overload
def current(value: float | Positive) -> float | Tensor: ...
@overload
def current(value: float | Positive | None) -> float | Tensor | None: ...
def current(value: float | Positive | None) -> float | Tensor | None:
    """A number that trains or does not, as it is now."""
    return value() if isinstance(value, Positive) else value


def shown(value: float | Positive | None) -> float | str | None:
    """The same for ``extra_repr``."""
    return value.extra_repr() if isinstance(value, Positive) else value
