"""Access of edits to the pixels of a picture, so that every edit is written once.

An edit has two parts: statistics of the whole picture (sums over all pixels), and a function of some of the pixels
given these statistics. A :class:`Source` computes the sums: in :mod:`nlfilter_torch.photo.picture.in_memory` for an
image or a batch in memory, with gradients; in :mod:`nlfilter_torch.photo.picture.tiled` for a picture that is read a
few rows at a time.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import symmetric_places
from nlfilter_torch.core.inner import Inner
from nlfilter_torch.core.kernels.grams import compute_grams
from nlfilter_torch.core.rational import RationalForm
from nlfilter_torch.operator.features import blur, blur_margin, reduce_channels
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.photo.picture.pixels import Fitted as Fitted
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.pixels import Pixels as Pixels
from nlfilter_torch.photo.picture.pixels import Planes as Planes
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles

SAMPLE = 1 << 15  # size of the sample of pixels that sums are estimated from, where an edit allows it

Kept = TypeVar("Kept")
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

    def of_columns(self, function: Callable[[Columns], Tensor]) -> Planes:
        """Apply a function, which returns (B, C, n), to the columns of the pixels."""

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

    def accept_any_scale(self) -> None:
        """Do not warn of values far outside [0, 1], since the edit takes them."""

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

    def shrunk(self, planes: Planes, size: tuple[int, int]) -> Tensor:
        """Planes (B, C, h, w) of all its pixels in a smaller size."""

    def resized_weights(self, weights: M, size: tuple[int, int], name: str) -> M:
        """Reduce weights of the pixels for K regions to a smaller size (H, W).

        Raises:
            ValueError: if they do not fit the picture; ``name`` is their name in the message.
        """

    def all(self, fitted: "Fitted") -> Tensor:
        """Result (B, C, H, W) of an edit at all pixels, for pictures that are small enough."""

    def cached(self, fitted: "Fitted") -> "Fitted":
        """Compute the result of an edit and keep it in memory, if there is room for it."""

    def mean_of(self, fitted: "Fitted", function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Means (B, S, 1, 1) of a function of the image and of an edit's result; the function returns (B, S, h, W)."""

    def regions(self, masks: M, name: str, *, needed: bool = True) -> list[Scribbles]:
        """Read the scribbles of several regions, see :meth:`scribbles`."""

    def weights_of(self, masks: M, name: str) -> "Planes":
        """Weights (B, K, h, w) of given pixels in masks of K regions, which are read as they are needed.

        Raises:
            ValueError: if they do not fit the picture; ``name`` is their name in the message.
        """

    def num_regions(self, masks: M, name: str) -> int:
        """Number of regions that have scribbles in ``masks``, which errors call ``name``."""

    def check_all_in_memory(self, sentence: str) -> None:
        """Raise ValueError with this sentence if the picture is read in parts."""

    def colours(self, places: Tensor) -> Tensor:
        """Colours (B, C, n) of single pixels, given by ascending row-major indices."""

    def weights_at(self, places: Tensor) -> Tensor | None:
        """How much single pixels count, (B, 1, n), given by row-major indices; None is 1 each."""

    def mean(self, planes: Planes) -> Tensor:
        """Means (B, C, 1, 1) over all pixels."""

    def ends(self, planes: Planes) -> tuple[Tensor, Tensor]:
        """Least and largest values (B, C, 1, 1) over all pixels."""

    def reduced(self, planes: Planes, step: int) -> Tensor:
        """Means (B, C, H / step, W / step), sizes rounded up, over blocks of ``step`` x ``step`` pixels."""

    def blocks(self, step: float, floats: int) -> "Reduced":
        """Reduce the picture, in memory, to means over blocks of ``step`` x ``step`` pixels.

        The step is an integer except for previews.

        Raises:
            MemoryError: if there is no room for ``floats`` numbers per pixel of the reduced picture.
        """

    def kept(self, name: Hashable, tensors: Sequence[Tensor], compute: Callable[[], Kept]) -> Kept:
        """Result, called ``name``, of a function of picture and tensors; a preview keeps it for the next edit."""

    def parts(self, function: Callable[[Tensor, Inner, int], Kept], margin: int) -> list[Kept]:
        """Results of a function of parts that make up the picture, without gradients.

        Args:
            function: of some rows (B, C, h, W), of which of them are the part, and of the number of the first of these
                in the picture. The other rows, up to ``margin`` on both sides, are there to be seen.
            margin: in rows.
        """

    def measured(self, function: Callable[["Source[M]"], Tensor]) -> Tensor:
        """Apply a measurement to the picture; for a frame of a film, average it over the reference frames."""


class Reduced(Source[Tensor], Pixels, Protocol):
    """A picture in memory: a source, and the set of all its pixels."""

    def like(self, image: Tensor) -> "Reduced":
        """Another picture, of the same kind, that keeps results if this one does."""


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
