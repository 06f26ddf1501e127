"""Dataclasses of tensors, such as operators and spectra: moving to devices and dtypes, and loading from files."""

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

Target = torch.device | str | int | torch.dtype | Tensor
Container = TypeVar("Container")

# Fields that are sums over all pixels, kept in float64 whatever the precision of the pixels.
EXACT = frozenset({"moment", "moments", "captured", "before", "ritz", "root"})


def loadable(*classes: type) -> None:
    """Let ``torch.load(..., weights_only=True)`` load these classes: they hold tensors, numbers and one another."""
    torch.serialization.add_safe_globals(list(classes))


def moved(container: Container, target: Target, dtype: torch.dtype | None = None) -> Container:
    """Copy a dataclass with all its tensors moved to another device or converted to another precision.

    Raises:
        TypeError: if the dtype is neither float32 nor float64.
    """
    device: torch.device | None = None
    if isinstance(target, Tensor):
        device, dtype = target.device, target.dtype
    elif isinstance(target, torch.dtype):
        dtype = target
    else:
        device = torch.device(target)
    if dtype not in (None, torch.float32, torch.float64):
        raise TypeError(
            f"dtype must be torch.float32 or torch.float64, got {dtype}; filters convert images of other dtypes"
        )

    result: Container = _move(container, device, dtype, exact=False)
    return result


def _move(value: Any, device: torch.device | None, dtype: torch.dtype | None, *, exact: bool) -> Any:
    """Move the tensors of a value of any type; keep the precision of all of them if ``exact``."""
    if isinstance(value, Tensor):
        kept = exact or dtype is None or not value.is_floating_point()
        return value.to(device=device, dtype=value.dtype if kept else dtype)
    if isinstance(value, tuple):
        return tuple(_move(item, device, dtype, exact=exact) for item in value)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    entries = {field.name: getattr(value, field.name) for field in fields(value)}
    moved_entries = {name: _move(item, device, dtype, exact=exact or name in EXACT) for name, item in entries.items()}
    return replace(value, **moved_entries)
