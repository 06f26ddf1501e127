"""The kernels in C, and how torch's dispatcher comes to call them.

They are compiled when the package is installed (``hatch_build.py``) or its wheel is built, for Linux on x86-64 and
AArch64, by GCC or Clang. Nothing is compiled or looked for later. Each belongs to an operator of
``torch.ops.nlfilter``, whose definition in torch computes the same everywhere else: on other devices, in other dtypes,
under transforms and for derivatives.
"""

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor
from torch.autograd import forward_ad

from nlfilter_torch.core import instruction_sets

SMALL = 1 << 15  # numbers of a factor below which a second thread takes longer to call than it saves
OPERATORS = torch.library.Library("nlfilter", "DEF")
Definition = TypeVar("Definition", bound=Callable[..., Any])

_POINTER, _LONG, _INT, _FLOAT = ctypes.c_void_p, ctypes.c_long, ctypes.c_int, ctypes.c_float


def _load() -> ctypes.CDLL | None:
    """The compiled library, if the installation has one."""
    library = instruction_sets.load_library()
    if library is None:
        return None
    shared: list[Any] = [_INT, _INT, _LONG]  # instruction set, threads, pixels
    share_threads(library, _openmp())
    planes: list[Any] = [_POINTER, _LONG, _LONG]  # (B, R, N) and their strides
    columns: list[Any] = [*shared, _LONG, _LONG, _LONG, *planes, *[_POINTER] * 3, _FLOAT, _INT, *planes, _POINTER]
    library.nlfilter_columns.argtypes = columns
    library.nlfilter_backward.argtypes = [*columns, _LONG, _POINTER, *planes, *[_POINTER] * 4]
    factor: list[Any] = [_LONG, _LONG, *planes]  # images, landmarks, (B, M, N)
    library.nlfilter_spread.argtypes = [*shared, *factor, _LONG, *[_POINTER] * 3]
    library.nlfilter_gather.argtypes = [*shared, *factor, _LONG, *planes, _POINTER]
    library.nlfilter_sweep.argtypes = [*shared, *factor, *[_POINTER] * 3, _FLOAT, _POINTER, _POINTER]
    library.nlfilter_lloyd.argtypes = [*shared, *[_LONG] * 4, _FLOAT, *[_POINTER] * 3]
    library.nlfilter_pivots.argtypes = [*shared, *[_LONG] * 3, _FLOAT, *[_POINTER] * 3]
    library.nlfilter_grams.argtypes = [*shared, *factor, _LONG, *[_POINTER] * 3]
    return library


def _openmp() -> Any:
    """The function by which torch's OpenMP library runs another on its threads; None where torch has another library.

    It is looked for in torch's own library and what that is linked to: torch has no operator that calls a function on
    its threads, and in C++ torch calls this one.
    """
    path = Path(torch.__file__).with_name("lib") / "libtorch_cpu.so"
    return getattr(ctypes.CDLL(str(path)), "GOMP_parallel", None) if path.exists() else None


def share_threads(library: ctypes.CDLL, openmp: Any) -> None:
    """Let kernels run on the threads of an OpenMP library, by its ``GOMP_parallel``; None has them start their own."""
    library.nlfilter_share_threads(ctypes.cast(openmp, _POINTER) if openmp is not None else None)


_library = _load()
level = instruction_sets.level(_library)  # of instruction_sets.NAMES, what this processor and installation can do


@contextmanager
def definitions_only() -> Iterator[None]:
    """Have torch do the work of the kernels in C, for tests and comparisons; in all threads."""
    global level
    before, level = level, 0
    try:
        yield
    finally:
        level = before


