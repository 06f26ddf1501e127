"""Warnings at the line of the user; importing this does not import torch."""

import sys
import warnings
from itertools import takewhile
from traceback import walk_stack


def warn(message: str) -> None:
    """Warn with the location of the line that called this package, through any number of wrappers and modules."""
    frames = walk_stack(sys._getframe())
    packages = (str(frame.f_globals.get("__name__", "")).partition(".")[0] for frame, _ in frames)
    inside = list(takewhile(lambda package: package in ("nlfilter_torch", "torch"), packages))
    warnings.warn(message, stacklevel=1 + len(inside))
