"""The look of a region of photographs, or of all of them, from the pixels of all pairs."""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import torch
from torch import Tensor

from nlfilter_torch.filtering.fit import fit_layers
from nlfilter_torch.photo.looks.edited_pixels import EditedPhotograph
from nlfilter_torch.photo.looks.lattice_choice import THINNED, LatticeChoice, ThinnedPixels, is_of_colours
from nlfilter_torch.photo.looks.look_choice import (
    RIDGES,
    Candidate,
    added_by_parts,
    choose_from_one,
    cross_validated,
    fit_parts,
    simplest,
)
from nlfilter_torch.photo.looks.look_sums import SAMPLED_PIXELS, LookSums, PartLayout, Parts, PixelSample

SLIDERS: Parts = ("alpha",)  # of looks that are steps of detail
FOLDS = 5  # of cross-validation, among which the pairs are divided
SLIDERS_ONLY = 0.98  # share of the change from which on an edit counts as one by sliders alone
LIKELY = 0.95  # share that the layers of a sample of the pixels explain of such an edit
Shares = tuple[float, float]  # of the change that is explained: of fitted data, and of data left out of the fit


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
