"""What edits of pictures larger than memory cost, and how exact they are.

    python -m benchmarks.streaming [files] [--out FILE.json]    files of 4, 25 and 100 megapixels
    python -m benchmarks.streaming strokes                      recolouring and colourising of 4 and 25 megapixels
    python -m benchmarks.streaming memory                       processor time in tiles, compared with in memory

A mosaic of photographs, each piece randomly rotated, darkened or lightened and textured, is written to a BigTIFF file;
a fresh process edits it into another file. Time is CPU time, summed over cores, so that other programs affect it
little; peaks are above the memory that is resident after the program and its libraries are loaded. Then a smaller
mosaic is edited in tiles and in memory.
"""

import argparse
import json
import platform
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import skimage.data
import tifffile
import torch
from numpy.typing import NDArray

from benchmarks.harness import MIB, forget_peak, in_fresh_process, options, resident, save_json, seconds
from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.photo import Drawn, Step, colorize, enhance, recolor, stream
from nlfilter_torch.photo.edits.applying import fit_step
from nlfilter_torch.photo.files.rows import open_picture, write_picture
from nlfilter_torch.photo.picture.colour import colour_guide, split_luminance
from nlfilter_torch.photo.picture.pictures import Picture, stored_as
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import SAMPLE, Passes

ALPHA = (3.0, 3.0, 4.0, 1.05)
PLAIN: dict[str, Any] = {  # the filter without limits or threshold, in pixels of the file
    "limits": "none",
    "threshold": 0.0,
    "viewing_size": 0.0,
    "bandwidth": "auto",
    "spatial_bandwidth": "none",
    "landmarks": 100,
}
PIECE = 256  # side of a piece of the mosaic
NAMES = ("astronaut", "chelsea", "coffee", "rocket", "camera", "moon", "coins", "page", "brick", "grass", "gravel")
BOXES = (  # strokes: (top, left, height, width) as shares of the picture, and RGB
    ((0.25, 0.25, 0.02, 0.03), (0, 0, 255)),
    ((0.70, 0.60, 0.02, 0.02), (255, 0, 0)),
    ((0.10, 0.80, 0.03, 0.01), (0, 180, 50)),
    ((0.85, 0.15, 0.02, 0.04), (0, 0, 255)),
)
LIMIT = 800 * MIB  # of memory for files
Array = NDArray[np.uint8]


def photographs() -> list[Array]:
    """Photographs (H, W, 3) of scikit-image, padded to at least the size of a piece."""
    pictures = [getattr(skimage.data, name)() for name in (*NAMES, "retina", "hubble_deep_field")]
    pictures.append(skimage.data.stereo_motorcycle()[0])
    colour = [picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2) for picture in pictures]
    short = [np.maximum(PIECE - np.array(picture.shape[:2]), 0) for picture in colour]
    return [np.pad(p, ((0, s[0]), (0, s[1]), (0, 0)), mode="symmetric") for p, s in zip(colour, short, strict=True)]


