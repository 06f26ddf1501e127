"""The precision in which functions and their hand-written derivatives run, whatever it is outside; and uncompiled ones.

Cholesky and eigen-decompositions reject half precision, and TF32 is too coarse for distances between patches. Every
public function therefore leaves autocast, computes in :func:`working_dtype` and casts its result back. Functions with
data-dependent control flow or loops over blocks of pixels are excluded from ``torch.compile``. Hand-written derivatives
run in full precision, too, return low-rank gradients as two factors, and raise on second derivatives.
"""

import functools
from collections.abc import Callable
from threading import Lock
from typing import Any, ParamSpec, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

Gradients = tuple[Tensor | None, ...]
P = ParamSpec("P")
R = TypeVar("R")
LARGEST_VALUE = 1e9  # limit of values that are squared


def working_dtype(tensor: Tensor) -> torch.dtype:
    """Return float64 for float64 tensors, float32 for all others."""
    return torch.float64 if tensor.dtype == torch.float64 else torch.float32


def squarable(values: Tensor) -> Tensor:
    """Limit values so that products of four of them are finite numbers of single precision."""
    return values.clamp(-LARGEST_VALUE, LARGEST_VALUE)


def trainable(tensor: Tensor) -> Tensor:
    """The tensor, or a copy if it was made in inference mode: autograd refuses to save such tensors."""
    inference = not torch.compiler.is_compiling() and tensor.is_inference() and not torch.is_inference_mode_enabled()
    return tensor.clone() if inference else tensor


def per_image(value: float | Tensor, like: Tensor, dimensions: int) -> Tensor:
    """A number or a tensor of shape () or (B,), as (1 or B, 1, ...) in the dtype and on the device of ``like``."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).reshape(-1, *[1] * (dimensions - 1))


class _WithoutTF32:
    """Context without TF32, for all threads of the process, since torch has no such setting for a single thread.

    Threads may enter it at the same time: the first one in saves the settings, and the last one out restores them.
    While a thread is inside, matrix products of all other threads are computed in full precision, too.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._threads = 0
        self._before = (False, False)

    def __enter__(self) -> None:
        with self._lock:
            if self._threads == 0:
                self._before = (torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32)
                self._set(False, False)
            self._threads += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._threads -= 1
            if self._threads == 0:
                self._set(*self._before)

    @staticmethod
    def _set(products: bool, convolutions: bool) -> None:
        torch.backends.cuda.matmul.allow_tf32 = products
        torch.backends.cudnn.allow_tf32 = convolutions


WITHOUT_TF32 = _WithoutTF32()


def _is_rounded(device: str) -> bool:
    """Whether autocast is on. Entering a context without it, before every call, would take as long as a product."""
    return torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled(device)


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Run ``function`` without autocast and, where a CUDA device exists, without TF32."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        devices = [a.device.type for a in args if isinstance(a, Tensor)]  # Dynamo of PyTorch 2.8 lacks `next`
        device = devices[0] if devices and devices[0] != "meta" else "cuda"
        if not torch.cuda.is_available() and not torch.compiler.is_compiling() and not _is_rounded(device):
            return function(*args, **kwargs)
        with torch.autocast("cpu", enabled=False), torch.autocast(device, enabled=False):
            if torch.cuda.is_available() and not torch.compiler.is_compiling():
                with WITHOUT_TF32:
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


@runtime_checkable
class Unformed(Protocol):
    """A gradient that is stored as something smaller, such as the factors of a product."""

    def formed(self) -> Tensor:
        """The gradient as an ordinary tensor."""


def as_ordinary(gradient: Tensor) -> Tensor:
    """A gradient as an ordinary tensor."""
    return gradient.formed() if isinstance(gradient, Unformed) else gradient


def once_differentiable(backward: Callable[..., Gradients]) -> Callable[..., Gradients]:
    """Make a ``backward`` of an autograd Function raise on second derivatives, and run it in full precision.

    A backward pass started under autocast would otherwise round its products. torch's decorator of the same name raises
    only if the incoming gradient requires a gradient; otherwise it treats the result as a constant, and second
    derivatives would be silently wrong.
    """
    exact = full_precision(backward)

    @functools.wraps(backward)
    def wrapper(ctx: Any, *gradients: Tensor) -> Gradients:
        with torch.no_grad():
            results = exact(ctx, *gradients)
        if not torch.is_grad_enabled() or torch.compiler.is_compiling():
            return results
        formed = [as_ordinary(g) for g in results if g is not None]
        # Connected to everything the gradients depend on: autograd visits only nodes on a path to a requested tensor.
        causes = [t for t in (*ctx.saved_tensors, *gradients) if t is not None and t.requires_grad]
        refused = iter(_Refusal.apply(len(formed), *formed, *causes))  # type: ignore[no-untyped-call]
        return tuple(None if g is None else next(refused) for g in results)

    return wrapper


class _Refusal(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, count: int, *tensors: Tensor) -> Gradients:
        return tensors[:count]

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Gradients:
        raise RuntimeError(
            "the filter must not be differentiated twice with respect to its guide, bandwidths or patch weights; "
            "detach them to take second derivatives with respect to the image and alpha only"
        )
