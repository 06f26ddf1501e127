"""Whether a look has a lattice, and which one, by what it explains of pixels that are left out of the fit."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import torch
from scipy.optimize import isotonic_regression
from torch import Tensor

from nlfilter_torch.photo.looks.lattice_fit import ColourChange, FittedLattice, fit_hues, fit_lattice, with_details
from nlfilter_torch.photo.looks.look_choice import SHRINK, SLACK, Candidate
from nlfilter_torch.photo.looks.look_filter import colours_of_nodes, pointwise, resampled, tone_curve
from nlfilter_torch.photo.looks.look_sums import (
    SAMPLED_PIXELS,
    SQUARES,
    LookSums,
    PartLayout,
    Parts,
    PixelSample,
)

THINNED = 2 * SAMPLED_PIXELS  # pixels of all pairs at most
COLOUR_PARTS = ("curves", "matrix", "saturation")  # parts that are functions of the colour
# A lattice is chosen if a look without it leaves more than SLACK times what it leaves, plus CLEAR. Where an edit may
# depend on the surroundings of pixels, since more than SURROUNDINGS is left, lattices gain a little on the picture and
# lose as much on others; there it is CLEARLY times as much. For several pairs, whose colours differ, it is FAIRLY times
# as much, and WITHIN times if parts of all of them are left out.
CLEARLY, FAIRLY, WITHIN, CLEAR, SURROUNDINGS = 1.75, 1.6, 2.5, 1e-4, 0.004
NEAR_GREYS = 3  # steps between nodes that colours may be away from greys to change with them
BATCH = 1 << 14  # pixels whose columns are in memory at once


def latin(square: Tensor) -> Tensor:
    """One of as many groups of squares as they are along a side, no two in the same row or column."""
    return (square + square // SQUARES) % SQUARES


def is_of_colours(parts: Parts) -> bool:
    """Whether a look consists of parts that are functions of the colour."""
    return {"curves" if part == "tone" else part for part in parts} <= set(COLOUR_PARTS)


@dataclass
class ThinnedPixels:
    """Pixels of all pairs, thinned so that they are never more than :data:`THINNED`.

    Attributes:
        samples: pixels of each pair.
        step: how many pixels one stands for.
    """

    samples: list[PixelSample] = field(default_factory=list)
    step: int = 1

    def add(self, pixels: PixelSample) -> None:
        """Add the pixels of a pair."""
        self.samples.append(pixels.every(self.step))
        while sum(len(sample.shown) for sample in self.samples) > THINNED:
            self.step *= 2
            self.samples = [sample.every(2) for sample in self.samples]

    def all(self) -> PixelSample:
        """All of them."""
        return PixelSample.joined(self.samples)


@dataclass(frozen=True)
class LatticeChoice:
    """The pixels that the lattice of a look is fitted to.

    Attributes:
        pixels: of all pairs, with columns.
        colours: more pixels of the same pairs, without columns, for details of the lattice, or the same.
        folds: the sums that looks were chosen from, of pairs or, for a single one, of its squares.
        layout: of the columns.
    """

    pixels: PixelSample
    colours: PixelSample
    folds: Sequence[LookSums]
    layout: PartLayout

    @property
    def is_single(self) -> bool:
        """Whether all pixels are of one pair."""
        return len(self.pixels.fold.unique()) == 1

    def lattice(self, bases: Sequence[Candidate]) -> Candidate | None:
        """A look with a lattice for what it leaves; None if that explains hardly more than the first look alone.

        A look from a single pair is weakened as :func:`choose_from_one` does. Of several ``bases``, the one is taken
        that leaves least with its lattice.
        """
        if int(self._groups(self.pixels).max()) == 0:
            return None
        fits = [self._fitted(basis) for basis in bases]
        look, colours, lattice = max(fits, key=lambda fit: fit[2].left_out)
        left, without = 1 - lattice.left_out, 1 - fits[0][2].without
        if SLACK * left + CLEAR >= without:
            return None
        often = CLEARLY if self.is_single else FAIRLY
        if left > SURROUNDINGS and (often * left + CLEAR >= without or not (self.is_single or self._agree(colours))):
            return None
        strength = 1 - SHRINK * min(max(left, 0.0), 1.0) if self.is_single else 1.0
        return replace(
            look,
            parts=(*look.parts, "lattice"),
            coefficients=strength * look.coefficients,
            fitted=lattice.fitted,
            left_out=lattice.left_out,
            lattice=strength * rising(lattice.changes[1], look.coefficients, self.layout, colours),
        )

    def _fitted(self, basis: Candidate) -> tuple[Candidate, ColourChange, FittedLattice]:
        """A look fitted to all folds, what it leaves of the pixels, and the lattice for that."""
        groups = self._groups(self.pixels)
        own = torch.arange(len(self.folds))
        own = latin(own) if self.is_single else own
        others = [
            reduce(LookSums.__add__, [sums for sums, group in zip(self.folds, own, strict=True) if group != left])
            for left in (*range(int(groups.max()) + 1), -1)
        ]
        looks = [basis.fitted_to(sums, self.layout) for sums in others]
        plain = _change(self.pixels, self._predicted(looks), groups)
        hues = fit_hues(plain)
        colours = more = plain.followed_by(hues)
        lattice = fit_lattice(colours)
        if is_of_colours(basis.parts) and len(self.colours.shown) > len(self.pixels.shown):
            before = self.colours.before.double()
            predicted = [coloured(before, look, self.layout) for look in (looks[0], looks[-1])]
            more = _change(self.colours, predicted, self._groups(self.colours)).followed_by([hues[0], hues[-1]])
        lattice = with_details(more, lattice)
        if bool(hues[-1].any()):
            lattice = replace(lattice.with_more(torch.stack([hues[0], hues[-1]])), without=plain.explained())
        return replace(basis, coefficients=looks[-1]), plain, lattice

    def _groups(self, pixels: PixelSample) -> Tensor:
        """The groups (P,) of pixels that are left out at once: those of a pair, or of squares of a single one."""
        if not self.is_single:
            return torch.searchsorted(self.pixels.fold.unique(), pixels.fold)
        values = self.pixels.square.unique()
        return latin(torch.searchsorted(values, pixels.square).clamp(max=len(values) - 1))

    def _agree(self, colours: ColourChange) -> bool:
        """Whether one lattice explains parts of all pictures from the rest of these.

        Colours of one pair that no other has say nothing when pairs are left out.
        """
        square = latin(self.pixels.square.unique(return_inverse=True)[1])
        parts = replace(colours, predicted=colours.predicted[-1:] * (int(square.max()) + 2), folds=square)
        lattice = with_details(parts, fit_lattice(parts))
        return 1 - lattice.without > WITHIN * (1 - lattice.left_out)

    def _predicted(self, looks: Sequence[Tensor]) -> list[Tensor]:
        """The pixels under looks with coefficients (3, F), (3, P) each."""
        coefficients = torch.stack(list(looks))
        parts = []
        for start in range(0, len(self.pixels.shown), BATCH):
            part = self.pixels.at(slice(start, start + BATCH))
            parts.append(part.before + torch.einsum("lcf,cfp->lcp", coefficients, part.columns(self.layout)))
        return list(torch.cat(parts, dim=2))


def _change(pixels: PixelSample, predicted: list[Tensor], groups: Tensor) -> ColourChange:
    """Pixels, what looks make of them, (3, P) each, and the groups (P,) they are in."""
    weights = pixels.shown.double()
    return ColourChange(pixels.before.double(), pixels.after.double(), predicted, weights / weights.sum(), groups)


def coloured(colours: Tensor, coefficients: Tensor, layout: PartLayout) -> Tensor:
    """Colours (3, P) under a look with coefficients (3, F) of parts that are functions of the colour."""
    curves, matrix, saturation = (coefficients[:, layout.place(name)] for name in COLOUR_PARTS)
    straight = torch.linspace(0, 1, layout.knots, dtype=colours.dtype)
    identity = torch.eye(3, dtype=colours.dtype)
    return pointwise(colours[None, :, None], straight + curves, identity + matrix, 1 + saturation[0])[0, :, 0]


def rising(lattice: Tensor, coefficients: Tensor, layout: PartLayout, pixels: ColourChange) -> Tensor:
    """A lattice (3, n, n, n) with which no grey gets darker from one to the next, unless it does without the lattice.

    The least changes of the greys, weighed by the pixels near them, are passed on to colours near them.
    """
    nodes = lattice.shape[1]
    if nodes < layout.knots:  # greys between the nodes count as well
        finer = resampled(lattice, layout.knots)
        risen = rising(finer, coefficients, layout, pixels)
        return lattice if risen is finer else risen
    plain = coloured(torch.linspace(0, 1, nodes, dtype=torch.float64).expand(3, -1), coefficients, layout)
    diagonal = torch.arange(nodes) * (nodes * nodes + nodes + 1)
    greys = plain + lattice.flatten(1)[:, diagonal]
    density = pixels.density(nodes)
    weights = density[diagonal] + 1e-6 * density.sum()
    moved = torch.stack([
        torch.from_numpy(isotonic_regression(values.numpy(), weights=weights.numpy()).x)
        if bool((before.diff() > -1e-6).all())
        else values
        for values, before in zip(greys, plain, strict=True)
    ])  # fmt: skip
    if bool((moved == greys).all()):
        return lattice
    colours = colours_of_nodes(nodes)
    near = (1 - (colours.amax(0) - colours.amin(0)) * (nodes - 1) / NEAR_GREYS).clamp(min=0)
    curves = (torch.linspace(0, 1, nodes, dtype=torch.float64) + moved - greys).expand(3, -1)
    change = tone_curve(colours.mean(0).expand(1, 3, -1, -1, -1).flatten(3), curves).view(3, nodes, nodes, nodes)
    return lattice + near * (change - colours.mean(0))
