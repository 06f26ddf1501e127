"""Access of edits to the pixels of a picture, so that every edit is written once.

An edit has two parts: statistics of the whole picture, and a function of some of the pixels given these statistics.
A :class:`Source` is the picture as the edit sees it. It has twelve members. Five say what it is: size, batch, channels,
dtype, and the memory that may be used. Two read it: ``over`` applies a function to blocks of its rows, of which means,
limits, reductions and single pixels follow (:mod:`nlfilter_torch.photo.picture.measuring`), and ``scribbles`` reads
what is drawn on it. ``emit`` writes an edit. The others make something of the picture: its filter, the same picture in
a smaller size or in another range of values, and measurements that films share among their frames.

There are two kinds of sources: :class:`InMemory`, an image or a batch in memory, which is one block and passes
gradients, and :class:`Tiled`, which reads a picture a few rows at a time. A source holds pixels as the edit sees them:
the affine map from a picture that uses little of its range (:class:`WorkingRange`) is applied where pixels are read,
and :meth:`Fitted.output` undoes it where they are written. What previews keep from one edit to the next is apart from
sources, in :func:`kept`.

Pixels pass between files and sources as a :class:`Picture`, all of them as they are stored, a :class:`Tile`, a block of
rows with its halo, and a :class:`Tiling`, rows to write.
"""

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Concatenate, ParamSpec, Protocol, TypeVar, cast, runtime_checkable

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import symmetric_places
from nlfilter_torch.core.kernels.tall_skinny import compute_grams
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.operator.features import blur, blur_margin, reduce_channels
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.photo.picture.pixels import Block, M, WorkingRange
from nlfilter_torch.photo.picture.pixels import Fitted as Fitted
from nlfilter_torch.photo.picture.pixels import Pixels as Pixels
from nlfilter_torch.photo.picture.pixels import Planes as Planes
from nlfilter_torch.photo.picture.pixels import Rest as Rest
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles

SAMPLE = 1 << 15  # size of the sample of pixels that sums are estimated from, where an edit allows it

Part = TypeVar("Part")
Kept = TypeVar("Kept")
P = ParamSpec("P")
Cache = dict[Hashable, tuple[Sequence[Tensor], object]]  # results by their names, with the tensors they depend on
Blocks = Callable[[], Iterable[Tensor]]  # columns (B, M, n) of the factor, block by block


@dataclass(frozen=True)
class Guide:
    """The guide image of an edit's filter, and the options of the filter.

    Attributes:
        options: of the filter.
        transform: function that computes the guide from an image (B, C, H, W); None uses the image itself.
        radius: radius in pixels of the neighbourhood that ``transform`` depends on.
        channels: number of channels of the guide; None is that of the image.
        blur: standard deviation in pixels of the Gaussian blur of the guide.
        spectral: whether the edit uses the spectrum.
        sampled: whether the spectrum may be estimated from a sample of the pixels.
        exact: whether the edit needs what the eigenvectors capture at single pixels, which depends on rare pixels that
            a sample lacks.
    """

    options: FilterOptions
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
        return blur(guide.double(), self.blur).to(guide.dtype)  # in float64, mirrored pictures differ less


class Operator(Protocol):
    """The filter W of a picture."""

    @property
    def pairs(self) -> RitzPairs:
        """Spectrum of W, without the values of the eigenvectors at pixels."""

    def of_columns(self, function: Callable[[Columns, *Rest], Tensor], *arguments: *Rest) -> Planes:
        """Apply a function, which returns (B, C, n), to the columns of the pixels and these arguments."""

    def layers(self, planes: Planes, order: int) -> Planes:
        """Detail layers (B, k+1, C, h, W) of planes of the picture."""

    def coefficients(self, planes: Planes) -> Tensor:
        """``F y``, (B, C, M), for planes y of the picture."""

    def rational(self, planes: Planes, form: RationalForm, weights: Tensor) -> Planes:
        """A rational function of W without a polynomial, for planes of the picture; ``weights`` are (B, 1 + J)."""

    def mean(self, planes: Planes) -> Tensor:
        """Means (B, C) of planes over the picture."""

    def at(self, places: Tensor) -> Blocks:
        """Columns of the factor at single pixels, given by ascending row-major indices."""


