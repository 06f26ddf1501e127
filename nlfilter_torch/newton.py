"""Balancing by Newton's method on the moment ``t = factor @ d``, with the Jacobian of a sample of the pixels.

Given t, a pixel's equation ``d (u . t + c d) = 1`` is a quadratic with one positive root d(t), so M numbers are all
that is unknown: ``t = sum_i u_i d_i(t)``. The Jacobian of ``t - sum_i u_i d_i(t)`` is symmetric,

    J = I + sum_i w_i u_i u_i^T,    w = d^2 / (1 + c d^2),

with its spectrum in [1, 2] at the solution. It costs as much as 14 sweeps over the factor, its sum over a sample next
to nothing. Pixels enter the sample in proportion to ``w |u|^2``, their leverage, so that the rare ones, which a uniform
sample misses and which converge last, are in it: on photographs of a megapixel each sweep then gains a factor of 10 to
100, where Chebyshev's iteration gains 5.8.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch import native
from nlfilter_torch.blocks import SWEPT, pixel_blocks
from nlfilter_torch.sharding import Shard, reduce_max, reduce_sum
from nlfilter_torch.thin import gather, spread

PER_LANDMARK = (32, 160)  # pixels of the sample, least and most: its Jacobian is then within 18 or 8 % of the true one
EXPLORED = 8192  # pixels that the first guess comes from, at most
SHARE = 8  # the part of the pixels that either is, between these bounds
LARGE = 64  # the part that the sample is at least: four times the pixels have rarer ones, and take no sweep more for it
GUESSES = 3  # steps that it takes towards their fixed point; more gain nothing for the pixels that are not among them
REFINEMENTS = 3  # steps of Newton's method on the sample; with two the inverse is that of a t still on its way
GOLDEN = 0.6180339887498949  # its multiples, modulo 1, fall evenly and on no period of the image
LARGEST = 2.0  # K has a unit diagonal and its entries are not negative but for errors, so that no d exceeds 1
SMALLEST_AFFINITY = 1e-12  # keeps the plain method, whose affinities may be negative, finite
MAX_SWEEPS = 12
ACCELERATOR_SWEEPS = 5  # on an accelerator a look at the residual would stop the queue
ROUGH = 0.2  # a sweep that gains less than a factor of five asks for another sample
STALL = 1e-3  # below this residual, two sweeps in turn that do not halve it have met rounding


def scaling_from_moment(factor: Tensor, diagonal: Tensor, total: Tensor) -> Tensor:
    """The scaling (B, N) of any pixels, given the moment ``factor @ d`` (B, M, 1) of a balanced image.

    A pixel's equation is ``d (u . total + diagonal d) = 1``, so 1/d is the positive root of a quadratic.
    """
    half = spread((total / 2).mT, factor).squeeze(1).clamp_(min=SMALLEST_AFFINITY)
    return (torch.addcmul(diagonal, half, half).sqrt() + half).reciprocal()


@dataclass(frozen=True)
class Sample:
    """Pixels that stand for the image.

    Attributes:
        factor: their columns, (B, M, n).
        diagonal: (B, n).
        weight: how many pixels each stands for, (B, n).
        shard: of the image, where other ranks have samples of the rest of it.
    """

    factor: Tensor
    diagonal: Tensor
    weight: Tensor
    shard: Shard | None

    def scaling(self, total: Tensor) -> Tensor:
        """Their d (B, n), given t (B, M, 1) in float64."""
        return scaling_from_moment(self.factor, self.diagonal, total.to(self.factor)).clamp_(max=LARGEST)

    def moment(self, scaling: Tensor) -> Tensor:
        """The sample's estimate of ``factor @ d``, (B, M, 1) in float64."""
        return reduce_sum(gather((self.weight * scaling).unsqueeze(1), self.factor).mT.double(), self.shard)

    def jacobian(self, scaling: Tensor) -> Tensor:
        """J, (B, M, M) in float64."""
        slope = scaling.square()
        slope = self.weight * slope / (1 + self.diagonal * slope)
        if native.suits(self.factor, slope):
            gram = native.grams(self.factor, slope.sqrt(), slope, 1)[:, 0].to(self.factor)
        else:
            gram = (self.factor * slope.unsqueeze(1)) @ self.factor.mT
        gram = reduce_sum(gram, self.shard)
        return gram.double() + torch.eye(gram.shape[1], dtype=torch.float64, device=gram.device)

    def residual(self, total: Tensor, found: Tensor) -> Tensor:
        """Largest deviation of a row sum from 1 among the sample, (B,), where d(total) has the moment ``found``."""
        return row_residual(self.factor, self.scaling(total), total - found, self.shard)


def row_residual(factor: Tensor, scaling: Tensor, error: Tensor, shard: Shard | None = None) -> Tensor:
    """Largest ``|d u . error|``, (B,): what row sums lack where d is the root for a total that is off by ``error``."""
    return reduce_max(spread(error.to(factor).mT, factor, scaling).abs().amax((1, 2)), shard)


