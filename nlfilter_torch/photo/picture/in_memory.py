"""An image or a batch in memory as the source of an edit, with gradients."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import cast

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_photograph, check_same_size, check_tensor, check_unit_range
from nlfilter_torch.core.inner import EVERYWHERE, Inner
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.rational_product import pole_terms, rational_product, weigh_poles
from nlfilter_torch.filtering.scribbles import check_painted
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.hidden import fill_nearby
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import RitzPairs, Spectrum
from nlfilter_torch.photo.declared.declaration import Arguments
from nlfilter_torch.photo.picture.drawn import Drawn, M
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.ends import ends_of, mean_of, usable
from nlfilter_torch.photo.picture.pixels import Fitted, Planes, part_of, strips_of
from nlfilter_torch.photo.picture.resizing import block_means, counted_means, resize, weights_of
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.seen import Seen, in_own_units, of_picture, range_of
from nlfilter_torch.photo.picture.source import SAMPLE, Blocks, Guide, Kept, Source, sampled_pairs, sampled_places
from nlfilter_torch.photo.picture.working_range import WorkingRange

Cache = dict[Hashable, tuple[Sequence[Tensor], object]]  # results by their names, with the tensors they depend on


class InMemory:
    """An image (B, C, H, W), float32 or float64, in memory: both a source and the set of all its pixels.

    ``cache`` holds its operators, by their options, and other results, by name; None caches nothing. ``weights``
    (B or 1, 1, H, W) say how much pixels count, from 0 to 1; None is 1 each.
    """

    first = 0

    def __init__(self, image: Tensor, cache: Cache | None = None, weights: Tensor | None = None) -> None:
        self.image, self.cache, self.dtype = image.contiguous(), cache, image.dtype
        weights = usable(weights)
        self.weights = None if weights is None else weights.to(image).expand(len(image), -1, -1, -1)
        self.batch, self.channels, *size = image.shape
        self.size, self.width = (size[0], size[1]), size[1]

    def accept_any_scale(self) -> None:
        """Such warnings are given before."""

    def operator(self, guide: Guide) -> "InMemoryOperator":
        """Build, or take from the cache, :func:`nonlocal_operator` of the guide.

        The cache holds one operator for each set of options that are not tensors; other tensors replace it. Operators
        of tensors that need gradients are not cached.
        """
        options = [(name, value) for name, value in sorted(vars(guide.options).items()) if name != "generator"]
        tensors = [tensor for _, value in options for tensor in tensors_in(value)]
        if any(tensor.requires_grad for tensor in tensors):
            return self._build(guide)
        named = tuple((name, without_tensors(value)) for name, value in options)
        copies = [tensor.clone() for tensor in tensors]
        return self.kept((guide.transform, guide.blur, *named), copies, partial(self._build, guide))

    def _build(self, guide: Guide) -> "InMemoryOperator":
        options = guide.options
        if self.weights is not None:
            counted = int((self.weights > 0).flatten(1).sum(1).min())
            options = replace(options, num_landmarks=min(options.num_landmarks, counted))
        operator = operator_from_guide(guide(self.image), options, self.weights)
        return InMemoryOperator(operator, self, guide.sampled, None if self.cache is None else {})

    def scribbles(self, mask: Tensor | None, colours: Tensor | None, name: str, *, needed: bool = True) -> Scribbles:
        """Read scribbles from tensors, ``mask`` (B, 1, H, W) and ``colours`` (B, 3, H, W).

        Without a mask, colours are (B, 4, H, W), whose last plane is the mask.
        """
        called = "strokes"
        if colours is not None:
            check_tensor(colours, called)
            if mask is None and colours.ndim == 4 and colours.shape[1] == 4:
                (colours, mask), called = colours.split([3, 1], dim=1), name
        if mask is None:
            raise TypeError(f"{name} must be a torch.Tensor, got NoneType; convert it with torch.as_tensor")
        check_image(mask, name, channels=1, batch=self.batch)
        check_same_size(mask, self.size, name, "image")
        if colours is not None:
            check_photograph(colours, called, channels=3, batch=self.batch)
            check_same_size(colours, self.size, called, "image")
        if needed:
            check_painted(mask, name)
        else:
            check_unit_range(mask, name)
        weights = mask.to(self.image).expand(self.batch, -1, -1, -1)
        if self.weights is not None:
            weights = weights * self.weights
            if needed and not bool((weights > 0).any()):
                raise ValueError(f"{name} must cover a pixel that is not hidden, got none that does; move it")
        weights = weights.flatten(2)
        marked = torch.ones_like(weights[0, 0], dtype=torch.bool)
        if not weights.requires_grad:  # pixels of weight 0 matter only to the derivative by the weights
            marked = (weights > 0).any(0).squeeze(0)
        places = marked.nonzero().squeeze(1)
        image = self.image.flatten(2)[:, :, places]
        shown = None
        if colours is not None:
            shown = colours.to(self.image).expand(self.batch, -1, -1, -1).flatten(2)[:, :, places]
        return Scribbles(places, weights[:, :, places], image, shown)

    def resized(self, size: tuple[int, int]) -> "InMemory":
        """Resize the image."""
        if size == self.size:
            return self
        if self.weights is None:
            return InMemory(resize(self.image, size))
        weights = weights_of(resize(self.weights, size))
        return InMemory(fill_nearby(resize(self.image, size), weights > 0), weights=weights)

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes of all pixels in another size."""
        return resize(planes(self), size)

    def kept(self, name: Hashable, tensors: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
        """The result of a function, from the cache if it was last computed from equal tensors."""
        return kept_in(self.cache, name, tensors, compute)

    def blocks(self, step: float, floats: int) -> "InMemory":
        """Reduce the image by :func:`block_means`."""
        if step == 1:
            return self
        cache: Cache | None = None if self.cache is None else {}
        return self.kept(("blocks", step), [], partial(self._blocks, step, cache))

    def _blocks(self, step: float, cache: Cache | None) -> "InMemory":
        weights = None if self.weights is None else weights_of(block_means(self.weights, step))
        return InMemory(self._block_means(self.image, step), cache, weights)

    def _block_means(self, planes: Tensor, step: float) -> Tensor:
        """Means over blocks of the pixels that count; of all pixels in blocks where none does."""
        means = block_means(planes, step)
        if self.weights is None:
            return means
        return counted_means(means, block_means(planes * self.weights, step), block_means(self.weights, step))

    def like(self, image: Tensor) -> "InMemory":
        """Another image (B, C, H, W), with a cache if this one has one."""
        return InMemory(image, None if self.cache is None else {}, self.weights)

    def resized_weights(self, weights: Tensor, size: tuple[int, int], name: str) -> Tensor:
        """Resize weights."""
        check_image(weights, name, batch=self.batch)
        check_same_size(weights, self.size, name, "image")
        weights = weights.to(self.image)
        ends = weights.amin((2, 3), keepdim=True), weights.amax((2, 3), keepdim=True)
        # Undoes the overshoot of interpolation but leaves invalid weights invalid.
        return resize(weights, size).clamp(*ends)

    def all(self, fitted: Fitted) -> Tensor:
        """Apply an edit to all pixels."""
        parts = [fitted.pixels(part) for part in strips_of(self)]
        planes = parts[0] if len(parts) == 1 else torch.cat(parts, dim=2)
        return planes if fitted.finish is None else fitted.finish(self.image, planes, EVERYWHERE)

    def cached(self, fitted: Fitted) -> Fitted:
        """Compute the result of an edit and keep it in memory."""
        return Fitted(part_of(self.all(fitted)))

    def mean_of(self, fitted: Fitted, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means of a function of the image and of the result of an edit."""
        return mean_of(self.all(fitted.then(function)), self.weights)

    def colours(self, places: Tensor) -> Tensor:
        """Colours of single pixels."""
        return self.image.flatten(2)[:, :, places]

    def weights_at(self, places: Tensor) -> Tensor | None:
        """The weights of single pixels."""
        return None if self.weights is None else self.weights.flatten(2)[:, :, places]

    def regions(self, masks: Tensor, name: str, *, needed: bool = True) -> list[Scribbles]:
        """Read the scribbles of K regions from a tensor (B, K, H, W)."""
        check_image(masks, name, batch=self.batch)
        return [self.scribbles(mask, None, name, needed=needed) for mask in masks.split(1, dim=1)]

    def weights_of(self, masks: Tensor, name: str) -> Planes:
        """Weights of given pixels in masks (B, K, H, W) in [0, 1]."""
        check_image(masks, name, batch=self.batch)
        check_same_size(masks, self.size, name, "image")
        check_unit_range(masks, name)
        return part_of(masks.to(self.image).expand(self.batch, -1, -1, -1))

    def num_regions(self, masks: Tensor, name: str) -> int:
        """K, of masks (B, K, H, W)."""
        check_image(masks, name, batch=self.batch)
        return masks.shape[1]

    def check_all_in_memory(self, sentence: str) -> None:
        """All pixels are in memory."""

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return mean_of(planes(self), self.weights)

    def ends(self, planes: Planes) -> tuple[Tensor, Tensor]:
        """Least and largest values over all pixels."""
        return ends_of(planes(self), self.weights)

    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means over blocks of pixels."""
        return self._block_means(planes(self), step)

    def parts(self, function: Callable[[Tensor, Inner, int], Kept], margin: int) -> list[Kept]:
        """The result for the image."""
        return [function(self.image, EVERYWHERE, 0)]

    def measured(self, function: Callable[[Source[Tensor]], Tensor]) -> Tensor:
        """Apply a measurement to the image."""
        return function(self)


@dataclass(frozen=True, eq=False)
class InMemoryOperator:
    """The operator of an image in memory; planes are computed at once, for all pixels.

    Attributes:
        operator: W.
        source: the image.
        sampled: whether the spectrum may be estimated from a sample of the pixels.
        cache: of what it computes, by name; None caches nothing.
    """

    operator: NonlocalOperator
    source: InMemory
    sampled: bool = False
    cache: Cache | None = None

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum; estimated from a sample, it has no values at pixels."""
        count = self.operator.factor.shape[2]
        if not self.sampled or count <= SAMPLE:
            return self.operator.spectrum()
        operator, places = self.operator, sampled_places(self.source.size).to(self.operator.factor.device)
        scaling = operator.scaling[:, places]
        if operator.weights is not None:
            scaling = scaling * operator.weights[:, places].sqrt()
        columns = Columns(operator.factor[:, :, places], scaling, operator.remainder[:, places])
        return sampled_pairs([columns], count, operator.factor.dtype)

    def of_columns(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Apply a function to the columns of all pixels."""
        planes = function(self.operator.matrix)
        return part_of(planes.unflatten(2, self.source.size))

    def layers(self, planes: Planes, order: int) -> Planes:
        """Compute :func:`detail_layers`."""
        values = planes(self.source)
        name = ("layers", order)
        return part_of(kept_in(self.cache, name, [values], lambda: detail_layers(self.operator, values, order=order)))

    def coefficients(self, planes: Planes) -> Tensor:
        """Compute :meth:`Spectrum.coefficients`."""
        values, spectrum = planes(self.source), cast(Spectrum, self.pairs)
        return kept_in(self.cache, "coefficients", [values], lambda: spectrum.coefficients(values))

    def rational(self, planes: Planes, form: RationalForm, weights: Tensor) -> Planes:
        """Compute :func:`rational_product`; with a cache, other weights take little time."""
        values, operator = planes(self.source).flatten(2), self.operator
        matrix = operator.matrix
        if matrix.needs_gradient:
            result = rational_product(matrix, values, form, weights)
        else:
            terms = kept_in(self.cache, form, [values], partial(pole_terms, matrix, values, form))
            result = weigh_poles(values, terms, weights)
        return part_of(result.unflatten(2, self.source.size))

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return mean_of(planes(self.source), self.source.weights)[..., 0, 0]

    def at(self, places: Tensor) -> Blocks:
        """Columns of the factor at single pixels."""
        columns = self.operator.factor[:, :, places]
        return lambda: [columns]


def kept_in(cache: Cache | None, name: Hashable, tensors: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
    """The result of a function, from a cache if it was last computed from equal tensors under this name."""
    if cache is None:
        return compute()
    entry = cache.get(name)
    if entry is None or not all(torch.equal(a, b) for a, b in zip(entry[0], tensors, strict=True)):
        entry = cache[name] = (tensors, compute())
    return cast(Kept, entry[1])


def tensors_in(option: object) -> list[Tensor]:
    """The tensors among an option, which may be several values."""
    values = option if isinstance(option, tuple | list) else [option]
    return [value for value in values if isinstance(value, Tensor)]


def without_tensors(option: Hashable) -> Hashable:
    """An option with its type in place of every tensor."""
    if isinstance(option, tuple | list):
        return tuple(map(without_tensors, option))
    return Tensor if isinstance(option, Tensor) else option


def fit_edit(edit: PhotoEdit, source: Source[M], drawn: Drawn[M], *, working: WorkingRange | None = None) -> Fitted:
    """Fit an edit to a picture.

    Args:
        edit: the edit.
        source: the picture.
        drawn: scribbles, in the form that the source takes.
        working: the range in which the edit sees the picture, if it does not depend on its pixels alone; None is the
            range that they use.
    """
    if not edit.relative:
        return edit.fit(source, drawn)
    working = range_of(source) if working is None else working
    if working is None:
        return edit.fit(source, drawn)
    fitted = of_picture(edit.in_range(working).fit(Seen(source, working), drawn), working)
    return in_own_units(fitted, working) if edit.gives_picture else fitted


def edited(edit: type[PhotoEdit], arguments: Arguments) -> Tensor:
    """The result of an edit's function: the image, which is the first of its arguments, edited.

    Every argument is named in the signature of the function alone; here they become the settings of the edit, the
    options of its filter and its scribbles.

    Args:
        edit: the edit.
        arguments: of its function: ``locals()`` before it has other variables.
    """
    name, image = next(iter(arguments.items()))
    masks = {scribble.argument: arguments[scribble.argument] for scribble in edit.declared.scribbles}
    drawn = Drawn.of(masks, arguments.get("strokes"))
    return edit_image(edit.of(arguments), image, drawn, name=name, channels=edit.image_channels)


@full_precision
def edit_image(
    edit: PhotoEdit,
    image: Tensor,
    drawn: Drawn[Tensor] | None = None,
    *,
    name: str = "image",
    channels: int | None = None,
    weights: Tensor | None = None,
) -> Tensor:
    """Edit an image (B, C, H, W) in [0, 1]; the result has its dtype.

    ``name`` is that of the image in errors, and ``channels`` the number that it must have, if any. ``weights`` are
    those of :class:`InMemory`.
    """
    (check_image if edit.relative else check_photograph)(image, name, channels=channels)
    source = InMemory(image.to(working_dtype(image)), weights=weights)
    return source.all(fit_edit(edit, source, Drawn() if drawn is None else drawn)).to(image.dtype)
