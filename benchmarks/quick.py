"""Benchmarks on small sizes, to check that they run: ``python -m benchmarks.quick < LINES``, one benchmark a line.

Each line is what follows ``python -m benchmarks.``, or begins with ``docs.``. Each benchmark has a process of its own,
as many at once as there are cores, forked from one that has imported torch and the library, as the imports take longer
than many of them. Prints what each has printed once it has ended, and returns 1 if one fails.
"""

import multiprocessing
import os
import runpy
import shlex
import sys
import tempfile
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import IO

import skimage.measure  # noqa: F401
import torch  # noqa: F401
from kornia import color, filters  # noqa: F401

from benchmarks import harness  # noqa: F401
from nlfilter_torch.photo.edits import applying  # noqa: F401


def run(line: str, output: IO[bytes]) -> None:
    """Run a benchmark in this process, which prints to a file from now on."""
    for stream in (sys.stdout, sys.stderr):
        os.dup2(output.fileno(), stream.fileno())
    name, *arguments = shlex.split(line)
    sys.argv = [name, *arguments]
    runpy.run_module(name if name.startswith("docs.") else f"benchmarks.{name}", run_name="__main__", alter_sys=True)


def main(lines: list[str]) -> int:
    """Run the benchmarks, and return 1 if one of them fails."""
    fork, failed = multiprocessing.get_context("fork"), False
    running: dict[int, tuple[BaseProcess, str, IO[bytes]]] = {}  # by the sentinel of the process
    while lines or running:
        while lines and len(running) < (os.cpu_count() or 1):
            line, output = lines.pop(0), tempfile.TemporaryFile()  # noqa: SIM115, closed when the process has ended
            process = fork.Process(target=run, args=(line, output))
            process.start()
            running[process.sentinel] = (process, line, output)
        for sentinel in wait(list(running)):
            assert isinstance(sentinel, int)
            process, line, output = running.pop(sentinel)
            process.join()
            with output:
                output.seek(0)
                print(line, output.read().decode(), sep="\n", flush=True)
            failed = failed or process.exitcode != 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main([line.strip() for line in sys.stdin if line.strip()]))
