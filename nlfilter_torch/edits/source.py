"""Where an edit finds the pixels of a picture, so that every edit is written once.

An edit consists of what it learns from the whole picture, by sums over all pixels, and of what it does to some of the
pixels once these sums are known. A :class:`Source` has the sums: here of an image in memory, with gradients and for a
batch; in :mod:`nlfilter_torch.tiled.source` of a picture that is read a few rows at a time.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_same_size, check_unit_range
from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.edits.components import Scribbles
from nlfilter_torch.edits.pixels import Fitted as Fitted
from nlfilter_torch.edits.pixels import Pixels as Pixels
from nlfilter_torch.edits.pixels import Planes as Planes
from nlfilter_torch.edits.resizing import resize
from nlfilter_torch.filtering.filters import detail_layers, residual_change, weigh_layers
from nlfilter_torch.filtering.scribbles import check_painted
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import blur, blur_margin, reduce_channels
from nlfilter_torch.operator.operator import Columns, NonlocalOperator
from nlfilter_torch.operator.spectrum import Response, RitzPairs, Spectrum, compute_grams

SAMPLE = 1 << 15  # pixels whose sums stand for those of all, where an edit allows it

Blocks = Callable[[], Iterable[Tensor]]  # columns (B, M, n) of the factor, block by block


@dataclass(frozen=True)
class Guide:
    """What the filter of an edit compares.

    Attributes:
        options: of :func:`nonlocal_operator`.
        look: makes the guide from an image (B, C, H, W); None takes the image.
        reach: how many pixels around a pixel ``look`` depends on.
        planes: channels of the guide; None is as many as the image has.
        blur: standard deviation in pixels of a Gaussian that the guide is blurred by.
        spectral: whether the edit takes sums along eigenvectors.
        sampled: whether a sample of the pixels may stand for all in these sums, as far as memory does not allow all.
        exact: whether it takes what eigenvectors capture of single pixels, which depends on rare pixels that a sample
            lacks.
    """

    options: Mapping[str, Any]
    look: Callable[[Tensor], Tensor] | None = None
    reach: int = 0
    planes: int | None = None
    blur: float = 0.0
    spectral: bool = False
    sampled: bool = False
    exact: bool = False

    @property
    def margin(self) -> int:
        """How many pixels around a pixel its value depends on."""
        return self.reach + self.blur_margin

    @property
    def blur_margin(self) -> int:
        """The same for the blur alone."""
        return blur_margin(self.blur)

    def __call__(self, image: Tensor) -> Tensor:
        """The guide of an image (B, C, H, W) of any size."""
        guide = image if self.look is None else self.look(image)
        if self.blur_margin == 0:
            return guide
        return blur(guide, self.blur)


class Operator(Protocol):
    """The filter W of a picture."""

    @property
    def pairs(self) -> RitzPairs:
        """Its spectrum, without pixels."""

    def each(self, function: Callable[[Columns], Tensor]) -> Planes:
        """The planes that a function (B, C, n) of columns gives."""

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers (B, k+1, C, h, W) of some planes of the picture."""

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y``, (B, C, M), of some planes y of the picture."""

    def mean(self, planes: Planes) -> Tensor:
        """Means (B, C) over the picture."""

    def at(self, places: Tensor) -> Blocks:
        """The columns of single pixels, numbered along the rows in ascending order."""


class Source(Protocol):
    """A picture to edit."""

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""

    @property
    def batch(self) -> int:
        """Images at once."""

    @property
    def channels(self) -> int:
        """Of the picture."""

    @property
    def dtype(self) -> torch.dtype:
        """In which it is computed, float32 or float64."""

    @property
    def whole(self) -> bool:
        """Whether all pixels are at hand at once."""

    @property
    def stride(self) -> float:
        """Every how many pixels of a photograph, each way, it has one; 1 but for previews."""

    def operator(self, guide: Guide) -> Operator:
        """The filter of the picture."""

    def scribbles(self, mask: Any, colours: Any, name: str, *, needed: bool = True) -> Scribbles:
        """Scribbles, in whatever form the source has these; ``name`` is that of the mask in errors.

        Raises:
            ValueError: if they do not fit the picture, or are ``needed`` and cover no pixel.
        """

    def resized(self, size: tuple[int, int]) -> "Source":
        """The picture in a smaller size (H, W)."""

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes (B, C, h, w) of all its pixels in a smaller size."""

    def resized_weights(self, weights: Any, size: tuple[int, int], name: str) -> Any:
        """Weights (B, K, H, W) of its pixels, in whatever form the source has these, in a smaller size (H, W).

        Raises:
            ValueError: if they do not fit the picture; ``name`` is theirs in errors.
        """

    def all(self, fitted: "Fitted") -> Tensor:
        """The planes (B, C, H, W) that an edit makes of all pixels, for pictures that are small enough."""

    def held(self, fitted: "Fitted") -> "Fitted":
        """An edit with the planes that it makes worked out, if there is room for them."""

    def mean_of(self, fitted: "Fitted", function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means (B, S, 1, 1) of the planes (B, S, h, W) that a function makes of pixels and of what an edit makes."""

    def regions(self, masks: Any, name: str) -> list[Scribbles]:
        """Scribbles of several regions, one after the other, each as :meth:`scribbles` has them."""

    def colours(self, places: Tensor) -> Tensor:
        """The colours (B, C, n) of single pixels, numbered along the rows in ascending order."""

    def mean(self, planes: Planes) -> Tensor:
        """Means (B, C, 1, 1) over all pixels."""

    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means (B, C, H / step, W / step), rounded up, over blocks of ``step`` pixels in both directions."""

    def blocks(self, step: float, floats: int) -> "InMemory":
        """The picture reduced by means over blocks of ``step`` pixels in both directions, in memory.

        The step is an integer, but for previews.

        Raises:
            MemoryError: if there is no room for so many ``floats`` for each of its pixels.
        """

    def measured(self, function: Callable[["Source"], Tensor]) -> Tensor:
        """What a function finds in the picture; of a frame, the mean of what it finds in the frames that count."""


class InMemory:
    """An image as a source, and all of its pixels.

    Args:
        image: (B, C, H, W), float32 or float64.
        kept: its operators by their options, if they are to be kept.
        stride: every how many pixels of a photograph, each way, it has one.
    """

    first = 0
    whole = True

    def __init__(self, image: Tensor, kept: dict[Any, Any] | None = None, stride: float = 1) -> None:
        self.image, self.kept, self.stride, self.dtype = image, kept, stride, image.dtype
        self.batch, self.channels, *size = image.shape
        self.size, self.width = (size[0], size[1]), size[1]

    def operator(self, guide: Guide) -> "InMemoryOperator":
        """:func:`nonlocal_operator` of the guide."""
        key = (
            guide.look,
            guide.blur,
            *((name, value) for name, value in sorted(guide.options.items()) if name != "generator"),
        )
        if self.kept is not None and key in self.kept:
            return cast(InMemoryOperator, self.kept[key])
        operator = InMemoryOperator(nonlocal_operator(guide(self.image), **guide.options), self, guide.sampled)
        if self.kept is not None and not any(isinstance(value, Tensor) for value in guide.options.values()):
            self.kept[key] = operator
        return operator

    def scribbles(self, mask: Tensor, colours: Tensor | None, name: str, *, needed: bool = True) -> Scribbles:
        """From tensors (B, 1, H, W) and (B, 3, H, W)."""
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
        """The image in another size."""
        if size == self.size:
            return self
        return InMemory(resize(self.image, size))

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes of all pixels in another size."""
        return resize(planes(self), size)

    def blocks(self, step: float, floats: int) -> "InMemory":
        """The image reduced by :func:`block_means`."""
        if step == 1:
            return self
        kept = None if self.kept is None else self.kept.setdefault(("blocks", step), {})
        return InMemory(block_means(self.image, step), kept)

    def resized_weights(self, weights: Tensor, size: tuple[int, int], name: str) -> Tensor:
        """Weights in another size."""
        check_same_size(weights, self.size, name, "image")
        weights = weights.to(self.image)
        ends = weights.detach().aminmax()  # interpolation may go beyond them, but hides no weight that is invalid
        return resize(weights, size).clamp(ends.min, ends.max)

    def all(self, fitted: "Fitted") -> Tensor:
        """All pixels under an edit."""
        planes = fitted.pixels(self)
        return planes if fitted.finish is None else fitted.finish(self.image, planes)

    def held(self, fitted: "Fitted") -> "Fitted":
        """With the planes of all pixels."""
        planes = self.all(fitted)
        return Fitted(lambda _: planes)

    def mean_of(self, fitted: "Fitted", function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means over all pixels."""
        return function(self.image, self.all(fitted)).mean((2, 3), keepdim=True)

    def colours(self, places: Tensor) -> Tensor:
        """Some pixels."""
        return self.image.flatten(2)[:, :, places]

    def regions(self, masks: Tensor, name: str) -> list[Scribbles]:
        """From a tensor (B, K, H, W)."""
        check_image(masks, name, batch=self.batch)
        return [self.scribbles(mask, None, name) for mask in masks.split(1, dim=1)]

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return planes(self).mean((2, 3), keepdim=True)

    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means over blocks of all pixels."""
        return block_means(planes(self), step)

    def measured(self, function: Callable[[Source], Tensor]) -> Tensor:
        """What a function finds."""
        return function(self)


@dataclass(frozen=True, eq=False)
class InMemoryOperator:
    """The operator of an image in memory; planes are of all its pixels and worked out at once.

    Attributes:
        operator: W.
        source: the image.
        sampled: whether the spectrum may be that of a sample of the pixels.
    """

    operator: NonlocalOperator
    source: InMemory
    sampled: bool = False

    @cached_property
    def pairs(self) -> RitzPairs:
        """The spectrum, without pixels if it is that of a sample."""
        count = self.operator.factor.shape[2]
        if not self.sampled or count <= SAMPLE:
            return self.operator.spectrum()
        some = sampled_places(count).to(self.operator.factor.device)
        of = Columns(self.operator.factor, self.operator.scaling, self.operator.remainder)
        columns = Columns(of.factor[:, :, some], of.scaling[:, some], of.remainder[:, some])
        return sampled_pairs([columns], count, of.factor.dtype)

    def each(self, function: Callable[[Columns], Tensor]) -> Planes:
        """All planes."""
        found = function(Columns(self.operator.factor, self.operator.scaling, self.operator.remainder))
        planes = found.unflatten(2, self.source.size)
        return lambda _: planes

    def layers(self, planes: Planes, order: int) -> Planes:
        """:func:`detail_layers`."""
        layers = detail_layers(self.operator, planes(self.source), order=order)
        return lambda _: layers

    def coefficients(self, planes: Planes) -> Tensor:
        """:meth:`Spectrum.coefficients`."""
        return cast(Spectrum, self.pairs).coefficients(planes(self.source))

    def mean(self, planes: Planes) -> Tensor:
        """Means over all pixels."""
        return planes(self.source).mean((2, 3))

    def at(self, places: Tensor) -> Blocks:
        """Some columns of the factor."""
        columns = self.operator.factor[:, :, places]
        return lambda: [columns]


def sampled_places(count: int) -> Tensor:
    """Numbers of :data:`SAMPLE` of so many pixels, ascending; the same ones in memory and in tiles."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:SAMPLE].sort().values


def sampled_pairs(blocks: Iterable[Columns], count: int, dtype: torch.dtype) -> RitzPairs:
    """The spectrum of an operator of ``count`` pixels from the columns at :func:`sampled_places`, block by block."""
    grams: Tensor | float = 0.0
    for block in blocks:
        factor, scaling, remainder = (part.double() for part in (block.factor, block.scaling, block.remainder))
        grams = grams + compute_grams(factor, scaling, remainder, 2)
    return RitzPairs.of_sums(torch.as_tensor(grams) * (count / SAMPLE), dtype)


def synthesize(operator: Operator, response: Response, coefficients: Tensor) -> Planes:
    """``V f(S) V^T y`` for a response f and coefficients (B, C, M) of y."""
    total = coefficients @ operator.pairs.gain(response).mT
    return operator.each(lambda columns: spread(total.to(columns.factor), columns.factor, columns.scaling))


def block_means(planes: Tensor, step: float) -> Tensor:
    """Means over blocks of ``step`` pixels in both directions, those at the lower and right borders smaller.

    Of a fractional step, pixels count by the share of them that is in the block.
    """
    if step == round(step):
        step = round(step)
        return planes if step == 1 else F.avg_pool2d(planes, step, ceil_mode=True, count_include_pad=False)
    rows, columns = (_shares(length, step).to(planes) for length in planes.shape[-2:])
    return rows @ planes @ columns.mT


def _shares(length: int, step: float) -> Tensor:
    """Weights (n, length) of the pixels of an axis in blocks of a fractional step."""
    count = math.ceil(length / step - 0.01)  # no sliver at the end
    ends = torch.arange(count + 1, dtype=torch.float64) * step
    ends[-1] = length
    first = torch.arange(length, dtype=torch.float64)
    inside = torch.minimum(ends[1:, None], first + 1) - torch.maximum(ends[:-1, None], first)
    inside = inside.clamp(min=0.0)
    return inside / inside.sum(1, keepdim=True)


def luminance(pixels: Pixels) -> Tensor:
    """The luminance of pixels in colour; pixels of another number of channels as they are."""
    return reduce_channels(pixels.image, "luminance")


def polynomial(
    operator: Operator, planes: Planes, order: int, residual: float | Tensor | None
) -> Callable[..., Tensor]:
    """:func:`polynomial_filter` of some planes of a picture, of any of its pixels and for any sliders.

    The weight of the residual may follow these, in place of the filter's.
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
    """An image in memory under an edit, in its own dtype."""
    source = InMemory(image.to(working_dtype(image)))
    return source.all(fit(source, *arguments, **options)).to(image.dtype)
