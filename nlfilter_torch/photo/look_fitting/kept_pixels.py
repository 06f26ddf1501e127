"""Pixels of all pairs that the lattice of a look is fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import TypeVar

import torch
from torch import Tensor

from nlfilter_torch.photo.look_fitting.hue_fit import fit_hues
from nlfilter_torch.photo.look_fitting.lattice_details import refined
from nlfilter_torch.photo.look_fitting.lattice_fit import ColourChange, FittedLattice, fit_lattice
from nlfilter_torch.photo.look_fitting.look_choice import SHRINK, SLACK, Candidate
from nlfilter_torch.photo.look_fitting.look_pixels import PixelSample
from nlfilter_torch.photo.look_fitting.look_sums import MOST, Layout, Parts, Sums, columns_of
from nlfilter_torch.photo.looks.lattice import colours_of_nodes, resampled
from nlfilter_torch.photo.looks.look_filter import pointwise, tone_curve

SQUARES = 3  # a single pair is divided into so many parts along each side, which are the folds
KEPT = 2 * MOST  # pixels of all pairs
COLOURS = ("curves", "matrix", "saturation")  # parts that are functions of the colour
# A lattice is chosen if a look without it leaves more than SLACK times what it leaves, plus CLEAR. Where an edit may
# depend on the surroundings of pixels, since more than SURROUNDINGS is left, lattices gain a little on the picture and
# lose as much on others; there it is CLEARLY times as much. For several pairs, whose colours differ, it is FAIRLY times
# as much, and WITHIN times if parts of all of them are left out.
CLEARLY, FAIRLY, WITHIN, CLEAR, SURROUNDINGS = 1.75, 1.6, 2.5, 1e-4, 0.004
NEAR = 3  # steps between nodes that colours may be away from greys to change with them
BATCH = 1 << 14  # pixels whose columns are in memory at once
_Number = TypeVar("_Number", int, Tensor)


def squares(places: Tensor, width: int) -> Tensor:
    """Number of the part of the picture that each pixel (P,) is in: its bounding box is divided into equal parts."""
    if len(places) == 0:
        return places
    rows, columns = (
        (numbers - numbers.min()) * SQUARES // (numbers.max() - numbers.min() + 1)
        for numbers in (places // width, places % width)
    )
    return rows * SQUARES + columns


def latin(square: _Number) -> _Number:
    """One of as many groups of squares as they are along a side, no two in the same row or column."""
    return (square + square // SQUARES) % SQUARES


def is_of_colours(parts: Parts) -> bool:
    """Whether a look consists of parts that are functions of the colour."""
    return {"curves" if part == "tone" else part for part in parts} <= set(COLOURS)


@dataclass(frozen=True)
class LookWithLattice:
    """A look with a lattice, and the shares of the change that it explains.

    Attributes:
        basis: the look beside the lattice.
        coefficients: (3, F) of its columns, fitted to all pixels, and weakened if there is a single pair.
        lattice: changes (3, n, n, n).
        fitted: share of the pixels that it was fitted to.
        left_out: share of those that were left out.
    """

    basis: Candidate
    coefficients: Tensor
    lattice: Tensor
    fitted: float
    left_out: float


@dataclass(frozen=True)
class _FittedPixels:
    """A look, its coefficients (3, F), what it leaves of pixels, and the lattice for that."""

    basis: Candidate
    coefficients: Tensor
    colours: ColourChange
    lattice: FittedLattice


@dataclass
class ThinnedPixels:
    """Pixels of all pairs, thinned so that they are never more than :data:`KEPT`.

    Attributes:
        samples: pixels of a pair, the fold of the pair, and for each pixel the number of its square, (P,).
        step: how many pixels one stands for.
    """

    samples: list[tuple[PixelSample, int, Tensor]] = field(default_factory=list)
    step: int = 1

    def add(self, pixels: PixelSample, fold: int, width: int) -> None:
        """Add the pixels of a pair in a fold, of a picture of that width."""
        square = squares(pixels.places, width)
        self.samples.append((pixels.every(self.step), fold, square[:: self.step]))
        while len(self) > KEPT:
            self.step *= 2
            self.samples = [(pixels.every(2), fold, square[::2]) for pixels, fold, square in self.samples]

    def __len__(self) -> int:
        """Number of pixels."""
        return sum(len(square) for _, _, square in self.samples)

    @property
    def square(self) -> Tensor:
        """For each pixel the number of its square, (P,)."""
        return torch.cat([square for _, _, square in self.samples])

    @property
    def fold(self) -> Tensor:
        """For each pixel the fold of its pair, (P,)."""
        return torch.cat([torch.full_like(square, fold) for _, fold, square in self.samples])

    def change(self, predicted: list[Tensor], folds: Tensor) -> ColourChange:
        """The pixels, what looks make of them, (3, P) each, and what folds (P,) they are in."""
        before, after = (
            torch.cat([getattr(pixels, name) for pixels, _, _ in self.samples], dim=1).double()
            for name in ("before", "after")
        )
        weights = torch.cat([pixels.shown for pixels, _, _ in self.samples]).double()
        return ColourChange(before, after, predicted, weights / weights.sum(), folds)


@dataclass
class KeptPixels:
    """Pixels of all pairs that the lattice of a look is fitted to.

    Attributes:
        sample: pixels with columns.
        colours: more pixels of the same pairs, without columns, for details of the lattice; or none.
    """

    sample: ThinnedPixels = field(default_factory=ThinnedPixels)
    colours: ThinnedPixels = field(default_factory=ThinnedPixels)

    def add(self, pixels: PixelSample, colours: PixelSample | None, fold: int, width: int) -> None:
        """Add the pixels of a pair in a fold, of a picture of that width, and if there are, more without columns."""
        self.sample.add(pixels, fold, width)
        self.colours.add(pixels if colours is None else colours, fold, width)

    def lattice(self, bases: Sequence[Candidate], folds: Sequence[Sums], layout: Layout) -> LookWithLattice | None:
        """A look with a lattice for what it leaves; None if that explains hardly more than the first look alone.

        A look from a single pair is weakened as :func:`choose_from_one` does.

        Args:
            bases: looks; the one is taken that leaves least with its lattice.
            folds: the sums that they were chosen from, of pairs or, for a single one, of its squares.
            layout: of the columns.
        """
        alone = len({fold for _, fold, _ in self.sample.samples}) == 1
        group = self._groups(self.sample)
        if int(group.max()) == 0:
            return None
        groups = [latin(i) if alone else i for i in range(len(folds))]
        fits = [self._fitted(basis, list(zip(folds, groups, strict=True)), group, layout) for basis in bases]
        best = max(fits, key=lambda fit: fit.lattice.left_out)
        left, without = 1 - best.lattice.left_out, 1 - fits[0].lattice.without
        if SLACK * left + CLEAR >= without:
            return None
        often = CLEARLY if alone else FAIRLY
        if left > SURROUNDINGS and (often * left + CLEAR >= without or not (alone or self._agree(best.colours))):
            return None
        changes = rising(best.lattice.changes, best.coefficients, layout, best.lattice.density)
        strength = 1 - SHRINK * min(max(left, 0.0), 1.0) if alone else 1.0
        shares = best.lattice.fitted, best.lattice.left_out
        return LookWithLattice(best.basis, strength * best.coefficients, strength * changes, *shares)

    def _fitted(
        self, basis: Candidate, folds: Sequence[tuple[Sums, int]], group: Tensor, layout: Layout
    ) -> _FittedPixels:
        """The lattice for what a look leaves of the pixels in groups (P,), to which the folds belong."""
        others = [[sums for sums, own in folds if own != left] for left in (*range(int(group.max()) + 1), -1)]
        looks = [basis.fitted_to(reduce(Sums.__add__, sums), layout) for sums in others]
        plain = self.sample.change(self._predicted(looks, layout), group)
        hues = fit_hues(plain)
        colours = more = plain.followed_by(hues)
        lattice = fit_lattice(colours)
        if is_of_colours(basis.parts) and len(self.colours) > len(self.sample):
            more = self.colours.change([], self._groups(self.colours))
            more = replace(more, predicted=[coloured(more.before, look, layout) for look in (looks[0], looks[-1])])
            more = more.followed_by([hues[0], hues[-1]])
        lattice = refined(more, lattice)
        if bool(hues[-1].any()):
            lattice = replace(lattice.with_more(hues[-1]), without=plain.explained())
        return _FittedPixels(basis, looks[-1], plain, lattice)

    def _groups(self, pixels: ThinnedPixels) -> Tensor:
        """The groups (P,) of pixels that are left out at once: those of a pair, or of squares of a single one."""
        if len({fold for _, fold, _ in self.sample.samples}) > 1:
            return torch.searchsorted(self.sample.fold.unique(), pixels.fold)
        values = self.sample.square.unique()
        return latin(torch.searchsorted(values, pixels.square).clamp(max=len(values) - 1))

    def _agree(self, colours: ColourChange) -> bool:
        """Whether one lattice explains parts of all pictures from the rest of these.

        Colours of one pair that no other has say nothing when pairs are left out.
        """
        square = latin(self.sample.square.unique(return_inverse=True)[1])
        parts = replace(colours, predicted=colours.predicted[-1:] * (int(square.max()) + 2), folds=square)
        lattice = refined(parts, fit_lattice(parts))
        return 1 - lattice.without > WITHIN * (1 - lattice.left_out)

    def _predicted(self, looks: Sequence[Tensor], layout: Layout) -> list[Tensor]:
        """The pixels under looks with coefficients (3, F), (3, P) each."""
        coefficients = torch.stack(list(looks))
        parts = []
        for pixels, _, _ in self.sample.samples:
            for start in range(0, len(pixels.places), BATCH):
                inside = slice(start, start + BATCH)
                weighed = {name: columns[..., inside] for name, columns in pixels.weighed.items()}
                columns = columns_of(pixels.before[:, inside], weighed, layout)
                change = torch.einsum("lcf,cfp->lcp", coefficients, columns)
                parts.append(pixels.before[:, inside] + change)
        return list(torch.cat(parts, dim=2))


def coloured(colours: Tensor, coefficients: Tensor, layout: Layout) -> Tensor:
    """Colours (3, P) under a look with coefficients (3, F) of parts that are functions of the colour."""
    curves, matrix, saturation = (coefficients[:, layout.place(name)] for name in COLOURS)
    straight = torch.linspace(0, 1, layout.knots, dtype=colours.dtype)
    identity = torch.eye(3, dtype=colours.dtype)
    return pointwise(colours[None, :, None], straight + curves, identity + matrix, 1 + saturation[0])[0, :, 0]


def rising(lattice: Tensor, coefficients: Tensor, layout: Layout, density: Tensor) -> Tensor:
    """A lattice (3, n, n, n) with which no grey gets darker from one to the next, unless it does without the lattice.

    The least changes of the greys, weighed by their density (n^3,), are passed on to colours near them.
    """
    if lattice.shape[1] < layout.knots:  # greys between the nodes count as well
        shares = resampled(density.view(1, *lattice.shape[1:]).expand(3, -1, -1, -1), layout.knots)[0].flatten()
        finer = resampled(lattice, layout.knots)
        risen = rising(finer, coefficients, layout, shares)
        return lattice if risen is finer else risen
    nodes = lattice.shape[1]
    steps = torch.linspace(0, 1, nodes, dtype=torch.float64).expand(3, -1)
    others = {name: torch.zeros(3, length, nodes) for name, length in layout.lengths.items() if name not in COLOURS}
    plain = steps + torch.einsum("cf,cfp->cp", coefficients, columns_of(steps, others, layout))
    diagonal = torch.arange(nodes) * (nodes * nodes + nodes + 1)
    greys = plain + lattice.flatten(1)[:, diagonal]
    weights = density[diagonal] + 1e-6 * density.sum()
    moved = torch.stack([
        nondecreasing(values, weights) if bool((before.diff() > -1e-6).all()) else values
        for values, before in zip(greys, plain, strict=True)
    ])  # fmt: skip
    if bool((moved == greys).all()):
        return lattice
    colours = colours_of_nodes(nodes)
    near = (1 - (colours.amax(0) - colours.amin(0)) * (nodes - 1) / NEAR).clamp(min=0)
    curves = (torch.linspace(0, 1, nodes, dtype=torch.float64) + moved - greys).expand(3, -1)
    change = tone_curve(colours.mean(0).expand(1, 3, -1, -1, -1).flatten(3), curves).view(3, nodes, nodes, nodes)
    return lattice + near * (change - colours.mean(0))


def nondecreasing(values: Tensor, weights: Tensor) -> Tensor:
    """The nondecreasing values (N,) of least weighted squared distance from some values, by pooling neighbours."""
    pools: list[tuple[float, float, int]] = []  # mean, weight and number of values
    for value, weight in zip(values.tolist(), weights.tolist(), strict=True):
        pools.append((value, weight, 1))
        while len(pools) > 1 and pools[-2][0] > pools[-1][0]:
            (low, light, few), (high, heavy, many) = pools.pop(), pools.pop()
            mean = (low * light + high * heavy) / (light + heavy)
            pools.append((mean, light + heavy, few + many))
    return torch.tensor([mean for mean, _, count in pools for _ in range(count)], dtype=values.dtype)
