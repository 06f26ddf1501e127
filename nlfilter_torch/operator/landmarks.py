"""Features to landmarks, the few points that all affinities are computed from. Paper: Sec. II-C, set A."""

from functools import partial
from typing import Literal

import torch
from torch import Tensor

from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.clusters import affinities_between, chance, draw_pivots, lloyd, pick, pivots
from nlfilter_torch.core.kernels.library import register

Sampling = Literal["kmeans", "uniform", "random"]

CAPTURED = 1e-4  # a point with a residual below this on the unit diagonal counts as captured
# More features or iterations move the centroids by less than their sampling error: at 512x400 pixels and m = 100, twice
# as many features lower the mean diagonal correction by at most 2 %; ten iterations by at most 3 %.
PER_LANDMARK = 64
STARTED_FROM = 32  # of them; more do not lower the error of W y
# Without bounds the cost would be quadratic in the number of landmarks. At 256x256 and m = 1000, 16384 candidates raise
# the mean diagonal by 5 % over 32768; a start from more of them does not lower it.
MOST_CANDIDATES = 32768
MOST_STARTED_FROM = 8192
DRAWN_SINGLY = 256  # landmarks; where there are more, the start is drawn in blocks, by matrix products
BLOCK, PROPOSED = 64, 8  # landmarks in a block, and proposals for each
ITERATIONS = 5
# Scores that differ by so many units of rounding are tied. Constant and periodic pictures with coordinates have many
# ties, which must not be decided by the order in which a kernel adds up.
TIE = 16
LARGEST = 1e16  # features whose squares float32 can still add up
MANY = 1 << 24  # a permutation of more pixels would take more memory than the image


def choose_landmarks(
    features: Tensor,
    size: tuple[int, int],
    count: int,
    sampling: Sampling,
    generator: torch.Generator | None,
    among: Communicator = ALONE,
    weights: Tensor | None = None,
) -> Tensor:
    """Choose or compute ``count`` landmarks.

    Args:
        features: (B, D, N) with N = H * W.
        size: (H, W).
        count: M, at most N. With M = N the landmarks are the pixels themselves.
        sampling: ``"kmeans"``: Lloyd centroids of a random subset; ``"uniform"``: the paper's spatial grid;
            ``"random"``: distinct random pixels.
        generator: source of randomness; None is a new one with seed 0, so that equal calls give equal landmarks.
        among: ranks that the rows of the image are spread over; N is then the number of pixels here, and all ranks use
            what the first one draws.
        weights: (B, N), how many pixels each point stands for: candidates of k-means are drawn in proportion to them.

    Returns:
        (B, D, M), differentiable in the features (k-means with the assignment held). All images of a batch draw the
        same pixels, so that a batch gives what single calls give.
    """
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    if count == features.shape[-1] and among.size == 1:
        return features
    pixels = (
        _candidates_by_weight(weights.mean(0), count, generator)
        if weights is not None and sampling == "kmeans"
        else candidate_pixels(size, count, sampling, generator)
    )
    pixels = among.broadcast(pixels.to(features.device))
    return condense(among.columns(features, pixels), count, generator, among)


def candidate_pixels(size: tuple[int, int], count: int, sampling: Sampling, generator: torch.Generator) -> Tensor:
    """Indices of distinct pixels, from whose features :func:`condense` computes ``count`` landmarks."""
    pixels = size[0] * size[1]
    if count == pixels:
        return torch.arange(pixels)
    if sampling == "uniform":
        return _grid(size, count)
    if sampling == "random" and pixels > MANY:
        draws = torch.randint(pixels, (2 * count,), generator=generator, device=generator.device)
        return torch.tensor(list(dict.fromkeys(draws.tolist()))[:count])  # distinct, in their random order
    if sampling == "random":
        return torch.randperm(pixels, generator=generator, device=generator.device)[:count]
    return stratified(pixels, candidate_count(pixels, count, sampling), generator)


