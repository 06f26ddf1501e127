"""What commands take from the start of their process to their file: ``python -m benchmarks.commands [whole]``.

Without a word: seconds of the processor with one thread, each the median of five processes after another that warms
caches: the help, the import of torch, edits of a tiny picture, which are little more than a start, and ``inspect`` of
0.4 megapixels. ``whole``: every command on photographs of ``--megapixels``: processor and wall seconds and the most
memory that the process had at once, as the kernel accounts for them; beside ``detail``, G'MIC and darktable do the task
nearest to it, if they are installed.
"""

import argparse
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from statistics import median
from subprocess import DEVNULL, run
from tempfile import TemporaryDirectory

from benchmarks import editors
from benchmarks.harness import Figure, options, report, save_picture
from benchmarks.photographs import enlarged
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph

SCRIBBLE, OTHER = "45%,45%,6%,6%", "5%,5%,6%,6%"
OPTIONS: dict[str, list[str]] = {
    "colorize": ["--region", f"{SCRIBBLE}:red", "--region", f"{OTHER}:blue"],
    "recolor": ["--region", f"{SCRIBBLE}:blue"],
    "defocus": ["--region", SCRIBBLE],
    "mask": ["--region", SCRIBBLE],
    "detail": ["--alpha", "2,2,2,1"],
    "look": ["--alpha", "2,1.5,1,1"],
}
INSPECT = 4.0  # seconds, at most
PROGRAM = ("-m", "nlfilter_torch")
COMMANDS = (*EDITS, "mask", "apply", "fit", "batch", "frames", "inspect", "demo", "presets")


def arguments_of(command: str, folder: Path) -> list[str]:
    """What a command is called with, in a folder prepared by :func:`prepare`."""
    source, target = str(folder / "photo.jpg"), str(folder / "out" / "out.png")
    if command == "apply":
        return [source, target, "--preset", str(folder / "edit.json")]
    if command == "fit":
        return [source, str(folder / "brighter.jpg"), str(folder / "out" / "look.json")]
    if command in ("batch", "frames"):
        return [str(folder / "photos"), str(folder / "out" / "folder"), "--preset", "crisp"]
    if command in ("inspect", "demo"):
        return [*([source] if command == "inspect" else []), str(folder / "out" / "pictures")]
    if command == "presets":
        return []
    return [source, target, *OPTIONS.get(command, [])]


def prepare(folder: Path, megapixels: float) -> None:
    """A photograph, the same in a folder, a brighter version, and an edit."""
    height = round((megapixels * 1e6 / 1.5) ** 0.5)
    pixels = enlarged("chelsea", height, round(1.5 * height))
    (folder / "photos").mkdir()
    write_photograph(Photograph(pixels), folder / "photo.jpg")
    shutil.copy(folder / "photo.jpg", folder / "photos" / "photo.jpg")
    write_photograph(Photograph(pixels**0.7), folder / "brighter.jpg")
    recipe = Recipe((Step("detail", alpha=(2.0, 2.0, 2.0, 1.0)), Step("tone", contrast=1.2)))
    (folder / "edit.json").write_text(recipe.to_json())


def cost(command: str, call: list[str], folder: Path) -> tuple[float, float, float]:
    """Processor and wall seconds of a call of a command, and its peak memory in MB.

    Raises:
        SystemExit: if it fails, with what it said.
    """
    (folder / "out").mkdir()
    start = time.perf_counter()
    with (folder / "said.txt").open("w") as said:
        process = subprocess.Popen(call, stdout=said, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - start
    if process.returncode:
        raise SystemExit(f"{command} ended with {process.returncode}: {(folder / 'said.txt').read_text()}")
    if command != "presets" and not any((folder / "out").iterdir()):
        raise SystemExit(f"{command} wrote no file")
    shutil.rmtree(folder / "out")
    return usage.ru_utime + usage.ru_stime, wall, usage.ru_maxrss * 1024 / 1e6


def processor_seconds(repeats: int, *arguments: str) -> float:
    """Seconds of the processor that Python takes with these arguments, the median of several processes."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    taken = []
    for _ in range(repeats + 1):
        before = getrusage(RUSAGE_CHILDREN)
        run([sys.executable, *arguments], check=True, stdout=DEVNULL, stderr=DEVNULL, env=environment)
        after = getrusage(RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return median(taken[1:])


def starts(folder: Path, repeats: int, *, quick: bool) -> Iterator[Figure]:
    """Measure commands on pictures in a folder."""
    tiny, large, out = (str(folder / name) for name in ("tiny.png", "large.png", "out.png"))
    for path, size in ((tiny, (48, 64)), (large, (55, 73) if quick else (548, 730))):
        save_picture(Path(path), enlarged("astronaut", *size))
    yield Figure("--help", processor_seconds(repeats, *PROGRAM, "--help"), unit="s")
    yield Figure("import of torch", processor_seconds(repeats, "-c", "import torch"), unit="s")
    for edit in ("sharpen", "denoise"):
        yield Figure(f"{edit} of 64x48 pixels", processor_seconds(repeats, *PROGRAM, edit, tiny, out), unit="s")
    inspected = processor_seconds(repeats, *PROGRAM, "inspect", large, str(folder / "inspected"))
    yield Figure("inspect of 0.4 megapixels", inspected, INSPECT, unit="s")


def whole(chosen: argparse.Namespace) -> None:
    """Print the cost of every command."""
    peers = editors.installed() if "detail" in chosen.commands else {}
    print(f"{'':14}{'megapixels':>11}{'CPU s':>9}{'wall s':>9}{'peak MB':>10}")
    for megapixels in chosen.megapixels:
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            # In another process, since the kernel counts the peak of this one as one of the commands.
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as other:
                other.submit(prepare, folder, megapixels).result()
            calls = {
                command: [sys.executable, *PROGRAM, command, *arguments_of(command, folder)]
                for command in chosen.commands
            }
            files = folder / "photo.jpg", folder / "out" / "out.png"
            calls |= {name: peer(*files, folder) for name, peer in peers.items()}
            for command, call in calls.items():
                cpu, wall, peak = cost(command, call, folder)
                print(f"{command:14}{megapixels:11.3g}{cpu:9.1f}{wall:9.1f}{peak:10.0f}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a figure falls short of its limit."""
    parser = options("commands", __doc__, "small pictures, once")
    parser.add_argument("suite", nargs="?", choices=("starts", "whole"), default="starts")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.3, 1.0, 12.0, 24.0], help="of whole")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS), metavar="COMMAND")
    chosen = parser.parse_args(arguments)
    if chosen.suite == "whole":
        if chosen.quick:
            chosen.megapixels = [0.004]
            chosen.commands = [command for command in chosen.commands if command in ("detail", "presets")]
        whole(chosen)
        return 0
    with TemporaryDirectory() as folder:
        return report(starts(Path(folder), 1 if chosen.quick else 5, quick=chosen.quick), quick=chosen.quick)


if __name__ == "__main__":
    sys.exit(main())
