"""The lattice of a look: what its other parts leave of an edit, as a function of colour.

It is the sum of three. A few parameters say what hues do under the edit, also of colours that no pixel has. A smooth
lattice follows the pixels, see :mod:`nlfilter_torch.photo.looks.lattice_problem`. Finer ones have a ridge that is equal
at all nodes, and weak: they follow the colours that many pixels have, and change nothing elsewhere.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from scipy.sparse import csr_array
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.looks.lattice_problem import (
    CellSums,
    Penalised,
    Ridged,
    product,
    shares_of_nodes,
    solve_lattices,
)
from nlfilter_torch.photo.looks.look_filter import colours_of_nodes, lattice_change, resampled

SMOOTH = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # strengths of the penalty on second derivatives
GRIDS = (9, 17, 33)  # numbers of nodes along each axis: smooth lattices have the first two, fine ones the last two
LOOSER = 0.99  # a looser lattice is chosen if it leaves at most this share of what a stiffer one leaves
FINER = 0.95  # a finer grid is chosen if it leaves at most this share of what a coarser one leaves
AGAIN = 2  # more rounds on the finest grid where values are clipped: each sees anew which results are beyond the ends
FINE_RIDGES = (10.0, 1.0, 0.1)  # so many pixels at a node, of average weight, halve its change
HUES = 6  # hats, at red, yellow, green, cyan, blue and magenta
HUE_RIDGES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # relative to the squares of the columns
HUE_PIXELS = 1 << 14  # that the parameters of hues are fitted to
PRIOR = 1e-4  # weight of evenly distributed colours that stay as they are, and keep hues of few pixels as they are
TINY = 1e-9


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

    @property
    def power(self) -> float:
        """Energy of the change."""
        return max(self.energy(self.after - self.before), 1e-30)

    @property
    def left_of_folds(self) -> float:
        """Energy of what the looks leave of the folds that they were fitted without."""
        return sum(self.energy(self.left(0.0, fold), fold) for fold in range(len(self.predicted) - 1))

    def explained(self) -> float:
        """Share of the change that the looks explain of the folds that they were fitted without."""
        return 1 - self.left_of_folds / self.power

    def every(self, step: int) -> "ColourChange":
        """Each ``step``-th of the pixels."""
        before, after, *predicted = (values[:, ::step] for values in (self.before, self.after, *self.predicted))
        return ColourChange(before, after, predicted, self.weights[::step], self.folds[::step])

    def followed_by(self, lattices: Iterable[Tensor]) -> "ColourChange":
        """The pixels, each of whose looks is followed by a lattice (3, n, n, n)."""
        colours = self.before[None, :, None]
        predicted = [
            result + lattice_change(colours, lattice)[0, :, 0]
            for result, lattice in zip(self.predicted, lattices, strict=True)
        ]
        return replace(self, predicted=predicted)

    def energy(self, rest: Tensor, look: int | None = None) -> float:
        """Weighted sum of squares of values (3, P), of the fold that a look was fitted without, or of all."""
        of_all = look is None or look == len(self.predicted) - 1
        weights = self.weights if of_all else self.weights * (self.folds == look)
        return float((weights * rest.square()).sum())

    def density(self, nodes: int) -> Tensor:
        """Weights (n^3,) of the pixels at the nodes of a lattice."""
        return torch.from_numpy(shares_of_nodes(self.before, nodes).T @ self.weights.numpy())


@dataclass(frozen=True)
class FittedLattice:
    """The lattice that explains most of what is left out.

    Attributes:
        changes: (2, 3, n, n, n), fitted without the first fold, and to all pixels.
        fitted: share of the change that the look explains with it.
        left_out: the same for pixels left out of the fit.
        without: share of the change of these that the look explains without it.
    """

    changes: Tensor
    fitted: float
    left_out: float
    without: float

    @property
    def nodes(self) -> int:
        """Number n of nodes along each axis."""
        return self.changes.shape[-1]

    def with_more(self, changes: Tensor) -> "FittedLattice":
        """The lattice and another one (2, 3, m, m, m), with as many nodes as the larger one."""
        nodes = max(self.nodes, changes.shape[-1])
        return replace(self, changes=resampled(self.changes, nodes) + resampled(changes, nodes))


def fit_lattice(pixels: ColourChange) -> FittedLattice:
    """Fit the lattice, whose smoothness and number of nodes leave least of folds that are left out.

    The smoothness is chosen with few nodes; one fold tells whether more nodes explain more.
    """
    last = len(pixels.predicted) - 1
    power, without = pixels.power, pixels.left_of_folds
    problem, fine = (Problem.of(pixels, nodes) for nodes in GRIDS[:2])
    smooth, folds, first = problem.smoothest(without)
    left = sum(folds)
    start = torch.zeros_like(first)
    finest = fine.solve([0], smooth, fine.cross([0]))
    finer = fine.left_of(0, finest[0])
    if finer < FINER * folds[0]:
        problem, left, first = fine, left * finer / folds[0], finest[0]
        start = first
    changes = problem.solve([last], smooth, problem.cross([last]), start.unsqueeze(0))[0]
    fitted = 1 - problem.left_of(last, changes) / power
    both = torch.stack([first, changes]).unflatten(2, (problem.sums.nodes,) * 3)
    return FittedLattice(both, fitted, 1 - left / power, 1 - without / power)


@dataclass(frozen=True)
class Problem:
    """Lattices of some number of nodes that explain what is left of pixels.

    Each look has one: those fitted without a fold, by the numbers of the folds, and the last one, fitted to all pixels.

    Attributes:
        pixels: the pixels.
        shares: of the nodes in each pixel, (P, n^3).
        sums: of the folds.
    """

    pixels: ColourChange
    shares: csr_array
    sums: CellSums

    @staticmethod
    def of(pixels: ColourChange, nodes: int) -> "Problem":
        """The problem for that many nodes along each axis."""
        shares = shares_of_nodes(pixels.before, nodes)
        counts = (nodes, len(pixels.predicted))
        return Problem(pixels, shares, CellSums.of(shares, pixels.weights, pixels.folds, counts))

    def cross(self, looks: Sequence[int]) -> Tensor:
        """Products (looks, 3, n^3) of the nodes and what looks leave of the pixels that they are fitted to."""
        weights, folds = self.pixels.weights, self.pixels.folds
        rests = [weights * (folds != look) * self.pixels.left(0.0, look) for look in looks]
        return torch.stack([product(self.shares.T, rest) for rest in rests])

    def smoothest(self, most: float) -> tuple[float, list[float], Tensor]:
        """The smoothness that leaves least of the folds that are left out, and what it leaves of each.

        Also the changes (3, n^3) fitted without the first fold. ``most`` is left without a lattice.
        """
        folds = range(len(self.pixels.predicted) - 1)
        cross = self.cross(folds)
        changes = torch.zeros_like(cross)
        best = (SMOOTH[0], [most / len(folds)] * len(folds), changes[0])
        for smooth in SMOOTH:
            changes = self.solve(folds, smooth, cross, changes)
            left = [self.left_of(fold, changes[fold]) for fold in folds]
            if sum(left) > LOOSER * sum(best[1]):
                break
            best = smooth, left, changes[0]
        return best

    def solve(self, looks: Sequence[int], smooth: float, cross: Tensor, start: Tensor | None = None) -> Tensor:
        """Smooth changes (looks, 3, n^3), from :meth:`cross`."""
        start = torch.zeros_like(cross) if start is None else start
        return solve_lattices(Penalised(self.sums.without(*looks), smooth), cross, start)

    def left_of(self, look: int, changes: Tensor) -> float:
        """Energy of what a look leaves of its fold, the last one of all, with changes (3, n^3) at the nodes."""
        return self.pixels.energy(self.pixels.left(product(self.shares, changes), look), look)


def with_details(pixels: ColourChange, lattice: FittedLattice) -> FittedLattice:
    """Add finer lattices, as long as they leave less of the first fold, which is left out.

    More nodes than before are worth it only if they leave clearly less.
    """
    for nodes in GRIDS[1:]:
        lattice = _with_details(pixels, lattice, nodes)
    for _ in range(AGAIN if bool(((pixels.after <= 0) | (pixels.after >= 1)).any()) else 0):
        lattice = _with_details(pixels, lattice, lattice.nodes)
    return lattice


def _with_details(pixels: ColourChange, lattice: FittedLattice, nodes: int) -> FittedLattice:
    """Add a lattice with that many nodes along each axis to what it leaves of the pixels, or none."""
    ends = replace(pixels, predicted=[pixels.predicted[0], pixels.predicted[-1]])
    first, last = ends.followed_by(lattice.changes).predicted
    rest = replace(pixels, predicted=[first, first, last], folds=pixels.folds.clamp(max=1))  # all but the first are one
    problem, count = Problem.of(rest, nodes), len(pixels.weights)
    before = rest.energy(rest.left(0.0, 0), 0)
    cross, best = problem.cross([0]), (before, 0.0, torch.zeros(1, 3, nodes**3, dtype=torch.float64))
    changes = torch.zeros_like(cross)
    for ridge in FINE_RIDGES:
        changes = solve_lattices(Ridged(problem.sums.without(0), ridge / count), cross, changes)
        left = problem.left_of(0, changes[0])
        if left > best[0]:
            break
        best = left, ridge, changes
    left, ridge, start = best
    if left >= before * (FINER if nodes > lattice.nodes else 1):
        return lattice
    change = solve_lattices(Ridged(problem.sums.without(2), ridge / count), problem.cross([2]), start)
    return replace(
        lattice.with_more(torch.cat([start, change]).unflatten(2, (nodes,) * 3)),
        fitted=1 - problem.left_of(2, change[0]) / pixels.power,
        left_out=1 - (1 - lattice.left_out) * left / before,
    )


def hue_columns(colours: Tensor) -> Tensor:
    """What a unit of each parameter changes of colours (3, P) in [0, 1]: (F, 3, P)."""
    red, green, blue = colours
    largest = colours.amax(0)
    chroma = largest - colours.amin(0)
    light = reduce_channels(colours[None, :, None], "luminance").view_as(chroma)
    safe = chroma.clamp(min=TINY)
    hue = torch.where(
        largest == red,
        ((green - blue) / safe) % HUES,
        torch.where(largest == green, (blue - red) / safe + 2, (red - green) / safe + 4),
    )
    numbers = torch.arange(HUES, dtype=hue.dtype).view(-1, 1)
    hats = (1 - ((hue - numbers + 3) % HUES - 3).abs()).clamp(min=0)
    saturated = colours - colours.mean(0)
    turned = torch.stack([green - blue, blue - red, red - green]) / 3**0.5
    lighter = chroma.expand(3, -1)
    kinds = torch.stack([lighter, saturated, turned, light * lighter, light * saturated, light * turned])
    kinds = torch.cat([kinds, chroma * torch.stack([lighter, saturated])])
    return (hats[:, None, None] * kinds).flatten(0, 1)


def fit_hues(pixels: ColourChange) -> list[Tensor]:
    """Changes (3, n, n, n) for each of the looks in :class:`ColourChange`, by a ridge that leaves least of folds.

    They are zero if that is hardly less than without them.
    """
    few = pixels.every(1 + (len(pixels.weights) - 1) // HUE_PIXELS)
    columns, number = hue_columns(few.before), len(few.predicted) - 1
    nodes = hue_columns(colours_of_nodes(GRIDS[1]).flatten(1))
    prior = PRIOR * nodes.square().sum(1).mean(1)
    grams, crosses = [], []
    for look in range(number + 1):  # the last one is fitted to all folds
        weighed = (columns * few.weights * (few.folds != look)).flatten(1)
        grams.append(weighed @ columns.flatten(1).mT)
        crosses.append(weighed @ few.left(0.0, look).flatten())
    gram, cross = torch.stack(grams), torch.stack(crosses)
    best, least = torch.zeros_like(cross), LOOSER * few.left_of_folds
    for ridge in HUE_RIDGES:
        free = ridge * gram.diagonal(dim1=1, dim2=2) + prior
        solved = torch.linalg.solve(gram + torch.diag_embed(free + TINY), cross)
        changes = torch.einsum("lf,fcp->lcp", solved[:number], columns)
        left = sum(few.energy(few.left(change, fold), fold) for fold, change in enumerate(changes))
        if left < least:
            best, least = solved, left
    return list(torch.einsum("lf,fcp->lcp", best, nodes).unflatten(2, (GRIDS[1],) * 3))
