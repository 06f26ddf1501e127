"""Exported programs without the custom operators of this package: for ONNX, and for programs that run without Python.

A program from ``torch.export`` calls ``torch.ops.nlfilter`` where an operator is built and applied. The functions below
compute the same from operations that every runtime has. They do not depend on values and take a fixed number of steps:
an inverse square root by Newton-Schulz iteration replaces the Cholesky decomposition, which ONNX lacks, and balancing
is by Chebyshev semi-iteration. As on accelerators, isolated pixels are not removed and eigenvalues above 1 not reduced.
"""

from collections.abc import Callable, Sequence
from itertools import islice
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from nlfilter_torch.core.kernels.clusters import UNCOVERED, best_trial, odds, pick
from nlfilter_torch.core.kernels.columns import PLAIN_EXPONENT, SMALLEST_EXPONENT
from nlfilter_torch.core.torch_internals import outside_modes
from nlfilter_torch.operator.assignment import Layout
from nlfilter_torch.operator.landmarks import (
    CAPTURED,
    DRAWN_SINGLY,
    ITERATIONS,
    LARGEST,
    TIE,
    candidate_pixels,
    canonical_candidates,
    draw_few,
    orientations,
    pivot_draws,
)
from nlfilter_torch.operator.nystrom import JITTER
from nlfilter_torch.operator.options import Sampling
from nlfilter_torch.operator.sinkhorn import LARGEST_SCALING, SMALLEST_SUM, TRUSTED, Rounds, chebyshev_weights

SWEEPS = 16
CONVERGED = 1e-12  # distance from 1, the limit of all eigenvalues of the Newton-Schulz iteration


class PortableForms(TorchFunctionMode):
    """Context that replaces ``torch.ops.nlfilter`` operators, and functions ONNX lacks, by their portable forms."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call the portable form of a function if there is one, otherwise the function itself."""
        return FORMS.get(func, func)(*args, **(kwargs or {}))


