"""An image or a batch in memory as the source of an edit, with gradients."""

import math
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Concatenate, cast

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import EVERYWHERE
from nlfilter_torch.core.checks import check_image, check_photograph, check_same_size, check_tensor, check_unit_range
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.matrix_function import pole_terms, rational_product, weigh_poles
from nlfilter_torch.filtering.scribbles import check_painted
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.hidden import fill_nearby
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import RitzPairs, Spectrum
from nlfilter_torch.photo.declared.declaration import Arguments
from nlfilter_torch.photo.picture.counted import LEAST_WEIGHT
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.measuring import mean, range_of, reduced_with_weights
from nlfilter_torch.photo.picture.pixels import Block, Fitted, M, Planes, WorkingRange, part_of, strips_of, whole_image
from nlfilter_torch.photo.picture.regions import InTiles
from nlfilter_torch.photo.picture.resizing import resize, weights_of
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import (
    SAMPLE,
    Blocks,
    Cache,
    Guide,
    Kept,
    P,
    Rest,
    Source,
    kept,
    kept_in,
    sampled_pairs,
    sampled_places,
)


class InMemory:
    """An image (B, C, H, W), float32 or float64, in memory: both a source and the set of all its pixels.

    ``cache`` holds its operators, by their options, and other results, by name; None caches nothing. ``weights``
    (B or 1, 1, H, W) say how much pixels count, from 0 to 1; None is 1 each.
    """

    first, inner, memory = 0, EVERYWHERE, math.inf

    def __init__(self, image: Tensor, cache: Cache | None = None, weights: Tensor | None = None) -> None:
        self.image, self.cache, self.dtype = image.contiguous(), cache, image.dtype
        weights = usable(weights)
        self.weights = None if weights is None else weights.to(image).expand(len(image), -1, -1, -1)
        self.batch, self.channels, *size = image.shape
        self.size, self.width = (size[0], size[1]), size[1]

    @property
    def pixels(self) -> Tensor:
        """The image, which has no halo."""
        return self.image

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
        return kept(self, (guide.transform, guide.blur, *named), copies, self._build, guide)

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

    def in_range(self, working: WorkingRange | None) -> "InMemory":
        """The image in a range of values."""
        if working is None:
            return self
        ends = [working.low, working.high, working.stretched]
        return kept(self, "in range", ends, lambda: self.like(working.seen(self.image), self.weights))

    def like(self, image: Tensor, weights: Tensor | None) -> "InMemory":
        """Another image (B, C, H, W), with a cache if this one has one."""
        return InMemory(image, None if self.cache is None else {}, weights)

    def over(
        self,
        function: Callable[[Block, *Rest], Kept],
        stage: str,
        *arguments: *Rest,
        margin: int = 0,
        step: int = 1,
        places: Tensor | None = None,
    ) -> Iterator[Kept]:
        """Apply a function to the image."""
        yield function(self, *arguments)

    def emit(self, fitted: Fitted) -> Iterator[tuple[Tensor, Tensor | None]]:
        """Yield :meth:`all`."""
        yield self.all(fitted), self.weights

    def all(self, fitted: Fitted) -> Tensor:
        """Apply an edit to all pixels."""
        seen = self.in_range(fitted.working)
        parts = [fitted.pixels(part) for part in strips_of(seen)]
        planes = parts[0] if len(parts) == 1 else torch.cat(parts, dim=2)
        result = planes if fitted.finish is None else fitted.finish(seen.image, planes, EVERYWHERE)
        return fitted.output(self.image, result)

    def measured(
        self, function: Callable[Concatenate[Source[Tensor], P], Tensor], *args: P.args, **kwargs: P.kwargs
    ) -> Tensor:
        """Apply a measurement to the image."""
        return function(self, *args, **kwargs)


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

    def of_columns(self, function: Callable[[Columns, *Rest], Tensor], *arguments: *Rest) -> Planes:
        """Apply a function to the columns of all pixels."""
        planes = function(self.operator.matrix, *arguments)
        return part_of(planes.unflatten(2, self.source.size))

    def layers(self, planes: Planes, order: int) -> Planes:
        """Compute :func:`detail_layers`."""
        values = planes(self.source)
        return part_of(
            kept_in(self.cache, ("layers", order), [values], detail_layers, self.operator, values, order=order)
        )

    def coefficients(self, planes: Planes) -> Tensor:
        """Compute :meth:`Spectrum.coefficients`."""
        values, spectrum = planes(self.source), cast(Spectrum, self.pairs)
        return kept_in(self.cache, "coefficients", [values], spectrum.coefficients, values)

    def rational(self, planes: Planes, form: RationalForm, weights: Tensor) -> Planes:
        """Compute :func:`rational_product`; with a cache, other weights take little time."""
        values, operator = planes(self.source).flatten(2), self.operator
        matrix = operator.matrix
        if matrix.needs_gradient:
            result = rational_product(matrix, values, form, weights)
        else:
            terms = kept_in(self.cache, form, [values], pole_terms, matrix, values, form)
            result = weigh_poles(values, terms, weights)
        return part_of(result.unflatten(2, self.source.size))

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return mean(self.source, planes)[..., 0, 0]

    def at(self, places: Tensor) -> Blocks:
        """Columns of the factor at single pixels."""
        columns = self.operator.factor[:, :, places]
        return lambda: [columns]


