"""Whether values of tensors can be read, and which transforms of torch a computation can run under.

Reading a value (``float(tensor)``, ``if tensor``) makes a processor wait for an accelerator, and is impossible where
tensors have shapes alone: on the device "meta", as fake tensors, under ``torch.compile`` and ``torch.export``. Checks
of values are skipped there, and iterations run a fixed number of steps.
"""

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor, peek_interpreter_stack
from torch._subclasses.fake_tensor import FakeTensor
from torch.autograd import forward_ad

_FAKE = torch._C._TorchDispatchModeKey.FAKE


def is_hidden(tensor: Tensor) -> bool:
    """Whether values cannot be read, or not without waiting: on accelerators, fake, compiling, in ``torch.func``."""
    return (
        tensor.device.type != "cpu"
        or torch.compiler.is_compiling()
        or is_functorch_wrapped_tensor(tensor)
        or is_fake(tensor)
    )


def is_fake(tensor: Tensor) -> bool:
    """Whether a tensor has a shape alone, or tensors made now will."""
    return isinstance(tensor, FakeTensor) or torch._C._get_dispatch_mode(_FAKE) is not None


def refuse_transforms(name: str, *values: object) -> None:
    """Raise if an operator would be built from ``values`` under a transform that cannot follow it.

    Args:
        name: of the first of the values.
        *values: what derivatives may be wanted of, tensors or not.
    """
    if torch.compiler.is_compiling():
        return
    # Reading these three takes less than a microsecond.
    if torch._C._is_tracing():
        raise TypeError(
            f"{name} must not be traced by torch.jit.trace while an operator is built, got a traced tensor; "
            "use torch.export.export, or trace only the application of an operator built before"
        )
    if forward_ad._current_level < 0 and peek_interpreter_stack() is None:
        return
    for value in values:
        if not isinstance(value, Tensor):
            continue
        if is_functorch_wrapped_tensor(value):
            raise TypeError(
                f"{name} must not be transformed by torch.func (vmap, grad, jvp) while an operator is built, got a "
                "transformed tensor; pass a batch, and take derivatives with torch.autograd.grad"
            )
        if forward_ad.unpack_dual(value).tangent is not None:
            raise TypeError(
                f"{name} must have no forward-mode derivative while an operator is built, got a tensor with a tangent; "
                "use reverse mode, with torch.autograd.grad"
            )
