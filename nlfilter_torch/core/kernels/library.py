"""The library of the kernels in C: its functions, instruction set and threads.

They are compiled when the package is installed (``hatch_build.py``) or its wheel is built, for Linux on x86-64 and
AArch64, by GCC or Clang; never at run time. Each belongs to an operator of ``torch.ops.nlfilter``, whose definition in
torch computes the same in all other cases: on other devices, in other dtypes, under transforms and for derivatives.
"""

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import wraps
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import torch
from torch import Tensor

# Elements of a factor below which a second thread does not pay: work of about 0.1 to 0.3 ms on one. Where all cores are
# busy, waking a thread takes up to 15 ms.
ONE_THREAD = 1 << 15
ONE_THREAD_COLUMNS = 1 << 18  # of the columns of a factor, their gradients and Gram matrices
ONE_THREAD_PRODUCTS = 1 << 20  # of products with a few rows
Result = TypeVar("Result")

_POINTER, _LONG, _INT = ctypes.c_void_p, ctypes.c_long, ctypes.c_int
_FLOAT, _DOUBLE = ctypes.c_float, ctypes.c_double
_library: ctypes.CDLL | None = None
level = 0  # index of instruction_sets.NAMES, set once: 0 without a library


class _Definitions:
    """Whether definitions in torch are used instead of kernels: while any thread is inside this context.

    Attributes:
        used: read without a lock before every operator.
    """

    def __init__(self) -> None:
        self.used = False
        self._lock = Lock()
        self._contexts = 0

    def __enter__(self) -> None:
        self._count(1)

    def __exit__(self, *_: object) -> None:
        self._count(-1)

    def _count(self, change: int) -> None:
        with self._lock:
            self._contexts += change
            self.used = self._contexts > 0


_definitions = _Definitions()


def use(library: ctypes.CDLL, best: int) -> None:
    """Run the kernels of a compiled library, with instruction sets up to ``best``.

    Raises:
        ImportError: if it was compiled from an earlier version of the kernels.
    """
    global _library, level
    try:
        _declare(library)
    except AttributeError as error:
        raise ImportError(
            f"kernels.so must be compiled from this version of nlfilter_torch, got one without {error.name}; install "
            "the package again, which compiles it"
        ) from error
    _library, level = library, best


def _declare(library: ctypes.CDLL) -> None:
    """Declare the types of the arguments of a library, which ``interface.h`` declares too; a test compares them."""
    shared: list[Any] = [_INT, _INT, _LONG]  # instruction set, threads, pixels
    share_threads(library, _openmp())
    planes: list[Any] = [_POINTER, _LONG, _LONG]  # (B, R, N) and their strides
    columns: list[Any] = [*shared, _LONG, _LONG, _LONG, *planes, *[_POINTER] * 3, _FLOAT, _INT, *planes, _POINTER]
    library.nlfilter_columns.argtypes = columns
    library.nlfilter_backward.argtypes = [*columns, _LONG, _POINTER, *planes, *[_POINTER] * 4]
    factor: list[Any] = [_LONG, _LONG, *planes]  # images, landmarks, (B, M, N)
    library.nlfilter_spread.argtypes = [*shared, *factor, _LONG, *[_POINTER] * 3]
    library.nlfilter_gather.argtypes = [*shared, *factor, _LONG, *planes, _POINTER]
    library.nlfilter_sweep.argtypes = [*shared, *factor, *[_POINTER] * 4, _FLOAT, _POINTER, _POINTER]
    library.nlfilter_balance.argtypes = [*shared, *factor, *[_POINTER] * 3, _LONG, _LONG, _FLOAT, *[_POINTER] * 5]
    library.nlfilter_conjugate.argtypes = [*shared, *factor, *[_POINTER] * 3, _LONG, _DOUBLE, _POINTER, _POINTER]
    library.nlfilter_lloyd.argtypes = [*shared, *[_LONG] * 4, _FLOAT, *[_POINTER] * 3]
    library.nlfilter_pivots.argtypes = [*shared, *[_LONG] * 3, _FLOAT, *[_POINTER] * 3]
    library.nlfilter_grams.argtypes = [*shared, *factor, _LONG, *[_POINTER] * 3]
    library.nlfilter_convolution.argtypes = [*shared, *[_LONG] * 6, _FLOAT, *[_POINTER] * 5]
    library.nlfilter_lattice.argtypes = [*shared, _LONG, _LONG, *planes, _POINTER, _LONG, _POINTER]
    library.nlfilter_stencil.argtypes = [*shared, *[_LONG] * 3, *[_POINTER] * 3]