def _draw(factor: Tensor, diagonal: Tensor, scaling: Tensor, count: int, shard: Shard | None) -> tuple[Sample, Tensor]:
    """A systematic sample in proportion to leverage, and its part of ``scaling``, (B, n)."""
    if 2 * count >= factor.shape[2]:
        return Sample(factor, diagonal, torch.ones_like(diagonal), shard), scaling
    slope = scaling.square()
    leverage = slope * (1 - diagonal) / (1 + slope * diagonal) + 1e-12  # |u|^2 is 1 - c
    summed = leverage.double().cumsum(1)
    ticks = (torch.arange(count, dtype=torch.float64, device=factor.device) + 0.5) / count
    chosen = torch.searchsorted(summed, summed[:, -1:] * ticks).clamp_(max=factor.shape[2] - 1)  # (B, n)
    weight = (summed[:, -1:] / count).to(factor) / leverage.gather(1, chosen)
    columns = factor.gather(2, chosen.unsqueeze(1).expand(-1, factor.shape[1], -1))
    return Sample(columns, diagonal.gather(1, chosen), weight, shard), scaling.gather(1, chosen)


def _guess(factor: Tensor, diagonal: Tensor, shard: Shard | None) -> Tensor:
    """A first t (B, M, 1), from a few thousand pixels that are spread evenly over the image."""
    pixels = factor.shape[2]
    few, rest = factor, diagonal
    count = min(max(pixels // SHARE, 16 * factor.shape[1]), EXPLORED)
    if 2 * count < pixels:
        steps = torch.arange(count, dtype=torch.float64, device=factor.device) * GOLDEN
        chosen = (steps.frac() * pixels).long().sort().values
        few, rest = factor.gather(2, chosen.expand(*factor.shape[:2], -1)), diagonal[:, chosen]
    sample = Sample(few, rest, torch.full_like(rest, pixels / few.shape[2]), shard)
    sums = spread(sample.moment(torch.ones_like(rest)).to(few).mT, few).squeeze(1) + rest
    total = sample.moment(sums.clamp_(min=1.0).rsqrt_())  # no row of K sums to less than its unit diagonal
    for _ in range(GUESSES):
        total = (total + sample.moment(sample.scaling(total))) / 2
    return total


def _sweep(factor: Tensor, diagonal: Tensor, total: Tensor, shard: Shard | None) -> tuple[Tensor, Tensor]:
    """d(t) for all pixels, (B, N), and its moment (B, M, 1): one read of the factor."""
    half = (total / 2).squeeze(2).to(factor)
    if native.suits(factor, diagonal, half):
        scaling, found = native.sweep(factor, diagonal, half, SMALLEST_AFFINITY, LARGEST)
        return scaling, reduce_sum(found.unsqueeze(2), shard)
    scaling, found = torch.empty_like(diagonal), torch.zeros_like(total)
    row = total.to(factor)
    for block in pixel_blocks(factor.shape[2], factor.shape[0], factor.device, length=SWEPT):
        columns = factor[:, :, block]
        torch.clamp(scaling_from_moment(columns, diagonal[:, block], row), max=LARGEST, out=scaling[:, block])
        found += gather(scaling[:, None, block], columns).mT
    return scaling, reduce_sum(found, shard)


def solve(
    factor: Tensor, diagonal: Tensor, tolerance: float, shard: Shard | None = None
) -> tuple[Tensor, Tensor, Tensor, int, Tensor]:
    """Scaling (B, N), its moment (B, M, 1) and residual (B,), the sweeps, and an estimate of J^-1, (B, M, M)."""
    watched = factor.device.type == "cpu"
    least, most = (bound * factor.shape[1] // (1 if shard is None else len(shard.rows)) for bound in PER_LANDMARK)
    count = max(min(factor.shape[2] // SHARE, max(most, factor.shape[2] // LARGE)), least)  # of the sample, here
    scaling, found = _sweep(factor, diagonal, _guess(factor, diagonal, shard), shard)
    total = found
    worst, slow, gain = 1.0, 0, 1.0
    for sweeps in range(1, (MAX_SWEEPS if watched else ACCELERATOR_SWEEPS) + 1):
        if gain > ROUGH if watched else sweeps < 3:
            sample, part = _draw(factor, diagonal, scaling, count, shard)
            # The sample foretells how the moment changes with t; its value here is known, so is the sample's error.
            error = found - sample.moment(part)
            for _ in range(REFINEMENTS):
                part = sample.scaling(total)
                # J is positive definite; its Cholesky factor, unlike batched LU in MKL, withstands several threads.
                lower = torch.linalg.cholesky_ex(sample.jacobian(part)).L
                total = total - torch.cholesky_solve(total - sample.moment(part) - error, lower)
            inverse = torch.cholesky_inverse(lower)
        else:
            total = total - inverse @ (total - found)
        scaling, found = _sweep(factor, diagonal, total, shard)
        if not watched:
            continue
        previous, worst = worst, sample.residual(total, found).max().item()
        gain = worst / previous
        slow = slow + 1 if gain > 0.5 else 0
        if worst <= tolerance or (worst < STALL and slow > 1):
            residual = row_residual(factor, scaling, total - found, shard)
            if slow > 1 or bool((residual <= tolerance).all()):
                break
    else:
        residual = row_residual(factor, scaling, total - found, shard)
    return scaling, found, residual, sweeps, inverse