def choose(
    features: Tensor, size: Sequence[int], count: int, sampling: Sampling, patch: int, coordinates: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`nlfilter_torch.operator.landmarks.choose`, with the random numbers as constants of the program."""
    with outside_modes():
        generator = torch.Generator().manual_seed(0)
        drawn = candidate_pixels(tuple(size), count, sampling, generator)
        few = draw_few(len(drawn), count, generator)
        draws = pivot_draws(count, generator).float()
    pixels, first = (torch.tensor(constant.tolist(), device=features.device) for constant in (drawn, few))
    batch = features.shape[0]
    if len(pixels) == count:
        alone = torch.arange(count, device=features.device).expand(batch, -1)
        return pixels.expand(batch, -1), alone.unsqueeze(1), alone
    if count > DRAWN_SINGLY:
        raise ValueError(
            f"num_landmarks must be at most {DRAWN_SINGLY} in a portable program with landmarks='kmeans', got {count}; "
            "use landmarks='uniform'"
        )
    if patch:
        layout = Layout(patch, coordinates)
        orientation = orientations(features, size, layout)
        candidates, _, points = canonical_candidates(features, size, pixels, orientation, layout)
    else:
        candidates = pixels.expand(batch, -1)
        points = pick(features, candidates.unsqueeze(1))
    points = (points - points.mean(dim=2, keepdim=True)).clamp(-LARGEST, LARGEST).float()
    chosen = _pivots(pick(points, first.expand(batch, 1, -1)), draws.tolist())  # (B, M)
    start = first.expand(batch, -1).gather(1, chosen).unsqueeze(1)
    return candidates, start, _lloyd(points, pick(points, start))


def _pivots(points: Tensor, draws: list[list[float]]) -> Tensor:
    """As :func:`nlfilter_torch.core.kernels.clusters.pivots`."""
    last = points.shape[2] - 1
    norms = points.square().sum(1, keepdim=True)
    rows, residual, nearest = points[:, :0], torch.ones_like(norms), torch.full_like(norms, UNCOVERED)
    known = torch.cat([points, norms], dim=1)
    chosen: list[Tensor] = []
    for numbers in draws:
        pivot, apart = _pivot(known, residual, nearest, numbers, last)
        row = apart.clamp(max=-PLAIN_EXPONENT).neg().exp()
        row = row - torch.bmm(pick(rows, pivot).mT, rows) if chosen else row
        row = row / row.gather(2, pivot).clamp(min=CAPTURED).sqrt()
        residual = residual - row.square()
        nearest = torch.minimum(nearest, apart).scatter(2, pivot, 0.0)
        rows = torch.cat([rows, row], dim=1)
        chosen.append(pivot)
    return torch.cat(chosen, dim=2).squeeze(1)


def _pivot(known: Tensor, residual: Tensor, nearest: Tensor, numbers: list[float], last: int) -> tuple[Tensor, Tensor]:
    """A pivot (B, 1, 1) and the squared distances (B, 1, S) from it of points and their squared norms (B, D + 1, S)."""
    rows = odds(residual, nearest, CAPTURED).double().cumsum(2).unbind(1)
    half = len(numbers) // 2
    draws = [(rows[position // half], number) for position, number in enumerate(numbers)]
    proposed = torch.stack([(row < number * row[:, -1:]).sum(1).clamp(max=last) for row, number in draws], dim=1)
    others = pick(known, proposed.unsqueeze(1))  # (B, D + 1, TRIALS)
    inner = torch.bmm(others[:, :-1].mT, known[:, :-1])
    apart = (known[:, -1:] + others[:, -1:].mT - 2 * inner).clamp(min=0.0)
    best = best_trial(apart, nearest, torch.ones_like(nearest))
    return proposed.unsqueeze(1).gather(2, best), pick(apart.mT, best).mT


def _lloyd(points: Tensor, start: Tensor) -> Tensor:
    """As :func:`nlfilter_torch.core.kernels.clusters.lloyd`."""
    margin = TIE * torch.finfo(points.dtype).eps
    extended = torch.cat([points, torch.ones_like(points[:, :1])], dim=1)
    rows = extended.mT
    slack = margin * points.square().sum(1).unsqueeze(2)
    numbers = torch.arange(start.shape[2], device=points.device)
    centres = start
    for step in range(ITERATIONS + 1):
        score = torch.bmm(rows, torch.cat([centres, -0.5 * centres.square().sum(1, keepdim=True)], dim=1))
        best = score.amax(2, keepdim=True)
        nearest = (score >= best - (slack + margin * best.abs())).byte().argmax(2)
        if step == ITERATIONS:
            break
        sums = torch.bmm(extended, (nearest.unsqueeze(2) == numbers).to(points.dtype))
        sizes = sums[:, -1:]
        centres = torch.where(sizes > 0, sums[:, :-1] / sizes.clamp(min=1.0), start)
    return nearest


def columns(features: Tensor, landmarks: Tensor, inverse: Tensor, limited: bool) -> tuple[Tensor, Tensor]:
    """As :func:`nlfilter_torch.core.kernels.columns.columns`, for all pixels at once."""
    centre = landmarks.mean(dim=2, keepdim=True)
    points, centred = landmarks - centre, features - centre
    norms, lengths = centred.square().sum(1, keepdim=True), points.square().sum(1).unsqueeze(2)
    exponents = 2 * torch.bmm(points.mT, centred) - norms - lengths
    factor = torch.bmm(inverse, exponents.clamp(SMALLEST_EXPONENT if limited else PLAIN_EXPONENT, 0.0).exp())
    norms = factor.square().sum(1)
    if not limited:
        return factor, torch.ones_like(norms)
    return factor * norms.clamp(min=1.0).rsqrt().unsqueeze(1), norms


def inverse_root(affinity: Tensor) -> Tensor:
    """Inverse square root (B, M, M) of the affinities between landmarks, in place of the inverse Cholesky factor.

    Either of the two, times the affinities of pixels, gives a Nystrom factor; the factors differ by a rotation. In the
    coupled Newton-Schulz iteration all eigenvalues tend to 1; scaling by a bound of the smallest halves the steps.
    """
    batch, count, _ = affinity.shape
    identity = torch.eye(count, dtype=affinity.dtype, device=affinity.device).expand(batch, -1, -1)
    most = affinity.sum(2, keepdim=True).amax(1, keepdim=True)  # bounds the eigenvalues; at most M + JITTER
    root, inverse = affinity / most, identity
    least = (JITTER / (count + JITTER)) ** 0.5
    while least < 1 - CONVERGED:
        scale = (3 / (1 + least + least * least)) ** 0.5
        step = torch.baddbmm(identity, inverse, root, beta=1.5 * scale, alpha=-0.5 * scale**3)
        root, inverse = torch.bmm(root, step), torch.bmm(step, inverse)
        least = scale * least * (3 - (scale * least) ** 2) / 2
    return inverse / most.sqrt()


def _row_sums(factor: Tensor, diagonal: Tensor, scaling: Tensor) -> tuple[Tensor, Tensor]:
    """Row sums (B, N, 1) of W for a scaling (B, N, 1), and the moment (B, M, 1)."""
    total = torch.bmm(factor, scaling)
    return scaling * (torch.bmm(factor.mT, total) + diagonal * scaling), total


def sinkhorn(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """As :func:`nlfilter_torch.operator.sinkhorn.sinkhorn`, by Chebyshev semi-iteration alone."""
    diagonal = diagonal.unsqueeze(2)
    scaling = _row_sums(factor, diagonal, torch.ones_like(diagonal))[0].clamp(min=SMALLEST_SUM).rsqrt()
    move = torch.zeros_like(scaling)
    for momentum, gain in islice(chebyshev_weights(1.0, 2.0), SWEEPS):
        move = momentum * move - gain * _row_sums(factor, diagonal, scaling)[0].clamp(*TRUSTED).log()
        scaling = (scaling * move.exp()).clamp(max=LARGEST_SCALING)
    sums, total = _row_sums(factor, diagonal, scaling)
    identity = torch.eye(factor.shape[1], dtype=torch.float64, device=factor.device).expand(len(factor), -1, -1)
    moments = total.double().unsqueeze(0).expand(Rounds.MOST + 1, -1, -1, -1)
    residual, removed = (sums - 1).abs().amax((1, 2)), torch.zeros_like(scaling, dtype=torch.bool)
    return scaling.squeeze(2), moments, residual, identity, removed.squeeze(2)


def spread(rows: Tensor, factor: Tensor, scaling: Tensor | None = None) -> Tensor:
    """As :func:`nlfilter_torch.core.kernels.tall_skinny.spread`."""
    return rows @ factor if scaling is None else rows @ factor * scaling.unsqueeze(1)


def moment(factor: Tensor, images: Tensor) -> Tensor:
    """As :func:`nlfilter_torch.core.kernels.tall_skinny.moment`, but summed in the precision of the factor."""
    return (factor @ images.mT).double()


def without(factor: Tensor, removed: Tensor) -> Tensor:
    """As :func:`nlfilter_torch.operator.sinkhorn.without`, for no removed pixel."""
    return factor


def hypot(down: Tensor, right: Tensor) -> Tensor:
    """As :func:`torch.hypot`, which ONNX lacks, except that squares of values above 1e19 overflow."""
    return (down.square() + right.square()).sqrt()


FORMS: dict[Callable[..., Any], Callable[..., Any]] = {
    torch.hypot: hypot,
    torch.ops.nlfilter.choose.default: choose,
    torch.ops.nlfilter.columns.default: columns,
    torch.ops.nlfilter.invert.default: inverse_root,
    torch.ops.nlfilter.moment.default: moment,
    torch.ops.nlfilter.sinkhorn.default: sinkhorn,
    torch.ops.nlfilter.spread.default: spread,
    torch.ops.nlfilter.without.default: without,
}