def bands(side: int) -> Iterator[Array]:
    """Yield bands (PIECE or fewer, side, 3) of a reproducible square picture of any size."""
    generator, sources = np.random.default_rng(0), photographs()
    for top in range(0, side, PIECE):
        band = np.empty((PIECE, -(-side // PIECE) * PIECE, 3), np.uint8)
        for left in range(0, side, PIECE):
            source = sources[generator.integers(len(sources))]
            y, x = (generator.integers(length - PIECE + 1) for length in source.shape[:2])
            piece = np.rot90(source[y : y + PIECE, x : x + PIECE], generator.integers(4)) / 255
            piece = piece ** generator.uniform(0.6, 1.6)
            piece = piece + generator.normal(0, generator.uniform(0, 4 / 255), piece.shape)
            band[:, left : left + PIECE] = np.rint(piece.clip(0, 1) * 255)
        yield band[: side - top, :side]


def mosaic(side: int) -> Array:
    """The whole picture (side, side, 3)."""
    return np.concatenate(list(bands(side)))


def write_mosaic(path: Path, side: int) -> None:
    """Write a tiled BigTIFF of side x side pixels."""

    def tiles() -> Iterator[Array]:
        for band in bands(side):
            for left in range(0, side, PIECE):
                tile = band[:, left : left + PIECE]
                yield np.pad(tile, ((0, PIECE - tile.shape[0]), (0, PIECE - tile.shape[1]), (0, 0)))

    kind = {"tile": (PIECE, PIECE), "compression": "zlib", "predictor": True, "maxworkers": 1}
    tifffile.imwrite(path, tiles(), shape=(side, side, 3), dtype=np.uint8, bigtiff=True, photometric="rgb", **kind)


@dataclass(frozen=True)
class Boxes:
    """Strokes (h, W, 4) with transparency; rows are drawn on request."""

    shape: tuple[int, int, int]
    dtype = np.dtype(np.uint8)

    def __getitem__(self, rows: slice) -> Array:
        """The rows from ``rows.start`` to ``rows.stop``."""
        strokes = np.zeros((rows.stop - rows.start, *self.shape[1:]), self.dtype)
        for place, colour in BOXES:
            top, left, height, width = (
                round(share * side) for share, side in zip(place, 2 * self.shape[:2], strict=True)
            )
            inside = slice(max(top - rows.start, 0), max(top + height - rows.start, 0))
            strokes[inside, left : left + width] = (*colour, 255)
        return strokes


def drawn_on(verb: str, side: int) -> Drawn:
    """What is drawn for an edit."""
    return Drawn() if verb == "detail" else Drawn({}, Boxes((side, side, 4)))


def as_image(rows: NDArray[Any]) -> torch.Tensor:
    """Convert rows (H, W, C) of 8 bits, or of floats, to an image (1, C, H, W)."""
    scale = np.float32(255 if rows.dtype == np.uint8 else 1)
    return torch.from_numpy(np.ascontiguousarray(rows.transpose(2, 0, 1), np.float32) / scale)[None]


def in_memory(verb: str, picture: NDArray[Any]) -> torch.Tensor:
    """An edit of a whole picture (H, W, 3)."""
    image = as_image(picture)
    if verb == "detail":
        return enhance(image, torch.tensor(ALPHA))
    strokes = as_image(Boxes((*picture.shape[:2], 4))[slice(0, len(picture))])
    if verb == "recolor":
        return recolor(image, strokes[:, :3], strokes[:, 3:])
    return colorize(split_luminance(image)[0], strokes[:, :3], strokes[:, 3:])


def in_tiles(step: Step, picture: NDArray[Any], **passes: Any) -> NDArray[Any]:
    """An edit of a picture in tiles."""
    edited = np.empty_like(picture)
    stream(step, picture, edited, drawn=drawn_on(step.edit, len(picture)), **passes)
    return edited


def work(verb: str, source: Path, target: Path, statistics: str, landmarks: int) -> dict[str, Any]:
    """Edit a file in this process; its time by stages, and memory."""
    colour_guide(torch.zeros(1, 3, 1, 1))  # imports kornia
    step = Step("detail", alpha=ALPHA, **PLAIN).changed(landmarks=landmarks) if verb == "detail" else Step(verb)
    before, started, wall = forget_peak(), time.process_time(), time.perf_counter()
    stages: dict[str, float] = {}
    stage, since = "", started

    def report(name: str, done: int, total: int) -> None:
        nonlocal stage, since
        now = time.process_time()
        stages[stage] = stages.get(stage, 0.0) + now - since
        stage, since = name, now

    with open_picture(source, LIMIT) as picture:
        side, width, _ = picture.shape
        tiled = Tiled(Picture(picture.rows), Passes("uint8", statistics, memory=LIMIT, report=report))
        write_picture(target, tiled.rows(fit_step(step, tiled, drawn_on(verb, side))), "uint8", picture)
    report("", 0, 0)
    stages.pop("")
    return {
        "edit": verb,
        "megapixels": side * width / 1e6,
        "landmarks": landmarks,
        "statistics": statistics,
        "cpu_s": time.process_time() - started,
        "wall_s": time.perf_counter() - wall,
        "peak_mib": resident("VmHWM") - before,
        "start_mib": before,
        "stages_s": stages,
    }


def from_files(sides: list[int], kinds: Callable[[int], list[tuple[str, str, int]]]) -> list[dict[str, Any]]:
    """Edit files of some sides in fresh processes, in kinds of edit, statistics and landmarks; print a line of each."""
    runs = []
    with tempfile.TemporaryDirectory() as name:
        source, target = Path(name) / "in.tif", Path(name) / "out.tif"
        for side in sides:
            write_mosaic(source, side)
            for verb, statistics, landmarks in kinds(side):
                run = in_fresh_process("streaming", "--work", verb, source, target, statistics, landmarks)
                stages = ", ".join(f"{name} {taken:.1f}" for name, taken in run["stages_s"].items())
                print(
                    f"{verb}, {run['megapixels']:.2f} MP, m = {landmarks}, {statistics}: {run['cpu_s']:.1f} s of CPU "
                    f"time, {run['cpu_s'] / run['megapixels']:.2f} s per MP, {run['peak_mib']:.0f} MiB over "
                    f"{run['start_mib']:.0f} at the start ({stages})",
                    flush=True,
                )
                runs.append(run)
    return runs


def exactness_of_detail(side: int, tiles: list[int]) -> dict[str, float]:
    """Largest differences between tiled and in-memory results, and between tile heights, as fractions of white."""
    picture = mosaic(side).astype(np.float32) / np.float32(255)
    image, alpha, step = as_image(picture), torch.tensor(ALPHA), Step("detail", alpha=ALPHA, **PLAIN)
    luminance = 0.299 * image[:, :1] + 0.587 * image[:, 1:2] + 0.114 * image[:, 2:]

    def filtered(**more: Any) -> NDArray[np.float32]:
        result = polynomial_filter(nonlocal_operator(luminance, **more), luminance, alpha)
        return (image + result - luminance)[0].permute(1, 2, 0).numpy()

    started = time.process_time()
    usual, taken = filtered(), time.process_time() - started
    # A tight tolerance, since otherwise its own residual would dominate the difference from full passes.
    whole, sample = filtered(tolerance=1e-6), min(SAMPLE, side * side // 4)
    sampled = in_tiles(step, picture, sample=sample, tile_rows=tiles[0])
    few = in_tiles(step, picture, sample=sample // 4, tile_rows=tiles[0])
    full = in_tiles(step, picture, sample=sample, statistics="full")
    others = [np.abs(in_tiles(step, picture, sample=sample, tile_rows=rows) - sampled).max() for rows in tiles[1:]]
    return {
        "megapixels": side * side / 1e6,
        "memory_cpu_s": taken,
        "sample_pixels": sample,
        "sample_max": float(np.abs(sampled - whole).max()),
        "sample_rms": float(np.sqrt(np.square(sampled - whole, dtype=np.float64).mean())),
        "few_max": float(np.abs(few - whole).max()),
        "full_max": float(np.abs(full - whole).max()),
        "usual_max": float(np.abs(full - usual).max()),
        "tiles_max": float(max(others)),
        "smallest_tile": tiles[0],
        "largest_tile": tiles[-1],
    }


def files(chosen: argparse.Namespace) -> None:
    """Detail from file to file, and its exactness."""

    def kinds(side: int) -> list[tuple[str, str, int]]:
        more = [("full", 100), ("sample", 50), ("sample", 200)] if side == 2048 else []
        return [("detail", *kind) for kind in [("sample", 100), *more]]

    if chosen.quick:
        runs = from_files([200], lambda side: [("detail", "sample", 100), ("detail", "full", 100)])
        exact = exactness_of_detail(200, [16, 64, 200])
    else:
        runs, exact = from_files([2048, 5000, 10_000], kinds), exactness_of_detail(2050, [64, 256, 1000, 4096])
    print(
        f"{exact['megapixels']:.2f} MP compared with memory, from a sample of {exact['sample_pixels']:.0f} pixels: "
        f"{exact['sample_max'] * 255:.2f} levels of 255 at most (RMS {exact['sample_rms'] * 255:.3f}), "
        f"from a quarter of them {exact['few_max'] * 255:.2f}; "
        f"from all pixels: {exact['full_max']:.1e} of white ({exact['usual_max']:.1e} with the usual tolerance); "
        f"tiles of {exact['smallest_tile']:.0f} to {exact['largest_tile']:.0f} rows differ by {exact['tiles_max']:.1e}"
    )
    machine = {"machine": platform.machine(), "threads": torch.get_num_threads(), "torch": torch.__version__}
    save_json(chosen.out, {"machine": machine, "runs": runs, "exactness": exact})


def strokes(chosen: argparse.Namespace) -> None:
    """Recolouring and colourising from file to file, and their exactness."""
    verbs = ("recolor", "colorize")
    from_files([200] if chosen.quick else [2048, 5000], lambda side: [(verb, "sample", 100) for verb in verbs])
    side = 200 if chosen.quick else 2048
    picture, sample = mosaic(side).astype(np.float32) / np.float32(255), side * side // 4
    for verb in verbs:
        step, wanted = Step(verb), in_memory(verb, picture)[0].permute(1, 2, 0).numpy()
        sampled = in_tiles(step, picture, sample=sample, tile_rows=64)
        other = np.abs(in_tiles(step, picture, sample=sample, tile_rows=1000) - sampled).max()
        error, full = np.abs(sampled - wanted), np.abs(in_tiles(step, picture, statistics="full") - wanted).max()
        print(
            f"{verb}, {side * side / 1e6:.2f} MP: a quarter as sample is off by {255 * error.max():.2f} of 255 at most "
            f"(RMS {255 * np.sqrt(np.square(error, dtype=np.float64).mean()):.3f}), full passes by {full:.1e} of "
            f"white; tiles of 64 and 1000 rows differ by {other:.1e}"
        )


def beside_memory(chosen: argparse.Namespace) -> None:
    """CPU time per megapixel of edits in memory and in tiles, from 8 bits to 8 bits, in turn."""
    memory, repeats = int(chosen.memory * 1e9), 1 if chosen.quick else chosen.repeats
    print(f"| edit | megapixels | threads | in memory, s per MP | tiled with {chosen.memory:g} GB, s per MP | ratio |")
    print("|---|---|---|---|---|---|")
    in_tiles(Step("detail", alpha=ALPHA), mosaic(100))  # lazy imports and compilation
    threads = chosen.threads[:1] if chosen.quick else chosen.threads
    for megapixels, verb, count in product([0.04] if chosen.quick else chosen.megapixels, chosen.edits, threads):
        picture = mosaic(round((megapixels * 1e6) ** 0.5))
        step = Step("detail", alpha=ALPHA) if verb == "detail" else Step(verb)
        torch.set_num_threads(count)
        runs = [
            (
                seconds(lambda: stored_as(in_memory(verb, picture), "uint8"), processor=True),  # noqa: B023
                seconds(lambda: in_tiles(step, picture, memory=memory), processor=True),  # noqa: B023
            )
            for _ in range(repeats)
        ]
        whole, tiled = (median(times) * 1e6 / picture[..., 0].size for times in zip(*runs, strict=True))
        ratio = median(run[1] / run[0] for run in runs)
        print(f"| {verb} | {megapixels} | {count} | {whole:.2f} | {tiled:.2f} | {ratio:.2f} |", flush=True)


SUITES = {"files": files, "strokes": strokes, "memory": beside_memory}


def main() -> None:
    """Run a suite."""
    parser = options("streaming", __doc__, "a fraction of a megapixel")
    add = parser.add_argument
    add("suite", nargs="?", choices=SUITES, default="files")
    add("--out", type=Path, help="JSON file for the figures of files")
    add("--megapixels", type=float, nargs="+", default=[1.4, 4.0, 12.0], help="of memory")
    add("--edits", nargs="+", choices=("detail", "recolor"), default=["detail", "recolor"], help="of memory")
    add("--threads", type=int, nargs="+", default=[1, 2], help="of memory")
    add("--repeats", type=int, default=3, help="of memory")
    add("--memory", type=float, default=1.0, help="memory limit of tiles in gigabytes")
    add("--work", nargs=5, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.work:
        verb, source, target, statistics, landmarks = chosen.work
        print(json.dumps(work(verb, Path(source), Path(target), statistics, int(landmarks))))
    else:
        SUITES[chosen.suite](chosen)


if __name__ == "__main__":
    main()
