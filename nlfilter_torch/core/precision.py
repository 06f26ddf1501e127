"""Decorators that run functions in float32 or float64 whatever the precision outside, and uncompiled if necessary.

Cholesky and eigen-decompositions reject half precision, and TF32 is too coarse for distances between patches. Every
public function therefore leaves autocast, computes in :func:`working_dtype` and casts its result back. Functions with
data-dependent control flow or loops over blocks of pixels are excluded from ``torch.compile``.
"""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor

P = ParamSpec("P")
R = TypeVar("R")


def working_dtype(tensor: Tensor) -> torch.dtype:
    """Return float64 for float64 tensors, float32 for all others."""
    return torch.float64 if tensor.dtype == torch.float64 else torch.float32


def per_image(value: float | Tensor, like: Tensor, dimensions: int) -> Tensor:
    """A number or a tensor of shape () or (B,), as (1 or B, 1, ...) in the dtype and on the device of ``like``."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).reshape(-1, *[1] * (dimensions - 1))


def as_given(result: Tensor, image: Tensor) -> Tensor:
    """Convert a result (B, C, H, W) to the dtype of ``image``, and to channels-last if ``image`` is."""
    result = result.to(image.dtype)
    if image.is_contiguous():
        return result
    # Dynamo cannot trace the question, and has no wrapped tensors.
    if not torch.compiler.is_compiling() and any(map(is_functorch_wrapped_tensor, (image, result))):
        return result
    channels_last = image.is_contiguous(memory_format=torch.channels_last)
    return result.contiguous(memory_format=torch.channels_last) if channels_last else result


@contextmanager
def _no_tf32() -> Iterator[None]:
    matmul, conv = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = matmul, conv


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Run ``function`` without autocast and, where a CUDA device exists, without TF32."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        devices = [a.device.type for a in args if isinstance(a, Tensor)]  # Dynamo of PyTorch 2.8 lacks `next`
        device = devices[0] if devices and devices[0] != "meta" else "cuda"
        with torch.autocast("cpu", enabled=False), torch.autocast(device, enabled=False):
            if torch.cuda.is_available() and not torch.compiler.is_compiling():
                with _no_tf32():
                    return function(*args, **kwargs)
            return function(*args, **kwargs)

    return wrapper


def uncompiled(function: Callable[P, R]) -> Callable[P, R]:
    """Run ``function`` uncompiled inside compiled code, at the cost of one graph break.

    Unlike :func:`torch.compiler.disable` as a decorator, this does not import the compiler with the package.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return wrapper


def uncompiled_with(*options: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Run a function uncompiled, as by :func:`uncompiled`, if one of these keyword arguments is not None."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        whole = uncompiled(function)

        @functools.wraps(function)
        def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
            if torch.compiler.is_compiling() and any(kwargs.get(name) is not None for name in options):
                return whole(*args, **kwargs)
            return function(*args, **kwargs)

        return wrapper

    return decorate
