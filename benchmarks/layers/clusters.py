"""Landmarks of clusters and manifolds beside those of scikit-learn's k-means++, and what ``diagnostics`` tells of them.

Both choose M landmarks from the features, three times with other random numbers; the operator is then built the same
way. The error is that of W v, relative to the norm of the exact product, for normal random v. The row of a point counts
as off by more than half if more than half of its weight lies at other points than in the exact filter. No choice was
made on these points: the seeding was chosen with other seeds.
"""

import math
import time
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from benchmarks.harness import Figure
from benchmarks.layers.point_sets import ISSUE, MORE, POINTS, PointSet
from nlfilter_torch import NonlocalOperator, nonlocal_operator, operator_from_features
from nlfilter_torch.operator.traps import LARGEST_SHARE

SEED = 40
DRAWS = 3  # choices of landmarks, whose errors are averaged
SWEEPS = 50
MEGAPIXEL = 1000
Build = Callable[[Tensor, int, int], NonlocalOperator]


def measure(quick: bool) -> Iterator[Figure]:
    """Figures of the clusters of the issue, of more sets of points, and of a photograph of a megapixel."""
    ratios = []
    sets = [ISSUE[0], MORE[0]] if quick else [*ISSUE, *MORE]
    for number, points in enumerate(sets):
        ratio, figures = compared(points, SEED + number, 300 if quick else POINTS, stated=number < 2 and not quick)
        ratios.append(ratio)
        yield from figures
    limit = None if quick else 1.0
    yield Figure(f"{len(ratios)} sets: error / scikit-learn's, geometric mean", geometric_mean(ratios), limit)
    yield Figure(f"{len(ratios)} sets: error / scikit-learn's, largest", max(ratios), limit)
    yield from photograph(quick)


def compared(points: PointSet, seed: int, number: int, *, stated: bool) -> tuple[float, list[Figure]]:
    """The ratio of the errors with our landmarks and with scikit-learn's, and figures of both."""
    generator = torch.Generator().manual_seed(seed)
    x = points.draw(generator, number)
    exact, v = exact_filter(x), torch.randn(number, generator=generator, dtype=torch.float64)
    wanted = exact @ v
    features, count = x.mT.float().unsqueeze(0), min(points.landmarks, number // 2)
    figures, errors = [], {}
    for name, build in (("scikit-learn", theirs), ("ours", ours)):
        operators = [build(features, count, draw) for draw in range(DRAWS)]
        errors[name] = sum(error(w, v, wanted) for w in operators) / DRAWS
        bound = errors["scikit-learn"] if stated and name == "ours" else None
        figures.append(Figure(f"{points.name}: error of W v, {name}", errors[name], bound))
        share = rows_off(operators[0], exact)
        figures.append(Figure(f"{points.name}: points off by more than half, {name}", share, None))
    half = operator_from_features(features, size=(number,), num_landmarks=count, landmarks="random")
    share, told = rows_off(half, exact), half.diagnostics().badly_covered[0]
    figures.append(Figure(f"{points.name}: points off by more than half, random landmarks", share, None))
    limit = 0.05 if number == POINTS else None
    figures.append(Figure(f"{points.name}: what diagnostics tell of that share, difference", abs(told - share), limit))
    return errors["ours"] / errors["scikit-learn"], figures


def geometric_mean(numbers: list[float]) -> float:
    """Of positive numbers."""
    return math.exp(sum(map(math.log, numbers)) / len(numbers))


def exact_filter(points: Tensor) -> Tensor:
    """The dense W (N, N) of points (N, D), balanced."""
    kernel = (-torch.cdist(points, points).square()).exp()
    scaling = kernel.sum(1).rsqrt()
    for _ in range(SWEEPS):
        scaling = (scaling / (kernel @ scaling)).sqrt()
    return scaling.unsqueeze(1) * kernel * scaling


def ours(features: Tensor, count: int, draw: int) -> NonlocalOperator:
    """The operator with the default landmarks."""
    generator = torch.Generator().manual_seed(draw)
    return operator_from_features(features, size=(features.shape[2],), num_landmarks=count, generator=generator)


def theirs(features: Tensor, count: int, draw: int) -> NonlocalOperator:
    """The operator with the centres of scikit-learn's k-means, which starts from k-means++, as landmarks."""
    from sklearn.cluster import KMeans

    centres = KMeans(count, n_init=1, random_state=draw).fit(features[0].mT.numpy()).cluster_centers_
    landmarks = torch.from_numpy(centres).mT.unsqueeze(0).to(features)
    return operator_from_features(features, size=(features.shape[2],), landmarks=landmarks)


def error(w: NonlocalOperator, v: Tensor, wanted: Tensor) -> float:
    """Error of W v, relative to the norm of the exact product."""
    return float(((w @ v.view(1, 1, -1)).flatten() - wanted).norm() / wanted.norm())


def rows_off(w: NonlocalOperator, exact: Tensor) -> float:
    """Share of the points whose rows are off by more than half."""
    return float(((w.to_dense()[0] - exact).abs().sum(1) / 2 > 0.5).double().mean())


def photograph(quick: bool) -> Iterator[Figure]:
    """What the measure tells of a photograph with the defaults, and the times of building and measuring."""
    from skimage.data import retina

    side = 100 if quick else MEGAPIXEL
    guide = torch.from_numpy(retina()[:side, :side]).permute(2, 0, 1)[None].float() / 255
    seconds = {}
    for landmarks in ("random", "kmeans", "random", "kmeans"):
        start = time.perf_counter()
        w = nonlocal_operator(guide, landmarks=landmarks)  # type: ignore[arg-type]
        seconds[landmarks] = time.perf_counter() - start
    start = time.perf_counter()
    share = float(w.badly_covered())
    name = f"retina, {side}x{side}"
    yield Figure(f"{name}: badly covered with the defaults", share, None if quick else LARGEST_SHARE)
    yield Figure(f"{name}: time of measuring it", time.perf_counter() - start, None, "s")
    yield Figure(f"{name}: time of the operator", seconds["kmeans"], None, "s")
    yield Figure(f"{name}: time of the operator with random landmarks", seconds["random"], None, "s")
