"""Least-squares problems of lattices, and their solution.

The changes at the nodes of a grid are fitted with penalties on second differences, and on the changes themselves where
few pixels have such colours, so that there other parts of a look decide alone. Both are the discretisation of integrals
over the cube of colours, the same for every number of nodes. Conjugate gradients solve all folds of a cross-validation
at once; the preconditioner is the penalty for evenly distributed colours, which is diagonal in cosines along each axis.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

RIDGE = 1e-3  # of the changes where there are no pixels, see :meth:`Penalised.ridge`
SCARCE = 0.01  # pixels at a node, relative to an even distribution, at which half of the ridge remains
STEPS, TOLERANCE = 200, 1e-3  # of conjugate gradients


@dataclass(frozen=True)
class CellSums:
    """Sums over pixels of products of the weights of nodes, for each of several folds of pixels.

    Attributes:
        nodes: n along each axis.
        bands: (8, folds, n^3): with itself, and with the seven nodes after it that share a tetrahedron.
    """

    nodes: int
    bands: Tensor

    @staticmethod
    def of(places: Tensor, shares: Tensor, weights: Tensor, folds: Tensor, counts: tuple[int, int]) -> "CellSums":
        """Sums over pixels: their nodes (4, P), the shares of these, weights (P,) and folds (P,) of (n, folds)."""
        nodes, number = counts
        offsets = torch.tensor(_offsets(nodes))
        bands = torch.zeros(len(offsets) * nodes**3 * number, dtype=torch.float64)
        for first in range(4):
            for second in range(first, 4):
                kind = torch.searchsorted(offsets, places[second] - places[first])
                index = (kind * number + folds) * nodes**3 + places[first]
                bands.index_add_(0, index, weights * shares[first] * shares[second])
        return CellSums(nodes, bands.view(len(offsets), number, nodes**3))

    def without(self, *folds: int) -> "CellSums":
        """For each of some folds, the sums over the others."""
        return CellSums(self.nodes, self.bands.sum(1, keepdim=True) - self.bands[:, list(folds)])

    @cached_property
    def density(self) -> Tensor:
        """Sums of the weights at each node, (folds, n^3)."""
        density = self.bands.sum(0)
        for band, offset in zip(self.bands[1:], _offsets(self.nodes)[1:], strict=True):
            density[:, offset:] += band[:, :-offset]
        return density

    def __call__(self, changes: Tensor) -> Tensor:
        """The matrix of the sums, times changes (folds, 3, n^3)."""
        bands = self.bands.unsqueeze(2)
        result = bands[0] * changes
        for band, offset in zip(bands[1:], _offsets(self.nodes)[1:], strict=True):
            result[..., :-offset].addcmul_(band[..., :-offset], changes[..., offset:])
            result[..., offset:].addcmul_(band[..., :-offset], changes[..., :-offset])
        return result


def _offsets(nodes: int) -> list[int]:
    """Distances between the indices of two nodes of a tetrahedron, ascending."""
    red, green, blue = nodes * nodes, nodes, 1
    return [0, blue, green, green + blue, red, red + blue, red + green, red + green + blue]


class Quadratic(Protocol):
    """A least-squares problem for changes (folds, 3, n^3)."""

    def __call__(self, changes: Tensor) -> Tensor:
        """The matrix of the problem, times changes."""
        ...

    def conditioned(self, values: Tensor) -> Tensor:
        """Values times the inverse of an approximate matrix."""
        ...


def solve_lattices(problem: Quadratic, cross: Tensor, start: Tensor) -> Tensor:
    """Changes (folds, 3, n^3) at the nodes, from products with what is to be explained, in the same shape.

    ``start`` is where the search starts.
    """
    result = start
    rest = cross - problem(result)
    direction = ready = problem.conditioned(rest)
    size = (rest * ready).sum(2, keepdim=True)
    limit = TOLERANCE**2 * (cross * problem.conditioned(cross)).sum(2, keepdim=True)
    for _ in range(STEPS):
        if bool((size <= limit).all()):
            break
        image = problem(direction)
        length = size / (direction * image).sum(2, keepdim=True).clamp(min=1e-300)
        result = result + length * direction
        rest = rest - length * image
        ready = problem.conditioned(rest)
        size, before = (rest * ready).sum(2, keepdim=True), size
        direction = ready + size / before.clamp(min=1e-300) * direction
    return result


@dataclass(frozen=True)
class Penalised:
    """The least-squares problem of a lattice, for all folds at once.

    Attributes:
        sums: over the pixels that each fold's lattice is fitted to.
        smooth: strength of the penalty on second derivatives.
    """

    sums: CellSums
    smooth: float

    def __call__(self, changes: Tensor) -> Tensor:
        """The matrix of the problem, times changes (folds, 3, n^3)."""
        return self._bent(changes).add_(self.sums(changes)).addcmul_(self.ridge.unsqueeze(1), changes)

    @cached_property
    def even(self) -> Tensor:
        """The weights at a node if colours were evenly distributed, (folds, 1)."""
        return self.sums.density.mean(1, keepdim=True)

    @cached_property
    def ridge(self) -> Tensor:
        """Penalty on the changes themselves, (folds, n^3), the larger, the fewer pixels have such colours."""
        scarce = SCARCE * self.even
        return RIDGE * self.even * scarce / (scarce + self.sums.density)

    @cached_property
    def stiffness(self) -> Tensor:
        """Strength of the penalty on second differences, (folds, 1, 1), the same for every number of nodes."""
        return self.smooth * self.even.unsqueeze(2) * ((self.sums.nodes - 1) / 8) ** 4

    @cached_property
    def differences(self) -> tuple[Tensor, Tensor]:
        """Squares (n, n) of second and of first differences along an axis."""
        straight = torch.eye(self.sums.nodes, dtype=torch.float64)
        bends, rises = straight.diff(n=2, dim=0), straight.diff(dim=0)
        return bends.mT @ bends, rises.mT @ rises

    def _bent(self, changes: Tensor) -> Tensor:
        """Changes (folds, 3, n^3) times the penalty on second differences, also mixed ones."""
        bends, rises = self.differences
        mixed = along(rises, changes, 2)
        result = along(bends, changes, 2) + 2 * along(rises, mixed, 1) + along(bends, changes, 1)
        mixed = 2 * (mixed + along(rises, changes, 1))
        result = result + along(rises, mixed, 0) + along(bends, changes, 0)
        return result.mul_(self.stiffness)

    @cached_property
    def spectrum(self) -> tuple[Tensor, Tensor]:
        """Cosines (n, n), and the approximate matrix of the problem in these, (folds, 1, n^3)."""
        basis, frequencies = cosines(self.sums.nodes)
        bends = (frequencies[:, None, None] + frequencies[:, None] + frequencies).square().flatten()
        usual = (self.sums.density + self.ridge).clamp(min=1e-30).log().mean(1).exp()
        return basis, bends * self.stiffness + usual[:, None, None]

    def conditioned(self, values: Tensor) -> Tensor:
        """Values (folds, 3, n^3) times the inverse of the approximate matrix."""
        basis, spectrum = self.spectrum
        for axis in range(3):
            values = along(basis.mT, values, axis)
        values = values / spectrum
        for axis in range(3):
            values = along(basis, values, axis)
        return values


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


def along(matrix: Tensor, values: Tensor, axis: int) -> Tensor:
    """Values (..., n^3) at the nodes times a matrix (n, n) along one of their three axes."""
    nodes = len(matrix)
    if axis == 2:
        return (values.reshape(-1, nodes) @ matrix.mT).view(values.shape)
    return (matrix @ values.reshape(-1, nodes, nodes ** (2 - axis))).view(values.shape)


def cosines(nodes: int) -> tuple[Tensor, Tensor]:
    """Orthonormal cosines (n, n), in columns, and the squared first differences (n,) that belong to them."""
    steps = torch.arange(nodes, dtype=torch.float64)
    basis = torch.cos(math.pi / nodes * (steps[:, None] + 0.5) * steps)
    return basis / basis.norm(dim=0), 2 - 2 * torch.cos(math.pi / nodes * steps)
