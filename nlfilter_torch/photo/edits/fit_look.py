"""Looks from pairs of photographs before and after an edit."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_order
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.photo.declared.shared_parameters import CURVE_KNOTS, SATURATIONS, STRAIGHT
from nlfilter_torch.photo.declared.steps import Step, json_of
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.looks.edited_pixels import EditedPhotograph, Pair, images_of
from nlfilter_torch.photo.looks.look_choice import CHOICES, Candidate
from nlfilter_torch.photo.looks.look_filter import LOOK_PARTS, lattice_from_numbers
from nlfilter_torch.photo.looks.look_sums import PartLayout, Parts
from nlfilter_torch.photo.looks.region import SLIDERS, RegionSums, add_photograph

KINDS_OF_CURVES = {"tone": "curves"}  # a tone curve for all channels is a part of this name
FILTER_NAMES = ("bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling", "viewing_size")


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
            others["lattice"] = lattice_from_numbers(torch.tensor(self.step["lattice"]))
        return {**named, "curves": curves, "matrix": matrix, **others}

    def to_json(self) -> str:
        """A file for ``nlfilter-torch apply``: a recipe of one step."""
        return json_of([self.step], complete=True)


@torch.no_grad()
@full_precision
def fit_look(
    pairs: Iterable[Pair],
    *,
    parts: Collection[str] = LOOK_PARTS,
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
    names = check_learn(parts, LOOK_PARTS, "parts")
    choices = _choices(names)
    layout = PartLayout(CURVE_KNOTS, SATURATIONS, order + 1)
    regions: list[RegionSums] = []
    for number, (before, after, masks) in enumerate(images_of(pairs)):
        count = 1 if masks is None else len(masks)
        regions = regions or [RegionSums(layout, has_lattice="lattice" in names) for _ in range(count)]
        if count != len(regions):
            raise ValueError(
                f"masks must be as many for every pair, got {count} after {len(regions)}; pass one for each region"
            )
        add_photograph(regions, number, EditedPhotograph(before, after, masks, step, order, generator))
    _check_regions(regions)
    looks = []
    for region in regions:
        look, explained, added = region.chosen(choices)
        changed = _step_of(look, layout, step)
        looks.append(FittedLook(changed, look.parts, look.fitted, look.left_out, explained, added))
    return looks[0] if len(looks) == 1 else tuple(looks)


def _choices(names: Collection[str]) -> list[Parts]:
    """The :data:`CHOICES` that remain with parts of these names only.

    Raises:
        ValueError: if there are none.
    """
    choices = [tuple(part for part in parts if KINDS_OF_CURVES.get(part, part) in names) for parts in CHOICES]
    choices = [parts for parts in dict.fromkeys(choices) if parts]
    if not choices:
        raise ValueError(f"parts must name one of {', '.join(LOOK_PARTS)}, got none; leave them out for all")
    return choices


def _step_of(look: Candidate, layout: PartLayout, step: Step) -> Step:
    """A look as a step of an edit: of detail if it consists of sliders alone, else ``step`` with these values."""
    changes = {name: look.coefficients[:, layout.place(name)] for name in layout.lengths}
    alpha = 1 + changes["alpha"][0]
    if look.parts == SLIDERS:
        plain = {name: step[name] for name in FILTER_NAMES}
        return Step("detail", alpha=_rounded(alpha), threshold=0.0, limits="none", **plain)
    red, green, blue = map(_rounded, torch.tensor(STRAIGHT, dtype=torch.float64) + changes["curves"])
    return step.changed(
        alpha=_rounded(alpha),
        bands=_rounded(1 + changes["bands"][0]),
        texture=_rounded(1 + changes["texture"][0]),
        red=red,
        green=green,
        blue=blue,
        matrix=_rounded((torch.eye(3, dtype=torch.float64) + changes["matrix"]).flatten()),
        saturation=_rounded(1 + changes["saturation"][0]),
        stretch=_rounded(changes["stretch"][0]),
        local=_rounded(changes["local"][0]),
        lattice=None if look.lattice is None else _rounded(look.lattice.flatten()),
    )


def _check_regions(regions: list[RegionSums]) -> None:
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


def _rounded(values: Tensor) -> tuple[float, ...]:
    return tuple(values.double().round(decimals=6).tolist())
