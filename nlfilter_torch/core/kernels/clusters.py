"""Parts of k-means: initial centroids, from randomly pivoted Cholesky decomposition, and Lloyd's iteration."""

from collections.abc import Iterator

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.library import contiguous, kernel, run
from nlfilter_torch.core.torch_internals import register

# As in interface.h. Of the proposals for pivots, half are drawn in proportion to a power of the distance from the
# nearest pivot too, similar to k-means++ (Arthur and Vassilvitskii, 2007): where clusters are wider than the bandwidth,
# residuals alone do not tell a cluster without a pivot from a point beside one.
TRIALS = 6  # proposals for each pivot
FIRST, LARGEST = 6, 48  # pivots of the first block, and of the largest; each block has twice as many as all before it
ORDERED = 2  # times that proposals are ordered by what they add
COVERED = 4.0  # squared distance from the nearest pivot at which a point counts as half covered
UNCOVERED = 1e16  # squared distance before there is a pivot, and the largest that counts
DISTINCT = 1e-6  # added to squared distances, so that there are probabilities where all points are equal
NEARLY = 1e-5  # proposals that cover more by less than this share of the points are equally good
MULTIPLIED = 256  # pivots from which matrix products are faster than the kernel in C
CACHED_SCORES = 1 << 20  # scores of points and centres; on CPUs a batch is divided into parts with at most this many


def pivot_blocks(count: int) -> Iterator[slice]:
    """Blocks of the numbers of pivots; each is chosen at once, by what the earlier ones leave."""
    first = 0
    while first < count:
        last = first + min(count - first, max(FIRST, 2 * first), LARGEST)
        yield slice(first, last)
        first = last


def odds(residual: Tensor, nearest: Tensor, captured: float) -> Tensor:
    """Unnormalised probabilities (B, 2, S) of proposing a point as a pivot.

    The fourth power of its residual (B, 1, S), times the fourth power of its distance from the nearest pivot, of which
    ``nearest`` (B, 1, S) is the square, and alone.
    """
    power = residual.clamp(min=captured).pow(4)
    return torch.cat([power * (nearest + DISTINCT).square(), power], dim=1)


def most_covering(apart: Tensor, nearest: Tensor, count: int) -> Tensor:
    """Numbers (B, 1, count) of the proposals that together cover most, given squared distances (B, P, S) from them.

    A point counts as covered the more the closer the nearest pivot is, by half at the squared distance
    :data:`COVERED`; ``nearest`` (B, 1, S) is that of the pivots so far. Proposals are ordered by what each adds, then
    again by what each adds to the better ones. Proposals that are equally good to rounding keep their order.
    """
    covered = (torch.minimum(apart, nearest) + COVERED).reciprocal_()  # in units of 1 / COVERED, a power of two
    before = (nearest + COVERED).reciprocal_().sum(2, dtype=torch.float64)  # (B, 1)
    unit = NEARLY * apart.shape[2] / COVERED
    # Summed in float64, as in C, so that rounding does not decide between proposals.
    added = covered.sum(2, dtype=torch.float64) - before
    order = (added / unit).round_().argsort(dim=1, descending=True, stable=True)
    for _ in range(ORDERED):
        reached = covered.gather(1, order.unsqueeze(2).expand_as(covered)).cummax(1).values
        added = torch.diff(reached.sum(2, dtype=torch.float64), dim=1, prepend=before)
        order = order.gather(1, (added / unit).round_().argsort(dim=1, descending=True, stable=True))
    return order[:, :count].unsqueeze(1)


def squared_distances(points: Tensor, norms: Tensor, others: Tensor, lengths: Tensor) -> Tensor:
    """Squared distances (B, M, S) of points (B, D, S) from others (B, D, M).

    ``norms`` (B, 1, S) and ``lengths`` (B, 1, M) are their squared norms.
    """
    return torch.baddbmm(norms + lengths.mT, others.mT, points, alpha=-2).clamp_(min=0.0)


def affinities(squared: Tensor) -> Tensor:
    """Affinities of squared distances."""
    return squared.clamp(max=60.0).neg_().exp_()


def pick(planes: Tensor, at: Tensor) -> Tensor:
    """Columns (B, R, M) of planes (B, R, S) with indices (B, 1, M)."""
    return planes.gather(2, at.expand(-1, planes.shape[1], -1))


def _compiled_pivots(points: Tensor, draws: Tensor, captured: float) -> Tensor | None:
    if len(draws) > MULTIPLIED:
        return None
    points, draws = contiguous(points, draws)
    batch, size, count = points.shape
    chosen = torch.empty(batch, len(draws), dtype=torch.long)
    arguments = (size, count, len(draws), captured, points.data_ptr(), draws.data_ptr(), chosen.data_ptr())
    run("pivots", torch.get_num_threads(), batch, *arguments)
    return chosen


def _fake_pivots(points: Tensor, draws: Tensor, captured: float) -> Tensor:
    return points.new_empty(points.shape[0], draws.shape[0], dtype=torch.long)


