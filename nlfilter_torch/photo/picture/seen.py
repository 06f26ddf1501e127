"""The range that a picture uses, and a picture seen relative to it.

Edits work in [0, 1], and their thresholds are levels of 8 bits. A picture that uses less than a quarter of [0, 1]
(medical and astronomical pictures of 16 bits, underexposed ones), or goes far beyond it (floats up to 65535), is seen
by them with its range stretched to [0, 1], and what they change is added to the picture in its own units. The range is
that of a sample of the pixels, so that a few very bright ones do not count. What lies far outside keeps its distance.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Generic

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import mirrored
from nlfilter_torch.core.checks import FAR_OUTSIDE
from nlfilter_torch.core.inner import Inner
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.core.torch_internals import is_unreadable
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.photo.picture.pixels import Fitted, M, Pixels, Planes
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Blocks, Guide, Kept, Operator, Reduced, Source, sampled_places, seeded
from nlfilter_torch.photo.picture.working_range import WorkingRange

SMALL_SHARE = 0.25  # share of [0, 1] below which the range in use is stretched
RARE = 0.005  # share of the values on either side that do not count for the range
AROUND = 0.125  # by which the range is extended on both sides, as a share of itself
LEAST_STEPS = 32  # steps of the depth that the range comprises at least
WHOLE = (255.0, 65535.0)  # white of the depths whose values have steps
NEARLY = 1e-2  # distance from a whole number of steps that is due to rounding
LINES = 64  # rows, and columns, whose crossings show whether a picture uses its range


def range_of(source: Source[M]) -> WorkingRange | None:
    """The ranges that the pictures of a source use, or None if all are to be seen as they are.

    Values that cannot be read, and images of other than 1 or 3 channels, are seen as they are.
    """
    if source.channels not in (1, 3) or source.batch == 0:
        return None
    source.accept_any_scale()
    return source.kept("working range", [], partial(_measured_range, source))


@torch.no_grad()
def _measured_range(source: Source[M]) -> WorkingRange | None:
    crossings = source.measured(partial(_used_at, _crossings(source.size)))
    if is_unreadable(crossings) or not bool(_is_unusual(crossings).any()):
        return None
    used = source.measured(partial(_used_at, sampled_places(source.size)))
    unusual = _is_unusual(used)
    if not bool(unusual.any()):
        return None
    low, high = _extended(*used)
    return WorkingRange(*(values.view(-1, 1, 1, 1) for values in (low, high, unusual)))


def _crossings(size: tuple[int, int]) -> Tensor:
    """Row-major indices (n,), ascending, of pixels in at most :data:`LINES` rows, which turn with the picture."""
    short, long = sorted(size)
    if short * long <= LINES**2:
        return torch.arange(short * long)
    places = torch.rand(2, LINES // 2, generator=seeded())
    across, along = ((places[axis] * side / 2).long() for axis, side in ((0, short), (1, long)))
    if short == long:
        along = across
    pairs = torch.cartesian_prod(across, along)
    return mirrored(pairs[:, 0], pairs[:, 1], size).unique()


def _used_at(places: Tensor, source: Source[M]) -> Tensor:
    """Range that the values of some pixels comprise, and the step of their depth or 0: (3, B)."""
    colours, weights = source.colours(places).detach(), source.weights_at(places)
    colours = colours.to(torch.promote_types(colours.dtype, torch.float32))
    values, quantile = colours.flatten(1), torch.quantile
    if weights is not None and bool((weights > 0).any(2).all()):
        values = torch.where(weights > 0, colours, torch.nan).flatten(1)
        quantile = torch.nanquantile
    ends = quantile(values, values.new_tensor([RARE, 1 - RARE]), dim=1)
    values = colours.flatten(1)
    step = values.new_zeros(len(values))
    for white in reversed(WHOLE):
        steps = values * white
        is_whole = ((steps - steps.round()).abs() < NEARLY).all(1)
        step = torch.where(is_whole, 1 / white, step)
    return torch.cat([ends, step[None]])


def _is_unusual(used: Tensor) -> Tensor:
    """Whether pictures with these results of :func:`_used_at` are seen in the range that they use, (B,)."""
    low, high, _ = used
    return ((high - low < SMALL_SHARE) | (low < -FAR_OUTSIDE) | (high > FAR_OUTSIDE)) & (high > low)


def _extended(low: Tensor, high: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """The range with room on both sides, but not beyond black and white, which clipped pixels have."""
    resolution = 2 * LEAST_STEPS * torch.finfo(low.dtype).eps * torch.maximum(low.abs(), high.abs())
    least = torch.maximum(LEAST_STEPS * step, resolution)
    around = AROUND * (high - low) + (least - (high - low)).clamp(min=0) / 2
    below, above = low - around, high + around
    below = torch.where(low >= 0, below.clamp(min=0), below)
    above = torch.maximum(above, below + least)
    above = torch.where(high <= 1, above.clamp(max=1), above)
    return torch.minimum(below, above - least), above


@dataclass(frozen=True, eq=False)
class SeenPixels:
    """Pixels of a picture as edits see them."""

    pixels: Pixels
    working: WorkingRange

    @cached_property
    def image(self) -> Tensor:
        """(B, C, h, w)."""
        return self.working.seen(self.pixels.image)

    @property
    def first(self) -> int:
        """Row-major index of the first pixel in the picture."""
        return self.pixels.first

    @property
    def width(self) -> int:
        """W of the picture."""
        return self.pixels.width


@dataclass(frozen=True)
class OfPixels:
    """Planes of the picture itself, from planes of the picture as edits see it."""

    planes: Planes
    working: WorkingRange

    def __call__(self, pixels: Pixels) -> Tensor:
        """Planes (B, C, h, w) at pixels of the picture itself."""
        return self.planes(SeenPixels(pixels, self.working))


@dataclass(frozen=True)
class OfSeen:
    """Planes of the picture as edits see it, from planes of the picture itself."""

    planes: Planes

    def __call__(self, pixels: Pixels) -> Tensor:
        """Planes (B, C, h, w) at pixels as edits see them."""
        assert isinstance(pixels, SeenPixels)  # for mypy
        return self.planes(pixels.pixels)


@dataclass(frozen=True)
class SeenGuide:
    """The transform of a guide that is computed from the picture as edits see it."""

    transform: Callable[[Tensor], Tensor] | None
    working: WorkingRange

    def __call__(self, image: Tensor) -> Tensor:
        """The guide (B, C', H, W) of an image."""
        seen = self.working.seen(image)
        return seen if self.transform is None else self.transform(seen)


@dataclass(frozen=True, eq=False)
class SeenFinish:
    """The second half of an edit, for the picture itself; its result is that for the picture as edits see it."""

    finish: Callable[[Tensor, Tensor, Inner], Tensor]
    working: WorkingRange

    def __call__(self, image: Tensor, planes: Tensor, inner: Inner) -> Tensor:
        """The result (B, C, H, W)."""
        return self.finish(self.working.seen(image), planes, inner)


def of_picture(fitted: Fitted, working: WorkingRange) -> Fitted:
    """An edit fitted to a picture as edits see it, for pixels of the picture itself; its results are not converted."""
    finish = None if fitted.finish is None else SeenFinish(fitted.finish, working)
    return replace(fitted, pixels=OfPixels(fitted.pixels, working), finish=finish)


@dataclass(frozen=True, eq=False)
class SeenOperator:
    """The filter of a picture as edits see it."""

    operator: Operator
    working: WorkingRange

    @property
    def pairs(self) -> RitzPairs:
        """Spectrum of W."""
        return self.operator.pairs

    def of_columns(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Apply a function to the columns of the pixels."""
        return OfSeen(self.operator.of_columns(function))

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers of planes."""
        return OfSeen(self.operator.layers(OfPixels(planes, self.working), order))

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y`` for planes y."""
        return self.operator.coefficients(OfPixels(planes, self.working))

    def rational(self, planes: Planes, form: RationalForm, weights: Tensor) -> Planes:
        """A rational function of W."""
        return OfSeen(self.operator.rational(OfPixels(planes, self.working), form, weights))

    def mean(self, planes: Planes) -> Tensor:
        """Means over the picture."""
        return self.operator.mean(OfPixels(planes, self.working))

    def at(self, places: Tensor) -> Blocks:
        """Columns of the factor at single pixels."""
        return self.operator.at(places)


@dataclass(frozen=True, eq=False)
class Seen(Generic[M]):
    """A picture as edits see it, as their source."""

    source: Source[M]
    working: WorkingRange

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.source.size

    @property
    def batch(self) -> int:
        """Number of images."""
        return self.source.batch

    @property
    def channels(self) -> int:
        """Number of channels of the picture."""
        return self.source.channels

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the computation."""
        return self.source.dtype

    def accept_any_scale(self) -> None:
        """The picture is seen in [0, 1]."""

    def operator(self, guide: Guide) -> SeenOperator:
        """Build the filter of the picture."""
        seen = replace(guide, transform=SeenGuide(guide.transform, self.working))
        return SeenOperator(self.source.operator(seen), self.working)

    def scribbles(self, mask: M | None, colours: M | None, name: str, *, needed: bool = True) -> Scribbles:
        """Read scribbles."""
        return self._seen_under(self.source.scribbles(mask, colours, name, needed=needed))

    def _seen_under(self, scribbles: Scribbles) -> Scribbles:
        return replace(scribbles, image=self._seen(scribbles.image))

    def _seen(self, colours: Tensor) -> Tensor:
        """Colours (B, C, n) of the picture as edits see them."""
        return self.working.seen(colours.unsqueeze(3)).squeeze(3)

    def resized(self, size: tuple[int, int]) -> "Seen[M]":
        """Reduce the picture to a smaller size."""
        return self if size == self.size else Seen(self.source.resized(size), self.working)

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes of all its pixels in a smaller size."""
        return self.source.shrunk(OfPixels(planes, self.working), size)

    def resized_weights(self, weights: M, size: tuple[int, int], name: str) -> M:
        """Reduce weights of the pixels to a smaller size."""
        return self.source.resized_weights(weights, size, name)

    def all(self, fitted: Fitted) -> Tensor:
        """Result of an edit at all pixels."""
        return self.source.all(of_picture(fitted, self.working))

    def cached(self, fitted: Fitted) -> Fitted:
        """Compute the result of an edit and keep it in memory, if there is room for it."""
        own = of_picture(fitted, self.working)
        cached = self.source.cached(own)
        return fitted if cached is own else replace(cached, pixels=OfSeen(cached.pixels))

    def mean_of(self, fitted: Fitted, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means of a function of the image and of an edit's result."""
        return self.source.mean_of(of_picture(fitted, self.working), partial(_of_seen, function, self.working))

    def regions(self, masks: M, name: str, *, needed: bool = True) -> list[Scribbles]:
        """Read the scribbles of several regions."""
        return [self._seen_under(scribbles) for scribbles in self.source.regions(masks, name, needed=needed)]

    def weights_of(self, masks: M, name: str) -> Planes:
        """Weights of given pixels in masks of several regions."""
        return self.source.weights_of(masks, name)

    def num_regions(self, masks: M, name: str) -> int:
        """Number of regions that have scribbles."""
        return self.source.num_regions(masks, name)

    def check_all_in_memory(self, sentence: str) -> None:
        """Raise ValueError with this sentence if the picture is read in parts."""
        self.source.check_all_in_memory(sentence)

    def colours(self, places: Tensor) -> Tensor:
        """Colours of single pixels."""
        return self._seen(self.source.colours(places))

    def weights_at(self, places: Tensor) -> Tensor | None:
        """The weights of single pixels."""
        return self.source.weights_at(places)

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return self.source.mean(OfPixels(planes, self.working))

    def ends(self, planes: Planes) -> tuple[Tensor, Tensor]:
        """Least and largest values over all pixels."""
        return self.source.ends(OfPixels(planes, self.working))

    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means over blocks."""
        return self.source.reduced(OfPixels(planes, self.working), step)

    def blocks(self, step: float, floats: int) -> Reduced:
        """Reduce the picture, in memory, to means over blocks."""
        small = self.source.blocks(step, floats)
        return self.source.kept(("seen blocks", step), [], lambda: small.like(self.working.seen(small.image)))

    def kept(self, name: Hashable, tensors: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
        """Result of a function of picture and tensors, which a preview keeps."""
        return self.source.kept(name, tensors, compute)

    def parts(self, function: Callable[[Tensor, Inner, int], Kept], margin: int) -> list[Kept]:
        """Results of a function of parts that make up the picture."""
        return self.source.parts(partial(_part_as_seen, function, self.working), margin)

    def measured(self, function: Callable[[Source[M]], Tensor]) -> Tensor:
        """Apply a measurement to the picture."""
        return self.source.measured(partial(_measured_as_seen, function, self.working))


def _of_seen(
    function: Callable[[Tensor, Tensor], Tensor], working: WorkingRange, image: Tensor, result: Tensor
) -> Tensor:
    return function(working.seen(image), result)


def _part_as_seen(
    function: Callable[[Tensor, Inner, int], Kept], working: WorkingRange, image: Tensor, inner: Inner, first_row: int
) -> Kept:
    return function(working.seen(image), inner, first_row)


def _measured_as_seen(function: Callable[[Source[M]], Tensor], working: WorkingRange, source: Source[M]) -> Tensor:
    return function(Seen(source, working))


def in_own_units(fitted: Fitted, working: WorkingRange) -> Fitted:
    """The edited picture in its own units, from an edit whose results are those of the picture as edits see it."""
    if fitted.finish is None:
        return Fitted(OwnUnits(fitted.pixels, working))
    return replace(fitted, finish=FinishInOwnUnits(fitted, working))


@dataclass(frozen=True, eq=False)
class OwnUnits:
    """Edited pixels in the units of the picture."""

    planes: Planes
    working: WorkingRange

    def __call__(self, pixels: Pixels) -> Tensor:
        """The edited pixels (B, C, h, w)."""
        return self.working.edited(pixels.image, self.planes(pixels))


@dataclass(frozen=True, eq=False)
class FinishInOwnUnits:
    """The second half of an edit, in the units of the picture."""

    fitted: Fitted
    working: WorkingRange

    def __call__(self, image: Tensor, planes: Tensor, inner: Inner) -> Tensor:
        """The edited image (B, C, H, W)."""
        assert self.fitted.finish is not None  # for mypy
        if self.fitted.repaired is not None:
            image = self.fitted.repaired(image, self.working.span)
        return self.working.edited(image, self.fitted.finish(image, planes, inner))
