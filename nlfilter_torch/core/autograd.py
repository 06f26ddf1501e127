"""Helpers for hand-written derivatives: low-rank gradients, and an error for second derivatives."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from nlfilter_torch.core.precision import full_precision

Gradients = tuple[Tensor | None, ...]


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
        product: OuterProduct = Tensor._make_wrapper_subclass(cls, shape, dtype=left.dtype, device=left.device)
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
        args, kwargs = tree_map_only(OuterProduct, OuterProduct.formed, (args, kwargs or {}))
        return func(*args, **kwargs)


def outer_product(left: Tensor, right: Tensor) -> Tensor:
    """``left @ right``, stored as its two factors if they are smaller than the product."""
    if left.shape[2] >= left.shape[1] or torch.compiler.is_compiling():
        return torch.bmm(left, right)
    return OuterProduct(left, right)


def factors_of(gradient: Tensor) -> tuple[Tensor, ...]:
    """Factors (B, M, r) and (B, r, N) of a low-rank gradient, or the gradient itself as a tuple of one."""
    return (gradient.left, gradient.right) if isinstance(gradient, OuterProduct) else (gradient,)


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
            found = exact(ctx, *gradients)
        if not torch.is_grad_enabled() or torch.compiler.is_compiling():
            return found
        formed = [g.formed() if isinstance(g, OuterProduct) else g for g in found if g is not None]
        # Connected to everything the gradients depend on: autograd visits only nodes on a path to a requested tensor.
        causes = [t for t in (*ctx.saved_tensors, *gradients) if t is not None and t.requires_grad]
        refused = iter(_Refusal.apply(len(formed), *formed, *causes))  # type: ignore[no-untyped-call]
        return tuple(None if g is None else next(refused) for g in found)

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
