"""Access of edits to the pixels of a picture, so that every edit is written once.

An edit has two parts: statistics of the whole picture (sums over all pixels), and a function of some of the pixels
given these statistics. A :class:`Source` computes the sums: here for an image or a batch in memory, with gradients; in
:mod:`nlfilter_torch.tiled.source` for a picture that is read a few rows at a time.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeVar, cast

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_same_size, check_unit_range
from nlfilter_torch.core.inner import EVERYWHERE
from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.edits.pixels import Fitted as Fitted
from nlfilter_torch.edits.pixels import Pixels as Pixels
from nlfilter_torch.edits.pixels import Planes as Planes
from nlfilter_torch.edits.pixels import in_strips, part_of, strips_of
from nlfilter_torch.edits.resizing import block_means, resize
from nlfilter_torch.edits.scribbled_pixels import Scribbles
from nlfilter_torch.filtering.filters import detail_layers, residual_change, weigh_layers
from nlfilter_torch.filtering.scribbles import check_painted
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import blur, blur_margin, reduce_channels
from nlfilter_torch.operator.operator import Columns, NonlocalOperator
from nlfilter_torch.operator.spectrum import Response, RitzPairs, Spectrum, compute_grams

SAMPLE = 1 << 15  # size of the sample of pixels that sums are estimated from, where an edit allows it

Kept = TypeVar("Kept")
Blocks = Callable[[], Iterable[Tensor]]  # columns (B, M, n) of the factor, block by block


@dataclass(frozen=True)
class Guide:
    """The guide image of an edit's filter, and the options of the filter.

    Attributes:
        options: of :func:`nonlocal_operator`.
        transform: function that computes the guide from an image (B, C, H, W); None uses the image itself.
        radius: radius in pixels of the neighbourhood that ``transform`` depends on.
        channels: number of channels of the guide; None is that of the image.
        blur: standard deviation in pixels of the Gaussian blur of the guide.
        spectral: whether the edit uses the spectrum.
        sampled: whether the spectrum may be estimated from a sample of the pixels.
        exact: whether the edit needs what the eigenvectors capture at single pixels, which depends on rare pixels that
            a sample lacks.
    """

    options: Mapping[str, Any]
    transform: Callable[[Tensor], Tensor] | None = None
    radius: int = 0
    channels: int | None = None
    blur: float = 0.0
    spectral: bool = False
    sampled: bool = False
    exact: bool = False

    @property
    def margin(self) -> int:
        """Radius in pixels of the neighbourhood that the guide at a pixel depends on."""
        return self.radius + self.blur_margin

    @property
    def blur_margin(self) -> int:
        """Margin needed by the blur alone, in pixels."""
        return blur_margin(self.blur)

    def __call__(self, image: Tensor) -> Tensor:
        """Compute the guide of an image (B, C, H, W) of any size."""
        guide = image if self.transform is None else self.transform(image)
        if self.blur_margin == 0:
            return guide
        return blur(guide, self.blur)


class Operator(Protocol):
    """The filter W of a picture."""

    @property
    def pairs(self) -> RitzPairs:
        """Spectrum of W, without the values of the eigenvectors at pixels."""

    def each(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Apply a function, which returns (B, C, n), to the columns of the pixels."""

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers (B, k+1, C, h, W) of planes of the picture."""

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y``, (B, C, M), for planes y of the picture."""

    def mean(self, planes: Planes) -> Tensor:
        """Means (B, C) of planes over the picture."""

    def at(self, places: Tensor) -> Blocks:
        """Columns of the factor at single pixels, given by ascending row-major indices."""


