"""Compiles the kernels in C when the package is installed; where that cannot be, torch does their work, more slowly."""

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


class CompiledKernels(BuildHookInterface):
    """Adds ``kernels.so`` to the wheel, or to the source tree of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile with ``CC`` or ``cc``; called before files are collected."""
        if platform.machine() != "x86_64" or sys.platform != "linux":
            self.app.display_info("nlfilter-torch: no kernels in C for this processor or system; torch does their work")
            return
        folder = Path(self.root) / FOLDER
        target = folder / "kernels.so"
        beside = target.with_suffix(".part")
        sources = map(str, sorted(folder.glob("*.c")))
        command = [*shlex.split(os.environ.get("CC", "cc")), *FLAGS, "-o", str(beside), *sources]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except (OSError, subprocess.CalledProcessError) as error:
            reason = getattr(error, "stderr", None) or error
            target.unlink(missing_ok=True)  # one of an earlier version may not fit this one
            self.app.display_warning(f"nlfilter-torch: torch does the work of the kernels in C, more slowly: {reason}")
            return
        beside.replace(target)
        build_data["artifacts"].append((FOLDER / "kernels.so").as_posix())
        build_data["pure_python"] = False
        # The library knows nothing of Python, so that one wheel serves every version of it.
        build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
