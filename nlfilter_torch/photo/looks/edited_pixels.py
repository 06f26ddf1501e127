"""Pairs of photographs before and after an edit, and their pixels with what each part of a look changes of them."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_photograph, check_same_device, check_same_size
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.fit import HALF_LEVEL, OFF_LEVEL
from nlfilter_torch.operator.build import operator_from_guide, sampled_operator
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.looks.alignment import inside_frame
from nlfilter_torch.photo.looks.histogram import LocalCurves
from nlfilter_torch.photo.looks.look_filter import blur_bands, local_curves, stretch_of, textures_of
from nlfilter_torch.photo.looks.look_sums import SAMPLED_PIXELS, PixelSample, sample, squares
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.source import seeded
from nlfilter_torch.photo.picture.viewing import viewed_size

Pair = tuple[Tensor, ...]  # before and after an edit, and masks of regions, if any
AGREEING = 0.5  # least correlation of the luminance of a photograph with that of its edit
GREYS = 256  # shades, for :func:`means_of_shades`
IN_REGION = 0.9  # value of a mask above which a pixel counts as part of the region


class EditedPhotograph:
    """A photograph before and after an edit, at the viewing size.

    Args:
        before: (3, H, W) in [0, 1].
        after: likewise.
        masks: of regions, (K, H, W) in [0, 1]; None is a region of everything.
        step: ``look`` with the parameters of the filter.
        order: k of the layers.
        generator: source of randomness for the landmarks; None draws the same for every photograph.
    """

    def __init__(
        self,
        before: Tensor,
        after: Tensor,
        masks: Tensor | None,
        step: Step,
        order: int,
        generator: torch.Generator | None,
    ) -> None:
        dtype = working_dtype(before)
        before, after = before.to(dtype), after.to(dtype)
        inside = inside_frame(before, after).to(dtype)
        free = ((after > 0) & (after < 1)).to(dtype) * inside
        size = (before.shape[-2], before.shape[-1])
        self.size = viewed_size(size, step["viewing_size"])
        self.stretch = stretch_of(before[None])  # not of its reduction, which has fewer extremes
        levels = after * 255
        #: Half the step between the values of the edited photograph, or 0.
        self.rounding = HALF_LEVEL if bool(((levels - levels.round()).abs() < OFF_LEVEL).all()) else 0.0
        if self.size != size:
            before, after, free = (resize(planes[None], self.size)[0] for planes in (before, after, free))
            inside = resize(inside[None, None], self.size)[0, 0]
            masks = None if masks is None else resize(masks[None].to(before), self.size)[0]
            free, inside, self.rounding = (free > 0.99).to(dtype), (inside > 0.99).to(dtype), 0.0
        self.image, self.order = before[None], order
        self.before, self.after = before.flatten(1), after.flatten(1)
        self.free, self.inside, self.masks = free.flatten(1), inside.flatten(), masks
        self.generator = generator or seeded()
        self.options = FilterOptions(**step.filter_options(self.size), generator=self.generator)

    @cached_property
    def luminance(self) -> Tensor:
        """Luminance before the edit, (1, 1, H, W)."""
        return reduce_channels(self.image, "luminance")

    @cached_property
    def bands(self) -> list[Tensor]:
        """Bands of blurs before the edit, and the rest, (3, N) each."""
        bands = [band[0].flatten(1) for band in blur_bands(self.image)]
        return [*bands[:-1], bands[-1] - self.luminance.mean()]

    @cached_property
    def texture(self) -> list[Tensor]:
        """Textures before the edit, (N,) each."""
        return [texture.flatten() for texture in textures_of(self.image)]

    @cached_property
    def local(self) -> LocalCurves:
        """Local tone curves before the edit."""
        return local_curves(self.image, self.stretch)

    @cached_property
    def layers(self) -> Tensor:
        """Detail layers of luminance before the edit, (k+1, N)."""
        operator = operator_from_guide(self.luminance, self.options)
        return detail_layers(operator, self.luminance, order=self.order)[0, :, 0].flatten(1)

    def regions(self) -> list[PixelSample]:
        """Pixels of each region that are not clipped; a region that the photograph does not show has none."""
        return [self._pixels(shown, self.layers) for shown in self._shown()]

    def regions_of_sample(self) -> list[PixelSample] | None:
        """A sample of :meth:`regions`, with layers of a filter that is balanced over this sample.

        It takes a fifth of the time, and the layers are off by a twentieth. None for small photographs, for those that
        are mostly clipped, and with masks, as the sample has few pixels of a small region.
        """
        count = self.free.shape[1]
        if count <= SAMPLED_PIXELS or self.masks is not None or float(self.free.amax(0).mean()) < 0.5:
            return None
        places = sample(torch.ones_like(self.free[0]))
        # The landmarks are those of :attr:`layers`.
        options = replace(self.options, generator=self.generator.clone_state())
        operator = sampled_operator(self.luminance, places, options)
        luminance = self.luminance.flatten(2)[:, :, None, places]
        layers = detail_layers(operator, luminance, order=self.order)[0, :, 0].flatten(1)
        inside = self.inside[places] > 0
        return [self._at(places[inside], layers[:, inside], self.inside)]

    def colours(self, most: int) -> list[PixelSample]:
        """Pixels of each region, at most so many, clipped or not, without the columns of any part."""
        samples = []
        for shown in self._shown():
            places = sample(shown, most)
            share = int((shown > 0).sum()) / max(len(places), 1)
            samples.append(self._sampled(places, shown * self.free, shown, share, shown.new_zeros(3, 0, len(places))))
        return samples

    def _shown(self) -> list[Tensor]:
        """Weights of the pixels, clipped or not, (N,) for each region."""
        if self.masks is None:
            return [self.inside]
        masks = ((self.masks.to(self.free).flatten(1) - IN_REGION) / (1 - IN_REGION)).clamp(0, 1)
        return [self.inside * mask for mask in masks]

    def _pixels(self, shown: Tensor, layers: Tensor) -> PixelSample:
        free = shown * self.free.amax(0)
        places = sample(free)
        if len(places) > 0:
            clipped = sample(shown * (free == 0))
            clipped = clipped[:: 1 + len(clipped) // len(places)]
            places = torch.cat([places, clipped]).sort().values
        return self._at(places, layers[:, places], shown)

    def _at(self, places: Tensor, layers: Tensor, shown: Tensor) -> PixelSample:
        weights = shown * self.free
        share = float((weights.amax(0) > 0).sum()) / max(int((weights[:, places].amax(0) > 0).sum()), 1)
        rows, columns = places // self.size[1], places % self.size[1]
        before = self.before[:, places]
        parts = (  # in the order of their columns
            torch.stack([band[:, places] for band in self.bands], dim=1),
            torch.stack([texture[places] for texture in self.texture]),
            self.stretch.changes(before[None, :, None])[0, :, :, 0].transpose(0, 1),
            self.local.at(before[None], rows, columns)[0].transpose(0, 1),
            layers,
        )
        surroundings = torch.cat([part.expand(3, -1, -1) for part in parts], dim=1)
        return self._sampled(places, weights, shown, share, surroundings)

    def _sampled(
        self, places: Tensor, weights: Tensor, shown: Tensor, share: float, surroundings: Tensor
    ) -> PixelSample:
        """The pixels at places (P,) with so many times their weights."""
        return PixelSample(
            self.before[:, places],
            self.after[:, places],
            surroundings,
            weights[:, places] * share,
            shown[places] * share,
            squares(places, self.size[1]),
            torch.zeros_like(places),
        )


def images_of(pairs: Iterable[Pair]) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Each image of the pairs, in colour: (3, H, W) before and after the edit, and masks (K, H, W)."""
    number, first = 0, None
    for pair in pairs:
        _check_pair(pair, number, first)
        before, after = pair[:2]
        first = before.new_empty(0) if first is None else first  # on its device, without its pixels
        masks = pair[2] if len(pair) == 3 else None
        names = _names(number)
        for i in range(before.shape[0]):
            image, edited = before[i].expand(3, -1, -1), after[i % after.shape[0]].expand(3, -1, -1)
            check_belong(image, edited, *names)
            yield image, edited, None if masks is None else masks[i % masks.shape[0]]
            number += 1


