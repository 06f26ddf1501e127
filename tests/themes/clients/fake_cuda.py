"""Fake tensors on the device "cuda", on machines without a GPU.

torch requires a device guard for operations on a device, and a build without CUDA has none for it. A guard that does
nothing is compiled here. Fake tensors have shapes, dtypes and devices but no values: operations on tensors of two
devices, and reading a value, raise an error.
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
    """Return why fake tensors on "cuda" do not work here, empty if they do. The first call compiles the guard."""
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
