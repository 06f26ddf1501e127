"""An image or a batch in memory as the source of an edit, with gradients, and edits as functions of an image."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any, Concatenate, Literal, ParamSpec, Protocol, cast, overload

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_photograph, check_same_size, check_unit_range
from nlfilter_torch.core.inner import EVERYWHERE
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.scribbles import check_painted
from nlfilter_torch.operator.build import nonlocal_operator, operator_from_guide
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import OperatorOptions
from nlfilter_torch.operator.products import Columns
from nlfilter_torch.operator.spectrum import RitzPairs, Spectrum
from nlfilter_torch.photo.picture.ends import ends_of
from nlfilter_torch.photo.picture.pixels import Fitted, Planes, part_of, strips_of
from nlfilter_torch.photo.picture.resizing import block_means, resize
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import SAMPLE, Blocks, Guide, Kept, Source, sampled_pairs, sampled_places

P = ParamSpec("P")


class InMemory:
    """An image (B, C, H, W), float32 or float64, in memory: both a source and the set of all its pixels.

    ``cache`` holds its operators, by their options, and other results, by name; None caches nothing.
    """

    first = 0
    whole = True

    def __init__(self, image: Tensor, cache: dict[Any, Any] | None = None) -> None:
        self.image, self.cache, self.dtype = image, cache, image.dtype
        self.batch, self.channels, *size = image.shape
        self.size, self.width = (size[0], size[1]), size[1]

    def operator(self, guide: Guide) -> "InMemoryOperator":
        """Build, or take from the cache, :func:`nonlocal_operator` of the guide.

        Of operators that differ only in options that are tensors, the last is cached, unless these need gradients.
        """

        def build() -> InMemoryOperator:
            operator = operator_from_guide(guide(self.image), OperatorOptions(**guide.options))
            return InMemoryOperator(operator, self, guide.sampled, None if self.cache is None else {})

        options = [(name, value) for name, value in sorted(guide.options.items()) if name != "generator"]
        tensors = [one for _, value in options for one in tensors_in(value)]
        if any(one.requires_grad for one in tensors):
            return build()
        named = tuple((name, without_tensors(value)) for name, value in options)
        return self.kept((guide.transform, guide.blur, *named), [one.clone() for one in tensors], build)

    def scribbles(self, mask: Tensor, colours: Tensor | None, name: str, *, needed: bool = True) -> Scribbles:
        """Read scribbles from tensors, ``mask`` (B, 1, H, W) and ``colours`` (B, 3, H, W)."""
        check_image(mask, name, channels=1, batch=self.batch)
        check_same_size(mask, self.size, name, "image")
        if colours is not None:
            check_photograph(colours, "strokes", channels=3, batch=self.batch)
            check_same_size(colours, self.size, "strokes", "image")
        if needed:
            check_painted(mask, name)
        else:
            check_unit_range(mask, name)
        weights = mask.to(self.image).expand(self.batch, -1, -1, -1).flatten(2)
        some = torch.ones_like(weights[0, 0], dtype=torch.bool)
        if not weights.requires_grad:  # pixels of weight 0 matter only to the derivative by the weights
            some = (weights > 0).any(0).squeeze(0)
        places = some.nonzero().squeeze(1)
        image = self.image.flatten(2)[:, :, places]
        shown = None
        if colours is not None:
            shown = colours.to(self.image).expand(self.batch, -1, -1, -1).flatten(2)[:, :, places]
        return Scribbles(places, weights[:, :, places], image, shown)

    def resized(self, size: tuple[int, int]) -> "InMemory":
        """Resize the image."""
        if size == self.size:
            return self
        return InMemory(resize(self.image, size))

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes of all pixels in another size."""
        return resize(planes(self), size)

    def kept(self, name: Any, given: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
        """The result of a function, from the cache if it was last computed from equal tensors."""
        return kept_in(self.cache, name, given, compute)

    def blocks(self, step: float, floats: int) -> "InMemory":
        """Reduce the image by :func:`block_means`."""
        if step == 1:
            return self
        cache: dict[Any, Any] | None = None if self.cache is None else {}
        return self.kept(("blocks", step), [], lambda: InMemory(block_means(self.image, step), cache))

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
        return self.all(fitted.then(function)).mean((2, 3), keepdim=True)

    def colours(self, places: Tensor) -> Tensor:
        """Colours of single pixels."""
        return self.image.flatten(2)[:, :, places]

    def regions(self, masks: Tensor, name: str) -> list[Scribbles]:
        """Read the scribbles of K regions from a tensor (B, K, H, W)."""
        check_image(masks, name, batch=self.batch)
        return [self.scribbles(mask, None, name) for mask in masks.split(1, dim=1)]

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return planes(self).mean((2, 3), keepdim=True)

    def ends(self, planes: Planes) -> tuple[Tensor, Tensor]:
        """Least and largest values over all pixels."""
        return ends_of(planes(self))

    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means over blocks of pixels."""
        return block_means(planes(self), step)

    def measured(self, function: Callable[[Source], Tensor]) -> Tensor:
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
    cache: dict[Any, Any] | None = None

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum; estimated from a sample, it has no values at pixels."""
        count = self.operator.factor.shape[2]
        if not self.sampled or count <= SAMPLE:
            return self.operator.spectrum()
        some, of = sampled_places(count).to(self.operator.factor.device), self.operator
        columns = Columns(of.factor[:, :, some], of.scaling[:, some], of.remainder[:, some])
        return sampled_pairs([columns], count, of.factor.dtype)

    def each(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Apply a function to the columns of all pixels."""
        found = function(Columns(self.operator.factor, self.operator.scaling, self.operator.remainder))
        return part_of(found.unflatten(2, self.source.size))

    def layers(self, planes: Planes, order: int) -> Planes:
        """Compute :func:`detail_layers`."""
        values = planes(self.source)
        name = ("layers", order)
        return part_of(kept_in(self.cache, name, [values], lambda: detail_layers(self.operator, values, order=order)))

    def coefficients(self, planes: Planes) -> Tensor:
        """Compute :meth:`Spectrum.coefficients`."""
        values, spectrum = planes(self.source), cast(Spectrum, self.pairs)
        return kept_in(self.cache, "coefficients", [values], lambda: spectrum.coefficients(values))

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return planes(self.source).mean((2, 3))

    def at(self, places: Tensor) -> Blocks:
        """Columns of the factor at single pixels."""
        columns = self.operator.factor[:, :, places]
        return lambda: [columns]


def kept_in(cache: dict[Any, Any] | None, name: Any, given: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
    """The result of a function, from a cache if it was last computed from equal tensors under this name."""
    if cache is None:
        return compute()
    found = cache.get(name)
    if found is None or not all(torch.equal(a, b) for a, b in zip(found[0], given, strict=True)):
        found = cache[name] = (given, compute())
    return cast(Kept, found[1])


def tensors_in(option: Any) -> list[Tensor]:
    """The tensors among an option, which may be several values."""
    return [one for one in (option if isinstance(option, tuple | list) else [option]) if isinstance(one, Tensor)]


def without_tensors(option: Any) -> Any:
    """An option with its type in place of every tensor."""
    if isinstance(option, tuple | list):
        return tuple(map(without_tensors, option))
    return Tensor if isinstance(option, Tensor) else option


def edited(image: Tensor, fit: Callable[..., Fitted], /, *arguments: Any, **options: Any) -> Tensor:
    """Fit an edit to an image in memory and apply it; the result has the image's dtype."""
    source = InMemory(image.to(working_dtype(image)))
    return source.all(fit(source, *arguments, **options)).to(image.dtype)


class EditOfImage(Protocol[P]):
    """An edit of an image; ``fit`` fits it to a source, given scribbles in the form that the source takes."""

    fit: Callable[..., Fitted]

    def __call__(self, image: Tensor, *args: P.args, **kwargs: P.kwargs) -> Tensor:
        """Edit the image."""


class EditOfGrey(Protocol[P]):
    """An edit like :class:`EditOfImage`, of an image that is the argument ``grey``."""

    fit: Callable[..., Fitted]

    def __call__(self, grey: Tensor, *args: P.args, **kwargs: P.kwargs) -> Tensor:
        """Edit the image."""


@overload
def edit_of(
    picture: Literal["image"], *, channels: int | None = None
) -> Callable[[Callable[Concatenate[Source, P], Fitted]], EditOfImage[P]]: ...


@overload
def edit_of(
    picture: Literal["grey"], *, channels: int | None = None
) -> Callable[[Callable[Concatenate[Source, P], Fitted]], EditOfGrey[P]]: ...


def edit_of(picture: str, *, channels: int | None = None) -> Any:
    """Turn a function that fits an edit to a source into a function that edits an image.

    The decorated function takes a :class:`Source` and returns :class:`Fitted`. Callers pass an image in place of the
    source and receive the edited image, in its dtype; the docstring and the annotations are written for them. The
    function of a source remains available as the attribute ``fit``.

    Callers know the image by the name ``picture``; it must have so many ``channels``, if given. Further options are
    those of :func:`nonlocal_operator`.
    """

    def decorate(fit: Callable[..., Fitted]) -> Any:
        signature = inspect.signature(fit)
        known = [
            name for each in (signature, inspect.signature(nonlocal_operator)) for name in list(each.parameters)[1:]
        ]
        takes_options = any(one.kind is inspect.Parameter.VAR_KEYWORD for one in signature.parameters.values())

        @full_precision
        @wraps(fit)
        def edit(*args: Any, **kwargs: Any) -> Tensor:
            if picture in kwargs and not args:
                args = (kwargs.pop(picture),)
            if picture in kwargs or not args:
                problem = "got multiple values for argument" if args else "missing 1 required positional argument:"
                raise TypeError(f"{fit.__name__}() {problem} {picture!r}")
            unknown = sorted(set(kwargs).difference(known)) if takes_options else []
            if unknown:
                raise TypeError(
                    f"{fit.__name__} has no argument {unknown[0]}; see its documentation for the valid ones"
                )
            image, *others = args
            check_photograph(image, picture, channels=channels)
            return edited(image, fit, *others, **kwargs)

        image = inspect.Parameter(picture, inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=Tensor)
        parameters = [image, *list(signature.parameters.values())[1:]]
        function: Any = edit
        function.fit = fit
        function.__signature__ = signature.replace(parameters=parameters, return_annotation=Tensor)
        function.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": Tensor}
        return function

    return decorate
