"""Looks from pairs of photographs before and after an edit."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_order
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.filtering.fit import fit_layers
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.photo.declared.shared_parameters import KNOTS, SATURATIONS, STRAIGHT
from nlfilter_torch.photo.declared.steps import Step, json_of
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.look_fitting.kept_pixels import KEPT, KeptPixels, LookWithLattice, is_of_colours, squares
from nlfilter_torch.photo.look_fitting.look_choice import (
    CHOICES,
    RIDGES,
    Candidate,
    added_by_parts,
    choose,
    choose_from_one,
    fit_parts,
    simplest,
)
from nlfilter_torch.photo.look_fitting.look_pixels import EditedPhotograph, PixelSample
from nlfilter_torch.photo.look_fitting.look_sums import MOST, Layout, Parts, Sums
from nlfilter_torch.photo.look_fitting.pairs import Pair, images_of
from nlfilter_torch.photo.looks.lattice import lattice_of
from nlfilter_torch.photo.looks.look_filter import NAMES

SLIDERS: Parts = ("alpha",)  # of looks that are steps of detail
FOLDS = 5  # of cross-validation, among which the pairs are divided
STIFF, STIFF_ALONE = 3e-3, 1e-2  # smallest ridge of tone curves and saturation, for several pairs and for one
SLIDERS_ONLY = 0.98  # share of the change from which on an edit counts as one by sliders alone
LIKELY = 0.95  # share that the layers of a sample of the pixels explain of such an edit
KINDS_OF_CURVES = {"tone": "curves"}  # a tone curve for all channels is a part of this name


@dataclass(frozen=True)
class FittedLook:
    """A look fitted to edits, and how much of them it explains.

    Attributes:
        step: the look as a step of an edit, of ``look``, or of ``detail`` if sliders alone explain the edits.
        parts: what it consists of: ``alpha``, ``bands``, ``texture``, ``tone`` (one curve) or ``curves``, ``matrix``,
            ``saturation``, ``stretch``, ``local`` and ``lattice``.
        fitted: share of the change of the pairs that it explains, 1 at best, clipped values aside.
        left_out: share of the change of pairs, or of parts of a single picture, explained by looks fitted without them.
        explained: the same two for every choice of parts that was tried.
        added: what each part adds to these two, the most first; the lattice, fitted to what the others leave, is last.
    """

    step: Step
    parts: Parts
    fitted: float
    left_out: float
    explained: dict[Parts, tuple[float, float]]
    added: dict[str, tuple[float, float]] = field(default_factory=dict)

    def apply(self, image: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """An image (B, C, H, W) in [0, 1] under the look; values may leave [0, 1]. Differentiable in the image."""
        return apply_step(self.step, image, generator=generator)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Its parts by name, for :class:`Look`: those of a step of ``detail`` are sliders only."""
        if self.parts == SLIDERS:
            return {"alpha": torch.tensor(self.step["alpha"])}
        curves = torch.tensor([self.step[channel] for channel in ("red", "green", "blue")])
        matrix = torch.tensor(self.step["matrix"]).view(3, 3)
        named = {name: torch.tensor(self.step[name]) for name in ("alpha", "bands", "texture")}
        others = {name: torch.tensor(self.step[name]) for name in ("saturation", "stretch", "local")}
        if self.step["lattice"] is not None:
            others["lattice"] = lattice_of(torch.tensor(self.step["lattice"]))
        return {**named, "curves": curves, "matrix": matrix, **others}

    def to_json(self) -> str:
        """A file for ``nlfilter-torch apply``: a recipe of one step."""
        return json_of([self.step], complete=True)


