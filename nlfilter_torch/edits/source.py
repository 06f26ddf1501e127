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
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_same_size, check_unit_range
from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.edits.components import Scribbles
from nlfilter_torch.filtering.filters import detail_layers, residual_change, weigh_layers
from nlfilter_torch.filtering.masks import diffusion_mask
from nlfilter_torch.filtering.scribbles import check_painted
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import pad_border, reduce_channels
from nlfilter_torch.operator.operator import Columns, NonlocalOperator
from nlfilter_torch.operator.spectrum import Response, RitzPairs, Spectrum, compute_grams


class Pixels(Protocol):
    """Some pixels of a picture: all of them, or some of its rows."""

    @property
    def image(self) -> Tensor:
        """(B, C, h, W)."""

    @property
    def first(self) -> int:
        """Number of the first one, along the rows of the picture."""


SAMPLE = 1 << 15  # pixels whose sums stand for those of all, where an edit allows it

Planes = Callable[[Any], Tensor]  # of some pixels, (B, C, h, W)
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
        return math.ceil(2.5 * self.blur)

    def __call__(self, image: Tensor) -> Tensor:
        """The guide of an image (B, C, H, W) of any size."""
        guide = image if self.look is None else self.look(image)
        if self.blur_margin == 0:
            return guide
        from kornia.filters import gaussian_blur2d  # kornia takes half a second to import

        margin = self.blur_margin
        size, padded = 2 * margin + 1, pad_border(guide, margin)
        blurred = gaussian_blur2d(padded, (size, size), (self.blur, self.blur))
        return blurred[..., margin:-margin, margin:-margin]


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

    def operator(self, guide: Guide) -> Operator:
        """The filter of the picture."""

    def masks(self, guide: Guide, regions: Any, negative: Any, *, time: Any, width: Any) -> Planes:
        """Diffusion masks (B, K, h, W) of regions, in whatever form the source has these."""

    def scribbles(self, mask: Any, colours: Any, name: str, *, needed: bool = True) -> Scribbles:
        """Scribbles, in whatever form the source has these; ``name`` is that of the mask in errors.

        Raises:
            ValueError: if they do not fit the picture, or are ``needed`` and cover no pixel.
        """

    def regions(self, masks: Any, name: str) -> list[Scribbles]:
        """Scribbles of several regions, one after the other, each as :meth:`scribbles` has them."""

    def colours(self, places: Tensor) -> Tensor:
        """The colours (B, C, n) of single pixels, numbered along the rows in ascending order."""

    def mean(self, planes: Planes) -> Tensor:
        """Means (B, C, 1, 1) over all pixels."""

    def medians(self, response: Callable[[Tensor], Tensor], margin: int) -> Tensor:
        """Medians (B, C) over all pixels but ``margin`` at the borders.

        Args:
            response: non-negative, from an image (B, C, H, W) to one without these.
            margin: how many pixels around a pixel it depends on.
        """


@dataclass(frozen=True, eq=False)
class Fitted:
    """What an edit does to any pixels of a picture that it was fitted to.

    Attributes:
        pixels: the edited pixels, or planes that ``finish`` makes these from.
        finish: from the image and these planes to the edited image, where that takes the pixels around a pixel.
        margin: how many.
        step: ``finish`` works on every so many pixels, counted from the first of what it is given, which tiles and
            ``margin`` are therefore multiples of.
    """

    pixels: Planes
    finish: Callable[[Tensor, Tensor], Tensor] | None = None
    margin: int = 0
    step: int = 1


