"""Gradients of low rank, stored as their two factors."""

from typing import Any, cast

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import replace_instances, without_memory


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
