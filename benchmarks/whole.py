"""Every command from the start of its process to its file: ``python -m benchmarks.whole [--megapixels 0.3 1 12 24]``.

Prints processor and wall seconds and the most memory that the process had at once, as the kernel accounts for them.
Beside ``detail``, G'MIC and darktable do the task nearest to it, if they are installed. ``--quick`` runs two commands
on a picture of 4,000 pixels.
"""

import argparse
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import skimage.data
import torch
import torch.nn.functional as F

from benchmarks import editors
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
COMMANDS = (*EDITS, "mask", "apply", "fit", "batch", "frames", "inspect", "demo", "presets")


def photograph(megapixels: float) -> torch.Tensor:
    """The cat at another size, (1, 3, H, W), 3:2."""
    height = round((megapixels * 1e6 / 1.5) ** 0.5)
    pixels = torch.from_numpy(skimage.data.chelsea().copy()).permute(2, 0, 1)[None].float() / 255
    return F.interpolate(pixels, size=(height, round(1.5 * height)), mode="bicubic", antialias=True).clamp(0, 1)


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
    pixels = photograph(megapixels)
    (folder / "photos").mkdir()
    write_photograph(Photograph(pixels), folder / "photo.jpg")
    shutil.copy(folder / "photo.jpg", folder / "photos" / "photo.jpg")
    write_photograph(Photograph(pixels**0.7), folder / "brighter.jpg")
    recipe = Recipe((Step("detail", alpha=(2.0, 2.0, 2.0, 1.0)), Step("tone", contrast=1.2)))
    (folder / "edit.json").write_text(recipe.to_json())


def measure(command: str, call: list[str], folder: Path) -> tuple[float, float, float]:
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.3, 1.0, 12.0, 24.0])
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS), metavar="COMMAND")
    parser.add_argument("--quick", action="store_true", help="detail and presets at 0.004 megapixels")
    options = parser.parse_args(arguments)
    if options.quick:
        options.megapixels = [0.004]
        options.commands = [command for command in options.commands if command in ("detail", "presets")]
    peers = editors.installed() if "detail" in options.commands else {}
    print(f"{'':14}{'megapixels':>11}{'CPU s':>9}{'wall s':>9}{'peak MB':>10}")
    for megapixels in options.megapixels:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            # In another process, since the kernel counts the peak of this one as one of the commands.
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as other:
                other.submit(prepare, folder, megapixels).result()
            calls = {
                command: [sys.executable, "-m", "nlfilter_torch", command, *arguments_of(command, folder)]
                for command in options.commands
            }
            files = folder / "photo.jpg", folder / "out" / "out.png"
            calls |= {name: peer(*files, folder) for name, peer in peers.items()}
            for command, call in calls.items():
                cpu, wall, peak = measure(command, call, folder)
                print(f"{command:14}{megapixels:11.3g}{cpu:9.1f}{wall:9.1f}{peak:10.0f}", flush=True)


if __name__ == "__main__":
    main()
