"""Figures of the library as a layer in training: ``python -m benchmarks.training [TOPIC ...] [--out FILE.json]``."""

import argparse
import importlib
import json
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.training.figures import Figure, table

TOPICS: dict[str, str] = {  # name of a module of this package: what it measures
    "points": "a scan beside 3-D nonlocal means, and coordinates of points beside SpectralEmbedding",
    "block": "the non-local block beside the usual one: accuracy of a small task, time and memory",
    "floors": "operators of small images and of many landmarks, in floors",
    "functions": "f(W) of any response: error, methods, and cost at a megapixel",
    "sizes": "padded batches, and exported and compiled layers for images of any size",
    "refinement": "coarse segmentations refined, beside kornia, OpenCV and a dense CRF; bad bandwidths",
    "clusters": "landmarks of clusters and manifolds beside scikit-learn's k-means++, and how well they cover points",
    "equivariance": "layers, masks and edits of pictures that are flipped, transposed or rotated",
    "landmarks": "landmarks that are held: slopes, noise, recovered parameters, training",
    "styles": "networks that predict a look for each photograph: weights of a few lattices beside tone curves",
}
ON_KODAK = ("functions", "landmarks")  # topics with a choice of photographs


def main(arguments: list[str] | None = None) -> int:
    """Measure the topics, print a table of each, and return 1 if a figure falls short of its limit or is not finite."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training", description=__doc__)
    topics = "; ".join(f"{name}: {text}" for name, text in TOPICS.items())
    parser.add_argument("topics", nargs="*", default=list(TOPICS), help=topics)
    small = "small cases, to see that everything runs; figures of full size, times among them, have no limits there"
    parser.add_argument("--quick", action="store_true", help=small)
    folder = f"folder with kodim01.png to kodim24.png: {' and '.join(ON_KODAK)} measure on some of them"
    parser.add_argument("--kodak", type=Path, metavar="FOLDER", help=f"{folder} (default: scikit-image's)")
    parser.add_argument("--out", type=Path, help="JSON with every figure")
    options = parser.parse_args(arguments)
    figures: dict[str, list[Figure]] = {}
    for topic in options.topics:
        print(f"{topic}: {TOPICS[topic]}", flush=True)
        measure = importlib.import_module(f"benchmarks.training.{topic}").measure
        photographs = {"kodak": options.kodak} if topic in ON_KODAK else {}
        figures[topic] = list(measure(quick=options.quick, **photographs))
        print(table(figures[topic]), flush=True)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps({name: [asdict(each) for each in row] for name, row in figures.items()}))
    return int(any(not each.holds for row in figures.values() for each in row))


if __name__ == "__main__":
    sys.exit(main())
