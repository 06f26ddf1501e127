"""All private parts of torch that this package uses, each with the reason for it, and what is built directly on them.

Other modules use only public parts of torch. A new version of torch may rename or remove private ones at any time:
``make test-oldest`` runs the tests with the oldest supported version, ``make test`` with that of ``constraints.txt``.

Built on them are the tests whether values of tensors can be read, the refusal of transforms under which no operator
can be built, the registration of operators, gradients of low rank, and the memory format of results. Reading a value
(``float(tensor)``, ``if tensor``) makes the CPU wait for an accelerator, and is impossible for tensors without data: on
the device "meta", as fake tensors, under ``torch.compile`` and ``torch.export``. In these cases checks of values are
skipped, and iterations run a fixed number of steps.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar, cast

import torch
import torch.distributed as dist
from torch import Tensor
from torch._C._functorch import (
    _add_batch_dim,
    _remove_batch_dim,
    get_unwrapped,
    is_batchedtensor,
    is_functorch_wrapped_tensor,
    is_gradtrackingtensor,
    is_legacy_batchedtensor,
    maybe_get_level,
    peek_interpreter_stack,
)
from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack
from torch._subclasses.fake_tensor import FakeTensor
from torch.autograd import forward_ad
from torch.utils._pytree import register_pytree_node, tree_map_only

P = ParamSpec("P")
R = TypeVar("R")
Definition = TypeVar("Definition", bound=Callable[..., Any])
Options = TypeVar("Options", bound=type[Any])

OPERATORS = torch.library.Library("nlfilter", "DEF")
DEFINITIONS: dict[Any, Callable[..., Any]] = {}  # of the operators of torch.ops.nlfilter
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


def has_modes() -> bool:
    """Whether a mode is active that changes or watches operations, in this thread alone.

    Autocasting, transforms and forward derivatives, tracing, and modes that users write (which count operations, say).
    """
    written = torch._C._len_torch_dispatch_stack() + torch._C._len_torch_function_stack() > 0
    return written or torch.is_autocast_enabled("cpu") or in_transform() or in_forward_mode() or is_traced()


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


def is_hidden(tensor: Tensor) -> bool:
    """Whether reading values would wait (accelerators) or is impossible (fake, compiling, in ``torch.func``)."""
    return tensor.device.type != "cpu" or is_unreadable(tensor)


def is_unreadable(tensor: Tensor) -> bool:
    """Whether reading values is impossible: without storage, fake, compiling, in ``torch.func``."""
    return tensor.is_meta or torch.compiler.is_compiling() or is_transformed(tensor) or is_fake(tensor)


def cached_constants(function: Callable[P, R]) -> Callable[P, R]:
    """Cache tensors that a function computes from hashable arguments, for later calls in any mode.

    Tensors are created on the CPU and are ordinary ones, even in inference mode or with another default device. Fake
    tensors are not cached, and neither are constants of a compiled program. Nobody may change a cached tensor.
    """

    @wraps(function)
    def made(*args: P.args, **kwargs: P.kwargs) -> R:
        with torch.inference_mode(False), torch.device("cpu"):
            return function(*args, **kwargs)

    cached = cast(Callable[P, R], lru_cache(maxsize=8)(made))

    @wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        return (made if in_fake_mode() else cached)(*args, **kwargs)

    return wrapper


def is_fake(tensor: Tensor) -> bool:
    """Whether a tensor is fake (has a shape but no data), or fake tensor mode is active."""
    return is_fake_tensor(tensor) or in_fake_mode()


def outside_transforms(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function of tensors that ``torch.func`` does not transform as if it were called before the transforms.

    In inference mode it returns ordinary tensors, which later training may use.

    A transform of what is computed from the result then sees a constant. Arguments that are transformed are left to
    the function, which refuses them by :func:`refuse_transforms`. Those that were computed inside a transform, but do
    not depend on what it varies, are constants, too.
    """

    @wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        if torch.is_inference_mode_enabled():
            with torch.inference_mode(False), torch.no_grad():
                return function(*args, **kwargs)
        if not (in_transform() or in_forward_mode()):
            return function(*args, **kwargs)
        args, kwargs = tree_map_only(Tensor, _without_wrapper, (args, kwargs))
        with temporarily_clear_interpreter_stack(), _outside_batches():
            return function(*args, **kwargs)

    return wrapper


def with_tensors(options: Options) -> Options:
    """Let :func:`outside_transforms` see the tensors that are fields of a dataclass."""
    names = [field.name for field in fields(options)]
    register_pytree_node(
        options,
        lambda value: ([getattr(value, name) for name in names], None),
        lambda values, _: options(**dict(zip(names, values, strict=True))),
    )
    return options