def _openmp() -> Any:
    """``GOMP_parallel`` of torch's OpenMP library, which runs a function on its threads; None for other libraries.

    It is looked up in torch's own library and those it links to, since torch has no operator that calls a function on
    its threads; torch's C++ code calls the same function.
    """
    path = Path(torch.__file__).with_name("lib") / "libtorch_cpu.so"
    return getattr(ctypes.CDLL(str(path)), "GOMP_parallel", None) if path.exists() else None


def share_threads(library: ctypes.CDLL, openmp: Any) -> None:
    """Let kernels run on the threads of an OpenMP library, by its ``GOMP_parallel``; with None they use their own."""
    library.nlfilter_share_threads(ctypes.cast(openmp, _POINTER) if openmp is not None else None)


def definitions_only() -> AbstractContextManager[None]:
    """Use the definitions in torch instead of the kernels in C, in all threads; for tests and comparisons."""
    return _definitions


def kernel(
    compiled: Callable[..., Result], dtype: torch.dtype = torch.float32, sums: int = 0
) -> Callable[..., Result | None]:
    """Let a kernel in C return None where there is none or it is not to be used; see :func:`definitions_only`.

    Args:
        compiled: calls the kernel, for non-empty tensors on CPUs.
        dtype: of the tensors that the kernel takes.
        sums: number of its last arguments that are sums over pixels, in float64.
    """

    @wraps(compiled)
    def wrapper(*arguments: Any) -> Result | None:
        planes = len(arguments) - sums
        suited = _suit(arguments[:planes], dtype) and _suit(arguments[planes:], torch.float64)
        return compiled(*arguments) if level and not _definitions.used and suited else None

    return wrapper


def _suit(arguments: Sequence[Any], dtype: torch.dtype) -> bool:
    """Whether a kernel supports all arguments: all tensors have its dtype and are not empty."""
    # Runs before every product; a loop takes half the time of a generator.
    for argument in arguments:
        if isinstance(argument, Tensor):
            if argument.dtype is not dtype or argument.numel() == 0:
                return False
        elif isinstance(argument, list) and not _suit(argument, dtype):
            return False
    return True


def by_rows(planes: Tensor) -> Tensor:
    """Planes (B, R, N) with contiguous rows, which may have any stride."""
    return planes if planes.stride(2) == 1 else planes.contiguous()


def contiguous(*tensors: Tensor) -> Iterator[Tensor]:
    """Each of the tensors, made contiguous."""
    return (tensor.contiguous() for tensor in tensors)


def repeated(tensor: Tensor, batch: int, length: int) -> Tensor:
    """Expand a tensor to (B, ..., N) if necessary, and make it contiguous."""
    if tensor.shape[0] != batch or tensor.shape[-1] != length:
        tensor = tensor.expand(batch, *tensor.shape[1:-1], length)
    return tensor.contiguous()


def place(planes: Tensor) -> tuple[int, int, int]:
    """Address of planes (B, R, N) with contiguous rows, and strides between images and between rows."""
    return planes.data_ptr(), planes.stride(0), planes.stride(1)


def pointer(tensor: Tensor | None) -> int | None:
    """Address of a contiguous tensor, or None."""
    return None if tensor is None else tensor.data_ptr()


def threads(factor: Tensor, least: int = ONE_THREAD) -> int:
    """Number of threads: as many as torch uses, but 1 for factors of fewer than ``least`` elements."""
    return 1 if factor.numel() < least else torch.get_num_threads()


def run(name: str, threads: int, count: int, *arguments: int | float | None) -> None:
    """Run a kernel on ``count`` pixels, or images."""
    if getattr(_library, f"nlfilter_{name}")(level, threads, count, *arguments):
        raise MemoryError("not enough memory for buffers of a few rows; use a smaller image")


def run_on_factor(name: str, factor: Tensor, *arguments: int | float | None, least: int = ONE_THREAD_PRODUCTS) -> None:
    """Run a kernel on all pixels of a factor (B, M, N) with contiguous rows; see :func:`threads`."""
    batch, landmarks, pixels = factor.shape
    run(name, threads(factor, least), pixels, batch, landmarks, *place(factor), *arguments)
