"""Parameters that stay in their range under optimiser steps of any size."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_number, check_positive, described

Option = TypeVar("Option", bound=str)


class Learnable(nn.Module):
    """Layer with options that can be learned, each a :func:`positive_option` or a :class:`UnitWindow`.

    Attributes:
        learnable: maps the names of these options to the names of their parameters.
        fixed: values of positive options, in use unless they are learned.
    """

    learnable: ClassVar[Mapping[str, str]]

    def __init__(self) -> None:
        super().__init__()
        self.fixed: dict[str, Any] = {}

    def start_positive(self, name: str, value: Any, learn: frozenset[str], *, other: type | None = None) -> None:
        """Initialise a positive option, as a parameter if in ``learn``; values of type ``other`` are not checked."""
        if name in learn:
            check_number(value, name, "pass the number to start from")
        if other is None or not isinstance(value, other):
            check_positive(value, name)
        self.register_parameter(
            self.learnable[name], nn.Parameter(torch.tensor([math.log(value)])) if name in learn else None
        )
        self.fixed[name] = value

    def shown(self, name: str) -> float | str | None:
        """Format a positive option for ``extra_repr``."""
        value: float | str | Tensor | None = getattr(self, name)
        if not isinstance(value, Tensor):
            return value
        return "..." if value.is_meta else f"{value.item():.4g}"

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Tensor],
        prefix: str,
        local_metadata: dict[str, Any],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        """Report learned options that are fixed in this layer."""
        own = dict(self.named_parameters())
        for option, parameter in self.learnable.items():
            if parameter not in own and prefix + parameter in state_dict:
                learned = state_dict.pop(prefix + parameter)
                start = f" and pass {option}={learned.exp().item():.4g}" if learned.ndim == 1 else ""
                # An unexpected key like any other, so that strict=False ignores it.
                unexpected_keys.append(
                    f"{prefix}{parameter}: {option} must be learned by the layer to load a learned one, got a fixed "
                    f"one; add {option!r} to learn{start} when constructing the layer"
                )
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )


def positive_option(name: str, meaning: str) -> Any:
    """Property of a :class:`Learnable` layer: a fixed value, or the exponential of the parameter ``log_<name>``.

    The exponential keeps the value positive and makes optimiser steps relative.
    """

    def value(layer: Learnable) -> Any:
        logarithm = getattr(layer, f"log_{name}")
        return layer.fixed[name] if logarithm is None else logarithm.exp().squeeze(0)

    def assign(layer: Learnable, value: Any) -> None:
        logarithm = getattr(layer, f"log_{name}")
        if logarithm is not None:
            check_number(value, name)
            check_positive(value, name)
            with torch.no_grad():
                logarithm.fill_(math.log(value))
        layer.fixed[name] = value

    return property(value, assign, doc=meaning)


class UnitWindow(nn.Module):
    """Learned positive weights of unit sum: the softmax of a parameter.

    Attributes:
        logits: parameter (p, p).
    """

    SMALLEST = 1e-6  # initial value in place of zero weights, which could not change

    def __init__(self, start: Tensor) -> None:
        super().__init__()
        self.logits = nn.Parameter(start.clamp(min=self.SMALLEST).log().to(torch.get_default_dtype()))

    def forward(self) -> Tensor:
        """The weights, (p, p)."""
        return self.logits.flatten().softmax(0).view_as(self.logits)

    def extra_repr(self) -> str:
        """The size of the window."""
        return "x".join(map(str, self.logits.shape))


def check_learn(learn: Option | Collection[Option], choices: Sequence[Option], called: str = "learn") -> frozenset[str]:
    """Return the names in ``learn``; raise unless they are among ``choices``. Errors use the name ``called``."""
    is_collection = isinstance(learn, Collection) and not isinstance(learn, Tensor)
    if not is_collection or any(not isinstance(name, str) for name in learn):
        raise TypeError(f"{called} must be a list of names, got {described(learn)}; choose from {', '.join(choices)}")
    names = frozenset([learn] if isinstance(learn, str) else learn)
    unknown = sorted(map(repr, names.difference(choices)))
    if unknown:
        raise ValueError(
            f"{called} must hold only names from {', '.join(map(repr, choices))}, got {', '.join(unknown)}; "
            "choose from these"
        )
    return names