def register(
    schema: str, compiled: Callable[..., Any] | None, fake: Callable[..., Any], *, differentiable: bool = False
) -> Callable[[Definition], Definition]:
    """Make a function an operator of ``torch.ops.nlfilter``: it defines what that computes, for every dtype and device.

    Args:
        schema: its name and signature.
        compiled: the same by a kernel in C, for tensors that are float32 and not empty, on processors, which gives None
            where it leaves the work to the definition; None if there is none.
        fake: uninitialised results, from the shapes of the arguments.
        differentiable: whether the definition is made of differentiable operations. Autograd, in reverse and forward
            mode and of any order, and the transforms of ``torch.func`` then see these operations.
    """
    name = schema.partition("(")[0]

    def decorate(definition: Definition) -> Definition:
        def on_processors(*arguments: Any) -> Any:
            found = compiled(*arguments) if compiled is not None and level and _suit(arguments) else None
            return definition(*arguments) if found is None else found

        def under_autograd(keys: Any, *arguments: Any) -> Any:
            if _are_derived(arguments):
                return definition(*arguments)
            keys = keys & below
            if (
                keys.highestPriorityTypeId() == torch._C.DispatchKey.CPU
            ):  # what redispatching comes to, without its 4 us
                return on_processors(*arguments)
            return operator.redispatch(keys, *arguments)

        OPERATORS.define(schema)
        OPERATORS.impl(name, definition, "CompositeExplicitAutograd")
        OPERATORS.impl(name, on_processors, "CPU")
        torch.library.register_fake(f"nlfilter::{name}", fake, lib=OPERATORS)
        operator, below = getattr(torch.ops.nlfilter, name).default, torch._C._after_autograd_keyset
        if differentiable:
            OPERATORS.impl(name, under_autograd, "Autograd", with_keyset=True)
            OPERATORS.impl(name, definition, "FuncTorchBatched")
        return cast(Definition, operator)

    return decorate


# The two below run before every product; as loops they take half the time that generators would.


def _suit(arguments: Sequence[Any]) -> bool:
    """Whether the kernels can work on all arguments: numbers, and tensors that are float32 and not empty."""
    for argument in arguments:
        if isinstance(argument, Tensor):
            if argument.dtype is not torch.float32 or argument.numel() == 0:
                return False
        elif isinstance(argument, list) and not _suit(argument):
            return False
    return True


def _are_derived(arguments: Sequence[Any]) -> bool:
    """Whether one of the arguments has derivatives to keep track of."""
    if torch.is_grad_enabled():
        for argument in arguments:
            if isinstance(argument, Tensor) and argument.requires_grad:
                return True
    if forward_ad._current_level < 0:
        return False
    return any(isinstance(t, Tensor) and forward_ad.unpack_dual(t).tangent is not None for t in arguments)


def by_rows(planes: Tensor) -> Tensor:
    """Planes (B, R, N) with each of their rows in one piece, however far they are apart."""
    return planes if planes.stride(2) == 1 else planes.contiguous()


def contiguous(*tensors: Tensor) -> Iterator[Tensor]:
    """Each of the tensors in one piece."""
    return (tensor.contiguous() for tensor in tensors)


def repeated(tensor: Tensor, batch: int, length: int) -> Tensor:
    """A tensor (B, ..., N) or one that is expanded to it, in one piece."""
    if tensor.shape[0] != batch or tensor.shape[-1] != length:
        tensor = tensor.expand(batch, *tensor.shape[1:-1], length)
    return tensor.contiguous()


def place(planes: Tensor) -> tuple[int, int, int]:
    """Where planes (B, R, N) with rows in one piece are, and how far images and rows are apart."""
    return planes.data_ptr(), planes.stride(0), planes.stride(1)


def pointer(tensor: Tensor | None) -> int | None:
    """Where a tensor in one piece is."""
    return None if tensor is None else tensor.data_ptr()


def threads(factor: Tensor) -> int:
    """As many as torch would use, but for small work."""
    return 1 if factor.numel() < SMALL else torch.get_num_threads()


def run(name: str, threads: int, count: int, *arguments: int | float | None) -> None:
    """Run a kernel on ``count`` pixels, or images."""
    if getattr(_library, f"nlfilter_{name}")(level, threads, count, *arguments):
        raise MemoryError("not enough memory for buffers of a few rows; use a smaller image")


def run_on_factor(name: str, factor: Tensor, *arguments: int | float | None) -> None:
    """Run a kernel on all pixels of a factor (B, M, N) with rows in one piece."""
    batch, landmarks, pixels = factor.shape
    run(name, threads(factor), pixels, batch, landmarks, *place(factor), *arguments)
