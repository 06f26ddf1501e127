"""Changes of detail: added detail and the rest, less of it in flat areas, and the changes of several regions."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.tall_skinny import spread
from nlfilter_torch.core.precision import per_image, squarable
from nlfilter_torch.filtering.filters import residual_change, weigh_layers
from nlfilter_torch.operator.features import blur, reduce_channels
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import Response
from nlfilter_torch.photo.picture.source import Operator, Pixels, Planes

VARIANCE_SIGMA = 2.0  # standard deviation in pixels of the Gaussian window for the local variance
EPSILON = 1e-12  # keeps gradients finite where neither the activity nor the threshold is above 0


def limit_by_activity(changes: Tensor, activity: Tensor, threshold: float | Tensor) -> Tensor:
    """Sum added detail and the rest of the change, (B, 2 C, H, W), with less added detail where the image is flat.

    Added detail is multiplied by ``v / (v + threshold^2)``, with v the activity (B, 1, H, W).
    """
    if not isinstance(threshold, Tensor) and threshold == 0:
        return sum_of(changes)
    added, rest = changes.chunk(2, dim=1)
    least = per_image(threshold, activity, 4).square()
    shares = torch.where(least == 0, 1.0, activity / (activity + least).clamp(min=EPSILON))
    return added * shares + rest


def activity(image: Tensor) -> Tensor:
    """Local variance (B, 1, H, W) of the luminance of an image."""
    grey = squarable(reduce_channels(image, "luminance").mean(1, keepdim=True))
    mean, square = blur(torch.cat([grey, grey.square()], dim=1), VARIANCE_SIGMA).chunk(2, dim=1)
    return (square - mean.square()).clamp(min=0)


def change_in_parts(image: Tensor, edited: Tensor, *, brightness: float | Tensor, colour: float | Tensor) -> Tensor:
    """The image with shares of the change of its luminance and of its chroma, numbers or tensors of shape () or (B,).

    Images (B, C, H, W) other than RGB have no chroma.
    """
    change = edited - image
    first = per_image(brightness, change, 4)
    if image.shape[1] != 3:
        return image + first * change
    luminance = reduce_channels(change, "luminance")
    return image + first * luminance + per_image(colour, change, 4) * (change - luminance)


def sum_of(changes: Tensor) -> Tensor:
    """Sum of added detail and the rest of the change, which are concatenated to (B, 2 C, H, W)."""
    added, rest = changes.chunk(2, dim=1)
    return added + rest


def split_sliders(sliders: Tensor) -> tuple[Tensor, Tensor]:
    """Split sliders less 1 into those that amplify detail and the others, each with 0 in place of the rest."""
    dim = 1 if sliders.ndim == 4 else sliders.ndim - 1
    places = torch.arange(sliders.shape[dim], device=sliders.device)
    is_detail = (places < sliders.shape[dim] - 1).view(-1, *[1] * (sliders.ndim - dim - 1))
    zero = torch.zeros_like(sliders)
    raised = (sliders > 0) & is_detail
    return torch.where(raised, sliders, zero), torch.where(raised, zero, sliders)


def change_of_mean(sliders: Tensor) -> Tensor | None:
    """Relative change of the mean of a picture by sliders less 1, (K, k+1), one row for each part of the picture.

    W preserves means, so only the last slider counts. Returns None, for no correction of the mean, if a part stays
    unchanged or the last sliders differ.
    """
    last = sliders[:, -1]
    return last[0] if bool((sliders != 0).any(1).all() & (last == last[0]).all()) else None


def blend_changes(changes: Tensor, masks: Tensor) -> Tensor:
    """Blend the changes of K regions and of the background, (B, (K + 1) S, H, W), by masks (B, K, H, W).

    Where the masks sum to more than 1, they are divided by their sum.
    """
    shares = masks / masks.sum(1, keepdim=True).clamp(min=1.0)
    rest = (1 - shares.sum(1, keepdim=True)).clamp(min=0.0)
    apart = changes.unflatten(1, (masks.shape[1] + 1, -1))
    return (torch.cat([shares, rest], dim=1).unsqueeze(2) * apart).sum(1)


def blend_edited(image: Tensor, edited: Sequence[Tensor], masks: Tensor) -> Tensor:
    """The image (B, C, H, W), edited in K ways (B, C', H, W) where the masks (B, K, H, W) are 1."""
    before = image.expand(-1, max(version.shape[1] for version in edited), -1, -1)
    changes = [version - before for version in edited]
    return before + blend_changes(torch.cat([*changes, torch.zeros_like(before)], dim=1), masks)


@dataclass(frozen=True, eq=False)
class DetailChange:
    """A change of planes of a picture by sliders less 1, with :func:`polynomial_filter`.

    Attributes:
        planes: what is changed.
        layers: its detail layers.
        sliders: less 1, so that sliders of 1 change nothing, bit for bit.
        residual: weight of the residual, less 1; None is that of eq. 12.
        captured: the planes, projected on the eigenvectors; None if ``residual`` is.
        share: remainder r of the diagonal of W; None if ``residual`` is.
    """

    planes: Planes
    layers: Planes
    sliders: Tensor
    residual: float | Tensor | None = None
    captured: Planes | None = None
    share: Planes | None = None

    @staticmethod
    def of(operator: Operator, planes: Planes, sliders: Tensor, residual: float | Tensor | None) -> "DetailChange":
        """Prepare the change of planes of a picture."""
        order = (sliders.shape[1] if sliders.ndim == 4 else sliders.shape[-1]) - 1
        layers = operator.layers(planes, order)
        if residual is None:
            return DetailChange(planes, layers, sliders)
        captured = synthesize(operator, torch.ones_like, operator.coefficients(planes))
        return DetailChange(planes, layers, sliders, residual, captured, operator.of_columns(remainder))

    def __call__(self, pixels: Pixels) -> Tensor:
        """Added detail and the rest of the change at the given pixels, (B, 2 C, h, w)."""
        halves = zip(split_sliders(self.sliders), (0.0, self.residual), strict=True)
        return torch.cat([self._by(pixels, half, weight) for half, weight in halves], dim=1)

    def whole(self, pixels: Pixels) -> Tensor:
        """The change at the given pixels, (B, C, h, w)."""
        return self._by(pixels, self.sliders, self.residual)

    def _by(self, pixels: Pixels, sliders: Tensor, weight: float | Tensor | None) -> Tensor:
        """The change by these sliders, and with this weight of the residual if there is one."""
        filtered = weigh_layers(self.layers(pixels), sliders)
        if weight is None or self.captured is None or self.share is None:
            return filtered
        residual = self.planes(pixels) - self.captured(pixels)
        return filtered + residual_change(sliders, weight, residual, self.share(pixels))


def synthesize(operator: Operator, response: Response, coefficients: Tensor) -> Planes:
    """Compute ``V f(S) V^T y`` for a response f and coefficients (B, C, M) of y."""
    total = coefficients @ operator.pairs.gain(response).mT
    return operator.of_columns(_spread, total)


def _spread(columns: Columns, total: Tensor) -> Tensor:
    return spread(total.to(columns.factor), columns.factor, columns.scaling)


def remainder(columns: Columns) -> Tensor:
    """Part r of the diagonal of W that the factor lacks, (B, 1, n)."""
    return columns.remainder.unsqueeze(1)
