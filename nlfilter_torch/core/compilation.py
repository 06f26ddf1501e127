"""What ``torch.compile`` is to leave alone: code whose course depends on values, and loops over blocks of pixels."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def uncompiled(function: Callable[P, R]) -> Callable[P, R]:
    """Run ``function`` as it is inside compiled code, at the price of one break of the graph.

    :func:`torch.compiler.disable` as a decorator would do the same, and import the compiler with this package.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return wrapper
