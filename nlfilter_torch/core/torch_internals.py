"""All private parts of torch that this package uses, each with the reason for it; elsewhere only public ones are used.

A new version of torch may rename or remove any of them. ``make test-oldest`` runs the tests with the oldest supported
version of torch, ``make test`` with the one in ``constraints.txt``.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor, peek_interpreter_stack
from torch._subclasses.fake_tensor import FakeTensor
from torch.autograd import forward_ad
from torch.utils._python_dispatch import _disable_current_modes
from torch.utils._pytree import tree_map_only

_FAKE = torch._C._TorchDispatchModeKey.FAKE

# An operator that sees the dispatch keys of a call can call its own kernel for CPUs. Without private parts it would
# have to be called a second time, from the start of the dispatcher.
CPU_KEY = torch._C.DispatchKey.CPU
BELOW_AUTOGRAD = torch._C._after_autograd_keyset


def is_transformed(tensor: Tensor) -> bool:
    """Whether a tensor is wrapped by a transform of ``torch.func``: it has no memory, and its values cannot be read.

    Such tensors are instances of ``Tensor`` itself, and no public function tells them from others.
    """
    return is_functorch_wrapped_tensor(tensor)


def in_transform() -> bool:
    """Whether a transform of ``torch.func`` is active, also where no tensor is wrapped by it."""
    return peek_interpreter_stack() is not None


def in_forward_mode() -> bool:
    """Whether a forward-mode derivative is being computed.

    The public ``unpack_dual`` answers this for one tensor at a time, and is too slow to precede every product.
    """
    return forward_ad._current_level >= 0


def is_traced() -> bool:
    """Whether ``torch.jit.trace`` is running; the public ``torch.jit.is_tracing`` takes twice as long."""
    return torch._C._is_tracing()


def is_fake_tensor(tensor: Tensor) -> bool:
    """Whether a tensor has a shape but no data; the class has no public name."""
    return isinstance(tensor, FakeTensor)


def in_fake_mode() -> bool:
    """Whether tensors that are created now are fake; there is no public question."""
    return torch._C._get_dispatch_mode(_FAKE) is not None


def outside_modes() -> AbstractContextManager[Any]:
    """Context in which constants of an exported program are computed as ordinary tensors, outside its fake mode."""
    return _disable_current_modes()


def is_on_cpu(keys: Any) -> bool:
    """Whether an operator called with these dispatch keys runs on a CPU next."""
    return keys.highestPriorityTypeId() == CPU_KEY


def without_memory(cls: type, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Instance of a subclass of ``Tensor`` with a shape but no memory, for which torch has no public constructor."""
    return Tensor._make_wrapper_subclass(cls, shape, dtype=like.dtype, device=like.device)


def replace_instances(cls: type, function: Callable[[Any], Any], values: Any) -> Any:
    """Replace all instances of a class in nested lists, tuples and dictionaries, as ``torch.func`` does."""
    return tree_map_only(cls, function, values)


def default_store() -> Any:
    """The store through which the processes of the default group met; only it tells which of them still answer."""
    return dist.distributed_c10d._get_default_store()
