"""Build hook that compiles the C kernels when the package is installed; without them, slower torch code is used.

``CC`` names the compiler; with a cross compiler, such as ``aarch64-linux-gnu-gcc``, the wheel is for its target.
"""

import os
import platform
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = Path("nlfilter_torch", "core", "kernels")
FLAGS = ["-std=gnu11", "-O3", "-fno-math-errno", "-fPIC", "-shared", "-pthread"]
PROCESSORS = ("x86_64", "aarch64")


class CompiledKernels(BuildHookInterface):
    """Adds ``kernels.so`` to the wheel, or to the source tree of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile with ``CC`` or ``cc``, before files are collected."""
        if platform.machine() not in PROCESSORS or sys.platform != "linux":
            self.app.display_info("nlfilter-torch: no kernels in C for this processor or system; torch does their work")
            return
        folder = Path(self.root) / FOLDER
        target = folder / "kernels.so"
        beside = target.with_suffix(".part")
        sources = map(str, sorted(folder.glob("*.c")))
        compiler = shlex.split(os.environ.get("CC", "cc"))
        try:
            subprocess.run([*compiler, *FLAGS, "-o", str(beside), *sources], check=True, capture_output=True, text=True)
            machine = subprocess.run([*compiler, "-dumpmachine"], check=True, capture_output=True, text=True).stdout
        except (OSError, subprocess.CalledProcessError) as error:
            reason = getattr(error, "stderr", None) or error
            target.unlink(missing_ok=True)  # one left from an earlier version may be incompatible
            self.app.display_warning(f"nlfilter-torch: torch does the work of the kernels in C, more slowly: {reason}")
            return
        beside.replace(target)
        build_data["artifacts"].append((FOLDER / "kernels.so").as_posix())
        build_data["pure_python"] = False
        # The library does not use Python's ABI, so that one wheel serves every version of Python.
        processor = machine.partition("-")[0]
        own = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{own if processor == platform.machine() else f'linux_{processor}'}"
