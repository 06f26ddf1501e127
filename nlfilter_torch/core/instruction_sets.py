"""Loading the compiled kernels and finding their instruction set, without importing torch, which takes seconds."""

import ctypes
import platform
from pathlib import Path

NAMES = ("none", "NEON") if platform.machine() in ("aarch64", "arm64") else ("none", "AVX2", "AVX-512")


def load_library() -> ctypes.CDLL | None:
    """Load the compiled library of :mod:`nlfilter_torch.core.kernels`, if it is installed."""
    path = Path(__file__).with_name("kernels") / "kernels.so"
    return ctypes.CDLL(str(path)) if path.exists() else None


def level(library: ctypes.CDLL | None) -> int:
    """Best instruction set that both this processor and the library support, as an index of :data:`NAMES`."""
    return 0 if library is None else int(library.nlfilter_level())