@register("pivots(Tensor points, Tensor draws, float captured) -> Tensor", kernel(_compiled_pivots), _fake_pivots)
def pivots(points: Tensor, draws: Tensor, captured: float) -> Tensor:
    """Pivots (B, M) of a randomly pivoted Cholesky decomposition of the affinities of points (B, D, S), in blocks.

    For every block of :func:`pivot_blocks`, :data:`TRIALS` times as many points are proposed as there are to be pivots,
    half of them by each of the two :func:`odds`, from strata of equal probability with the random numbers ``draws``,
    (M, TRIALS) in [0, 1). Those that together cover most become pivots. A residual below ``captured`` counts as
    captured. Epperly, Tropp and Webber, 2024, accept or reject the proposals of a block by chance instead.
    """
    norms = points.square().sum(1, keepdim=True)  # (B, 1, S)
    residual, nearest = torch.ones_like(norms), torch.full_like(norms, UNCOVERED)
    columns = points.new_empty(len(points), len(draws), points.shape[2])
    drawn: list[Tensor] = []
    for block in pivot_blocks(len(draws)):
        numbers, before = draws[block].reshape(2, -1).double(), columns[:, : block.start]
        strata = torch.arange(numbers.shape[1], device=points.device)
        # Summed in float64, as in C, so that rounding does not decide which of thousands of points is drawn.
        summed = odds(residual, nearest, captured).cumsum(2, dtype=torch.float64)
        ticks = (strata + numbers) / numbers.shape[1] * summed[:, :, -1:]
        proposed = torch.searchsorted(summed, ticks).clamp_(max=points.shape[2] - 1).flatten(1).unsqueeze(1)
        apart = squared_distances(points, norms, pick(points, proposed), pick(norms, proposed))  # (B, P, S)
        best = most_covering(apart, nearest, block.stop - block.start)
        chosen, apart = proposed.gather(2, best), apart.gather(1, best.mT.expand(-1, -1, apart.shape[2]))
        drawn.append(chosen)
        if block.stop == len(draws):
            break
        nearest = torch.minimum(nearest, apart.amin(1, keepdim=True)).scatter(2, chosen, 0.0)
        rest = torch.baddbmm(affinities(apart), pick(before, chosen).mT, before, alpha=-1)
        among = pick(rest, chosen).double()
        among.diagonal(dim1=1, dim2=2).add_(captured)
        lower = torch.linalg.cholesky_ex(among).L.to(rest)
        columns[:, block] = torch.linalg.solve_triangular(lower, rest, upper=False)
        residual = residual - columns[:, block].square().sum(1, keepdim=True)
    return torch.cat(drawn, dim=2).squeeze(1)


def _compiled_lloyd(points: Tensor, start: Tensor, iterations: int, margin: float) -> Tensor:
    points, start = contiguous(points, start)
    batch, size, count = points.shape
    nearest = torch.empty(batch, count, dtype=torch.int32)
    run(
        "lloyd", torch.get_num_threads(), batch, size, count, start.shape[2], iterations, margin, points.data_ptr(),
        start.data_ptr(), nearest.data_ptr(),
    )  # fmt: skip
    return nearest.long()


def _fake_lloyd(points: Tensor, start: Tensor, iterations: int, margin: float) -> Tensor:
    return points.new_empty(points.shape[0], points.shape[2], dtype=torch.long)


@register(
    "lloyd(Tensor points, Tensor start, int iterations, float margin) -> Tensor", kernel(_compiled_lloyd), _fake_lloyd
)
def lloyd(points: Tensor, start: Tensor, iterations: int, margin: float) -> Tensor:
    """Run Lloyd's iteration from centres (B, D, M); return the index (B, S) of the nearest centre of points (B, D, S).

    Scores that differ by less than ``margin`` times the magnitude of their terms are ties; the first index wins.
    """
    together = max(1, CACHED_SCORES // (points.shape[2] * start.shape[2]))
    if points.device.type == "cpu" and together < points.shape[0]:
        parts = zip(points.split(together), start.split(together), strict=True)
        return torch.cat([lloyd(*part, iterations, margin) for part in parts])
    extended = torch.cat([points, torch.ones_like(points[:, :1])], dim=1)  # for scores, and for sums and sizes
    slack = margin * points.square().sum(1).unsqueeze(2)  # (B, S, 1)
    centres = start
    for step in range(iterations + 1):
        # Half the squared norm of points minus half their squared distance to centres, (B, S, M).
        score = extended.mT @ torch.cat([centres, -0.5 * centres.square().sum(1, keepdim=True)], dim=1)
        best = score.amax(2, keepdim=True)
        nearest = (score >= best - (slack + margin * best.abs())).byte().argmax(2)  # the first of the nearest
        if step == iterations:
            break
        members = score.zero_().scatter_(2, nearest.unsqueeze(2), 1.0)
        sums = extended @ members  # (B, D + 1, M)
        sizes = sums[:, -1:]
        centres = torch.where(sizes > 0, sums[:, :-1] / sizes.clamp(min=1.0), start)
    return nearest
