"""Looks from pairs of photographs before and after an edit."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_order, check_photograph, check_same_size
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.filtering.fit import fit_layers
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.declared.shared_parameters import KNOTS, SATURATIONS, STRAIGHT
from nlfilter_torch.photo.declared.steps import Step, json_of
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.look_fitting.alignment import inside_frame
from nlfilter_torch.photo.look_fitting.look_fit import (
    CHOICES,
    RIDGES,
    Found,
    Layout,
    Parts,
    Sums,
    choose,
    choose_from_one,
    fit_parts,
    simplest,
)
from nlfilter_torch.photo.look_fitting.look_pixels import EditedPhotograph, SomePixels
from nlfilter_torch.photo.looks.look_filter import NAMES

Pair = tuple[Tensor, ...]
FOLDS = 5  # into which pairs are put
SQUARES = 3  # parts along each side of a picture that are left out in turn if there is one pair
STIFF, STIFF_ALONE = 3e-3, 1e-2  # least ridge of tone curves and saturation, of several pairs and of one
SLIDERS_ONLY = 0.98  # share that sliders explain of a pair for which they are found to the last digit
LIKELY = 0.95  # such a share by the layers of a sample of the pixels
ALIKE = 0.5  # correlation of the luminance before and after an edit; less do not belong together
SHADES = 256


@dataclass(frozen=True)
class FittedLook:
    """A look that was found, and how much of the edits it explains.

    Attributes:
        step: the look as a step of an edit, of ``look``, or of ``detail`` if sliders alone explain the edits.
        parts: what it consists of: ``alpha``, ``bands``, ``texture``, ``tone`` (one curve) or ``curves``, ``matrix``,
            ``saturation``, ``stretch`` and ``local``.
        fitted: share of the change of the pairs that it explains, 1 at best, clipped values aside.
        left_out: share of the change of pairs, or of parts of a single picture, explained by looks fitted without them.
        explained: the same two for every choice of parts that was tried.
    """

    step: Step
    parts: Parts
    fitted: float
    left_out: float
    explained: dict[Parts, tuple[float, float]]

    def apply(self, image: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """An image (B, C, H, W) in [0, 1] under the look; values may leave [0, 1]. Differentiable in the image."""
        return apply_step(self.step, image, generator=generator)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Its parts by name, for :class:`Look`: those of a step of ``detail`` are sliders only."""
        if self.step.edit == "detail":
            return {"alpha": torch.tensor(self.step["alpha"])}
        curves = torch.tensor([self.step[channel] for channel in ("red", "green", "blue")])
        matrix = torch.tensor(self.step["matrix"]).view(3, 3)
        named = {name: torch.tensor(self.step[name]) for name in ("alpha", "bands", "texture")}
        rest = {name: torch.tensor(self.step[name]) for name in ("saturation", "stretch", "local")}
        return {**named, "curves": curves, "matrix": matrix, **rest}

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

    In closed form, from small sums over 65,536 pixels of each pair or all of a smaller one; one pair is in memory at a
    time. Parts and ridge are chosen by leaving out pairs, or ninths of the picture if there is one pair only, which
    says nothing of other pictures: the look is kept closer to the identity then, the more it leaves of the edit.

    Args:
        pairs: photographs before and after the edit, two tensors (B, C, H, W) in [0, 1] of the same shape, C = 1 or 3;
            or three, with masks (B, K, H, W) in [0, 1] of K regions that have looks of their own, which may be missing
            in some pairs. Read once. A frame of one colour around an edited photograph is left out.
        parts: what the look may consist of, any of ``alpha`` (sliders), ``bands`` (gains of blurs),
            ``texture`` (these without edges), ``curves``,
            ``matrix``, ``saturation``, ``stretch`` (automatic levels) and ``local`` (local contrast).
        order: k; k + 1 sliders.
        step: ``look`` with the parameters of the filter; None has the defaults.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        The look, or with masks one for each region.

    Raises:
        TypeError, ValueError: if there is no pair, or the pictures of one do not belong together, are the same, or are
            black or white all over after the edit.

    Example:
        >>> before = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> look = fit_look([(before, before**1.5)])
        >>> look.parts, look.fitted > 0.99
        (('tone',), True)
    """
    check_order(order)
    step = Step("look") if step is None else step
    names = check_learn(parts, NAMES, "parts")
    choices = [tuple(name for name in some if ("curves" if name == "tone" else name) in names) for some in CHOICES]
    choices = [some for some in dict.fromkeys(choices) if some]
    if not choices:
        raise ValueError(f"parts must name one of {', '.join(NAMES)}, got none; leave them out for all")
    layout = Layout(KNOTS, SATURATIONS, order + 1)
    regions: list[_Region] = []
    number = 0
    for pair in pairs:
        for before, after, masks in _images(pair, number):
            count = 1 if masks is None else len(masks)
            if number and count != len(regions):
                raise ValueError(
                    f"masks must be as many for every pair, got {count} after {len(regions)}; pass one for each region"
                )
            regions = regions or [_Region(layout, []) for _ in range(count)]
            _add(regions, before, after, masks, step, number, generator)
            number += 1
    if number == 0:
        raise ValueError("pairs must hold a pair of photographs, got none; pass (before, after)")
    for i, region in enumerate(regions):
        if not region.folds:
            raise ValueError(
                f"masks must hold a pixel that is not clipped in every region, got none in region {i + 1}; select some"
            )
    if not any(bool((sums.power > 0).any()) for region in regions for sums in region.folds):
        raise ValueError("pairs must hold an edited photograph, but each is the same before and after; edit one")
    found = tuple(region.look(step, choices) for region in regions)
    return found[0] if len(found) == 1 else found


@dataclass
class _Region:
    """What is known of the edits of a region.

    Attributes:
        layout: of the sums.
        folds: by pair, and by squares of the first.
        sliders: sums of the Gram matrix of layers, and of it times sliders, of pairs that these explain; None if one
            of the pairs is none of these.
    """

    layout: Layout
    folds: list[Sums]
    squares: list[Sums] | None = None
    sliders: tuple[Tensor, Tensor] | None = (torch.zeros(1), torch.zeros(1))

    def look(self, step: Step, choices: Sequence[Parts]) -> FittedLook:
        """The look, of one of these choices of parts."""
        if len(self.folds) == 1 and self.squares:
            best, found = choose_from_one(self.squares, self.layout, choices, STIFF_ALONE)
        else:
            found = choose(self.folds, self.layout, choices, STIFF)
            best = simplest(found)
        return FittedLook(
            self._step(best, step),
            best.parts,
            best.fitted,
            best.left_out,
            {parts: (look.fitted, look.left_out) for parts, look in found.items()},
        )

    def _step(self, found: Found, step: Step) -> Step:
        """Of the edit whose parameters these are."""
        values = {name: found.coefficients[:, self.layout.place(name)] for name in self.layout.lengths}
        alpha = 1 + values["alpha"][0]
        if found.parts == ("alpha",):
            if self.sliders is not None:
                alpha = torch.linalg.solve(*self.sliders)
            plain = {name: step[name] for name in FILTER_NAMES}
            return Step("detail", alpha=_rounded(alpha), threshold=0.0, limits="none", **plain)
        curves = torch.tensor(STRAIGHT, dtype=torch.float64) + values["curves"]
        matrix = torch.eye(3, dtype=torch.float64) + values["matrix"]
        red, green, blue = map(_rounded, curves)
        return step.changed(
            alpha=_rounded(alpha),
            bands=_rounded(1 + values["bands"][0]),
            texture=_rounded(1 + values["texture"][0]),
            red=red,
            green=green,
            blue=blue,
            matrix=_rounded(matrix.flatten()),
            saturation=_rounded(1 + values["saturation"][0]),
            stretch=_rounded(values["stretch"][0]),
            local=_rounded(values["local"][0]),
        )


FILTER_NAMES = ("bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling", "viewing_size")


def _rounded(values: Tensor) -> tuple[float, ...]:
    return tuple(round(value, 6) for value in values.tolist())


def _images(pair: Pair, number: int) -> Iterable[tuple[Tensor, Tensor, Tensor | None]]:
    """Each image of a pair, in colour: (3, H, W) before and after the edit, and masks (K, H, W)."""
    if not isinstance(pair, tuple | list) or len(pair) not in (2, 3):
        raise TypeError(
            f"pairs must hold tuples of two photographs, or these and masks, got {type(pair).__name__}; "
            "pass [(before, after)]"
        )
    before, after = pair[:2]
    names = (f"before of pair {number + 1}", f"after of pair {number + 1}")
    check_photograph(before, names[0])
    check_photograph(after, names[1], channels=before.shape[1], batch=before.shape[0])
    check_same_size(after, (before.shape[-2], before.shape[-1]), names[1], names[0])
    if before.shape[1] not in (1, 3):
        raise ValueError(f"{names[0]} must have 1 or 3 channels, got {before.shape[1]}; pass grey or RGB")
    masks = pair[2] if len(pair) == 3 else None
    if masks is not None:
        check_image(masks, "masks", batch=before.shape[0])
        check_same_size(masks, (before.shape[-2], before.shape[-1]), "masks", names[0])
    for i in range(before.shape[0]):
        one, other = before[i].expand(3, -1, -1), after[i % after.shape[0]].expand(3, -1, -1)
        check_belong(one, other, *names)
        yield one, other, None if masks is None else masks[i % masks.shape[0]]


def check_belong(before: Tensor, after: Tensor, first: str, second: str) -> None:
    """Raise unless an image (3, H, W) can be an edit of another one.

    Edits keep most of what is dark and light, or at least (negatives, false colours) most of what luminance says: its
    correlation with the means of the edited luminance of every shade, and the other way round.
    """
    if bool((before == after).all()):
        return  # says that the look leaves it as it is
    shown = inside_frame(before, after) & ((after > 0) & (after < 1)).any(0)
    if not bool(shown.any()):
        raise ValueError(f"{second} must have pixels that are not clipped to black or white, got none; edit it less")
    grey, edited = (reduce_channels(image[None], "luminance")[0, 0, shown].double() for image in (before, after))
    if min(float(grey.std(correction=0)), float(edited.std(correction=0))) < 1 / 255:
        return  # nothing to compare
    shades = (grey.clamp(0, 1) * (SHADES - 1)).round().long()
    counts = torch.zeros(SHADES, dtype=torch.float64).index_add(0, shades, torch.ones_like(grey)).clamp(min=1)
    means = torch.zeros(SHADES, dtype=torch.float64).index_add(0, shades, edited) / counts
    shared = float(((means[shades] - edited.mean()).square().mean() / edited.var(correction=0)).sqrt())
    if len(grey) >= 4 * SHADES and shared < ALIKE:
        raise ValueError(
            f"{second} must be an edit of {first}, but their brightness agrees only to {100 * shared:.0f} % "
            f"(at least {100 * ALIKE:.0f} % is needed); check that they show the same picture"
        )


def _add(
    regions: list[_Region],
    before: Tensor,
    after: Tensor,
    masks: Tensor | None,
    step: Step,
    number: int,
    generator: torch.Generator | None,
) -> None:
    """Add the sums of an image (3, H, W) before and after an edit."""
    layout = regions[0].layout
    photograph = EditedPhotograph(before, after, masks, step, layout.sliders - 1, generator)
    width = photograph.size[1]

    def sums(pixels: SomePixels) -> list[Sums]:
        """Sums over parts of the picture, one after the other, which take less memory than all pixels at once."""
        square = _squares(pixels.places, width)
        return pixels.sums(layout, [(square == i).nonzero().squeeze(1) for i in square.unique()])

    found = photograph.regions_of_sample()
    known = None if found is None else [sums(pixels) for pixels in found]
    if found is None or known is None or _of_sliders(reduce(Sums.__add__, known[0]), layout, LIKELY):
        found = photograph.regions()
        known = [sums(pixels) for pixels in found]
    for region, pixels, parts in zip(regions, found, known, strict=True):
        if not parts:
            continue  # the region is not in this photograph
        whole = reduce(Sums.__add__, parts)
        region.squares = region.squares or parts
        if len(region.folds) < FOLDS:
            region.folds.append(whole)
        else:
            region.folds[number % FOLDS] = region.folds[number % FOLDS] + whole
        _add_sliders(region, pixels, whole, photograph.rounding)


def _squares(places: Tensor, width: int) -> Tensor:
    """Whole numbers of pixels (P,) of a picture, by the part of the rectangle around them."""
    if len(places) == 0:
        return places
    rows, columns = (
        (found - found.min()) * SQUARES // (found.max() - found.min() + 1)
        for found in (places // width, places % width)
    )
    return rows * SQUARES + columns


def _of_sliders(sums: Sums, layout: Layout, share: float) -> bool:
    """Whether sliders explain such a share of the change."""
    return sums.explained(fit_parts(sums, ("alpha",), layout, RIDGES[0])) >= share


def _add_sliders(region: _Region, pixels: SomePixels, sums: Sums, rounding: float) -> None:
    """Add sliders of least squares to which rounding of the edited picture is no error."""
    if region.sliders is None:
        return
    if not _of_sliders(sums, region.layout, SLIDERS_ONLY):
        region.sliders = None
        return
    # Sliders add the same to every channel, each of which is rounded by itself.
    layers = pixels.weighed["alpha"].repeat(1, 3)
    before, after, weights = (planes.flatten() for planes in (pixels.before, pixels.after, pixels.weights))
    alpha = fit_layers(layers, before, after, weights, rounding)
    place = region.layout.place("alpha")
    gram = sums.gram[:, place, place].sum(0)
    gram = gram + 1e-9 * gram.diagonal().max() * torch.eye(len(gram), dtype=gram.dtype)
    old = region.sliders
    region.sliders = (old[0].double() + gram, old[1].double() + gram @ alpha.double())
