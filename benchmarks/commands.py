"""What commands take from start to end: ``python -m benchmarks.commands``, in half a minute.

Seconds of the processor with one thread, each the median of five processes after another that warms caches: the help,
the import of torch, edits of a tiny picture, which are little more than a start, and ``inspect`` of 0.4 megapixels.
``--quick`` runs it once on small pictures.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from statistics import median
from subprocess import DEVNULL, run
from tempfile import TemporaryDirectory

import skimage.data
from PIL import Image

from benchmarks.training.figures import Figure, table

INSPECT = 4.0  # seconds, at most
PROGRAM = ("-m", "nlfilter_torch")


def seconds(repeats: int, *arguments: str) -> float:
    """Seconds of the processor that Python takes with these arguments, the median of several processes."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    taken = []
    for _ in range(repeats + 1):
        before = getrusage(RUSAGE_CHILDREN)
        run([sys.executable, *arguments], check=True, stdout=DEVNULL, stderr=DEVNULL, env=environment)
        after = getrusage(RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return median(taken[1:])


def measure(folder: Path, repeats: int, *, quick: bool) -> Iterator[Figure]:
    """Measure commands on pictures in a folder."""
    tiny, large, out = (str(folder / name) for name in ("tiny.png", "large.png", "out.png"))
    astronaut = Image.fromarray(skimage.data.astronaut())
    astronaut.resize((64, 48)).save(tiny)
    astronaut.resize((73, 55) if quick else (730, 548)).save(large)
    yield Figure("--help", seconds(repeats, *PROGRAM, "--help"), unit="s")
    yield Figure("import of torch", seconds(repeats, "-c", "import torch"), unit="s")
    for edit in ("sharpen", "denoise"):
        yield Figure(f"{edit} of 64x48 pixels", seconds(repeats, *PROGRAM, edit, tiny, out), unit="s")
    inspected = seconds(repeats, *PROGRAM, "inspect", large, str(folder / "inspected"))
    yield Figure("inspect of 0.4 megapixels", inspected, INSPECT, unit="s")


def main() -> int:
    """Measure and print a table; return 1 if a figure falls short of its limit."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.commands", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small pictures, once, to see that everything runs")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        figures = list(measure(Path(folder), 1 if options.quick else 5, quick=options.quick))
    print(table(figures))
    return int(not options.quick and not all(figure.holds for figure in figures))


if __name__ == "__main__":
    sys.exit(main())
