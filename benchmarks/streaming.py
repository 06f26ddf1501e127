"""Time, memory and accuracy of tiled filtering: ``python -m benchmarks.streaming``.

A mosaic of photographs, each piece randomly rotated, darkened or lightened and textured, is written to a BigTIFF file;
a fresh process filters it into another file. Time is CPU time, summed over cores, so that other programs affect it
little. Peaks are the kernel's (VmHWM; Linux only), minus the memory that is resident after the program and its
libraries are loaded. ``--quick`` runs everything on a fraction of a megapixel.
"""

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import tifffile
import torch
from numpy.typing import NDArray

from benchmarks.memory import MIB, forget_peak, resident
from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.photo import Drawn, Step, stream
from nlfilter_torch.photo.declared.steps import working_bytes
from nlfilter_torch.photo.edits.applying import fit_step
from nlfilter_torch.photo.files.rows import open_picture, write_picture
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import SAMPLE, Passes, Statistics

ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.05])
PLAIN: dict[str, Any] = {  # the filter without limits or threshold, in pixels of the file
    "limits": "none",
    "threshold": 0.0,
    "viewing_size": 0.0,
    "bandwidth": "auto",
    "spatial_bandwidth": "none",
    "landmarks": 100,
}
DETAIL = Step("detail", alpha=tuple(ALPHA.tolist()), **PLAIN)
PIECE = 256  # side of a piece of the mosaic
NAMES = ("astronaut", "chelsea", "coffee", "rocket", "camera", "moon", "coins", "page", "brick", "grass", "gravel")
Array = NDArray[np.uint8]


def photographs() -> list[Array]:
    """Photographs (H, W, 3) of scikit-image, padded to at least the size of a piece."""
    pictures = [getattr(skimage.data, name)() for name in (*NAMES, "retina", "hubble_deep_field")]
    pictures.append(skimage.data.stereo_motorcycle()[0])
    colour = [picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2) for picture in pictures]
    short = [np.maximum(PIECE - np.array(picture.shape[:2]), 0) for picture in colour]
    return [np.pad(p, ((0, s[0]), (0, s[1]), (0, 0)), mode="symmetric") for p, s in zip(colour, short, strict=True)]


