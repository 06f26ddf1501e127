"""Exclude code from ``torch.compile``: data-dependent control flow, and loops over blocks of pixels."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


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