@dataclass(frozen=True, eq=False)
class InMemory:
    """An image as a source, and all of its pixels.

    Attributes:
        image: (B, C, H, W), float32 or float64.
        kept: its operators by their options, if they are to be kept.
    """

    image: Tensor
    kept: dict[Any, "InMemoryOperator"] | None = None
    first = 0
    whole = True

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return (self.image.shape[-2], self.image.shape[-1])

    @property
    def batch(self) -> int:
        """B."""
        return self.image.shape[0]

    @property
    def channels(self) -> int:
        """C."""
        return self.image.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        """Of the image."""
        return self.image.dtype

    def operator(self, guide: Guide) -> "InMemoryOperator":
        """:func:`nonlocal_operator` of the guide."""
        key = (
            guide.look,
            guide.blur,
            *((name, value) for name, value in sorted(guide.options.items()) if name != "generator"),
        )
        if self.kept is not None and key in self.kept:
            return self.kept[key]
        operator = InMemoryOperator(nonlocal_operator(guide(self.image), **guide.options), self, guide.sampled)
        if self.kept is not None and not any(isinstance(value, Tensor) for value in guide.options.values()):
            self.kept[key] = operator
        return operator

    def masks(self, guide: Guide, regions: Tensor, negative: Tensor | None, *, time: Any, width: Any) -> Planes:
        """:func:`diffusion_mask`."""
        spectrum = cast(Spectrum, self.operator(guide).pairs)
        masks = diffusion_mask(spectrum, regions.to(self.image), time=time, width=width, negative=negative)
        return lambda _: masks

    def scribbles(self, mask: Tensor, colours: Tensor | None, name: str, *, needed: bool = True) -> Scribbles:
        """From tensors (B, 1, H, W) and (B, 3, H, W)."""
        named = [(mask, name, 1), *([] if colours is None else [(colours, "strokes", 3)])]
        for tensor, called, channels in named:
            check_image(tensor, called, channels=channels, batch=self.batch)
            check_same_size(tensor, self.size, called, "image")
        (check_painted if needed else check_unit_range)(mask, name)
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

    def medians(self, response: Callable[[Tensor], Tensor], margin: int) -> Tensor:
        """Medians over all pixels."""
        return response(self.image).flatten(2).median(2).values


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
        factor, remainder = self.operator.factor, self.operator.remainder
        count = factor.shape[2]
        if not self.sampled or count <= SAMPLE:
            return self.operator.spectrum()
        some = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:SAMPLE].to(factor.device)
        scaling, rest = self.operator.scaling[:, some].double(), None
        if remainder is not None:
            rest = remainder[:, some].double()
        grams = compute_grams(factor[:, :, some].double(), scaling, rest, 1 if rest is None else 2)
        return RitzPairs.of_sums(grams * (count / SAMPLE), factor.dtype)

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


def synthesize(operator: Operator, response: Response, coefficients: Tensor) -> Planes:
    """``V f(S) V^T y`` for a response f and coefficients (B, C, M) of y."""
    total = coefficients @ operator.pairs.gain(response).mT
    return operator.each(lambda columns: spread(total.to(columns.factor), columns.factor, columns.scaling))


def luminance(pixels: Pixels) -> Tensor:
    """The luminance of pixels in colour; pixels of another number of channels as they are."""
    return reduce_channels(pixels.image, "luminance")


def polynomial(
    operator: Operator, planes: Planes, order: int, residual: float | Tensor | None
) -> Callable[[Any, Tensor], Tensor]:
    """:func:`polynomial_filter` of some planes of a picture, of any of its pixels and for any sliders."""
    layers = operator.layers(planes, order)
    if residual is None:
        return lambda pixels, alpha: weigh_layers(layers(pixels), alpha)
    captured = synthesize(operator, torch.ones_like, operator.coefficients(planes))
    share = operator.each(lambda columns: columns.remainder.unsqueeze(1))

    def filtered(pixels: Any, alpha: Tensor) -> Tensor:
        change = residual_change(alpha, residual, planes(pixels) - captured(pixels), share(pixels))
        return weigh_layers(layers(pixels), alpha) + change

    return filtered


def edited(image: Tensor, fit: Callable[..., Fitted], *arguments: Any, **options: Any) -> Tensor:
    """An image in memory under an edit, in its own dtype."""
    source = InMemory(image.to(working_dtype(image)))
    return apply_fitted(fit(source, *arguments, **options), source).to(image.dtype)


def apply_fitted(fitted: Fitted, source: InMemory) -> Tensor:
    """All pixels of an image under an edit."""
    planes = fitted.pixels(source)
    return planes if fitted.finish is None else fitted.finish(source.image, planes)