def _candidates_by_weight(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Candidates of k-means among points with weights (N,): what :func:`stratified` picks of the pixels in order."""
    summed = weights.double().cumsum(0).cpu()
    summed = summed * (len(summed) / summed[-1]).clamp(min=1.0)  # a point may stand for less than a pixel
    pixels = round(float(summed[-1]))
    wanted = min(pixels, _bounded(PER_LANDMARK * count, MOST_CANDIDATES, count))
    return torch.searchsorted(summed, stratified(pixels, wanted, generator).double(), right=True).clamp_(
        max=len(summed) - 1
    )


def condense(subset: Tensor, count: int, generator: torch.Generator, among: Communicator = ALONE) -> Tensor:
    """Landmarks (B, D, M) from the features (B, D, S) of the candidates: centroids where there are more than M."""
    if subset.shape[2] == count:
        return subset
    start, assignment = clusters(subset.detach(), count, generator, among)
    return means_of_clusters(subset, assignment, start)


def clusters(
    points: Tensor, count: int, generator: torch.Generator, among: Communicator = ALONE
) -> tuple[Tensor, Tensor]:
    """Which of the points (B, D, S) start the clusters of k-means, (B, 1, M), and the cluster of each, (B, S)."""
    points = points - points.mean(dim=2, keepdim=True)  # small offsets keep ||x||^2 + ||z||^2 - 2xz accurate
    points = points.clamp(-LARGEST, LARGEST).float()  # a choice needs no more, and the kernels in C take no more
    few = draw_few(points.shape[2], count, generator).to(points.device)
    chosen = _pivots(pick(points, few.expand(len(points), 1, -1)), count, generator)
    start = among.broadcast(few[chosen]).unsqueeze(1)  # (B, 1, M)
    assignment = among.broadcast(lloyd(points, pick(points, start), ITERATIONS, TIE * torch.finfo(points.dtype).eps))
    return start, assignment


def draw_few(candidates: int, count: int, generator: torch.Generator) -> Tensor:
    """Indices of the candidates, half of them, among which those are that M clusters start from."""
    few = torch.randperm(candidates, generator=generator, device=generator.device)
    return few[: _bounded(STARTED_FROM * count, MOST_STARTED_FROM, count)]


def means_of_clusters(subset: Tensor, assignment: Tensor, start: Tensor) -> Tensor:
    """Landmarks (B, D, M) from candidates (B, D, S) and their :func:`clusters`."""
    return _cluster_means(subset, assignment, pick(subset, start))


def candidate_count(pixels: int, count: int, sampling: str) -> int:
    """How many :func:`candidate_pixels` there are."""
    return min(pixels, _bounded(PER_LANDMARK * count, MOST_CANDIDATES, count)) if sampling == "kmeans" else count


def _bounded(candidates: int, most: int, count: int) -> int:
    """So many candidates for ``count`` landmarks, or ``most``, or twice the landmarks if that is more."""
    return min(candidates, max(most, 2 * count))


def _grid(size: tuple[int, int], count: int) -> Tensor:
    """Indices of ``count`` pixels spread evenly over an image of ``size``, as rows of nearly equal length."""
    height, width = size
    rows = round((count * height / width) ** 0.5)
    rows = min(max(rows, -(-count // width), 1), height, count)
    lengths = [count // rows + (row < count % rows) for row in range(rows)]
    lines = []
    for row, length in enumerate(lengths):
        y = (2 * row + 1) * height // (2 * rows)
        x = (2 * torch.arange(length) + 1) * width // (2 * length)
        lines.append(y * width + x)
    return torch.cat(lines)


def stratified(pixels: int, count: int, generator: torch.Generator) -> Tensor:
    """``count`` distinct pixels, one from each of ``count`` equal stretches of the image.

    From front to back: in that order they are picked three times as quickly as in a random one.
    """
    device = generator.device
    offsets = torch.rand(count, generator=generator, device=device, dtype=torch.float64)
    return ((torch.arange(count, device=device) + offsets) * (pixels / count)).long().clamp_(max=pixels - 1)


def _pivots(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices (B, count) of points (B, D, S) to start k-means from: the pivots of a random Cholesky decomposition.

    Each is drawn by what the ones before do not capture of the kernel's unit diagonal (Chen, Epperly, Tropp and
    Webber, 2022). Patches that are rare but unlike all others get a landmark, which a uniform draw would miss, and
    k-means would never move one there. The fourth power is greedier than the residual itself: at h_y = 40/255 the
    error of W y on the small astronaut of benchmarks.accuracy is 0.55 grey levels with it, 0.79 with the first power,
    0.71 where k-means starts from any candidates.
    """
    draws = torch.rand(count, generator=generator, device=generator.device, dtype=torch.float64).to(points)
    if count > DRAWN_SINGLY:
        offsets = torch.rand(count, generator=generator, device=generator.device, dtype=torch.float64).to(points.device)
        images = points.split(1) if points.device.type == "cpu" else [points]  # columns of one at a time
        return torch.cat([_pivots_by_blocks(image, draws, offsets) for image in images])
    return pivots(points, draws, CAPTURED)


def _pivots_by_blocks(points: Tensor, draws: Tensor, offsets: Tensor) -> Tensor:
    """Pivots as in :func:`_pivots`, but a block at a time, so that matrix products do nearly all of the work.

    Within a block, pivots are drawn one by one from a systematic sample of proposals. Half of these come in proportion
    to the fourth power of the residual before the block, half evenly, since a few points may hold all of the residual.
    Weights in the draw are divided by the probability of a proposal.
    """
    batch, _, size = points.shape
    norms = points.square().sum(1, keepdim=True)  # (B, 1, S)
    residual = torch.ones_like(norms)
    columns = points.new_empty(batch, len(draws), size)
    found: list[Tensor] = []
    for block, offset in zip(draws.split(BLOCK), offsets, strict=False):
        first = sum(pivot.shape[2] for pivot in found)
        before = columns[:, :first]
        odds = chance(residual, CAPTURED)
        odds += odds.mean(2, keepdim=True)
        summed = odds.cumsum(2, dtype=torch.float64)
        ticks = (torch.arange(PROPOSED * len(block), device=points.device) + offset) / (PROPOSED * len(block))
        proposed = torch.searchsorted(summed, summed[:, :, -1:] * ticks).clamp_(max=size - 1)  # (B, 1, P)
        few, lengths, known = (pick(planes, proposed) for planes in (points, norms, before))
        shared = torch.baddbmm(affinities_between(few, lengths, few, lengths), known.mT, known, alpha=-1)  # (B, P, P)
        chosen, rows, scales = draw_pivots(
            partial(_row, shared), pick(residual, proposed), pick(odds, proposed), block, CAPTURED
        )
        found.append(proposed.gather(2, chosen))  # (B, 1, n)
        few, lengths, known = (pick(planes, chosen) for planes in (few, lengths, known))
        rest = torch.baddbmm(affinities_between(points, norms, few, lengths), known.mT, before, alpha=-1)  # (B, n, S)
        lower = pick(rows, chosen).mT.tril(-1) + torch.diag_embed(scales)
        columns[:, first : first + len(block)] = torch.linalg.solve_triangular(lower, rest, upper=False)
        residual -= columns[:, first : first + len(block)].square().sum(1, keepdim=True)
    return torch.cat(found, dim=2).squeeze(1)


def _row(matrices: Tensor, pivot: Tensor) -> Tensor:
    """Row (B, 1, S), at ``pivot`` (B, 1, 1), of symmetric matrices (B, S, S)."""
    return pick(matrices, pivot).mT


def _cluster_means(points: Tensor, assignment: Tensor, fallback: Tensor) -> Tensor:
    """Mean (B, D, M) of the points (B, D, S) of every cluster; an empty one takes its column of ``fallback``."""
    extended = torch.cat([points, torch.ones_like(points[:, :1])], dim=1)  # sums and sizes in one
    add = _sums_in_order if points.device.type == "cpu" else _sums_by_product
    sums = add(extended, assignment, fallback.shape[2])
    sizes = sums[:, -1:]
    return torch.where(sizes > 0, sums[:, :-1] / sizes.clamp(min=1.0), fallback)


def _sums_in_order(points: Tensor, assignment: Tensor, count: int) -> Tensor:
    """Sums (B, D, M) of the points of every cluster, one after the other."""
    zeros = points.new_zeros(*points.shape[:2], count)
    return zeros.scatter_add(2, assignment.unsqueeze(1).expand_as(points), points)


def _sums_by_product(points: Tensor, assignment: Tensor, count: int) -> Tensor:
    """The same on accelerators, which would add up in another order every time."""
    members = points.new_zeros(points.shape[0], count, points.shape[2])
    return points @ members.scatter_(1, assignment.unsqueeze(1), 1.0).mT


def _fake_choice(features: Tensor, height: int, width: int, count: int, sampling: str) -> tuple[Tensor, ...]:
    batch, candidates = features.shape[0], candidate_count(height * width, count, sampling)
    shapes = (candidates,), (batch, 1, count), (batch, candidates)
    return tuple(features.new_empty(shape, dtype=torch.long) for shape in shapes)


@register(
    "choose(Tensor features, int height, int width, int count, str sampling) -> (Tensor, Tensor, Tensor)",
    None,
    _fake_choice,
)
def choose(features: Tensor, height: int, width: int, count: int, sampling: Sampling) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates (S,), those that clusters start from (B, 1, M) and the cluster of each (B, S)."""
    generator = torch.Generator().manual_seed(0)
    pixels = candidate_pixels((height, width), count, sampling, generator).to(features.device)
    if len(pixels) == count:
        _, start, assignment = _fake_choice(features, height, width, count, sampling)
        return pixels, start.zero_(), assignment.zero_()
    start, assignment = clusters(ALONE.columns(features, pixels), count, generator)
    return pixels, start, assignment


def choose_in_graph(features: Tensor, size: tuple[int, int], count: int, sampling: Sampling) -> Tensor:
    """:func:`choose_landmarks` as a compiler records it, with the landmarks of a call without a generator."""
    if count == features.shape[2]:
        return features
    pixels, start, assignment = choose(features.detach(), size[0], size[1], count, sampling)
    subset = ALONE.columns(features, pixels)
    return subset if pixels.shape[0] == count else means_of_clusters(subset, assignment, start)