class Source(Protocol[M]):
    """A picture to edit, whose masks and scribbles have the type M.

    Pixels count in proportion to their opacity in operators, means and scribbles, and those that are hidden, which have
    colours of pixels nearby, for nothing.
    """

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
    def memory(self) -> float:
        """Bytes that an edit may use for what it keeps of the picture; infinity if all of the picture is in memory."""

    def over(
        self,
        function: Callable[[Block, *Rest], Part],
        stage: str,
        *arguments: *Rest,
        margin: int = 0,
        step: int = 1,
        places: Tensor | None = None,
    ) -> Iterator[Part]:
        """Apply a function to blocks of rows that make up the picture, and yield the results in order.

        Gradients pass if the picture is in memory, where it is one block.

        Args:
            function: of a block.
            stage: name for the progress.
            arguments: further ones of the function.
            margin: rows of the halo of a block on both sides, except beyond the picture.
            step: all blocks but the last have a multiple of so many rows.
            places: row-major indices, ascending; blocks with none of these pixels may be left out.
        """

    def emit(self, fitted: "Fitted") -> Iterator[tuple[Tensor, Tensor | None]]:
        """Yield the result of an edit, (B, C, h, W), some rows after another, and how much the pixels count."""

    def operator(self, guide: Guide) -> Operator:
        """Build the filter of the picture."""

    def scribbles(self, mask: M | None, colours: M | None, name: str, *, needed: bool = True) -> Scribbles:
        """Read scribbles; ``name`` is the name of the mask in errors.

        Args:
            mask: of the scribbles; None if it is the fourth channel of the colours.
            colours: of the scribbles, if these count.
            name: of the mask, in errors.
            needed: whether a pixel must be covered.

        Raises:
            ValueError: if they do not fit the picture, or are ``needed`` and cover no pixel.
        """

    def resized(self, size: tuple[int, int]) -> "Source[M]":
        """Reduce the picture to a smaller size (H, W)."""

    def in_range(self, working: WorkingRange | None) -> "Source[M]":
        """The picture as an edit sees it that takes values of any scale: None is as they are.

        There is no warning of values far outside [0, 1] from now on.
        """

    def measured(
        self, function: "Callable[Concatenate[Source[M], P], Tensor]", *args: P.args, **kwargs: P.kwargs
    ) -> Tensor:
        """Apply a measurement to the picture; for a frame of a film, average it over the reference frames."""


class Reduced(Source[Tensor], Pixels, Protocol):
    """A picture in memory: a source, and the set of all its pixels."""


@runtime_checkable
class Keeping(Protocol):
    """A picture that may keep results for the next edit, in a cache if it has one."""

    cache: Cache | None


def kept(
    source: Source[M],
    name: Hashable,
    tensors: Sequence[Tensor],
    function: Callable[P, Kept],
    *args: P.args,
    **kwargs: P.kwargs,
) -> Kept:
    """The result of a function that depends on picture and tensors alone; previews keep it for the next edit.

    Args:
        source: the picture.
        name: of the result.
        tensors: with which the result changes.
        function: computes it.
        args: of the function.
        kwargs: of the function.
    """
    return kept_in(source.cache if isinstance(source, Keeping) else None, name, tensors, function, *args, **kwargs)


def kept_in(
    cache: Cache | None,
    name: Hashable,
    tensors: Sequence[Tensor],
    function: Callable[P, Kept],
    *args: P.args,
    **kwargs: P.kwargs,
) -> Kept:
    """The result of a function, from a cache if it was last computed from equal tensors under this name."""
    if cache is None:
        return function(*args, **kwargs)
    entry = cache.get(name)
    if entry is None or not all(torch.equal(a, b) for a, b in zip(entry[0], tensors, strict=True)):
        entry = cache[name] = (tensors, function(*args, **kwargs))
    return cast(Kept, entry[1])


def seeded(seed: int = 0) -> torch.Generator:
    """Return a generator with the seed; 0 is the seed of the command line."""
    return torch.Generator().manual_seed(seed)


def sampled_places(size: tuple[int, int]) -> Tensor:
    """Indices, ascending, of :data:`SAMPLE` pixels of a picture (H, W); the same sample in memory and in tiles.

    It holds the mirror images of its pixels, so that it turns with the picture.
    """
    pixels = size[0] * size[1]
    return torch.arange(pixels) if pixels <= SAMPLE else symmetric_places(size, SAMPLE, seeded()).sort().values


def sampled_pairs(blocks: Iterable[Columns], count: int, dtype: torch.dtype) -> RitzPairs:
    """Estimate the spectrum of an operator of ``count`` pixels from blocks of the columns at :func:`sampled_places`."""
    grams: Tensor | float = 0.0
    for block in blocks:
        factor, scaling, remainder = (part.double() for part in (block.factor, block.scaling, block.remainder))
        grams = grams + compute_grams(factor, scaling, remainder, 2)
    return RitzPairs.of_sums(torch.as_tensor(grams) * (count / SAMPLE), dtype)


def luminance(pixels: Pixels) -> Tensor:
    """Luminance of RGB pixels; pixels with another number of channels are returned unchanged."""
    return reduce_channels(pixels.image, "luminance")


def at(source: Source[M], places: Tensor) -> tuple[Tensor, Tensor | None]:
    """Colours (B, C, n) of single pixels, given by ascending row-major indices, and how much they count, (B, 1, n).

    None in place of the latter is 1 each.
    """
    parts = list(source.over(_at, "Looking", places, math.prod(source.size), places=places))
    if not parts:
        return torch.zeros(source.batch, source.channels, 0, dtype=source.dtype), None
    colours, weights = zip(*parts, strict=True)
    return torch.cat(colours, dim=2), None if weights[0] is None else torch.cat(weights, dim=2)


def _at(block: Block, places: Tensor, pixels: int) -> tuple[Tensor, Tensor | None]:
    """Of the pixels that lie in a block of a picture of so many."""
    image, weights = block.image.flatten(2), block.weights
    if image.shape[2] == pixels:
        chosen = places  # without reading values, which a GPU would have to wait for
    else:
        ends = places.new_tensor([block.first, block.first + image.shape[2]])
        first, last = torch.searchsorted(places, ends).tolist()
        chosen = places[first:last] - block.first
    return image[:, :, chosen], None if weights is None else weights.flatten(2)[:, :, chosen]
