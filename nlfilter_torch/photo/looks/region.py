"""The look of a region of photographs, or of all of them, from the pixels of all pairs.

Whether it has a lattice, and which one, is decided by what that explains of pixels that are left out of the fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import torch
from scipy.optimize import isotonic_regression
from torch import Tensor

from nlfilter_torch.filtering.fit import fit_layers
from nlfilter_torch.photo.looks.edited_pixels import EditedPhotograph
from nlfilter_torch.photo.looks.lattice_fit import ColourChange, FittedLattice, fit_hues, fit_lattice, with_details
from nlfilter_torch.photo.looks.look_choice import (
    RIDGES,
    SHRINK,
    SLACK,
    Candidate,
    added_by_parts,
    choose_from_one,
    cross_validated,
    fit_parts,
    simplest,
)
from nlfilter_torch.photo.looks.look_filter import COLOUR_PARTS, colours_of_nodes, pointwise, resampled, tone_curve
from nlfilter_torch.photo.looks.look_sums import SAMPLED_PIXELS, SQUARES, LookSums, PartLayout, Parts, PixelSample

SLIDERS: Parts = ("alpha",)  # of looks that are steps of detail
FOLDS = 5  # of cross-validation, among which the pairs are divided
SLIDERS_ONLY = 0.98  # share of the change from which on an edit counts as one by sliders alone
LIKELY = 0.95  # share that the layers of a sample of the pixels explain of such an edit
Shares = tuple[float, float]  # of the change that is explained: of fitted data, and of data left out of the fit
THINNED = 2 * SAMPLED_PIXELS  # pixels of all pairs at most
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


class RegionSums:
    """The pixels of a region in all pairs.

    Args:
        layout: of the columns of a look.
        has_lattice: whether the look may have a lattice.

    Attributes:
        folds: sums of the pairs, divided among the folds.
    """

    def __init__(self, layout: PartLayout, *, has_lattice: bool) -> None:
        self.layout, self.has_lattice = layout, has_lattice
        self.folds: list[LookSums] = []
        self._squares: list[LookSums] = []  # sums of the squares of the first photograph that shows the region
        # Sums of the Gram matrix of the layers, and of its product with the sliders of each pair; None if there is a
        # pair that sliders alone do not explain.
        self._sliders: tuple[Tensor, Tensor] | None = (torch.zeros(1), torch.zeros(1))
        self._pixels, self._colours = ThinnedPixels(), ThinnedPixels()  # for the lattice; the latter have no columns

    def add(
        self,
        number: int,
        pixels: PixelSample,
        squares: list[LookSums],
        rounding: float,
        colours: PixelSample | None,
    ) -> None:
        """Add the pixels of a pair with that number, and the sums over their squares.

        ``rounding`` is half the step between the values of the edited photograph, or 0. ``colours`` are more of its
        pixels.
        """
        if not squares:
            return  # the region is not in this photograph
        whole = reduce(LookSums.__add__, squares)
        self._squares = self._squares or squares
        fold = len(self.folds) if len(self.folds) < FOLDS else number % FOLDS
        if fold == len(self.folds):
            self.folds.append(whole)
        else:
            self.folds[fold] = self.folds[fold] + whole
        if self.has_lattice:
            more = pixels._replace(surroundings=pixels.surroundings[:, :0]) if colours is None else colours
            for kept, sample in ((self._pixels, pixels), (self._colours, more)):
                kept.add(sample._replace(fold=torch.full_like(sample.fold, fold)))
        self._add_sliders(pixels, whole, rounding)

    def _add_sliders(self, pixels: PixelSample, sums: LookSums, rounding: float) -> None:
        """Add the least-squares sliders of a pair, for which differences within rounding are no error."""
        if self._sliders is None:
            return
        if not _are_sliders(sums, self.layout, SLIDERS_ONLY):
            self._sliders = None
            return
        # Sliders add the same to every channel, each of which is rounded by itself.
        layers = pixels.surroundings[0, -self.layout.sliders :].repeat(1, 3)
        before, after, weights = (planes.flatten() for planes in (pixels.before, pixels.after, pixels.weights))
        alpha = fit_layers(layers, before, after, weights, rounding)
        place = self.layout.place("alpha")
        gram = sums.gram[:, place, place].sum(0)
        gram = gram + 1e-9 * gram.diagonal().max() * torch.eye(len(gram), dtype=gram.dtype)
        total, products = self._sliders
        self._sliders = (total.double() + gram, products.double() + gram @ alpha.double())

    @property
    def _groups(self) -> list[LookSums]:
        """Sums of what is left out in turn: of pairs, or of the squares of a single one."""
        return self.folds if len(self.folds) > 1 else self._squares

    def chosen(self, choices: Sequence[Parts]) -> tuple[Candidate, dict[Parts, Shares], dict[str, Shares]]:
        """The look that suits the pairs best, of one of these choices of parts.

        Also the shares that every choice explains, and what each part of the look adds to these, the most first; the
        lattice, fitted to what the others leave, is last.
        """
        alone = len(self.folds) == 1
        if alone:
            best, candidates = choose_from_one(self._groups, self.layout, choices)
        else:
            candidates = cross_validated(self._groups, self.layout, choices, alone=False)
            best = simplest(candidates)
        explained = {parts: (look.fitted, look.left_out) for parts, look in candidates.items()}
        more = self._with_lattice(candidates)
        basis = best if more is None else candidates[more.parts[:-1]]
        added = added_by_parts(basis, self._groups, self.layout, alone=alone)
        if more is not None:
            explained[more.parts] = more.fitted, more.left_out
            added["lattice"] = more.fitted - basis.fitted, more.left_out - basis.left_out
            return more, explained, added
        if best.parts == SLIDERS and self._sliders is not None:
            coefficients = torch.zeros_like(best.coefficients)
            coefficients[:, self.layout.place("alpha")] = torch.linalg.solve(*self._sliders) - 1
            best = replace(best, coefficients=coefficients)
        return best, explained, added

    def _with_lattice(self, candidates: dict[Parts, Candidate]) -> Candidate | None:
        """A look with a lattice for what one of the candidates leaves; None if that explains hardly more."""
        if not self.has_lattice:
            return None
        bases = [simplest(candidates)]
        if not is_of_colours(bases[0].parts):
            plain = {parts: look for parts, look in candidates.items() if is_of_colours(parts)}
            bases += [simplest(plain)] if plain else []
        return LatticeChoice(self._pixels.all(), self._colours.all(), self._groups, self.layout).lattice(bases)


def add_photograph(regions: Sequence[RegionSums], number: int, photograph: EditedPhotograph) -> None:
    """Add the pixels of a photograph with that number to each of its regions.

    They are a sample, unless sliders explain the edit: these are fitted to all pixels.
    """
    layout = regions[0].layout
    samples = photograph.regions_of_sample() or []
    sums = [pixels.sums(layout) for pixels in samples]
    if not sums or _are_sliders(reduce(LookSums.__add__, sums[0]), layout, LIKELY):
        samples = photograph.regions()
        sums = [pixels.sums(layout) for pixels in samples]
    many = regions[0].has_lattice and photograph.free.shape[1] > SAMPLED_PIXELS
    colours = photograph.colours(THINNED) if many else [None] * len(regions)
    for region, pixels, own, more in zip(regions, samples, sums, colours, strict=True):
        region.add(number, pixels, own, photograph.rounding, more)


def _are_sliders(sums: LookSums, layout: PartLayout, share: float) -> bool:
    """Whether sliders alone explain such a share of the change."""
    return sums.explained(fit_parts(sums, SLIDERS, layout, RIDGES[0])) >= share
