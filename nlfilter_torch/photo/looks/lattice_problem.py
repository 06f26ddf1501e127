"""Least-squares problems of lattices, and their solution.

The changes at the nodes of a grid are fitted with penalties on second differences, and on the changes themselves where
few pixels have such colours, so that there other parts of a look decide alone. Both are the discretisation of integrals
over the cube of colours, the same for every number of nodes. Conjugate gradients solve all folds of a cross-validation
at once; the preconditioner is the penalty for evenly distributed colours, which is diagonal in cosines along each axis.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from scipy.fft import dctn, idctn
from scipy.sparse import csr_array
from torch import Tensor

from nlfilter_torch.core.kernels.lattice import corners

RIDGE = 1e-3  # of the changes where there are no pixels, see :meth:`Penalised.ridge`
SCARCE = 0.01  # pixels at a node, relative to an even distribution, at which half of the ridge remains
STEPS, TOLERANCE = 200, 1e-3  # of conjugate gradients


def shares_of_nodes(colours: Tensor, nodes: int) -> csr_array:
    """The shares (P, n^3) of the nodes of a lattice in colours (3, P): four in each row, whose sum is 1."""
    places, shares = (values.mT.flatten().numpy() for values in corners(colours, nodes))
    return csr_array((shares, places, range(0, len(places) + 1, 4)), shape=(colours.shape[1], nodes**3))


@dataclass(frozen=True)
class CellSums:
    """Sums over pixels of products of the shares of two nodes.

    Attributes:
        nodes: n along each axis.
        grams: a matrix (n^3, n^3) for each of several folds of pixels.
    """

    nodes: int
    grams: Sequence[csr_array]

    @staticmethod
    def of(shares: csr_array, weights: Tensor, folds: Tensor, counts: tuple[int, int]) -> "CellSums":
        """Sums over pixels: the shares (P, n^3) of their nodes, weights (P,) and folds (P,) of (n, folds)."""
        roots = shares.multiply(weights.sqrt().unsqueeze(1).numpy()).tocsr()
        parts = [roots[(folds == fold).numpy()] for fold in range(counts[1])]
        return CellSums(counts[0], [part.T @ part for part in parts])

    def without(self, *folds: int) -> "CellSums":
        """For each of some folds, the sums over the others."""
        return CellSums(self.nodes, [sum(self.grams) - self.grams[fold] for fold in folds])

    @cached_property
    def density(self) -> Tensor:
        """Sums of the weights at each node, (folds, n^3)."""
        return torch.from_numpy(np.stack([gram.sum(1) for gram in self.grams]))

    @cached_property
    def diagonal(self) -> Tensor:
        """Sums of the squares of the shares, (folds, n^3)."""
        return torch.from_numpy(np.stack([gram.diagonal() for gram in self.grams]))

    def __call__(self, changes: Tensor) -> Tensor:
        """The matrix of the sums, times changes (folds, 3, n^3)."""
        return torch.stack([product(gram, own) for gram, own in zip(self.grams, changes, strict=True)])


def product(matrix: csr_array, rows: Tensor) -> Tensor:
    """A sparse matrix (Q, P), times each of some rows (C, P): (C, Q)."""
    return torch.from_numpy(matrix @ rows.mT.numpy()).mT.contiguous()


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
    def spectrum(self) -> Tensor:
        """The approximate matrix of the problem, (folds, 1, n, n, n), in cosines along each axis."""
        steps = torch.arange(self.sums.nodes, dtype=torch.float64)
        frequencies = 2 - 2 * torch.cos(math.pi / self.sums.nodes * steps)
        bends = (frequencies[:, None, None] + frequencies[:, None] + frequencies).square()
        usual = (self.sums.density + self.ridge).clamp(min=1e-30).log().mean(1).exp()
        return bends * self.stiffness[..., None, None] + usual.view(-1, 1, 1, 1, 1)

    def conditioned(self, values: Tensor) -> Tensor:
        """Values (folds, 3, n^3) times the inverse of the approximate matrix."""
        axes = (-3, -2, -1)
        waves = dctn(values.unflatten(2, (self.sums.nodes,) * 3).numpy(), axes=axes, norm="ortho")
        return torch.from_numpy(idctn(waves / self.spectrum.numpy(), axes=axes, norm="ortho")).flatten(2)


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
        return values / (self.sums.diagonal.unsqueeze(1) + self.ridge)


def along(matrix: Tensor, values: Tensor, axis: int) -> Tensor:
    """Values (..., n^3) at the nodes times a matrix (n, n) along one of their three axes."""
    nodes = len(matrix)
    if axis == 2:
        return (values.reshape(-1, nodes) @ matrix.mT).view(values.shape)
    return (matrix @ values.reshape(-1, nodes, nodes ** (2 - axis))).view(values.shape)