@torch.no_grad()
@full_precision
def fit_look(
    pairs: Iterable[Pair],
    *,
    parts: Collection[str] = NAMES,
    order: int = 3,
    step: Step | None = None,
    generator: torch.Generator | None = None,
) -> FittedLook | tuple[FittedLook, ...]:
    """Find the look that turns photographs into edited ones, whatever program edited them.

    The fit is a least-squares problem in closed form, from small sums over 65,536 pixels of each pair, or over all
    pixels of a smaller one. One pair is in memory at a time. The parts of the look and the strength of a ridge are
    chosen by cross-validation over the pairs. A single pair is divided into ninths, which say little about other
    pictures; the look is then kept closer to the identity, the less of the edit it explains. A lattice is fitted to
    what the best look leaves, and added if it explains clearly more of what is left out; colours that no pair has do
    not depend on it, but for what a few parameters say of their hues.

    Args:
        pairs: photographs before and after the edit, two tensors (B, C, H, W) in [0, 1] of the same shape, C = 1 or 3;
            or three, with masks (B, K, H, W) in [0, 1] of K regions that have looks of their own, which may be missing
            in some pairs. Read once. A frame of one colour around an edited photograph is left out.
        parts: what the look may consist of, any of ``alpha`` (sliders), ``bands`` (gains of blurs), ``texture`` (these
            without edges), ``curves``, ``matrix``, ``saturation``, ``stretch`` (automatic levels), ``local`` (local
            contrast) and ``lattice`` (what the others leave, as a function of colour), which needs others beside it.
        order: k; k + 1 sliders.
        step: ``look`` with the parameters of the filter; None has the defaults.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        The look, or with masks one for each region.

    Raises:
        TypeError, ValueError: if there is no pair, or the pictures of one do not belong together, are the same, are
            black or white all over after the edit, or are on several devices.

    Example:
        >>> before = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> look = fit_look([(before, before**1.5)])
        >>> look.parts, look.fitted > 0.99
        (('tone',), True)
    """
    check_order(order)
    step = Step("look") if step is None else step
    names = check_learn(parts, NAMES, "parts")
    choices = _choices(names)
    layout = Layout(KNOTS, SATURATIONS, order + 1)
    regions: list[_Region] = []
    for number, (before, after, masks) in enumerate(images_of(pairs)):
        count = 1 if masks is None else len(masks)
        regions = regions or [
            _Region(layout, [], kept=KeptPixels() if "lattice" in names else None) for _ in range(count)
        ]
        if count != len(regions):
            raise ValueError(
                f"masks must be as many for every pair, got {count} after {len(regions)}; pass one for each region"
            )
        _add(regions, number, EditedPhotograph(before, after, masks, step, order, generator))
    _check_regions(regions)
    looks = tuple(region.look(step, choices) for region in regions)
    return looks[0] if len(looks) == 1 else looks


def _choices(names: Collection[str]) -> list[Parts]:
    """The :data:`CHOICES` that remain with parts of these names only.

    Raises:
        ValueError: if there are none.
    """
    choices = [tuple(part for part in parts if KINDS_OF_CURVES.get(part, part) in names) for parts in CHOICES]
    choices = [parts for parts in dict.fromkeys(choices) if parts]
    if not choices:
        raise ValueError(f"parts must name one of {', '.join(NAMES)}, got none; leave them out for all")
    return choices