def _names(number: int) -> tuple[str, str]:
    """Names in errors of the two photographs of a pair."""
    return f"before of pair {number + 1}", f"after of pair {number + 1}"


def _check_pair(pair: Pair, number: int, first: Tensor | None) -> None:
    """Raise unless a pair holds two photographs of the same shape, and masks of their size, if any.

    All of them have to be on the device of the first photograph before the edit, if there was one.
    """
    if not isinstance(pair, tuple | list) or len(pair) not in (2, 3):
        raise TypeError(
            f"pairs must hold tuples of two photographs, or these and masks, got {type(pair).__name__}; "
            "pass [(before, after)]"
        )
    before, after, *masks = pair
    names = _names(number)
    check_photograph(before, names[0])
    if first is not None:
        check_same_device(before, first, names[0], "first pair")
    check_photograph(after, names[1], channels=before.shape[1], batch=before.shape[0])
    check_same_size(after, (before.shape[-2], before.shape[-1]), names[1], names[0], before)
    if before.shape[1] not in (1, 3):
        raise ValueError(f"{names[0]} must have 1 or 3 channels, got {before.shape[1]}; pass grey or RGB")
    for mask in masks:
        if mask is not None:
            check_image(mask, "masks", batch=before.shape[0])
            check_same_size(mask, (before.shape[-2], before.shape[-1]), "masks", names[0], before)


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
    shared = float(((means_of_shades(grey, edited) - edited.mean()).square().mean() / edited.var(correction=0)).sqrt())
    if len(grey) >= 4 * GREYS and shared < AGREEING:
        raise ValueError(
            f"{second} must be an edit of {first}, but their brightness agrees only to {100 * shared:.0f} % "
            f"(at least {100 * AGREEING:.0f} % is needed); check that they show the same picture"
        )


def means_of_shades(grey: Tensor, values: Tensor) -> Tensor:
    """For each pixel, the mean (P,) of the values (P,) of all pixels whose luminance (P,) is of the same shade."""
    shades = (grey.clamp(0, 1) * (GREYS - 1)).round().long()
    return (shades.bincount(values) / shades.bincount().clamp(min=1))[shades]
