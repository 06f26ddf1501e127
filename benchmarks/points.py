"""Labels of a few points extended to many, beside scikit-learn's methods: ``python -m benchmarks.points``.

The points are scikit-learn's digits of 8x8 pixels, each drawn many times with noise and shifted by up to a pixel; ten
of each class are labelled. Printed are the shares of the other labels that are right, in the mean of three draws, and
the median seconds: of ``nlfilter_torch.sklearn.LabelPropagation`` by default (400 landmarks) and with 100, of
scikit-learn's ``LabelSpreading`` with nearest neighbours, and of the nearest labelled point. Nothing is tuned against
the labels.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from sklearn.datasets import load_digits
from sklearn.neighbors import KNeighborsClassifier
from sklearn.semi_supervised import LabelSpreading

from benchmarks.harness import Figure, options, report
from nlfilter_torch.sklearn import LabelPropagation

POINTS, LABELLED, DRAWS = 20_000, 10, 3
NOISE, SHIFT = 2.0, 1  # of pixel values up to 16, and in pixels
WANTED = 0.75

Array = NDArray[np.float64]


def digits(count: int, seed: int) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Digits (count, 64), their classes, and the classes that are told, -1 elsewhere."""
    random = np.random.default_rng(seed)
    images, classes = load_digits().images, load_digits().target
    drawn = random.integers(len(images), size=count)
    shifts = random.integers(-SHIFT, SHIFT + 1, size=(count, 2))
    shifted = [np.roll(images[n], shift, (0, 1)) for n, shift in zip(drawn, shifts, strict=True)]
    points = np.stack(shifted).reshape(count, -1) + NOISE * random.standard_normal((count, 64))
    truth, told = classes[drawn], np.full(count, -1)
    for number in range(10):
        kept = random.permutation(np.flatnonzero(truth == number))[:LABELLED]
        told[kept] = number
    return points, truth, told


def ours(points: Array, told: NDArray[np.int64], **settings: int) -> NDArray[np.int64]:
    """Classes by the estimator of this library."""
    classes: NDArray[np.int64] = LabelPropagation(random_state=0, **settings).fit(points, told).transduction_
    return classes


def spreading(points: Array, told: NDArray[np.int64], **settings: object) -> NDArray[np.int64]:
    """Classes by scikit-learn's LabelSpreading."""
    classes: NDArray[np.int64] = LabelSpreading(**settings).fit(points, told).transduction_
    return classes


def nearest(points: Array, told: NDArray[np.int64]) -> NDArray[np.int64]:
    """The class of the nearest labelled point."""
    known = told >= 0
    classes: NDArray[np.int64] = KNeighborsClassifier(1).fit(points[known], told[known]).predict(points)
    return classes


def figures(count: int, draws: int) -> Iterator[Figure]:
    """The share of each method that is right."""
    methods: dict[str, Callable[[Array, NDArray[np.int64]], NDArray[np.int64]]] = {
        "LabelPropagation": ours,
        "LabelPropagation, 100 landmarks": lambda points, told: ours(points, told, n_landmarks=100),
        "scikit-learn: LabelSpreading, nearest neighbours": lambda p, t: spreading(p, t, kernel="knn"),
        "nearest labelled point": nearest,
    }
    shares, seconds = ({name: list[float]() for name in methods} for _ in range(2))
    for seed in range(draws):
        points, truth, told = digits(count, seed)
        for name, method in methods.items():
            start = time.perf_counter()
            classes = method(points, told)
            seconds[name].append(time.perf_counter() - start)
            shares[name].append(float((classes == truth)[told < 0].mean()))
    for name, values in shares.items():
        print(f"{name}: {statistics.median(seconds[name]):.1f} s")
        limit = WANTED if name == "LabelPropagation" else None
        yield Figure(f"{name}: labels that are right", statistics.mean(values), limit, at_most=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure."""
    parser = options("points", __doc__, "500 points, once")
    chosen = parser.parse_args(arguments)
    return report(figures(500 if chosen.quick else POINTS, 1 if chosen.quick else DRAWS), quick=chosen.quick)


if __name__ == "__main__":
    raise SystemExit(main())