def in_blocks(source: Source[M], step: float, floats: int) -> InMemory:
    """Reduce a picture, in memory, to means over blocks of ``step`` x ``step`` pixels, see :func:`reduced`.

    Raises:
        MemoryError: if there is no room for ``floats`` numbers per pixel of the reduced picture.
    """
    if isinstance(source, InMemory) and step == 1:
        return source
    needed = math.prod(math.ceil(side / step) for side in source.size) * floats * source.dtype.itemsize
    if needed > source.memory:
        raise MemoryError(
            f"{cast(InTiles, source).picture.name} needs at least {needed / 1e6:.0f} MB of memory, but only "
            f"{source.memory / 1e6:.0f} MB may be used; allow more, or use a smaller picture"
        )
    return kept(source, ("blocks", step), [], _in_blocks, source, step)


def _in_blocks(source: Source[M], step: float) -> InMemory:
    image, weights = reduced_with_weights(source, whole_image, step)
    weights = None if weights is None else weights_of(weights)
    return source.like(image, weights) if isinstance(source, InMemory) else InMemory(image, weights=weights)


def usable(weights: Tensor | None) -> Tensor | None:
    """Weights (B, 1, H, W), with 0 for tiny ones; None if all are 1, or if no pixel of some image counts."""
    if weights is None or bool((weights == 1).all()):
        return None
    weights = torch.where(weights < LEAST_WEIGHT, 0.0, weights)
    return weights if bool((weights.amax((2, 3)) > 0).all()) else None


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
    if edit.relative and working is None:
        working = kept(source, "working range", [], range_of, source)
    if not edit.relative or working is None:
        return edit.fit(source, drawn)
    fitted = edit.in_range(working).fit(source.in_range(working), drawn)
    return replace(fitted, working=working, gives_picture=edit.gives_picture)


def edited(edit: type[PhotoEdit], arguments: Arguments) -> Tensor:
    """The result of an edit's function: the image, which is the first of its arguments, edited.

    Every argument is named in the signature of the function alone; here they become the settings of the edit, the
    options of its filter and its scribbles.

    Args:
        edit: the edit.
        arguments: of its function: ``locals()`` before it has other variables.
    """
    name, image = next(iter(arguments.items()))
    kinds = edit.declared.with_role("object", "background", "added", "removed")
    masks = {scribble.argument: arguments[scribble.argument] for scribble in kinds}
    drawn = Drawn.of(masks, arguments.get("strokes"), arguments.get("box"))
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
