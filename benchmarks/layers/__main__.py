"""What the library gives as a layer in training: ``python -m benchmarks.layers [TOPIC ...] [--out FILE.json]``."""

import importlib
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.harness import Figure, options, save_json

TOPICS: dict[str, str] = {  # name of a module of this package: what it measures
    "points": "a scan beside 3-D nonlocal means, and coordinates of points beside SpectralEmbedding",
    "block": "the non-local block beside the usual one: accuracy of a small task, time and memory",
    "functions": "f(W) of any response: error, methods, and cost at a megapixel",
    "refinement": "coarse segmentations refined, beside kornia, OpenCV and a dense CRF; bad bandwidths",
    "clusters": "landmarks of clusters and manifolds beside scikit-learn's k-means++, and how well they cover points",
    "landmarks": "landmarks that are held: slopes, noise, recovered parameters, training",
    "styles": "networks that predict a look for each photograph: weights of a few lattices beside tone curves",
}
FOLDERS = {"functions": "kodak", "landmarks": "kodak", "refinement": "pictures"}  # topics with a choice of photographs


def main(arguments: list[str] | None = None) -> int:
    """Measure the topics, print a table of each, and return 1 if a figure falls short of its limit or is not finite."""
    small = "small cases, whose times and figures of full size have no limits"
    parser = options("layers", __doc__, small)
    topics = "; ".join(f"{name}: {text}" for name, text in TOPICS.items())
    parser.add_argument("topics", nargs="*", default=list(TOPICS), help=topics)
    folder = "of kodim01.png to kodim24.png, on some of which functions and landmarks measure (default: scikit-image's)"
    parser.add_argument("--kodak", type=Path, metavar="FOLDER", help=folder)
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="of photographs for refinement")
    parser.add_argument("--out", type=Path, help="JSON with every figure")
    chosen = parser.parse_args(arguments)
    figures: dict[str, list[Figure]] = {}
    for topic in chosen.topics:
        print(f"{topic}: {TOPICS[topic]}", flush=True)
        measure = importlib.import_module(f"benchmarks.layers.{topic}").measure
        photographs = {FOLDERS[topic]: getattr(chosen, FOLDERS[topic])} if topic in FOLDERS else {}
        figures[topic] = list(measure(quick=chosen.quick, **photographs))
        print(*figures[topic], sep="\n", flush=True)
    save_json(chosen.out, {name: [asdict(each) for each in row] for name, row in figures.items()})
    return int(any(not each.holds for row in figures.values() for each in row))


if __name__ == "__main__":
    sys.exit(main())
