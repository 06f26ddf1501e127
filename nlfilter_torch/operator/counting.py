"""Points of weight 0, which are filtered but do not count: padding, hidden or unknown pixels.

Sums over points do not contain them, so that they take no part in balancing and landmarks are not made of them. Their
own rows of W are computed afterwards, as those of points of another image: from what counts, with little weight on the
point's own value, so that W extends what is known to them.
"""

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.clusters import pick
from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.operator.landmarks import (
    assign_landmarks,
    canonical_candidates,
    cluster_draws,
    clustered,
    drawn_candidates,
    orientations,
)
from nlfilter_torch.operator.options import Assignment, FilterOptions
from nlfilter_torch.operator.orientation import Layout, source_pixels
from nlfilter_torch.operator.scaling import KernelMatrix

# Share of the diagonal correction that a point of weight 0 keeps: its own value counts where little else does.
OWN = 1e-3
LITTLE = 1e-6  # affinities to all that counts, below which a point of weight 0 keeps its value


def hidden_points(weights: Tensor | None) -> Tensor | None:
    """The points of weight 0, (B, N) bool; None if there are none. Reads values."""
    if weights is None:
        return None
    hidden = weights == 0
    return hidden if bool(hidden.any()) else None


def assign_among_counted(
    features: Tensor,
    size: tuple[int, ...],
    options: FilterOptions,
    weights: Tensor,
    layout: Layout | None = None,
) -> tuple[Tensor, Assignment | None]:
    """:func:`~nlfilter_torch.operator.landmarks.assign_landmarks`, of the points that count in each image.

    The landmarks are those of an image without its padding. ``weights`` (B, N) may be 0. The assignment is None if the
    images differ in their numbers of candidates.
    """
    generator = torch.Generator().manual_seed(0) if options.generator is None else options.generator
    options, state, count = replace(options, generator=generator), generator.get_state(), options.num_landmarks
    parts = []
    for image, row in zip(features.split(1), weights, strict=True):
        generator.set_state(state)  # all images of a batch use the same random numbers
        kept = row.nonzero().squeeze(1)
        if layout is not None and options.landmarks == "kmeans" and count < len(kept):
            landmarks, assignment = _in_canonical_order(image, size, count, generator, row, kept, layout)
        else:
            counted = _uneven(row[kept].unsqueeze(0))
            landmarks, assignment = assign_landmarks(image[:, :, kept], _size_of(kept, size), options, weights=counted)
            assignment = replace(assignment, candidates=kept[assignment.candidates])
        parts.append((landmarks, replace(assignment, points=math.prod(size))))
    return torch.cat([landmarks for landmarks, _ in parts]), _joined([assignment for _, assignment in parts])


def _in_canonical_order(
    image: Tensor,
    size: tuple[int, ...],
    count: int,
    generator: torch.Generator,
    weights: Tensor,
    kept: Tensor,
    layout: Layout,
) -> tuple[Tensor, Assignment]:
    """Landmarks of the points ``kept`` (n,) of an image (1, D, N), which turn with it.

    The points are numbered in the canonical orientation of the smallest rectangle that holds them all.
    """
    rows, columns = kept // size[1], kept % size[1]
    (top, left), box = (int(rows.min()), int(columns.min())), (int(rows.max()), int(columns.max()))
    box = (box[0] - top + 1, box[1] - left + 1)
    whole = torch.arange(math.prod(size), device=kept.device).view(size)
    places = whole[top : top + box[0], left : left + box[1]].flatten()
    inside, amounts = image[:, :, places], weights[places]
    if layout.coordinates:  # from the first pixel on, as those of an image without what does not count
        inside = torch.cat([inside[:, :-2], image[:, -2:, whole[: box[0], : box[1]].flatten()]], dim=1)
    orientation = orientations(inside, box, layout, counted=(amounts > 0).unsqueeze(0))
    numbers = source_pixels(orientation.numbers, box, torch.arange(len(places), device=kept.device))[0]
    order = (amounts[numbers] > 0).nonzero().squeeze(1)
    counted = _uneven(amounts[numbers[order]].unsqueeze(0))
    pixels = drawn_candidates((1, len(order)), count, "kmeans", generator, counted).to(order.device)
    draws = None if len(pixels) == count else cluster_draws(len(pixels), count, generator)
    source = partial(source_pixels, orientation.numbers, box, order[pixels])
    candidates, _, chosen = canonical_candidates(inside, source, orientation, layout)
    assignment = Assignment(places[candidates], None, None, math.prod(size))
    return clustered(pick(image, assignment.candidates.unsqueeze(1)), chosen, assignment, count, draws)


def _uneven(weights: Tensor) -> Tensor | None:
    """Weights (1, n), or None if they are all equal."""
    return None if bool((weights == weights[:, :1]).all()) else weights


def _joined(assignments: list[Assignment]) -> Assignment | None:
    """The assignment of a batch, from those of its images."""
    first = assignments[0]
    if any(assignment.kind != first.kind for assignment in assignments):
        return None
    candidates = torch.cat([assignment.candidates for assignment in assignments])
    if first.clusters is None:
        return replace(first, candidates=candidates)
    clusters, start = (
        torch.cat([torch.as_tensor(getattr(assignment, name)) for assignment in assignments])
        for name in ("clusters", "start")
    )
    return replace(first, candidates=candidates, clusters=clusters, start=start)


def _size_of(kept: Tensor, size: tuple[int, ...]) -> tuple[int, ...]:
    """Size of the rectangle or cuboid that points (n,) of an image of ``size`` fill; (1, n) if they fill none."""
    lengths = tuple(int(axis.max() - axis.min()) + 1 for axis in torch.unravel_index(kept, size))
    return lengths if math.prod(lengths) == len(kept) else (1, len(kept))


def extended(
    matrix: KernelMatrix, scaling: Tensor, factor: Tensor, diagonal: Tensor, hidden: Tensor, *, completed: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Factor, diagonal and scaling of a kernel that was balanced without its hidden points, with those of these points.

    Args:
        matrix: the balanced kernel, of factor zero at hidden points.
        scaling: d, (B, N), of the balanced kernel.
        factor: (B, M, N), also of the hidden points.
        diagonal: (B, N), also of the hidden points.
        hidden: (B, N) bool.
        completed: whether the kernel has a unit diagonal.

    Returns:
        Factor (B, M, N), diagonal (B, N) and scaling (B, N); differentiable.
    """
    total = matrix.moment(scaling)
    sums = spread(total.to(factor).mT, factor).squeeze(1)  # u . t
    alone = hidden & ~(sums > (LITTLE if completed else torch.finfo(sums.dtype).tiny ** 0.5))
    sums = torch.where(hidden & ~alone, sums, 1.0)
    own = OWN * diagonal
    root = 2 / (sums + (sums.square() + 4 * own).sqrt()) if completed else 1 / sums  # of d (u . t + c d) = 1
    factor = torch.where(hidden.unsqueeze(1), factor * ~alone.unsqueeze(1), matrix.factor)
    return (
        factor,
        torch.where(hidden, torch.where(alone, 1.0, own), matrix.diagonal),
        torch.where(hidden, torch.where(alone, 1.0, root), scaling),
    )
