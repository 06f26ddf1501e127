"""Sweeps over a factor that balancing is made of: each reads it once, although it forms two products with it."""

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import SWEPT, pixel_blocks
from nlfilter_torch.core.kernels.library import by_rows, pointer, register, repeated, run_on_factor
from nlfilter_torch.core.kernels.tall_skinny import gather, moment, spread


def positive_root(half: Tensor, diagonal: Tensor) -> Tensor:
    """The positive root d of ``d (2 half + diagonal d) = 1``, without cancellation whichever sign ``half`` has."""
    root = torch.addcmul(diagonal, half, half).sqrt()
    # Without a diagonal a negative sum has no root; the bound, below the rounding of 1 - |u|^2, keeps d finite.
    least = torch.finfo(half.dtype).eps / 4
    return torch.where(half < 0, (root - half) / diagonal.clamp(min=least), (root + half).clamp(min=least).reciprocal())


def _empty(factor: Tensor) -> tuple[Tensor, Tensor]:
    """Room for a number of every pixel, (B, N), and a moment of zeros, (B, M) in float64."""
    batch, landmarks, pixels = factor.shape
    return factor.new_empty(batch, pixels), factor.new_zeros(batch, landmarks, dtype=torch.float64)


def _run(
    factor: Tensor, row: Tensor, scaling: Tensor | None, diagonal: Tensor | None, most: float
) -> tuple[Tensor, Tensor]:
    out, found = _empty(factor)
    factor = by_rows(factor)
    batch, landmarks, pixels = factor.shape
    row = repeated(row, batch, landmarks)
    scaling, diagonal = (t if t is None else repeated(t, batch, pixels) for t in (scaling, diagonal))
    run_on_factor(
        "sweep", factor, row.data_ptr(), pointer(scaling), pointer(diagonal), most, out.data_ptr(), found.data_ptr()
    )
    return out, found


def _compiled_sweep(
    factor: Tensor, diagonal: Tensor, half: Tensor, most: float, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    scaling, found = _run(factor, half, None, diagonal, most)
    return scaling, found if weights is None else moment(factor, (weights * scaling).unsqueeze(1)).squeeze(2)


@register(
    "sweep(Tensor factor, Tensor diagonal, Tensor half, float most, Tensor? weights=None) -> (Tensor, Tensor)",
    _compiled_sweep,
    lambda factor, *_: _empty(factor),
)
def sweep(
    factor: Tensor, diagonal: Tensor, half: Tensor, most: float, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The scaling d (B, N) of every pixel for a guess at the moment, and the moment (B, M) in float64 that it has.

    It takes ``half`` of the guess t, (B, M), the ``most`` that d may be, and how many pixels each of them stands for,
    (B, N); None is one. The moment is ``factor @ (weights * d)``.
    """
    scaling, found = _empty(factor)
    row = half.unsqueeze(2).mT
    for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
        columns = factor[:, :, block]
        root = positive_root(spread(row, columns).squeeze(1), diagonal[:, block])
        part = torch.clamp(root, max=most, out=scaling[:, block])
        part = part if weights is None else part * weights[:, block]
        found += gather(part.unsqueeze(1), columns).squeeze(1)
    return scaling, found


def _compiled_weigh(factor: Tensor, weights: Tensor, vector: Tensor) -> Tensor:
    return _run(factor, vector, weights, None, 0.0)[1]


@register(
    "weigh(Tensor factor, Tensor weights, Tensor vector) -> Tensor",
    _compiled_weigh,
    lambda factor, *_: _empty(factor)[1],
)
def weigh(factor: Tensor, weights: Tensor, vector: Tensor) -> Tensor:
    """``factor diag(weights) factor^T vector``, (B, M) in float64, of a factor (B, M, N), (B, N) and (B, M)."""
    _, found = _empty(factor)
    row = vector.unsqueeze(2).mT
    for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
        columns = factor[:, :, block]
        found += gather(weights[:, None, block] * spread(row, columns), columns).squeeze(1)
    return found
