"""Edits of brightness at the viewing size, so that sliders have the same effect at any resolution.

Patches have a fixed size in pixels: in a photograph of 24 megapixels, a patch of 5x5 covers a sixteenth of what it
covers in the same photograph at 1.5 megapixels, and sliders would change only grain that is invisible when the whole
picture fits on a screen. A larger picture is therefore reduced to the viewing size; its change of brightness is
computed there and enlarged. Of the ways to make sliders independent of resolution this is the cheapest: patches and
factor are those of the small picture, whatever the size of the photograph.

Detail too fine for the viewing size is changed like the coarser detail around it: what the small picture lacks is
multiplied by the slope of the change over the brightness, from a regression over 5x5 pixels of the small picture. The
finest parts of a texture are amplified (or smoothed) as much as the others; an edge, which is not detail, stays as
sharp as it is. The mean of what this adds over a pixel of the small picture is subtracted, so that the result, when
reduced, is nearly the small result, which the editor shows while a slider moves.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.torch_internals import cached_constants
from nlfilter_torch.operator.features import pad_border
from nlfilter_torch.photo.picture.limits import Balance, Limits, balance_of, balanced, clamped, limit, move_luminance
from nlfilter_torch.photo.picture.measuring import cached, everywhere, shrunk
from nlfilter_torch.photo.picture.pixels import Fitted, M, Pixels, Planes, corner, whole_image
from nlfilter_torch.photo.picture.resizing import interpolation, resize
from nlfilter_torch.photo.picture.source import Source

MEGAPIXEL = 1_000_000
ROUND_TRIP_RADIUS = 4  # radius in pixels of the kernel that equals enlarging and reducing again
RESTORED = 5  # terms of the Neumann series that inverts the smoothing by enlarging and reducing again
FAINT_VARIANCE = (2 / 255) ** 2  # variance of brightness below which its slope is attenuated towards 0


def viewed_size(size: tuple[int, int], megapixels: float) -> tuple[int, int]:
    """Return (H, W) of a picture reduced to a number of megapixels; unchanged if it has no more, or for 0.

    >>> viewed_size((4000, 6000), 1.5), viewed_size((600, 800), 1.5)
    ((1000, 1500), (600, 800))
    """
    scale = math.sqrt(megapixels * MEGAPIXEL / (size[0] * size[1]))
    if megapixels == 0 or scale >= 1:
        return size
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def fit_change(
    source: Source[M],
    change: Callable[[Source[M]], Fitted],
    planes: Planes,
    size: float,
    limits: Limits,
    *,
    brighter: float | Tensor | Balance | None = 0.0,
) -> Fitted:
    """Fit an edit that changes the brightness of a picture, by a change computed at the viewing size.

    Args:
        source: the picture.
        change: function that fits the change (B, 1 or C, h, w) to a source.
        planes: what is changed, luminance or all channels.
        size: the viewing size in megapixels; 0 is the size of the picture.
        limits: ``soft`` as :func:`limit`; ``none`` adds the change as it is.
        brighter: intended relative increase of the mean brightness, by default 0; or the :func:`balance` of another
            picture; None corrects neither mean brightness nor chroma.
    """
    small = viewed_size(source.size, size)
    if small == source.size:
        return within_limits(source, change(source), limits, brighter)
    reduced = source.resized(small)
    return enlarged_change(source, reduced, change(reduced), planes, limits, brighter=brighter)


def enlarged_change(
    source: Source[M],
    reduced: Source[M],
    change: Fitted,
    planes: Planes,
    limits: Limits,
    *,
    brighter: float | Tensor | Balance | None = 0.0,
) -> Fitted:
    """The edit of a picture by a change of its reduction to a smaller size; arguments as in :func:`fit_change`."""
    fitted, balance = _limited(reduced, change, limits, brighter)
    before, image = everywhere(reduced, Fitted(planes)), everywhere(reduced, Fitted(whole_image))
    after, saturation = balanced(image, everywhere(reduced, fitted), balance, limits)
    coarse = Coarse.of(before, after, saturation, limits)
    return Fitted(coarse.enlarged(source, planes).edited)


def within_limits(
    source: Source[M], change: Fitted, limits: Limits, brighter: float | Tensor | Balance | None = 0.0
) -> Fitted:
    """The edit that applies a change of brightness to a picture; arguments as those of :func:`fit_change`."""
    fitted, balance = _limited(source, change, limits, brighter)
    return fitted.then(_with_balance, balance, limits)


def _with_balance(image: Tensor, moved: Tensor, balance: Balance | None, limits: Limits) -> Tensor:
    """Apply a limited change of brightness to pixels of a picture with that balance."""
    return move_luminance(image, *balanced(image, moved, balance, limits))


def balance(source: Source[M], change: Fitted, limits: Limits, brighter: float | Tensor) -> Balance | None:
    """The balance of a picture under a change of its brightness; arguments as those of :func:`fit_change`."""
    return _limited(source, change, limits, brighter)[1]


def _limited(
    source: Source[M], change: Fitted, limits: Limits, brighter: float | Tensor | Balance | None
) -> tuple[Fitted, Balance | None]:
    """The change, limited, and the balance of the picture."""
    if limits == "none":
        return change, None
    fitted = change.then(limit)
    if brighter is None or isinstance(brighter, Balance):
        return fitted, brighter
    kept = cached(source, fitted)
    return kept, balance_of(source, kept, brighter)


@dataclass(frozen=True, eq=False)
class Coarse:
    """A change of brightness at the viewing size.

    Attributes:
        planes: (B, S, h, w): the planes before the change, the change, its slope over these planes and, for ``soft``
            limits of luminance, the change of saturation.
        count: number of channels of each of the first three.
        limits: those of :func:`fit_change`.
    """

    planes: Tensor
    count: int
    limits: Limits

    @staticmethod
    def of(before: Tensor, change: Tensor, saturation: Tensor | None, limits: Limits) -> "Coarse":
        """Join planes, their change and, if they are luminance, the change of saturation."""
        parts = [before, change, slope(before, change), *([] if saturation is None else [saturation])]
        return Coarse(torch.cat(parts, dim=1), before.shape[1], limits)

    def enlarged(self, source: Source[M], planes: Planes) -> "EnlargedChange":
        """The change of a larger picture whose ``planes`` it changes."""
        return EnlargedChange(self, planes, source.size).corrected(source)

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.planes.shape[-2], self.planes.shape[-1]


@dataclass(frozen=True, eq=False)
class EnlargedChange:
    """A change of brightness at the viewing size, enlarged to a larger picture.

    Attributes:
        coarse: the change at the viewing size.
        planes: what is changed of the larger picture.
        size: (H, W) of the larger picture.
    """

    coarse: Coarse
    planes: Planes
    size: tuple[int, int]

    def changes(self, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """Changes of the planes and of the saturation of pixels of the larger picture."""
        count, planes = self.coarse.count, self.planes(pixels)
        enlarged = self._enlarged(pixels)
        blurred, changed, steepness = enlarged[:, : 3 * count].chunk(3, dim=1)
        return changed + steepness * (planes - blurred), enlarged[:, 3 * count :]

    def edited(self, pixels: Pixels) -> Tensor:
        """Pixels of the larger picture under the change."""
        moved, saturation = self.changes(pixels)
        changed = moved, saturation if saturation.shape[1] else None
        image = pixels.image
        return move_luminance(image, *(clamped(image, *changed) if self.coarse.limits == "soft" else changed))

    def corrected(self, source: Source[M]) -> "EnlargedChange":
        """Correct the change so that its mean over blocks of the larger picture is the change of the small one.

        The change of detail that the small picture lacks has a nonzero mean, which is subtracted here.
        """
        planes, count, size = self.coarse.planes, self.coarse.count, self.coarse.size
        before, change, rest = planes.split([count, count, planes.shape[1] - 2 * count], dim=1)
        stride = math.sqrt(self.size[0] * self.size[1] / (size[0] * size[1]))
        change = _restored(change - shrunk(source, self._finer, size), stride)
        return replace(self, coarse=replace(self.coarse, planes=torch.cat([before, change, rest], dim=1)))

    def _finer(self, pixels: Pixels) -> Tensor:
        """Change of the detail of pixels that the small picture lacks."""
        count = self.coarse.count
        detail = self.planes(pixels) - self._enlarged(pixels, slice(0, count))
        return self._enlarged(pixels, slice(2 * count, 3 * count)) * detail

    def _enlarged(self, pixels: Pixels, channels: slice = slice(None)) -> Tensor:
        """Channels of :attr:`Coarse.planes`, enlarged to pixels of the larger picture."""
        (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
        columns = None if width == pixels.width else range(left, left + width)
        rows = range(top, top + height)
        return resize(self.coarse.planes[:, channels], self.size, rows, columns)


def _restored(planes: Tensor, stride: float) -> Tensor:
    """Approximate inverse of :func:`enlarged_and_reduced`."""
    estimate = planes
    for _ in range(RESTORED - 1):
        estimate = estimate + planes - enlarged_and_reduced(estimate, stride)
    return estimate


def enlarged_and_reduced(planes: Tensor, stride: float) -> Tensor:
    """Enlarge planes (B, C, H, W) by a factor of ``stride`` and reduce them again, as one convolution.

    Approximate at borders, and for a fractional stride.
    """
    kernel = _round_trip_kernel(stride).to(planes)
    radius = len(kernel) // 2
    padded = F.pad(planes, (radius,) * 4, mode="replicate")
    return _smoothed(_smoothed(padded, kernel, 2), kernel, 3)


def _smoothed(planes: Tensor, kernel: Tensor, dim: int) -> Tensor:
    """Convolve along an axis with a symmetric kernel of odd length; a tenth of the time of ``conv2d``."""
    radius = len(kernel) // 2
    length = planes.shape[dim] - 2 * radius
    shifted = [planes.narrow(dim, i, length) for i in range(len(kernel))]
    total = shifted[radius] * kernel[radius]
    for i in range(radius):
        total = total + (shifted[i] + shifted[-1 - i]) * kernel[i]
    return total


@cached_constants
def _round_trip_kernel(stride: float) -> Tensor:
    """Kernel (2 ROUND_TRIP_RADIUS + 1,) of :func:`enlarged_and_reduced` along an axis, averaged over the phases."""
    length, places = 64, range(28, 36)
    large = round(length * stride)
    used, down = interpolation(places, large, length)
    rows = torch.stack([weights @ _up(used, length, large) for weights in down])  # (8, 64)
    around = [rows[i, place - ROUND_TRIP_RADIUS : place + ROUND_TRIP_RADIUS + 1] for i, place in enumerate(places)]
    kernel = torch.stack(around).mean(0)
    return (kernel + kernel.flip(0)) / (2 * kernel.sum())


def _up(used: slice, length: int, large: int) -> Tensor:
    """Interpolation weights (n, length) of the pixels of an axis for a slice of its enlargement."""
    part, weights = interpolation(range(used.start, used.stop), length, large)
    return F.pad(weights, (part.start, length - part.stop))


def slope(before: Tensor, change: Tensor) -> Tensor:
    """Slope of a change over the planes (B, C, H, W) before it, by regression over 5x5 pixels; 0 in flat areas."""
    mean = _mean_around(before)
    covariance = _mean_around(before * change) - mean * _mean_around(change)
    variance = (_mean_around(before.square()) - mean.square()).clamp(min=0.0)
    return covariance / (variance + FAINT_VARIANCE)


def _mean_around(planes: Tensor) -> Tensor:
    """Mean over the 5x5 pixels around each pixel."""
    fifth = planes.new_full((5,), 0.2)
    return _smoothed(_smoothed(pad_border(planes, 2), fifth, 2), fifth, 3)