@dataclass
class _Region:
    """Sums over the pixels of a region in all pairs.

    Attributes:
        layout: of the sums.
        folds: sums of the pairs, divided among the folds.
        squares: sums of the squares of the first photograph that shows the region.
        sliders: sums of the Gram matrix of the layers, and of its product with the sliders of each pair; None if there
            is a pair that sliders alone do not explain.
        kept: pixels of all pairs, for the lattice; None if there is none to fit.
    """

    layout: Layout
    folds: list[Sums]
    squares: list[Sums] | None = None
    sliders: tuple[Tensor, Tensor] | None = (torch.zeros(1), torch.zeros(1))
    kept: KeptPixels | None = None

    def add(
        self,
        number: int,
        pixels: PixelSample,
        squares: list[Sums],
        rounding: float,
        width: int,
        colours: PixelSample | None = None,
    ) -> None:
        """Add the pixels of a pair with that number, and the sums over their squares.

        ``rounding`` is half the step between the values of the edited photograph, or 0, and ``width`` is its width.
        ``colours`` are more of its pixels, without columns.
        """
        if not squares:
            return  # the region is not in this photograph
        whole = reduce(Sums.__add__, squares)
        self.squares = self.squares or squares
        fold = len(self.folds) if len(self.folds) < FOLDS else number % FOLDS
        if fold == len(self.folds):
            self.folds.append(whole)
        else:
            self.folds[fold] = self.folds[fold] + whole
        if self.kept is not None:
            self.kept.add(pixels, colours, fold, width)
        self._add_sliders(pixels, whole, rounding)

    def _add_sliders(self, pixels: PixelSample, sums: Sums, rounding: float) -> None:
        """Add the least-squares sliders of a pair, for which differences within rounding are no error."""
        if self.sliders is None:
            return
        if not _are_sliders(sums, self.layout, SLIDERS_ONLY):
            self.sliders = None
            return
        # Sliders add the same to every channel, each of which is rounded by itself.
        layers = pixels.weighed["alpha"].repeat(1, 3)
        before, after, weights = (planes.flatten() for planes in (pixels.before, pixels.after, pixels.weights))
        alpha = fit_layers(layers, before, after, weights, rounding)
        place = self.layout.place("alpha")
        gram = sums.gram[:, place, place].sum(0)
        gram = gram + 1e-9 * gram.diagonal().max() * torch.eye(len(gram), dtype=gram.dtype)
        total, products = self.sliders
        self.sliders = (total.double() + gram, products.double() + gram @ alpha.double())

    def look(self, step: Step, choices: Sequence[Parts]) -> FittedLook:
        """The look, of one of these choices of parts."""
        best, candidates = self._chosen(choices)
        explained = {parts: (look.fitted, look.left_out) for parts, look in candidates.items()}
        more = self._with_lattice(candidates)
        if more is None:
            added = self._added(best)
            return FittedLook(self._step(best, step), best.parts, best.fitted, best.left_out, explained, added)
        basis = more.basis
        parts = (*basis.parts, "lattice")
        explained[parts] = more.fitted, more.left_out
        changed = self._step(replace(basis, parts=parts, coefficients=more.coefficients), step, more.lattice)
        added = self._added(basis) | {"lattice": (more.fitted - basis.fitted, more.left_out - basis.left_out)}
        return FittedLook(changed, parts, more.fitted, more.left_out, explained, added)

    def _chosen(self, choices: Sequence[Parts]) -> tuple[Candidate, dict[Parts, Candidate]]:
        """The look without a lattice that suits the pairs best, and all that were tried."""
        if len(self.folds) == 1 and self.squares:
            return choose_from_one(self.squares, self.layout, choices, STIFF_ALONE)
        candidates = choose(self.folds, self.layout, choices, STIFF)
        return simplest(candidates), candidates

    def _with_lattice(self, candidates: dict[Parts, Candidate]) -> LookWithLattice | None:
        """A look with a lattice for what one of the candidates leaves; None if that explains hardly more."""
        groups = self.folds if len(self.folds) > 1 else self.squares
        if self.kept is None or not groups:
            return None
        bases = [simplest(candidates)]
        if not is_of_colours(bases[0].parts):
            plain = {parts: look for parts, look in candidates.items() if is_of_colours(parts)}
            bases += [simplest(plain)] if plain else []
        return self.kept.lattice(bases, groups, self.layout)

    def _added(self, look: Candidate) -> dict[str, tuple[float, float]]:
        """What each part adds to the shares that a look explains."""
        alone = len(self.folds) == 1 and bool(self.squares)
        groups, stiff = (self.squares or [], STIFF_ALONE) if alone else (self.folds, STIFF)
        return added_by_parts(look, groups, self.layout, stiff, alone=alone)

    def _step(self, look: Candidate, step: Step, lattice: Tensor | None = None) -> Step:
        """The look as a step of an edit: of detail if it consists of sliders alone."""
        changes = {name: look.coefficients[:, self.layout.place(name)] for name in self.layout.lengths}
        alpha = 1 + changes["alpha"][0]
        if look.parts == SLIDERS:
            if self.sliders is not None:
                alpha = torch.linalg.solve(*self.sliders)
            plain = {name: step[name] for name in FILTER_NAMES}
            return Step("detail", alpha=_rounded(alpha), threshold=0.0, limits="none", **plain)
        curves = torch.tensor(STRAIGHT, dtype=torch.float64) + changes["curves"]
        matrix = torch.eye(3, dtype=torch.float64) + changes["matrix"]
        red, green, blue = map(_rounded, curves)
        return step.changed(
            alpha=_rounded(alpha),
            bands=_rounded(1 + changes["bands"][0]),
            texture=_rounded(1 + changes["texture"][0]),
            red=red,
            green=green,
            blue=blue,
            matrix=_rounded(matrix.flatten()),
            saturation=_rounded(1 + changes["saturation"][0]),
            stretch=_rounded(changes["stretch"][0]),
            local=_rounded(changes["local"][0]),
            lattice=None if lattice is None else _rounded(lattice.flatten()),
        )