@contextmanager
def _outside_batches() -> Iterator[None]:
    """Leave the older ``vmap`` of ``torch.autograd.functional``, in which no random numbers may be drawn."""
    levels = _batch_level()
    for _ in range(levels):
        torch._C._vmapmode_decrement_nesting()
    try:
        yield
    finally:
        for _ in range(levels):
            torch._C._vmapmode_increment_nesting()


def _batch_level() -> int:
    """Number of nested calls of the older ``vmap``, which can only be asked for by starting another."""
    level = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    return level


def _without_wrapper(tensor: Tensor) -> Tensor:
    """The tensor inside the wrappers of derivatives of ``torch.func`` that it does not depend on."""
    while is_gradtrackingtensor(tensor) and not are_derived([tensor]):
        tensor = get_unwrapped(tensor)
    return tensor


def for_each_gradient(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Call the backward pass of an autograd Function once for each of a batch of gradients.

    Batches come from ``is_grads_batched`` and ``vectorize``, and from ``vmap`` of ``torch.autograd.grad``.
    """

    @wraps(backward)
    def wrapper(ctx: Any, *gradients: Tensor) -> Any:
        if torch.compiler.is_compiling() or not any(map(_is_batched, gradients)):
            return backward(ctx, *gradients)
        batched = [_Level.of(gradient) for gradient in gradients]
        level = next(level for level in batched if level is not None)
        first = next(g for g, known in zip(gradients, batched, strict=True) if known is not None)
        size = level.without(first, 1).shape[0]
        slices = zip(*[level.without(gradient, size).unbind() for gradient in gradients], strict=True)
        results = zip(*[backward(ctx, *part) for part in slices], strict=True)
        return tuple(level.stacked(parts) for parts in results)

    return wrapper


def _is_batched(tensor: Tensor) -> bool:
    return is_batchedtensor(tensor) or is_legacy_batchedtensor(tensor)


@dataclass(frozen=True)
class _Level:
    """A level of batching, of ``torch.func`` or of the older one that batched gradients use."""

    legacy: bool
    number: int

    @staticmethod
    def of(tensor: Tensor) -> "_Level | None":
        """The innermost level at which a tensor is batched."""
        if is_batchedtensor(tensor):
            return _Level(False, maybe_get_level(tensor))
        if not is_legacy_batchedtensor(tensor):
            return None
        return _Level(True, _batch_level())

    def without(self, tensor: Tensor, size: int) -> Tensor:
        """The entries of a batch, in the first dimension; copies if the tensor is not batched."""
        remove = torch._remove_batch_dim if self.legacy else _remove_batch_dim
        return remove(tensor, self.number, size, 0)

    def stacked(self, parts: tuple[Any, ...]) -> Tensor | None:
        """A batch of tensors, or None."""
        if parts[0] is None:
            return None
        add = torch._add_batch_dim if self.legacy else _add_batch_dim
        # Gradients that are stored as factors become ordinary tensors.
        return add(torch.stack([part.formed() if hasattr(part, "formed") else part for part in parts]), 0, self.number)


def refuse_transforms(**values: object) -> None:
    """Raise if one of these arguments is transformed in a way that operators cannot be built."""
    if torch.compiler.is_compiling():
        return
    # These three checks take less than a microsecond.
    if is_traced():
        raise TypeError(
            f"{next(iter(values))} must not be traced by torch.jit.trace while an operator is built, got a traced "
            "tensor; use torch.export.export, or trace only the application of an operator built before"
        )
    for name, value in values.items():
        for tensor in value if isinstance(value, tuple) else (value,):
            if not isinstance(tensor, Tensor):
                continue
            if is_transformed(tensor):
                raise TypeError(
                    f"{name} must not be transformed by torch.func (vmap, grad, jvp) while an operator is built, got a "
                    "transformed tensor; pass a batch, and take derivatives with torch.autograd.grad"
                )
            if in_forward_mode() and forward_ad.unpack_dual(tensor).tangent is not None:
                raise TypeError(
                    f"{name} must have no forward-mode derivative while an operator is built, got a tensor with a "
                    "tangent; use reverse mode, with torch.autograd.grad"
                )


def register(
    schema: str,
    compiled: Callable[..., Any] | None,
    fake: Callable[..., Any],
    *,
    differentiable: bool = False,
) -> Callable[[Definition], Definition]:
    """Register a function as the definition of an operator of ``torch.ops.nlfilter``, for all dtypes and devices.

    Args:
        schema: name and signature of the operator.
        compiled: the same computation by a kernel in C, for tensors on CPUs; may return None to leave it to the
            definition. None if there is no kernel.
        fake: returns uninitialised results for the shapes of the arguments.
        differentiable: whether the definition consists of differentiable operations. Autograd, in reverse and forward
            mode and of any order, and the transforms of ``torch.func`` then see these operations.
    """
    name = schema.partition("(")[0]

    def decorate(definition: Definition) -> Definition:
        def on_processors(*arguments: Any) -> Any:
            result = None if compiled is None else compiled(*arguments)
            return definition(*arguments) if result is None else result

        def under_autograd(keys: Any, *arguments: Any) -> Any:
            if are_derived(arguments):
                return definition(*arguments)
            keys = keys & BELOW_AUTOGRAD
            if is_on_cpu(keys):  # same as redispatching, but saves 4 us
                return on_processors(*arguments)
            return operator.redispatch(keys, *arguments)

        OPERATORS.define(schema)
        OPERATORS.impl(name, definition, "CompositeExplicitAutograd")
        OPERATORS.impl(name, on_processors, "CPU")
        torch.library.register_fake(f"nlfilter::{name}", fake, lib=OPERATORS)
        operator = getattr(torch.ops.nlfilter, name).default
        DEFINITIONS[operator] = definition
        if differentiable:
            OPERATORS.impl(name, under_autograd, "Autograd", with_keyset=True)
            OPERATORS.impl(name, definition, "FuncTorchBatched")
        return cast(Definition, operator)

    return decorate


def are_derived(arguments: Sequence[Any]) -> bool:
    """Whether one of the arguments requires a gradient or has a forward-mode derivative."""
    if torch.is_grad_enabled():
        for argument in arguments:  # before every product; a loop takes half the time of a generator
            if isinstance(argument, Tensor) and argument.requires_grad:
                return True
    if not in_forward_mode():
        return False
    return any(isinstance(t, Tensor) and forward_ad.unpack_dual(t).tangent is not None for t in arguments)


class OuterProduct(Tensor):
    """A low-rank gradient ``left @ right`` of the factor, evaluated only when needed.

    The gradients of products with W and of balancing are low-rank matrices (B, M, N). When autograd adds them, their
    factors are concatenated, and the backward pass of the Nystrom factor evaluates the sum block by block. This saves
    three copies of the factor. Any other operation sees an ordinary tensor.

    Attributes:
        left: (B, M, r).
        right: (B, r, N).
    """

    left: Tensor
    right: Tensor

    @staticmethod
    def __new__(cls, left: Tensor, right: Tensor) -> "OuterProduct":
        """Create a tensor that has the shape of the product but owns no memory."""
        shape = (left.shape[0], left.shape[1], right.shape[2])
        product = cast(OuterProduct, without_memory(cls, shape, left))
        product.left, product.right = left, right
        return product

    def formed(self) -> Tensor:
        """The product as an ordinary tensor, (B, M, N)."""
        return torch.bmm(self.left, self.right)

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        if func is torch.ops.aten.detach.default:
            return args[0]
        if func is torch.ops.aten.add.Tensor and not kwargs and all(isinstance(a, OuterProduct) for a in args):
            left = torch.cat([a.left for a in args], dim=2)
            return OuterProduct(left, torch.cat([a.right for a in args], dim=1))
        args, kwargs = replace_instances(OuterProduct, OuterProduct.formed, (args, kwargs or {}))
        return func(*args, **kwargs)


def outer_product(left: Tensor, right: Tensor) -> Tensor:
    """``left @ right``, stored as its two factors if they are smaller than the product."""
    if left.shape[2] >= left.shape[1] or torch.compiler.is_compiling():
        return torch.bmm(left, right)
    return OuterProduct(left, right)


def factors_of(gradient: Tensor) -> tuple[Tensor, ...]:
    """Factors (B, M, r) and (B, r, N) of a low-rank gradient, or the gradient itself as a tuple of one."""
    return (gradient.left, gradient.right) if isinstance(gradient, OuterProduct) else (gradient,)


def in_format_of(result: Tensor, image: Tensor) -> Tensor:
    """Convert a result (B, C, *size) to the dtype of ``image``, and to channels-last if ``image`` is."""
    result = result.to(image.dtype)
    channels_last = {4: torch.channels_last, 5: torch.channels_last_3d}.get(image.ndim)
    if image.is_contiguous() or channels_last is None:
        return result
    # Dynamo cannot trace this, and has no such tensors.
    if not torch.compiler.is_compiling() and any(map(is_transformed, (image, result))):
        return result
    is_last = image.is_contiguous(memory_format=channels_last)
    return result.contiguous(memory_format=channels_last) if is_last else result
