"""Pixels of a photograph before and after an edit, with what each part of a look changes of them."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.fit import HALF_LEVEL, OFF_LEVEL
from nlfilter_torch.operator.build import operator_from_guide, sampled_operator
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import OperatorOptions
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.look_fitting.alignment import inside_frame
from nlfilter_torch.photo.look_fitting.look_sums import MOST, Layout, Sums, columns_of, sample, sums_of
from nlfilter_torch.photo.looks.histogram import LocalCurves
from nlfilter_torch.photo.looks.look_filter import bands_of, local_curves, range_of, textures_of
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.source import seeded
from nlfilter_torch.photo.picture.viewing import viewed_size

INSIDE = 0.9  # value of a mask above which a pixel counts as part of the region


@dataclass(frozen=True)
class PixelSample:
    """Pixels of a photograph before and after an edit.

    Attributes:
        places: row-major indices (P,) of the pixels.
        before: (3, P).
        after: (3, P).
        weighed: columns of the parts of a look that depend on the surroundings of a pixel, as for :func:`columns_of`.
        weights: (3, P); 0 for values that are clipped after the edit.
        shown: weights (P,) of the pixels regardless of clipping.
    """

    places: Tensor
    before: Tensor
    after: Tensor
    weighed: dict[str, Tensor]
    weights: Tensor
    shown: Tensor

    def every(self, step: int) -> "PixelSample":
        """Each ``step``-th of the pixels, with ``step`` times their weights."""
        weighed = {name: columns[..., ::step] for name, columns in self.weighed.items()}
        places, before, after = (planes[..., ::step] for planes in (self.places, self.before, self.after))
        return PixelSample(places, before, after, weighed, self.weights[:, ::step] * step, self.shown[::step] * step)

    def sums(self, layout: Layout, subsets: list[Tensor]) -> list[Sums]:
        """Sums over subsets of the pixels, given by their indices (P',)."""
        sums = []
        for subset in subsets:
            before = self.before[..., subset]
            weighed = {name: columns[..., subset] for name, columns in self.weighed.items()}
            columns = columns_of(before, weighed, layout)
            sums.append(sums_of(columns, self.after[..., subset] - before, self.weights[..., subset]))
        return sums


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
        self.stretch = range_of(before[None])  # not of its reduction, which has fewer extremes
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
        self.options = step.filter_options(self.size)
        self.generator = generator or seeded()

    @cached_property
    def luminance(self) -> Tensor:
        """Luminance before the edit, (1, 1, H, W)."""
        return reduce_channels(self.image, "luminance")

    @cached_property
    def bands(self) -> list[Tensor]:
        """Bands of blurs before the edit, and the rest, (3, N) each."""
        bands = [band[0].flatten(1) for band in bands_of(self.image)]
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
        operator = operator_from_guide(self.luminance, OperatorOptions(**self.options, generator=self.generator))
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
        if count <= MOST or self.masks is not None or float(self.free.amax(0).mean()) < 0.5:
            return None
        places = sample(torch.ones_like(self.free[0]))
        generator = self.generator.clone_state()  # the landmarks are those of :attr:`layers`
        operator = sampled_operator(self.luminance, places, **self.options, generator=generator)
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
            before, after, free = (planes[:, places] for planes in (self.before, self.after, self.free))
            weights = shown[places] * share
            samples.append(PixelSample(places, before, after, {}, weights * free, weights))
        return samples

    def _shown(self) -> list[Tensor]:
        """Weights of the pixels, clipped or not, (N,) for each region."""
        if self.masks is None:
            return [self.inside]
        masks = ((self.masks.to(self.free).flatten(1) - INSIDE) / (1 - INSIDE)).clamp(0, 1)
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
        before, after = self.before[:, places], self.after[:, places]
        weighed = {
            "bands": torch.stack([band[:, places] for band in self.bands], dim=1),
            "texture": torch.stack([texture[places] for texture in self.texture]),
            "stretch": self.stretch.changes(before[None, :, None])[0, :, :, 0].transpose(0, 1),
            "local": self.local.at(before[None], rows, columns)[0].transpose(0, 1),
            "alpha": layers,
        }
        return PixelSample(places, before, after, weighed, weights[:, places] * share, shown[places] * share)