def _check_regions(regions: list[_Region]) -> None:
    """Raise unless there are pairs with an edit, and every region has pixels in them."""
    if not regions:
        raise ValueError("pairs must hold a pair of photographs, got none; pass (before, after)")
    for i, region in enumerate(regions):
        if not region.folds:
            raise ValueError(
                f"masks must hold a pixel that is not clipped in every region, got none in region {i + 1}; select some"
            )
    if not any(bool((sums.power > 0).any()) for region in regions for sums in region.folds):
        raise ValueError("pairs must hold an edited photograph, but each is the same before and after; edit one")


FILTER_NAMES = ("bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling", "viewing_size")


def _rounded(values: Tensor) -> tuple[float, ...]:
    return tuple(values.double().round(decimals=6).tolist())


def _add(regions: list[_Region], number: int, photograph: EditedPhotograph) -> None:
    """Add the pixels of a photograph with that number to each of its regions."""
    samples, sums = _pixels_and_sums(photograph, regions[0].layout)
    many = regions[0].kept is not None and photograph.free.shape[1] > MOST
    colours = photograph.colours(KEPT) if many else [None] * len(regions)
    for region, pixels, own, more in zip(regions, samples, sums, colours, strict=True):
        region.add(number, pixels, own, photograph.rounding, photograph.size[1], more)


def _pixels_and_sums(photograph: EditedPhotograph, layout: Layout) -> tuple[list[PixelSample], list[list[Sums]]]:
    """Pixels of each region, and sums over their squares.

    They are a sample, unless sliders explain the edit: these are fitted to all pixels.
    """
    width = photograph.size[1]
    sample = photograph.regions_of_sample()
    if sample is not None:
        sums = [_sums_of_squares(pixels, layout, width) for pixels in sample]
        if not _are_sliders(reduce(Sums.__add__, sums[0]), layout, LIKELY):
            return sample, sums
    regions = photograph.regions()
    return regions, [_sums_of_squares(pixels, layout, width) for pixels in regions]


def _sums_of_squares(pixels: PixelSample, layout: Layout, width: int) -> list[Sums]:
    """Sums over the squares of a picture of that width, one after the other to save memory."""
    square = squares(pixels.places, width)
    return pixels.sums(layout, [(square == i).nonzero().squeeze(1) for i in square.unique()])


def _are_sliders(sums: Sums, layout: Layout, share: float) -> bool:
    """Whether sliders alone explain such a share of the change."""
    return sums.explained(fit_parts(sums, SLIDERS, layout, RIDGES[0])) >= share
