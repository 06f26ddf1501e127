"""Tests whether values of tensors can be read, and under which torch transforms a computation can run.

Reading a value (``float(tensor)``, ``if tensor``) makes the CPU wait for an accelerator, and is impossible for tensors
without data: on the device "meta", as fake tensors, under ``torch.compile`` and ``torch.export``. In these cases checks
of values are skipped, and iterations run a fixed number of steps.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import ParamSpec, TypeVar, cast

import torch
from torch import Tensor
from torch.autograd import forward_ad

from nlfilter_torch.core.torch_internals import (
    in_fake_mode,
    in_forward_mode,
    in_transform,
    is_fake_tensor,
    is_traced,
    is_transformed,
)

P = ParamSpec("P")
R = TypeVar("R")


def is_hidden(tensor: Tensor) -> bool:
    """Whether reading values would wait (accelerators) or is impossible (fake, compiling, in ``torch.func``)."""
    return tensor.device.type != "cpu" or torch.compiler.is_compiling() or is_transformed(tensor) or is_fake(tensor)


def cached_constants(function: Callable[P, R]) -> Callable[P, R]:
    """Cache tensors that a function computes from hashable arguments, for later calls in any mode.

    Tensors are created on the CPU and are ordinary ones, even in inference mode or with another default device. Fake
    tensors are not cached.
    """
    cached = cast(Callable[P, R], lru_cache(maxsize=8)(function))

    @wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with torch.inference_mode(False), torch.device("cpu"):
            return (function if in_fake_mode() else cached)(*args, **kwargs)

    return wrapper


def is_fake(tensor: Tensor) -> bool:
    """Whether a tensor is fake (has a shape but no data), or fake tensor mode is active."""
    return is_fake_tensor(tensor) or in_fake_mode()


def refuse_transforms(name: str, *values: object) -> None:
    """Raise if one of ``values``, the first called ``name``, is transformed in a way that operators cannot be built."""
    if torch.compiler.is_compiling():
        return
    # These three checks take less than a microsecond.
    if is_traced():
        raise TypeError(
            f"{name} must not be traced by torch.jit.trace while an operator is built, got a traced tensor; "
            "use torch.export.export, or trace only the application of an operator built before"
        )
    if not in_forward_mode() and not in_transform():
        return
    transformed = any(is_transformed(value) for value in values if isinstance(value, Tensor))
    if transformed:
        raise TypeError(
            f"{name} must not be transformed by torch.func (vmap, grad, jvp) while an operator is built, got a "
            "transformed tensor; pass a batch, and take derivatives with torch.autograd.grad"
        )
    if in_transform():
        raise TypeError(
            f"{name} must not be used to build an operator inside torch.func (vmap, grad, jvp), got a call in it; "
            "build the operator before, and transform a function of its application"
        )
    for value in values:
        if not isinstance(value, Tensor):
            continue
        if forward_ad.unpack_dual(value).tangent is not None:
            raise TypeError(
                f"{name} must have no forward-mode derivative while an operator is built, got a tensor with a tangent; "
                "use reverse mode, with torch.autograd.grad"
            )
