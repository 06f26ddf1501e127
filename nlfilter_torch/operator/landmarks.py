"""Landmarks: the few points whose affinities to all pixels determine the kernel. Paper: Sec. II-C, set A."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, cast

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import stratified
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.kernels.clusters import MULTIPLIED, TRIALS, lloyd, pick, pivots
from nlfilter_torch.core.torch_internals import cached_constants, register
from nlfilter_torch.operator.options import Assignment, FilterOptions, Sampling
from nlfilter_torch.operator.orientation import (
    MOST_CHANNELS,
    ORIENTATIONS,
    Layout,
    Orientation,
    canonical_points,
    orientation_of,
    source_pixels,
    whole_sums,
)

CAPTURED = 1e-4  # a point whose residual on the unit diagonal is below this counts as captured
# Candidates per landmark. More candidates or iterations move the centroids by less than their sampling error: at
# 512x400 pixels and m = 100, twice as many candidates lower the mean diagonal correction by at most 2 %; ten iterations
# by at most 3 %.
PER_LANDMARK = 64
STARTED_FROM = 32  # candidates per landmark from which the start is drawn; more do not lower the error of W y
# Without bounds the cost would be quadratic in the number of landmarks. At 256x256 and m = 1000, the mean diagonal is
# 5 % higher with 16384 candidates than with 32768; drawing the start from more of them does not lower it.
MOST_CANDIDATES = 32768
MOST_STARTED_FROM = 8192
ITERATIONS = 5
# Scores that differ by at most this many units of rounding are tied. Constant and periodic pictures with coordinates
# have many ties, which must not be decided by a kernel's order of summation.
TIE = 16
LARGEST_FEATURE = 1e16  # limit of features: sums of their squares do not overflow float32
MANY = 1 << 24  # a permutation of more pixels than this would take more memory than the image


def assign_landmarks(
    features: Tensor,
    size: tuple[int, ...],
    options: FilterOptions,
    communicator: Communicator = ALONE,
    weights: Tensor | None = None,
    layout: Layout | None = None,
) -> tuple[Tensor, Assignment]:
    """Choose or compute landmarks; also return of which points they are made.

    Args:
        features: (B, D, N).
        size: (H, W), or any other whose product is N.
        options: their number M, at most N, with which the landmarks are the pixels themselves; how they are chosen,
            ``"kmeans"``: Lloyd centroids of a random subset, ``"uniform"``: the paper's spatial grid, ``"random"``:
            distinct random pixels; and the generator: None means a new one with seed 0, so that equal calls give equal
            landmarks.
        communicator: ranks that the rows of the image are distributed over; N is then the number of pixels of this
            rank, and all ranks use what the first one draws.
        weights: (B, N), number of pixels that each point represents; k-means candidates are drawn in proportion to it.
        layout: of the features, if they are those of an image: k-means then chooses the same patches of an image that
            is flipped, transposed or rotated by 90 degrees. Not used with weights.

    Returns:
        (B, D, M), differentiable in the features (for k-means with the assignment held fixed), and the assignment. The
        same pixels are drawn for all images of a batch, but for their orientations, so that a batch without weights
        gives the same results as single calls.
    """
    count, sampling = options.num_landmarks, cast(Sampling, options.landmarks)
    points, alone = math.prod(size), communicator.size == 1
    if count == features.shape[-1] and alone:
        return features.clone(), Assignment(torch.arange(points, device=features.device)[None], None, None, points)
    fixed = options.generator is None and weights is None and alone
    if fixed:
        pixels, draws = _fixed_draws(size, count, sampling)
    else:
        generator = torch.Generator().manual_seed(0) if options.generator is None else options.generator
        pixels = drawn_candidates(size, count, sampling, generator, weights)
        draws = None if len(pixels) == count else cluster_draws(len(pixels), count, generator)
    if layout is not None and sampling == "kmeans" and weights is None:
        orientation = orientations(features, size, layout, communicator)
        source = partial(_fixed_source, orientation.numbers, size, count)
        if not fixed:
            pixels = communicator.broadcast(pixels.to(features.device))
            source = partial(source_pixels, orientation.numbers, size, pixels)
        candidates, subset, chosen = canonical_candidates(features, source, orientation, layout, communicator)
    else:
        pixels = communicator.broadcast(pixels.to(features.device))
        candidates = pixels[None].clone()
        subset = communicator.columns(features, pixels)
        chosen = subset.detach()
    return clustered(subset, chosen, Assignment(candidates, None, None, points), count, draws, communicator)


class ClusterDraws(NamedTuple):
    """What the initial centroids are chosen by.

    Attributes:
        few: numbers (n,) of the candidates that may be chosen.
        numbers: random numbers (M, TRIALS) in [0, 1) that decide the pivots, in float64.
    """

    few: Tensor
    numbers: Tensor


def cluster_draws(candidates: int, count: int, generator: torch.Generator) -> ClusterDraws:
    """Draw which of up to half of the candidates are chosen as initial centroids."""
    few = torch.randperm(candidates, generator=generator, device=generator.device)
    few = few[: _bounded(STARTED_FROM * count, MOST_STARTED_FROM, count)]
    return ClusterDraws(
        few, torch.rand(count, TRIALS, generator=generator, device=generator.device, dtype=torch.float64)
    )


@cached_constants
def _fixed_draws(size: tuple[int, ...], count: int, sampling: Sampling) -> tuple[Tensor, ClusterDraws | None]:
    """What a new generator draws: candidates, and what follows if there are more than ``count``."""
    generator = torch.Generator().manual_seed(0)
    pixels = candidate_pixels(size, count, sampling, generator)
    return pixels, None if len(pixels) == count else cluster_draws(len(pixels), count, generator)


def _fixed_source(orientation: Tensor, size: tuple[int, ...], count: int, *, flipped: bool = True) -> Tensor:
    """:func:`source_pixels` of the candidates that a new generator draws for k-means."""
    return _fixed_sources(size, count, orientation.device, flipped)[orientation]


@cached_constants
def _fixed_sources(size: tuple[int, ...], count: int, device: torch.device, flipped: bool) -> Tensor:
    """The same for every orientation, (8, S)."""
    pixels = candidate_pixels(size, count, "kmeans", torch.Generator().manual_seed(0)).to(device)
    return source_pixels(torch.arange(ORIENTATIONS, device=device), size, pixels, flipped=flipped)


def clustered(
    subset: Tensor,
    canonical: Tensor,
    candidates: Assignment,
    count: int,
    draws: ClusterDraws | None,
    communicator: Communicator = ALONE,
) -> tuple[Tensor, Assignment]:
    """The result of :func:`assign_landmarks` from candidates with features (B, D, S), and those by which they cluster.

    Landmarks are the candidates themselves without ``draws``.
    """
    if draws is None:
        return subset, candidates
    start, assignment = clusters(canonical, count, draws, communicator)
    return means_of_clusters(subset, start, assignment), replace(candidates, clusters=assignment, start=start)


def canonical_candidates(
    features: Tensor,
    source: Callable[..., Tensor],
    orientation: Orientation,
    layout: Layout,
    communicator: Communicator = ALONE,
) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates that have certain numbers in the canonical orientation of each image.

    Args:
        features: (B, D, N), of the rows here.
        source: :func:`source_pixels` of these numbers, with the option ``flipped`` open.
        orientation: of the images.
        layout: of the features.
        communicator: ranks that the rows of the image are distributed over.

    Returns:
        Their indices (B, S) in the images, their features (B, D, S), and those for the canonical orientation.
    """
    candidates, coordinates = source(), None
    subset = communicator.columns(features, candidates.unsqueeze(1))
    if layout.coordinates:
        coordinates = communicator.columns(features[:, -2:].detach(), source(flipped=False).unsqueeze(1))
    return candidates, subset, canonical_points(subset, orientation, layout, coordinates)