class Source(Protocol):
    """A picture to edit."""

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""

    @property
    def batch(self) -> int:
        """Number of images."""

    @property
    def channels(self) -> int:
        """Number of channels of the picture."""

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the computation, float32 or float64."""

    @property
    def whole(self) -> bool:
        """Whether all pixels are in memory."""

    def operator(self, guide: Guide) -> Operator:
        """Build the filter of the picture."""

    def scribbles(self, mask: Any, colours: Any, name: str, *, needed: bool = True) -> Scribbles:
        """Read scribbles in the form that this source takes; ``name`` is the name of the mask in errors.

        Raises:
            ValueError: if they do not fit the picture, or are ``needed`` and cover no pixel.
        """

    def resized(self, size: tuple[int, int]) -> "Source":
        """Reduce the picture to a smaller size (H, W)."""

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes (B, C, h, w) of all its pixels in a smaller size."""

    def resized_weights(self, weights: Any, size: tuple[int, int], name: str) -> Any:
        """Reduce weights (B, K, H, W) of the pixels, in the form that this source takes, to a smaller size (H, W).

        Raises:
            ValueError: if they do not fit the picture; ``name`` is their name in the message.
        """

    def all(self, fitted: "Fitted") -> Tensor:
        """Result (B, C, H, W) of an edit at all pixels, for pictures that are small enough."""

    def cached(self, fitted: "Fitted") -> "Fitted":
        """Compute the result of an edit and keep it in memory, if there is room for it."""

    def mean_of(self, fitted: "Fitted", function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means (B, S, 1, 1) of a function of the image and of an edit's result; the function returns (B, S, h, W)."""

    def regions(self, masks: Any, name: str) -> list[Scribbles]:
        """Read the scribbles of several regions, see :meth:`scribbles`."""

    def colours(self, places: Tensor) -> Tensor:
        """Colours (B, C, n) of single pixels, given by ascending row-major indices."""

    def mean(self, planes: Planes) -> Tensor:
        """Means (B, C, 1, 1) over all pixels."""

    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means (B, C, H / step, W / step), sizes rounded up, over blocks of ``step`` x ``step`` pixels."""

    def blocks(self, step: float, floats: int) -> "InMemory":
        """Reduce the picture, in memory, to means over blocks of ``step`` x ``step`` pixels.

        The step is an integer except for previews.

        Raises:
            MemoryError: if there is no room for ``floats`` numbers per pixel of the reduced picture.
        """

    def kept(self, name: Any, given: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
        """The result of a function of the picture and of given tensors; a preview keeps it for the next edit.

        Args:
            name: of the result.
            given: tensors that it depends on.
            compute: the function.
        """

    def measured(self, function: Callable[["Source"], Tensor]) -> Tensor:
        """Apply a measurement to the picture; for a frame of a film, average it over the reference frames."""


class InMemory:
    """An image in memory, both as a source and as the set of all its pixels.

    Args:
        image: (B, C, H, W), float32 or float64.
        cache: cache of its operators, by their options, and of what they compute; None caches nothing.
    """

    first = 0
    whole = True

    def __init__(self, image: Tensor, cache: dict[Any, Any] | None = None) -> None:
        self.image, self.cache, self.dtype = image, cache, image.dtype
        self.batch, self.channels, *size = image.shape
        self.size, self.width = (size[0], size[1]), size[1]

    def operator(self, guide: Guide) -> "InMemoryOperator":
        """Build, or take from the cache, :func:`nonlocal_operator` of the guide."""
        key = (
            guide.transform,
            guide.blur,
            *((name, value) for name, value in sorted(guide.options.items()) if name != "generator"),
        )
        if self.cache is not None and key in self.cache:
            return cast(InMemoryOperator, self.cache[key])
        operator = InMemoryOperator(nonlocal_operator(guide(self.image), **guide.options), self, guide.sampled)
        if self.cache is not None and not any(isinstance(value, Tensor) for value in guide.options.values()):
            self.cache[key] = operator
        return operator

    def scribbles(self, mask: Tensor, colours: Tensor | None, name: str, *, needed: bool = True) -> Scribbles:
        """Read scribbles from tensors, ``mask`` (B, 1, H, W) and ``colours`` (B, 3, H, W)."""
        named = [(mask, name, 1), *([] if colours is None else [(colours, "strokes", 3)])]
        for tensor, called, channels in named:
            check_image(tensor, called, channels=channels, batch=self.batch)
            check_same_size(tensor, self.size, called, "image")
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
        if self.cache is None:
            return compute()
        found = self.cache.get(name)
        if found is None or not all(torch.equal(a, b) for a, b in zip(found[0], given, strict=True)):
            found = self.cache[name] = (given, compute())
        return cast(Kept, found[1])

    def blocks(self, step: float, floats: int) -> "InMemory":
        """Reduce the image by :func:`block_means`."""
        if step == 1:
            return self
        cache = None if self.cache is None else self.cache.setdefault(("blocks", step), {})
        return InMemory(block_means(self.image, step), cache)

    def resized_weights(self, weights: Tensor, size: tuple[int, int], name: str) -> Tensor:
        """Resize weights."""
        check_same_size(weights, self.size, name, "image")
        weights = weights.to(self.image)
        ends = weights.detach().aminmax()  # undoes the overshoot of interpolation but leaves invalid weights invalid
        return resize(weights, size).clamp(ends.min, ends.max)

    def all(self, fitted: "Fitted") -> Tensor:
        """Apply an edit to all pixels."""
        parts = [fitted.pixels(part) for part in strips_of(self)]
        planes = parts[0] if len(parts) == 1 else torch.cat(parts, dim=2)
        return planes if fitted.finish is None else fitted.finish(self.image, planes, EVERYWHERE)

    def cached(self, fitted: "Fitted") -> "Fitted":
        """Compute the result of an edit and keep it in memory."""
        return Fitted(part_of(self.all(fitted)))

    def mean_of(self, fitted: "Fitted", function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means of a function of the image and of the result of an edit."""
        (found,) = in_strips(lambda *some: (function(*some),), self.image, self.all(fitted))
        return found.mean((2, 3), keepdim=True)

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
    """

    operator: NonlocalOperator
    source: InMemory
    sampled: bool = False

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum; estimated from a sample, it has no values at pixels."""
        count = self.operator.factor.shape[2]
        if not self.sampled or count <= SAMPLE:
            return self.operator.spectrum()
        some = sampled_places(count).to(self.operator.factor.device)
        of = Columns(self.operator.factor, self.operator.scaling, self.operator.remainder)
        columns = Columns(of.factor[:, :, some], of.scaling[:, some], of.remainder[:, some])
        return sampled_pairs([columns], count, of.factor.dtype)

    def each(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Apply a function to the columns of all pixels."""
        found = function(Columns(self.operator.factor, self.operator.scaling, self.operator.remainder))
        return part_of(found.unflatten(2, self.source.size))

    def layers(self, planes: Planes, order: int) -> Planes:
        """Compute :func:`detail_layers`."""
        values = planes(self.source)
        key = ("layers", self.operator, order)
        return part_of(self.source.kept(key, [values], lambda: detail_layers(self.operator, values, order=order)))

    def coefficients(self, planes: Planes) -> Tensor:
        """Compute :meth:`Spectrum.coefficients`."""
        values, spectrum = planes(self.source), cast(Spectrum, self.pairs)
        return self.source.kept(("coefficients", self.operator), [values], lambda: spectrum.coefficients(values))

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return planes(self.source).mean((2, 3))

    def at(self, places: Tensor) -> Blocks:
        """Columns of the factor at single pixels."""
        columns = self.operator.factor[:, :, places]
        return lambda: [columns]


def sampled_places(count: int) -> Tensor:
    """Indices, ascending, of :data:`SAMPLE` of ``count`` pixels; the same sample in memory and in tiles."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:SAMPLE].sort().values


def sampled_pairs(blocks: Iterable[Columns], count: int, dtype: torch.dtype) -> RitzPairs:
    """Estimate the spectrum of an operator of ``count`` pixels from blocks of the columns at :func:`sampled_places`."""
    grams: Tensor | float = 0.0
    for block in blocks:
        factor, scaling, remainder = (part.double() for part in (block.factor, block.scaling, block.remainder))
        grams = grams + compute_grams(factor, scaling, remainder, 2)
    return RitzPairs.of_sums(torch.as_tensor(grams) * (count / SAMPLE), dtype)


def synthesize(operator: Operator, response: Response, coefficients: Tensor) -> Planes:
    """Compute ``V f(S) V^T y`` for a response f and coefficients (B, C, M) of y."""
    total = coefficients @ operator.pairs.gain(response).mT
    return operator.each(lambda columns: spread(total.to(columns.factor), columns.factor, columns.scaling))


def luminance(pixels: Pixels) -> Tensor:
    """Luminance of RGB pixels; pixels with another number of channels are returned unchanged."""
    return reduce_channels(pixels.image, "luminance")


def polynomial(
    operator: Operator, planes: Planes, order: int, residual: float | Tensor | None
) -> Callable[..., Tensor]:
    """Prepare :func:`polynomial_filter` of planes of a picture.

    Returns:
        A function of pixels, sliders and, optionally, a weight of the residual that replaces ``residual``.
    """
    layers = operator.layers(planes, order)
    if residual is None:
        return lambda pixels, alpha, _=None: weigh_layers(layers(pixels), alpha)
    captured = synthesize(operator, torch.ones_like, operator.coefficients(planes))
    share = operator.each(lambda columns: columns.remainder.unsqueeze(1))

    def filtered(pixels: Any, alpha: Tensor, weight: float | Tensor | None = None) -> Tensor:
        weight = residual if weight is None else weight
        change = residual_change(alpha, weight, planes(pixels) - captured(pixels), share(pixels))
        return weigh_layers(layers(pixels), alpha) + change

    return filtered


def edited(image: Tensor, fit: Callable[..., Fitted], *arguments: Any, **options: Any) -> Tensor:
    """Fit an edit to an image in memory and apply it; the result has the image's dtype."""
    source = InMemory(image.to(working_dtype(image)))
    return source.all(fit(source, *arguments, **options)).to(image.dtype)
