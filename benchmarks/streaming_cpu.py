"""CPU time of edits in tiles compared with edits in memory: ``python -m benchmarks.streaming_cpu``.

The mosaic of ``benchmarks.streaming`` is edited alternately in memory and in tiles, from 8 bits to 8 bits, in one
process. Prints medians of CPU time per megapixel, summed over all threads. ``--quick`` runs it on a fraction of a
megapixel.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.streaming import ALPHA, mosaic
from benchmarks.streaming_strokes import Boxes
from nlfilter_torch.photo import Drawn, Step, recolor, stream
from nlfilter_torch.photo.edits.detail import enhance
from nlfilter_torch.photo.picture.pictures import stored_as

Edit = Callable[[], NDArray[Any]]


def as_tensor(rows: NDArray[np.uint8]) -> torch.Tensor:
    """Convert rows (H, W, C) of 8 bits to an image (1, C, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(rows.transpose(2, 0, 1), np.float32) / np.float32(255))[None]


def ways(verb: str, picture: NDArray[np.uint8], memory: int) -> tuple[Edit, Edit]:
    """Create functions that edit a picture in memory and in tiles."""
    edited, strokes = np.empty_like(picture), Boxes((*picture.shape[:2], 4))

    def in_memory() -> NDArray[Any]:
        if verb == "detail":
            return stored_as(enhance(as_tensor(picture), ALPHA), "uint8")
        over = as_tensor(strokes[slice(0, len(picture))])
        return stored_as(recolor(as_tensor(picture), over[:, :3], over[:, 3:]), "uint8")

    def in_tiles() -> NDArray[Any]:
        if verb == "detail":
            stream(Step("detail", alpha=tuple(ALPHA.tolist())), picture, edited, memory=memory)
        else:
            stream(Step("recolor"), picture, edited, drawn=Drawn({}, strokes), memory=memory)
        return edited

    return in_memory, in_tiles


def processor_time(edit: Edit) -> float:
    """CPU seconds of an edit, summed over all cores."""
    started = time.process_time()
    edit()
    return time.process_time() - started


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description="CPU time of edits in tiles compared with edits in memory.")
    parser.add_argument("--quick", action="store_true", help="a fraction of a megapixel, to check that it runs")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[1.4, 4.0, 12.0])
    parser.add_argument("--edits", nargs="+", choices=("detail", "recolor"), default=["detail", "recolor"])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--memory", type=float, default=1.0, help="memory limit of tiles in gigabytes")
    options = parser.parse_args()
    print(f"| edit | megapixels | threads | in memory, s per MP | tiled with {options.memory:g} GB, s per MP | ratio |")
    print("|---|---|---|---|---|---|")
    for edit in ways("detail", np.concatenate(list(mosaic(100, 100))), 10**9):
        edit()  # lazy imports and compilation
    for megapixels in [0.04] if options.quick else options.megapixels:
        side = round((megapixels * 1e6) ** 0.5)
        picture = np.concatenate(list(mosaic(side, side)))
        for verb in options.edits:
            edits = ways(verb, picture, int(options.memory * 1e9))
            for threads in options.threads[:1] if options.quick else options.threads:
                torch.set_num_threads(threads)
                repeats = 1 if options.quick else options.repeats
                runs = [[processor_time(edit) * 1e6 / side**2 for edit in edits] for _ in range(repeats)]
                whole, tiled = (median(times) for times in zip(*runs, strict=True))
                ratio = median(run[1] / run[0] for run in runs)
                print(f"| {verb} | {megapixels} | {threads} | {whole:.2f} | {tiled:.2f} | {ratio:.2f} |", flush=True)


if __name__ == "__main__":
    main()
