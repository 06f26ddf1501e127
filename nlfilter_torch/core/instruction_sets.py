"""The compiled kernels, and the instruction set they use here; told without torch, which takes seconds to import."""

import ctypes
from pathlib import Path

NAMES = ("none", "AVX2", "AVX-512")


def load_library() -> ctypes.CDLL | None:
    """The compiled library of :mod:`nlfilter_torch.core.kernels`, if the installation has one."""
    path = Path(__file__).with_name("kernels") / "kernels.so"
    return ctypes.CDLL(str(path)) if path.exists() else None


def level(library: ctypes.CDLL | None) -> int:
    """What this processor and the library can do, as an index of :data:`NAMES`."""
    return 0 if library is None else int(library.nlfilter_level())
