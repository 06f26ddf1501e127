"""Finer lattices for what a smooth one leaves of the colours that many pixels have.

The smooth lattice of :mod:`nlfilter_torch.photo.look_fitting.lattice_fit` says what becomes of colours that few pixels
have. A finer one has a ridge that is equal at all nodes, and weak: it follows the pixels wherever there are some, and
changes nothing elsewhere. All are added up in one lattice.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nlfilter_torch.photo.look_fitting.lattice_fit import (
    FINER,
    CellSums,
    ColourChange,
    FittedLattice,
    Problem,
    conjugate_gradients,
)
from nlfilter_torch.photo.looks.lattice import resampled

GRIDS = (17, 33)  # numbers of nodes along each axis
AGAIN = 2  # more rounds on the finest grid where values are clipped: each sees anew which results are beyond the ends
RIDGES = (10.0, 1.0, 0.1)  # so many pixels at a node, of average weight, halve its change


def refined(pixels: ColourChange, lattice: FittedLattice) -> FittedLattice:
    """Add finer lattices, as long as they leave less of the first fold, which is left out.

    More nodes than before are worth it only if they leave clearly less.
    """
    for nodes in GRIDS:
        lattice = _with_details(pixels, lattice, nodes)
    for _ in range(AGAIN if bool(((pixels.after <= 0) | (pixels.after >= 1)).any()) else 0):
        lattice = _with_details(pixels, lattice, lattice.changes.shape[1])
    return lattice


def _with_details(pixels: ColourChange, lattice: FittedLattice, nodes: int) -> FittedLattice:
    """Add a lattice with that many nodes along each axis, or none."""
    problem = _rest(pixels, lattice, nodes)
    rest, count = problem.pixels, len(pixels.weights)
    before = rest.energy(rest.left(0.0, 0), 0)
    cross, best = problem.cross(0), (before, 0.0, torch.zeros(3, nodes**3, dtype=torch.float64))
    changes = torch.zeros_like(cross)
    for ridge in RIDGES:
        changes = conjugate_gradients(Ridged(problem.sums.without(0), ridge / count), cross, changes)
        left = problem.left_of(0, changes[0])
        if left > best[0]:
            break
        best = left, ridge, changes[0]
    left, ridge, first = best
    if left >= before * (FINER if nodes > lattice.changes.shape[1] else 1):
        return lattice
    cross = problem.products(2).unsqueeze(0)
    change = conjugate_gradients(Ridged(problem.sums.all(), ridge / count), cross, first.unsqueeze(0))[0]
    power = max(pixels.energy(pixels.after - pixels.before), 1e-30)
    return replace(
        lattice,
        changes=resampled(lattice.changes, nodes) + change.view(3, nodes, nodes, nodes),
        first=resampled(lattice.first, nodes) + first.view(3, nodes, nodes, nodes),
        fitted=1 - rest.energy(rest.left(problem.at_pixels(change), 2)) / power,
        left_out=1 - (1 - lattice.left_out) * left / before,
        density=problem.sums.all().density[0],
    )


def _rest(pixels: ColourChange, lattice: FittedLattice, nodes: int) -> Problem:
    """The problem of explaining with that many nodes what is left of pixels.

    Of its three predictions, the first is by looks without the first fold, and the last by those of all.
    """
    ends = replace(pixels, predicted=[pixels.predicted[0], pixels.predicted[-1]])
    first, all_of = ends.followed_by([lattice.first, lattice.changes]).predicted
    return Problem.of(replace(pixels, predicted=[first, first, all_of], folds=pixels.folds.clamp(max=1)), nodes)


@dataclass(frozen=True)
class Ridged:
    """The least-squares problem of a lattice whose changes are small.

    Attributes:
        sums: over the pixels.
        ridge: penalty on each change.
    """

    sums: CellSums
    ridge: float

    def __call__(self, changes: Tensor) -> Tensor:
        """The matrix of the problem, times changes (1, 3, n^3)."""
        return self.sums(changes).add_(changes, alpha=self.ridge)

    def conditioned(self, values: Tensor) -> Tensor:
        """Values (1, 3, n^3) divided by the diagonal of the matrix."""
        return values / (self.sums.bands[0].unsqueeze(1) + self.ridge)
