"""Values of functions with their gradients."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.results.inputs import seeded


def with_gradients(function: Callable[..., Any], *tensors: Tensor, parameters: Sequence[Tensor] = ()) -> list[Any]:
    """The value of a function of tensors, without and with gradients, and the gradients of a random sum of its entries.

    Gradients are those in the tensors, and in parameters that the function uses besides.
    """
    with torch.no_grad():
        plain = function(*tensors)
    leaves = [tensor.detach().clone().requires_grad_() for tensor in tensors]
    value = function(*leaves)
    weights = torch.rand(value.shape, generator=seeded(9), dtype=torch.float64).to(value)
    gradients = torch.autograd.grad((value * weights).sum(), [*leaves, *parameters], allow_unused=True)
    return [plain, value, *gradients]
