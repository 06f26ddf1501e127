"""Command lines, run in a folder of small pictures: exit status, printed text, and the files they write."""

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.results import digests, inputs
from benchmarks.results.command_lines import RIGHT, WRONG
from benchmarks.results.digests import Digest
from nlfilter_torch.__main__ import main

Stamps = dict[Path, int]  # times of the last change of files, in nanoseconds

TERMINAL = {"COLUMNS": "120", "TERMINAL_WIDTH": "120", "TERM": "dumb", "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}


def results() -> Iterator[tuple[str, Digest]]:
    """The results of all command lines, by these, and the inputs that they read."""
    os.environ |= TERMINAL | {"PYTHONPATH": str(digests.SOURCE.parent)}
    before = Path.cwd()
    with TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            here = Path(folder)
            inputs.write_files(here)
            yield "inputs", {str(path): digests.hashed((here / path).read_bytes()) for path in sorted(stamps(here))}
            yield from of_lines(here)
        finally:
            os.chdir(before)


def of_lines(folder: Path) -> Iterator[tuple[str, Digest]]:
    """The results of command lines; the first of every command has a process of its own, with imports of its own."""
    seen: set[str] = set()
    for line in lines(RIGHT) + lines(WRONG):
        arguments = shlex.split(line)
        yield line, of_line(arguments, folder, alone=arguments[0] not in seen)
        seen.add(arguments[0])
    for command in sorted(name for name in seen if name.isalpha() and name != "embellish"):
        yield f"{command} --help", of_line([command, "--help"], folder, alone=False)


def lines(text: str) -> list[str]:
    """The command lines of a text, without empty lines and comments."""
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def of_line(arguments: list[str], folder: Path, *, alone: bool) -> Digest:
    """The result of a command line, run in a process of its own if it is ``alone``."""
    before = stamps(folder)
    status, printed, told = (in_own_process if alone else in_this_process)(arguments)
    return {
        "status": str(status),
        "output": digests.of_text(printed, folder),
        "errors": digests.of_text(told, folder),
        "files": written(before, stamps(folder), folder),
    }


def in_own_process(arguments: list[str]) -> tuple[int, str, str]:
    """Run a command line as a program; return its exit status, output and errors."""
    program = [sys.executable, "-m", "nlfilter_torch", *arguments]
    ended = subprocess.run(program, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    return ended.returncode, ended.stdout, ended.stderr


def in_this_process(arguments: list[str]) -> tuple[int, str, str]:
    """Run a command line by the function that the program calls, which saves the time to import torch."""
    output, errors = StringIO(), StringIO()
    with redirect_stdout(output), redirect_stderr(errors):
        try:
            status = main(arguments)
        except Exception as error:  # that the program does not expect
            status = 1
            errors.write(f"{type(error).__name__}: {error}\n")
    return status, output.getvalue(), errors.getvalue()


def stamps(folder: Path) -> Stamps:
    """The files in a folder, with the times of their last change."""
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def written(before: Stamps, after: Stamps, folder: Path) -> dict[str, Digest]:
    """Digests of the files that were written, and the names of those that were removed."""
    changed = {whole(path) for path, time in after.items() if before.get(path) != time}
    removed = {whole(path) for path in before.keys() - after.keys()} - changed
    contents = {str(path): digests.of_file(folder / path, folder) for path in sorted(changed)}
    return contents | {str(path): "removed" for path in sorted(removed)}


def whole(path: Path) -> Path:
    """The array of zarr that a file belongs to, or the file."""
    return next((parent for parent in path.parents if parent.suffix == ".zarr"), path)