def orientations(
    features: Tensor,
    size: Sequence[int],
    layout: Layout,
    communicator: Communicator = ALONE,
    counted: Tensor | None = None,
) -> Orientation:
    """The canonical orientations of images of ``size`` (H, W) with features (B, D, N), those of the rows here.

    Pixels where ``counted`` (B, N) is False do not count.
    """
    area, width = layout.patch * layout.patch, size[1]
    planes = range(area // 2, features.shape[1] - 2 * layout.coordinates, area)
    values = [features[:, plane].detach() for plane in planes[:MOST_CHANNELS]]
    if counted is not None:
        values = [torch.where(counted, plane, plane.amin(1, keepdim=True)) for plane in values]
        counted = counted.unflatten(1, (-1, width))
    least, most = ([getattr(plane, end)(1) for plane in values] for end in ("amin", "amax"))
    ends = torch.stack([-torch.stack(least).amin(0), torch.stack(most).amax(0)], dim=1)  # (B, 2)
    ends = communicator.max(ends)
    span = ends.sum(1, keepdim=True)
    scale = 1 / torch.where(span > 0, span, 1.0)
    sums = [
        whole_sums(((plane + ends[:, :1]) * scale).unflatten(1, (-1, width)), communicator.first_row, size, counted)
        for plane in values
    ]
    return orientation_of(communicator.sum(torch.stack(sums, dim=1)), len(planes))


def landmarks_of(features: Tensor, assignment: Assignment, communicator: Communicator = ALONE) -> Tensor:
    """Landmarks (B, D, M) of features (B, D, N) by an assignment that was made before; differentiable in the features.

    Equal to those of :func:`assign_landmarks`, if that returned the assignment for the same features.
    """
    assignment, batch = assignment.on(features.device), features.shape[0]
    subset = communicator.columns(features, assignment.candidates.unsqueeze(1))
    if assignment.clusters is None or assignment.start is None:
        return subset
    start, members = (tensor.expand(batch, *tensor.shape[1:]) for tensor in (assignment.start, assignment.clusters))
    return means_of_clusters(subset, start, members)


def candidate_pixels(size: tuple[int, ...], count: int, sampling: Sampling, generator: torch.Generator) -> Tensor:
    """Draw indices of distinct pixels, from whose features :func:`condense` computes ``count`` landmarks."""
    pixels = math.prod(size)
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


def drawn_candidates(
    size: tuple[int, ...], count: int, sampling: Sampling, generator: torch.Generator, weights: Tensor | None
) -> Tensor:
    """:func:`candidate_pixels`, those of k-means in proportion to weights (B, N) if there are any.

    They are drawn by :func:`stratified` sampling of the pixels that the points represent.
    """
    if weights is None or sampling != "kmeans":
        return candidate_pixels(size, count, sampling, generator)
    summed = weights.mean(0).double().cumsum(0).cpu()
    summed = summed * (len(summed) / summed[-1]).clamp(min=1.0)  # a point may represent less than a pixel
    draws = weighted_draws(round(float(summed[-1])), count, generator)
    return torch.searchsorted(summed, draws.double(), right=True).clamp_(max=len(summed) - 1)


def weighted_draws(pixels: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw from so many ``pixels`` that points represent, as candidates for ``count`` landmarks."""
    return stratified(pixels, min(pixels, _bounded(PER_LANDMARK * count, MOST_CANDIDATES, count)), generator)


def condense(subset: Tensor, count: int, generator: torch.Generator, points: Tensor | None = None) -> Tensor:
    """Compute landmarks (B, D, M) from features (B, D, S) of the candidates: centroids if S > M.

    Clusters are those of ``points`` (B, D, S), the features for the canonical orientation, if they are not None.
    """
    if subset.shape[2] == count:
        return subset
    draws = cluster_draws(subset.shape[2], count, generator)
    return means_of_clusters(subset, *clusters(subset.detach() if points is None else points, count, draws))


def clusters(
    points: Tensor, count: int, draws: ClusterDraws, communicator: Communicator = ALONE
) -> tuple[Tensor, Tensor]:
    """Cluster points (B, D, S) by k-means: indices (B, 1, M) of the initial centroids, and assignment (B, S)."""
    points = points - points.mean(dim=2, keepdim=True)  # small offsets keep ||x||^2 + ||z||^2 - 2xz accurate
    # Single precision suffices here, and the kernels in C take nothing else.
    points = points.clamp(-LARGEST_FEATURE, LARGEST_FEATURE).float()
    few = draws.few.to(points.device)
    chosen = _pivots(pick(points, few.expand(len(points), 1, -1)), draws.numbers)
    start = communicator.broadcast(few[chosen]).unsqueeze(1)  # (B, 1, M)
    assignment = communicator.broadcast(
        lloyd(points, pick(points, start), ITERATIONS, TIE * torch.finfo(points.dtype).eps)
    )
    return start, assignment


def candidate_count(pixels: int, count: int, sampling: str) -> int:
    """Number of pixels that :func:`candidate_pixels` draws."""
    if sampling != "kmeans":
        return count
    # Unlike min, sym_min asks nothing of a number of pixels that a program does not know.
    fewer: int = torch.sym_min(pixels, _bounded(PER_LANDMARK * count, MOST_CANDIDATES, count))
    return fewer


def _bounded(candidates: int, most: int, count: int) -> int:
    """Limit a number of candidates to ``most``, or to twice ``count`` if that is more."""
    return min(candidates, max(most, 2 * count))


def _grid(size: tuple[int, ...], count: int) -> Tensor:
    """Indices of ``count`` pixels spread evenly over an image of ``size``, as rows of nearly equal length.

    A volume is divided into slices with nearly equal numbers of voxels, each of which is such a grid.
    """
    height, *row_size = size
    if not row_size:
        return (2 * torch.arange(count) + 1) * height // (2 * count)
    width = math.prod(row_size)
    rows = round((count * height ** len(row_size) / width) ** (1 / len(size)))
    rows = min(max(rows, -(-count // width), 1), height, count)
    lengths = [count // rows + (row < count % rows) for row in range(rows)]
    lines = []
    for row, length in enumerate(lengths):
        y = (2 * row + 1) * height // (2 * rows)
        lines.append(y * width + _grid(tuple(row_size), length))
    return torch.cat(lines)


def _pivots(points: Tensor, draws: Tensor) -> Tensor:
    """Choose initial centroids (B, M) among points (B, D, S), by random numbers (M, TRIALS).

    They are pivots of a randomly pivoted Cholesky decomposition.

    Pivots are proposed in proportion to the fourth power of the residual: the part of the kernel's unit diagonal that
    the earlier pivots do not capture (Chen, Epperly, Tropp and Webber, 2022). Rare patches that are unlike all others
    thus get a landmark; uniform sampling would miss them, and k-means would never move a centroid there. The fourth
    power is greedier than the residual itself: at h_y = 40/255 the error of W y on the small astronaut of
    benchmarks.accuracy is 0.55 grey levels with it, 0.79 with the first power, and 0.71 if k-means starts from
    arbitrary candidates. Half of the proposals depend on the distance from the nearest pivot too, so that clusters
    wider than the bandwidth are not missed, and of several times as many proposals those that cover most are taken.
    """
    together = points.device.type != "cpu" or len(draws) <= MULTIPLIED  # on CPUs products are of one image at a time
    draws = draws.to(points)
    return torch.cat([pivots(part, draws, CAPTURED) for part in points.split(len(points) if together else 1)])


def means_of_clusters(subset: Tensor, start: Tensor, assignment: Tensor) -> Tensor:
    """Landmarks (B, D, M): means of candidates (B, D, S) by the result of :func:`clusters`.

    The landmark of an empty cluster is its initial centroid.
    """
    extended = torch.cat([subset, torch.ones_like(subset[:, :1])], dim=1)  # for sums and sizes at once
    add = _sums_in_order if subset.device.type == "cpu" else _sums_by_product
    sums = add(extended, assignment, start.shape[2])
    sizes = sums[:, -1:]
    return torch.where(sizes > 0, sums[:, :-1] / sizes.clamp(min=1.0), pick(subset, start))


def _sums_in_order(points: Tensor, assignment: Tensor, count: int) -> Tensor:
    """Sums (B, D, M) of the points of each cluster, added up in order."""
    zeros = points.new_zeros(*points.shape[:2], count)
    return zeros.scatter_add(2, assignment.unsqueeze(1).expand_as(points), points)


def _sums_by_product(points: Tensor, assignment: Tensor, count: int) -> Tensor:
    """Sums (B, D, M) as in :func:`_sums_in_order` on accelerators, where scatter_add has no fixed order."""
    members = points.new_zeros(points.shape[0], count, points.shape[2])
    return points @ members.scatter_(1, assignment.unsqueeze(1), 1.0).mT


def _fake_choice(
    features: Tensor, size: Sequence[int], count: int, sampling: str, patch: int, coordinates: bool
) -> tuple[Tensor, ...]:
    batch, candidates = features.shape[0], candidate_count(math.prod(size), count, sampling)
    shapes = (batch, candidates), (batch, 1, count), (batch, candidates)
    return tuple(features.new_empty(shape, dtype=torch.long) for shape in shapes)


@register(
    "choose(Tensor features, SymInt[] size, int count, str sampling, int patch, bool coordinates)"
    " -> (Tensor, Tensor, Tensor)",
    None,
    _fake_choice,
)
def choose(
    features: Tensor, size: Sequence[int], count: int, sampling: Sampling, patch: int, coordinates: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Choose candidates (B, S), initial centroids among them (B, 1, M) and their assignment to clusters (B, S).

    ``patch`` and ``coordinates`` are the :class:`Layout` of the features; a width of 0 means that there is none.
    """
    if sampling != "uniform" and torch.compiler.is_compiling():  # traced through: a program holds no random numbers
        raise ValueError(
            f"landmarks must be given or 'uniform' in a portable program, got {sampling!r}; pass an operator, and "
            "hold='features'"
        )
    layout = Layout(patch, coordinates) if patch else None
    options = FilterOptions(num_landmarks=count, landmarks=sampling)
    assignment = assign_landmarks(features, tuple(size), options, layout=layout)[1]
    batch = (len(features), -1)
    candidates = assignment.candidates.expand(*batch).contiguous()
    if assignment.clusters is None or assignment.start is None:  # each is a cluster of its own
        alone = torch.arange(count, device=features.device).expand(*batch)
        return candidates, alone.unsqueeze(1).contiguous(), alone.contiguous()
    return candidates, assignment.start, assignment.clusters


def choose_in_graph(
    features: Tensor, size: tuple[int, ...], count: int, sampling: Sampling, layout: Layout | None = None
) -> tuple[Tensor, Assignment]:
    """:func:`assign_landmarks` in a form that can be compiled; chooses the same landmarks as without a generator."""
    # Nothing here depends on the size of the image, so that a program serves for all sizes.
    patch, coordinates = (0, False) if layout is None else (layout.patch, layout.coordinates)
    pixels, start, clusters = choose(features.detach(), size, count, sampling, patch, coordinates)
    means = sampling == "kmeans"
    assignment = Assignment(pixels, clusters if means else None, start if means else None, features.shape[2])
    return landmarks_of(features, assignment), assignment


def landmarks_by(
    features: Tensor,
    size: tuple[int, ...],
    options: FilterOptions,
    communicator: Communicator = ALONE,
    weights: Tensor | None = None,
    layout: Layout | None = None,
) -> tuple[Tensor, Assignment | None]:
    """Landmarks (B, D, M) for features (B, D, N) of an image of ``size``, by some options, if they are to be chosen.

    Also returns of which points they are made; None for landmarks that were passed as features.

    Raises:
        ValueError: if the landmarks do not fit the features.
    """
    landmarks = options.landmarks
    if isinstance(landmarks, str):
        if torch.compiler.is_compiling():  # never with a generator, weights or a group
            return choose_in_graph(features, size, options.num_landmarks, landmarks, layout)
        return assign_landmarks(features, size, options, communicator, weights, layout)
    batch, points = features.shape[0], math.prod(size)
    if isinstance(landmarks, Assignment):
        _check_assignment(landmarks, batch, points)
        return landmarks_of(features, landmarks, communicator), landmarks
    if not isinstance(landmarks, Tensor):
        if landmarks.assignment is not None and landmarks.assignment.serves(batch, points):
            return landmarks_of(features, landmarks.assignment, communicator), landmarks.assignment
        landmarks = landmarks.landmarks.detach()
    _check_features(landmarks, features)
    return communicator.copy_to_group(landmarks.to(features.dtype)).expand(batch, -1, -1), None


def _check_assignment(assignment: Assignment, batch: int, points: int) -> None:
    """Raise unless landmarks can be computed by an assignment."""
    if not assignment.serves(batch, points):
        images = f"{assignment.batch} images" if assignment.batch > 1 else "one image"
        raise ValueError(
            f"landmarks must be an assignment of {points} points of {batch} images, got one of {assignment.points} "
            f"points of {images}; pass the operator or its landmarks, whose features are then kept"
        )


def _check_features(landmarks: Tensor, features: Tensor) -> None:
    """Raise unless landmarks (B, D, M) fit features (B, D, N)."""
    batch, size, _ = features.shape
    if landmarks.shape[1] != size:
        raise ValueError(
            f"landmarks must have shape (B, {size}, M), with as many features as the points, got "
            f"{tuple(landmarks.shape)}; take them from an operator with the same patch size, channels and coordinates"
        )
    if landmarks.shape[0] not in (1, batch):
        raise ValueError(
            f"landmarks must have a batch size of 1 or {batch}, like the points, got {landmarks.shape[0]}; "
            "pass landmarks[:1] to use the same for all"
        )
    if landmarks.device != features.device:
        raise ValueError(
            f"landmarks must be on the device of the points, {features.device}, got {landmarks.device}; move one by "
            ".to()"
        )
