"""Fake tensors on the device "cuda", on machines without a GPU.

torch asks a guard of the device before it does anything there, and a torch without CUDA has none. One that does nothing
is compiled here. Fake tensors have shapes, dtypes and devices but no values: tensors of two devices in one operation,
and every look at a value, raise.
"""

import ctypes
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import torch

SOURCE = """
#include <c10/core/impl/DeviceGuardImplInterface.h>
namespace c10::impl { C10_REGISTER_GUARD_IMPL(CUDA, NoOpDeviceGuardImpl<DeviceType::CUDA>) }
"""


@cache
def missing() -> str:
    """Why fake tensors on "cuda" do not work here; empty where they do. The first call compiles the guard."""
    if torch.cuda.is_available():
        return ""
    compiler = shutil.which("c++")
    if sys.platform != "linux" or compiler is None:
        return "there is no C++ compiler, or this is not Linux"
    folder, root = Path(mkdtemp()), Path(torch.__file__).parent
    (folder / "guard.cpp").write_text(SOURCE)
    command = [compiler, "-std=c++20", "-shared", "-fPIC", f"-I{root}/include", "guard.cpp", "-o", "guard.so"]
    done = subprocess.run([*command, f"-L{root}/lib", "-lc10"], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        return f"the guard of the device cannot be compiled: {done.stderr.splitlines()[0]}"
    ctypes.CDLL(str(folder / "guard.so"))
    return ""
