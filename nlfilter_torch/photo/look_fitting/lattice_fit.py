"""The lattice of a look: what its other parts leave of an edit, as a smooth function of colour.

The changes at the nodes of a grid are fitted by least squares, with penalties on second differences, and on the changes
themselves where few pixels have such colours, so that there the other parts decide alone. Both are the discretisation
of integrals over the cube of colours, the same for every number of nodes. Conjugate gradients solve all folds of a
cross-validation at once; the preconditioner is the penalty for evenly distributed colours, which is diagonal in cosines
along each axis.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.lattice import corners
from nlfilter_torch.photo.looks.lattice import lattice_change, resampled

SMOOTH = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # strengths of the penalty on second derivatives
RIDGE = 1e-3  # of the changes where there are no pixels, see :meth:`Penalised.ridge`
SCARCE = 0.01  # pixels at a node, relative to an even distribution, at which half of the ridge remains
STEPS, TOLERANCE = 200, 1e-3  # of conjugate gradients
GRIDS = (9, 17)  # numbers of nodes along each axis
LOOSER = 0.99  # a looser lattice is chosen if it leaves at most this share of what a stiffer one leaves
FINER = 0.95  # a finer grid is chosen if it leaves at most this share of what a coarser one leaves


@dataclass(frozen=True)
class ColourChange:
    """Pixels of edited photographs, and what other parts of a look make of them.

    Attributes:
        before: (3, P), in float64.
        after: (3, P).
        predicted: results of the other parts of looks, fitted without each fold in turn, and finally to all: a list of
            (3, P).
        weights: (P,).
        folds: numbers (P,) of the folds.
    """

    before: Tensor
    after: Tensor
    predicted: list[Tensor]
    weights: Tensor
    folds: Tensor

    def left(self, change: Tensor | float, number: int) -> Tensor:
        """What is left (3, P) if the look of that number changes the pixels further.

        Nothing is left of values that are clipped after the edit and beyond that under the look.
        """
        result = self.predicted[number] + change
        beyond = ((self.after >= 1) & (result > 1)) | ((self.after <= 0) & (result < 0))
        return torch.where(beyond, 0.0, self.after - result)

    def explained(self) -> float:
        """Share of the change that the looks explain of the folds that they were fitted without."""
        folds = range(len(self.predicted) - 1)
        left = sum(self.energy(self.left(0.0, fold), fold) for fold in folds)
        return 1 - left / max(self.energy(self.after - self.before), 1e-30)

    def followed_by(self, lattices: Sequence[Tensor]) -> "ColourChange":
        """The pixels, each of whose looks is followed by a lattice (3, n, n, n)."""
        colours = self.before[None, :, None]
        predicted = [
            result + lattice_change(colours, lattice)[0, :, 0]
            for result, lattice in zip(self.predicted, lattices, strict=True)
        ]
        return replace(self, predicted=predicted)

    def energy(self, rest: Tensor, fold: int | None = None) -> float:
        """Weighted sum of squares of values (3, P), of all or of a fold."""
        weights = self.weights if fold is None else self.weights * (self.folds == fold)
        return float((weights * rest.square()).sum())


@dataclass(frozen=True)
class FittedLattice:
    """The lattice that explains most of what is left out.

    Attributes:
        changes: (3, n, n, n).
        fitted: share of the change that the look explains with it.
        left_out: the same for pixels left out of the fit.
        without: share of the change of these that the look explains without it.
        density: weights of the pixels at the nodes, (n^3,).
        first: changes (3, n, n, n) fitted without the first fold.
    """

    changes: Tensor
    fitted: float
    left_out: float
    without: float
    density: Tensor
    first: Tensor

    def with_more(self, changes: Tensor) -> "FittedLattice":
        """The lattice and another one (3, m, m, m) of what comes before it, with as many nodes as the larger one."""
        nodes = max(self.changes.shape[1], changes.shape[1])
        density = self.density.view(1, *self.changes.shape[1:]).expand(3, -1, -1, -1)
        return replace(
            self,
            changes=resampled(self.changes, nodes) + resampled(changes, nodes),
            density=resampled(density, nodes)[0].flatten(),
        )


def fit_lattice(pixels: ColourChange) -> FittedLattice:
    """Fit the lattice, whose smoothness and number of nodes leave least of folds that are left out.

    The smoothness is chosen with few nodes; one fold tells whether more nodes explain more.
    """
    number = len(pixels.predicted) - 1
    power = max(pixels.energy(pixels.after - pixels.before), 1e-30)
    without = sum(pixels.energy(pixels.left(0.0, fold), fold) for fold in range(number))
    problem, fine = (Problem.of(pixels, nodes) for nodes in GRIDS)
    smooth, folds, first = problem.smoothest(without)
    left = sum(folds)
    cross = fine.cross(0)
    start = fine.solve([0], smooth, cross, torch.zeros_like(cross))
    finer = fine.left_of(0, start[0])
    if finer < FINER * folds[0]:
        problem, left, first = fine, left * finer / folds[0], start[0]
    changes = problem.solve_all(smooth, start if problem is fine else None)
    fitted = 1 - pixels.energy(pixels.left(problem.at_pixels(changes), number)) / power
    changes, first = (values.view(3, *[problem.sums.nodes] * 3) for values in (changes, first))
    return FittedLattice(changes, fitted, 1 - left / power, 1 - without / power, problem.sums.all().density[0], first)


@dataclass(frozen=True)
class Problem:
    """Lattices of some number of nodes that explain what is left of pixels.

    Attributes:
        pixels: the pixels.
        places: indices (4, P) of their nodes.
        shares: weights (4, P) of these.
        sums: of the folds.
    """

    pixels: ColourChange
    places: Tensor
    shares: Tensor
    sums: "CellSums"

    @staticmethod
    def of(pixels: ColourChange, nodes: int) -> "Problem":
        """The problem for that many nodes along each axis."""
        places, shares = corners(pixels.before, nodes)
        counts = (nodes, len(pixels.predicted) - 1)
        return Problem(pixels, places, shares, CellSums.of(places, shares, pixels.weights, pixels.folds, counts))

    @property
    def folds(self) -> list[int]:
        """Numbers of the folds."""
        return list(range(self.sums.bands.shape[1]))

    def products(self, number: int, fold: int | None = None) -> Tensor:
        """Products (3, n^3) of the nodes and what the look of that number leaves of pixels, but for a fold."""
        weights = self.pixels.weights if fold is None else self.pixels.weights * (self.pixels.folds != fold)
        rest = weights * self.pixels.left(0.0, number)
        products = torch.zeros(3, self.sums.nodes**3, dtype=torch.float64)
        for place, share in zip(self.places, self.shares, strict=True):
            for channel in range(3):
                products[channel].index_add_(0, place, share * rest[channel])
        return products

    def cross(self, *folds: int) -> Tensor:
        """For each fold, products (folds, 3, n^3) of the nodes and what is left of the pixels of the others."""
        return torch.stack([self.products(fold, fold) for fold in folds])

    def smoothest(self, most: float) -> tuple[float, list[float], Tensor]:
        """The smoothness that leaves least of the folds that are left out, and what it leaves of each.

        Also the changes (3, n^3) fitted without the first fold. ``most`` is left without a lattice.
        """
        cross = self.cross(*self.folds)
        changes = torch.zeros_like(cross)
        best = (SMOOTH[0], [most / len(self.folds)] * len(self.folds), changes[0])
        for smooth in SMOOTH:
            changes = self.solve(self.folds, smooth, cross, changes)
            left = [self.left_of(fold, changes[fold]) for fold in self.folds]
            if sum(left) > LOOSER * sum(best[1]):
                break
            best = smooth, left, changes[0]
        return best

    def solve(self, folds: list[int], smooth: float, cross: Tensor, start: Tensor) -> Tensor:
        """For each fold, the changes (folds, 3, n^3) fitted to the others."""
        return conjugate_gradients(Penalised(self.sums.without(*folds), smooth), cross, start)

    def solve_all(self, smooth: float, start: Tensor | None = None) -> Tensor:
        """Changes (3, n^3) fitted to all pixels."""
        cross = self.products(len(self.folds)).unsqueeze(0)
        start = torch.zeros_like(cross) if start is None else start
        return conjugate_gradients(Penalised(self.sums.all(), smooth), cross, start)[0]

    def left_of(self, fold: int, changes: Tensor) -> float:
        """Energy of what is left of a fold by changes (3, n^3) that were fitted without it."""
        return self.pixels.energy(self.pixels.left(self.at_pixels(changes), fold), fold)

    def at_pixels(self, changes: Tensor) -> Tensor:
        """Changes (3, P) of the pixels by those of the nodes, (3, n^3)."""
        change = torch.zeros_like(self.pixels.before)
        for place, share in zip(self.places, self.shares, strict=True):
            change.addcmul_(share, changes[:, place])
        return change


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

    def all(self) -> "CellSums":
        """The sums over all folds."""
        return CellSums(self.nodes, self.bands.sum(1, keepdim=True))

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


def conjugate_gradients(problem: Quadratic, cross: Tensor, start: Tensor) -> Tensor:
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