def mosaic(height: int, width: int) -> Iterator[Array]:
    """Yield bands (PIECE or fewer, width, 3) of a reproducible picture of any size."""
    generator, sources = np.random.default_rng(0), photographs()
    for top in range(0, height, PIECE):
        band = np.empty((PIECE, -(-width // PIECE) * PIECE, 3), np.uint8)
        for left in range(0, width, PIECE):
            source = sources[generator.integers(len(sources))]
            y, x = (generator.integers(length - PIECE + 1) for length in source.shape[:2])
            piece = np.rot90(source[y : y + PIECE, x : x + PIECE], generator.integers(4)) / 255
            piece = piece ** generator.uniform(0.6, 1.6)
            piece = piece + generator.normal(0, generator.uniform(0, 4 / 255), piece.shape)
            band[:, left : left + PIECE] = np.rint(piece.clip(0, 1) * 255)
        yield band[: height - top, :width]


def write_mosaic(path: Path, side: int) -> None:
    """Write a tiled BigTIFF of side x side pixels."""

    def tiles() -> Iterator[Array]:
        for band in mosaic(side, side):
            for left in range(0, side, PIECE):
                tile = band[:, left : left + PIECE]
                yield np.pad(tile, ((0, PIECE - tile.shape[0]), (0, PIECE - tile.shape[1]), (0, 0)))

    shape = (side, side, 3)
    options = {"tile": (PIECE, PIECE), "compression": "zlib", "predictor": True, "maxworkers": 1}
    tifffile.imwrite(path, tiles(), shape=shape, dtype=np.uint8, bigtiff=True, photometric="rgb", **options)


def work(source: Path, target: Path, statistics: Statistics, landmarks: int, memory: int) -> dict[str, object]:
    """Filter a file in this process, and return time and memory."""
    edit_luminance(torch.zeros(1, 3, 1, 1), lambda y: y)  # imports kornia
    forget_peak()
    before, started, wall = resident("VmRSS"), time.process_time(), time.perf_counter()
    stages: dict[str, float] = {}
    stage, since = "", started

    def report(name: str, done: int, total: int) -> None:
        nonlocal stage, since
        now = time.process_time()
        stages[stage] = stages.get(stage, 0.0) + now - since
        stage, since = name, now

    with open_picture(source, memory) as picture:
        tiled = Tiled(Picture(picture.rows), Passes("uint8", statistics, memory=memory, report=report))
        rows = tiled.rows(fit_step(DETAIL.changed(landmarks=landmarks), tiled, Drawn()))
        write_picture(target, rows, "uint8", picture)
        pixels = picture.shape[0] * picture.shape[1]
    report("", 0, 0)
    stages.pop("")
    return {
        "megapixels": pixels / 1e6,
        "landmarks": landmarks,
        "statistics": statistics,
        "cpu_s": time.process_time() - started,
        "wall_s": time.perf_counter() - wall,
        "peak_mib": resident("VmHWM") - before,
        "start_mib": before,
        "stages_s": stages,
    }


def in_fresh_process(folder: Path, source: Path, statistics: str, landmarks: int) -> dict[str, object]:
    """Run :func:`work` in a fresh process."""
    arguments = [str(source), str(folder / "out.tif"), statistics, str(landmarks)]
    command = [sys.executable, "-m", "benchmarks.streaming", "--work", *arguments]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    result: dict[str, object] = json.loads(done.stdout.splitlines()[-1])
    return result


def exactness(side: int, tiles: list[int]) -> dict[str, float]:
    """Largest differences between tiled and in-memory results, and between tile heights, as fractions of white."""
    picture = np.concatenate(list(mosaic(side, side))).astype(np.float32) / np.float32(255)
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    luminance = 0.299 * image[:, :1] + 0.587 * image[:, 1:2] + 0.114 * image[:, 2:]
    started = time.process_time()

    def in_colour(filtered: torch.Tensor) -> NDArray[np.float32]:
        return (image + filtered - luminance)[0].permute(1, 2, 0).numpy()

    usual = in_colour(polynomial_filter(nonlocal_operator(luminance), luminance, ALPHA))
    in_memory = time.process_time() - started
    # A tight tolerance, since otherwise its own residual would dominate the difference from full passes.
    whole = in_colour(polynomial_filter(nonlocal_operator(luminance, tolerance=1e-6), luminance, ALPHA))

    def by_rows(**options: Any) -> NDArray[np.float32]:
        edited = np.empty_like(picture)
        stream(DETAIL, picture, edited, **({"sample": min(SAMPLE, side * side // 4)} | options))
        return edited

    sampled = by_rows(tile_rows=tiles[0])
    others = [np.abs(by_rows(tile_rows=rows) - sampled).max() for rows in tiles[1:]]
    result: dict[str, Any] = {
        "megapixels": side * side / 1e6,
        "memory_cpu_s": in_memory,
        "sample_pixels": min(SAMPLE, side * side // 4),
    }
    result["sample_max"] = float(np.abs(sampled - whole).max())
    result["sample_rms"] = float(np.sqrt(np.square(sampled - whole, dtype=np.float64).mean()))
    few = by_rows(tile_rows=tiles[0], sample=result["sample_pixels"] // 4)
    result["few_max"] = float(np.abs(few - whole).max())
    full = by_rows(statistics="full")
    result["full_max"] = float(np.abs(full - whole).max())
    result["usual_max"] = float(np.abs(full - usual).max())
    return result | {"tiles_max": float(max(others)), "smallest_tile": tiles[0], "largest_tile": tiles[-1]}


def main() -> None:
    """Measure, print, and write JSON if requested."""
    parser = argparse.ArgumentParser(description="Time, memory and accuracy of tiled filtering.")
    parser.add_argument("--quick", action="store_true", help="a fraction of a megapixel, to check that it runs")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument(
        "--table", type=Path, metavar="JSON", help="print the tables of docs/scale.md from a file of --out"
    )
    parser.add_argument("--work", nargs=4, metavar=("IN", "OUT", "STATISTICS", "LANDMARKS"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.table:
        table(json.loads(options.table.read_text()))
        return
    if options.work:
        source, target, statistics, landmarks = options.work
        print(json.dumps(work(Path(source), Path(target), statistics, int(landmarks), 800 * MIB)))
        return

    sides = [200] if options.quick else [2048, 5000, 10_000]
    runs = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number, side in enumerate(sides):
            source = folder / "in.tif"
            write_mosaic(source, side)
            kinds = [("sample", 100)]
            if number == 0:
                kinds += [("full", 100)] if options.quick else [("full", 100), ("sample", 50), ("sample", 200)]
            for statistics, landmarks in kinds:
                runs.append(in_fresh_process(folder, source, statistics, landmarks))
                show(runs[-1])
    exact = exactness(200, [16, 64, 200]) if options.quick else exactness(2050, [64, 256, 1000, 4096])
    print(
        f"{exact['megapixels']:.2f} MP compared with memory, from a sample of {exact['sample_pixels']:.0f} pixels: "
        f"{exact['sample_max'] * 255:.2f} levels of 255 at most (RMS {exact['sample_rms'] * 255:.3f}), "
        f"from a quarter of them {exact['few_max'] * 255:.2f}; "
        f"from all pixels: {exact['full_max']:.1e} of white ({exact['usual_max']:.1e} with the usual tolerance); "
        f"tiles of {exact['smallest_tile']:.0f} to {exact['largest_tile']:.0f} rows differ by {exact['tiles_max']:.1e}"
    )
    if options.out:
        machine = {"machine": platform.machine(), "threads": torch.get_num_threads(), "torch": torch.__version__}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps({"machine": machine, "runs": runs, "exactness": exact}, indent=1) + "\n")


def table(figures: dict[str, Any]) -> None:
    """Print the tables of docs/scale.md from the JSON of a run."""
    print("| megapixels | m | statistics | CPU, s | s per MP | peak over start, MiB |\n|---|---|---|---|---|---|")
    for run in figures["runs"]:
        cpu, pixels = run["cpu_s"], run["megapixels"]
        kinds = f"{pixels:.1f} | {run['landmarks']} | {run['statistics']}"
        print(f"| {kinds} | {cpu:.1f} | {cpu / pixels:.2f} | {run['peak_mib']:.0f} |")
    large = max(figures["runs"], key=lambda run: run["megapixels"])
    once = sum(large["stages_s"][name] for name in ("Balancing", "Summing up"))
    rate = (large["cpu_s"] - once) / large["megapixels"]
    exact = figures["exactness"]
    whole = exact["memory_cpu_s"] / exact["megapixels"]
    print("\n| workers | way | time | memory of each |\n|---|---|---|---|")
    print(f"| 1 | rows | {(1000 * rate + once) / 60:.0f} min | {large['peak_mib'] / 1024:.1f} GiB |")
    for workers in (8, 64):
        pixels = 1e9 / workers
        memory = pixels * working_bytes(large["landmarks"], 5) / 2**30
        print(f"| {workers} | shards | {1000 * whole / workers / 60:.1f} min | {memory:.0f} GiB |")
    print(f"\n{rate:.2f} s per MP by rows and {once:.1f} s once; {whole:.2f} s per MP in memory")


def show(run: dict[str, object]) -> None:
    """Print one line for a run."""
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in run["stages_s"].items())  # type: ignore[attr-defined]
    cpu, pixels = float(run["cpu_s"]), float(run["megapixels"])  # type: ignore[arg-type]
    print(
        f"{pixels:7.2f} MP, m = {run['landmarks']}, {run['statistics']}: {cpu:.1f} s of CPU time, {cpu / pixels:.2f} "
        f"s per MP, {run['peak_mib']:.0f} MiB over {run['start_mib']:.0f} at the start ({stages})",
        flush=True,
    )


if __name__ == "__main__":
    main()
