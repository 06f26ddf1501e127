"""Time, memory and accuracy of tiled stroke edits: ``python -m benchmarks.streaming_strokes``.

The mosaic of ``benchmarks.streaming``, with some strokes on it, is recoloured and colourised from file to file, each in
a fresh process, and measured as in that module. ``--quick`` runs everything on a fraction of a megapixel.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.memory import MIB, forget_peak, resident
from benchmarks.streaming import mosaic, write_mosaic
from nlfilter_torch.photo import Drawn, Step, colorize, recolor, stream
from nlfilter_torch.photo.edits.applying import fit_step
from nlfilter_torch.photo.files.rows import open_picture, write_picture
from nlfilter_torch.photo.picture.colour import colour_guide, split_luminance
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes

VERBS = ("recolor", "colorize")
BOXES = (  # (top, left, height, width) as shares of the picture, and RGB
    ((0.25, 0.25, 0.02, 0.03), (0, 0, 255)),
    ((0.70, 0.60, 0.02, 0.02), (255, 0, 0)),
    ((0.10, 0.80, 0.03, 0.01), (0, 180, 50)),
    ((0.85, 0.15, 0.02, 0.04), (0, 0, 255)),
)


@dataclass(frozen=True)
class Boxes:
    """Strokes (h, W, 4) with transparency; rows are drawn on request."""

    shape: tuple[int, int, int]
    dtype = np.dtype(np.uint8)

    def __getitem__(self, rows: slice) -> NDArray[np.uint8]:
        """The rows from ``rows.start`` to ``rows.stop``."""
        strokes = np.zeros((rows.stop - rows.start, *self.shape[1:]), self.dtype)
        for place, colour in BOXES:
            top, left, height, width = (
                round(share * side) for share, side in zip(place, 2 * self.shape[:2], strict=True)
            )
            inside = slice(max(top - rows.start, 0), max(top + height - rows.start, 0))
            strokes[inside, left : left + width] = (*colour, 255)
        return strokes


def work(verb: str, source: Path, target: Path, memory: int) -> dict[str, Any]:
    """Edit a file in this process, and return time and memory."""
    colour_guide(torch.zeros(1, 3, 1, 1))  # imports kornia
    forget_peak()
    before, started = resident("VmRSS"), time.process_time()
    with open_picture(source, memory) as picture:
        height, width, _ = picture.shape
        tiled = Tiled(Picture(picture.rows), Passes("uint8", memory=memory))
        write_picture(
            target, tiled.rows(fit_step(Step(verb), tiled, Drawn({}, Boxes((height, width, 4))))), "uint8", picture
        )
    return {
        "verb": verb,
        "megapixels": height * width / 1e6,
        "cpu_s": time.process_time() - started,
        "peak_mib": resident("VmHWM") - before,
    }


def exactness(side: int) -> list[str]:
    """Largest differences between tiled and in-memory results of each edit, as lines of text."""
    picture = np.concatenate(list(mosaic(side, side))).astype(np.float32) / np.float32(255)
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    layer = Boxes((side, side, 4))[slice(0, side)].astype(np.float32) / np.float32(255)
    strokes = torch.from_numpy(layer).permute(2, 0, 1)[None]
    lines = []
    for verb, whole in (
        ("recolor", recolor(image, strokes[:, :3], strokes[:, 3:])),
        ("colorize", colorize(split_luminance(image)[0], strokes[:, :3], strokes[:, 3:])),
    ):
        wanted = whole[0].permute(1, 2, 0).numpy()

        def edited(verb: str = verb, **options: Any) -> NDArray[np.float32]:
            rows = np.empty_like(picture)
            stream(Step(verb), picture, rows, drawn=Drawn({}, layer), **options)
            return rows

        sampled = edited(sample=side * side // 4, tile_rows=64)
        other = np.abs(edited(sample=side * side // 4, tile_rows=1000) - sampled).max()
        error, full = np.abs(sampled - wanted), np.abs(edited(statistics="full") - wanted).max()
        lines.append(
            f"{verb}, {side * side / 1e6:.2f} MP: a quarter as sample is off by {255 * error.max():.2f} of 255 at most "
            f"(RMS {255 * np.sqrt(np.square(error, dtype=np.float64).mean()):.3f}), full passes by {full:.1e} of "
            f"white; tiles of 64 and 1000 rows differ by {other:.1e}"
        )
    return lines


def main() -> None:
    """Measure, and print the results."""
    parser = argparse.ArgumentParser(description="Time, memory and accuracy of tiled stroke edits.")
    parser.add_argument("--quick", action="store_true", help="a fraction of a megapixel, to check that it runs")
    parser.add_argument("--work", nargs=3, metavar=("VERB", "IN", "OUT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        verb, source, target = options.work
        print(json.dumps(work(verb, Path(source), Path(target), 800 * MIB)))
        return
    print("| edit | megapixels | CPU, s | s per MP | peak over start, MiB |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        source, target = Path(name) / "in.tif", Path(name) / "out.tif"
        for side in (200,) if options.quick else (2048, 5000):
            write_mosaic(source, side)
            for verb in VERBS:
                command = [sys.executable, "-m", "benchmarks.streaming_strokes", "--work", verb]
                done = subprocess.run([*command, str(source), str(target)], check=True, capture_output=True, text=True)
                run = json.loads(done.stdout.splitlines()[-1])
                cpu, pixels = run["cpu_s"], run["megapixels"]
                print(f"| {verb} | {pixels:.1f} | {cpu:.1f} | {cpu / pixels:.2f} | {run['peak_mib']:.0f} |", flush=True)
    print("\n" + "\n".join(exactness(200 if options.quick else 2048)))


if __name__ == "__main__":
    main()
