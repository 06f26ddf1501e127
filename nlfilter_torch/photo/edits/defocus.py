"""Synthetic defocus: a sharp subject before a blurred background, as with a wide aperture. Paper: Sec. V-C."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.core.checks import check_reach
from nlfilter_torch.operator.options import Completion, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import DEFOCUS
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.pixels import Box, M
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Fitted, Source
from nlfilter_torch.photo.selections.by_hand import ByHand, check_drawn
from nlfilter_torch.photo.selections.connected import Extent
from nlfilter_torch.photo.selections.mask import ObjectEdit, background_of, boxed, fit_regions

Aperture = Literal["disc", "gaussian"]

# A mask below BLURRED counts as background, above SHARP as subject. A blurred part of the subject is more disturbing
# than a sharp part of the background, so uncertain pixels stay sharp.
BLURRED, SHARP = 0.05, 0.25
SUBJECT_WEIGHT = 1e-5  # weight of the subject in the blur of the background
ROWS, FAST = 192, 64  # rows of a Fourier transform, about; its sizes are multiples of this, which makes it fast


def defocus(
    image: Tensor,
    focus_region: Tensor | None,
    *,
    background: Tensor | None = None,
    box: Box | None = None,
    added: Tensor | None = None,
    removed: Tensor | None = None,
    radius: float | None = None,
    aperture: Aperture = DEFOCUS.defaults["aperture"],
    reach: float | Tensor = DEFOCUS.defaults["reach"],
    extent: Extent = DEFOCUS.defaults["extent"],
    photometric_bandwidth: float | Tensor = DEFOCUS.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = DEFOCUS.defaults["patch_size"],
    num_landmarks: int = DEFOCUS.defaults["num_landmarks"],
    landmarks: Sampling = DEFOCUS.defaults["landmarks"],
    completion: Completion = "diagonal",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Blur the background of a subject that stays in focus.

    Paper: Sec. V-C, Fig. 17, with :func:`region_mask` in place of its mask. Only the background is blurred, so the
    subject does not bleed into it.

    Args:
        image: (B, C, H, W) in [0, 1], C = 1 or 3.
        focus_region: (B, 1, H, W) in [0, 1], above 0 on part or all of the subject; None if it is ``added``,
            or in a ``box``.
        background: (B, 1, H, W) in [0, 1], background scribbles, above 0 on pixels that are blurred together with
            similar ones. ``focus_region`` takes precedence over it.
        box: ``(left, top, right, bottom)`` in pixels, a rectangle that holds the subject, or a tensor (B, 1, 4); all
            outside it is blurred, see :func:`region_mask`.
        added: (B, 1, H, W) in [0, 1], painted on the mask of the subject by hand: 1 stays sharp, whatever is computed.
        removed: (B, 1, H, W) in [0, 1], likewise: 1 is blurred. It takes precedence over ``added``.
        radius: radius of the strongest blur, in pixels, at most half the short side; None is 2.5 % of the short side.
        aperture: ``"disc"`` turns bright dots into discs, as a lens does; ``"gaussian"`` is the paper's, with the same
            variance.
        reach: that of :func:`region_mask`.
        extent: that of :func:`region_mask`.
        photometric_bandwidth: that of :func:`region_mask`, in hundredths of Lab.
        spatial_bandwidth: that of :func:`region_mask`, in pixels; None is 0.3 of the short side.
        patch_size: width of the compared patches.
        num_landmarks: M of the filter.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, C, H, W), within the range of ``image`` and equal to it to rounding where it is in focus. Differentiable in
        image, region and background.

    Raises:
        TypeError, ValueError: if a tensor has another size, leaves its range, the region is empty, or ``background`` is
            painted only under it in some image.

    Example:
        >>> image = torch.rand(1, 3, 40, 40, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> image[..., 20:] += 0.6
        >>> region = torch.zeros(1, 1, 40, 40)
        >>> region[..., 10:20, 24:34] = 1
        >>> blurred = defocus(image, region, radius=3.0, num_landmarks=50)
        >>> torch.equal(blurred[..., 10:20, 24:34], image[..., 10:20, 24:34])
        True
        >>> bool(blurred[..., :18].std() < image[..., :18].std() / 2)
        True
    """
    return edited(Defocus, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Defocus(ObjectEdit):
    """The edit of :func:`defocus`."""

    declared: ClassVar[Edit] = DEFOCUS
    relative: ClassVar[bool] = True
    radius: float | None
    aperture: Aperture

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the mask of the subject."""
        if source.channels not in (1, 3):
            raise ValueError(f"image must have 1 or 3 channels, got {source.channels}; select 1 or 3")
        DEFOCUS.check(aperture=self.aperture, radius=self.radius)
        lens = Lens(float(DEFOCUS["radius"].pixels(self.radius, source.size)), self.aperture)
        check_reach(lens.radius, "radius", source.size)
        region, added = drawn.masks.get("focus_region"), drawn.masks.get("added")
        check_drawn(region, added, "focus_region", drawn.box)
        by_hand = ByHand.of(source, added, drawn.masks.get("removed"), 1)
        inside, background = [], list[Scribbles]()
        if region is not None:
            needed = added is None and drawn.box is None
            inside = [source.scribbles(region, None, "focus_region", needed=needed)]
        inside, boxes = boxed(source, drawn.box, inside, 1, "focus_region")
        if inside:
            background = background_of(source, drawn.masks.get("background"), inside[0], "background")
        subject = fit_regions(source, inside, background, self.selection_in(source.size), by_hand, boxes)
        return Fitted(subject.masks, lens.finish, lens.reach)


def focus_of(mask: Tensor) -> Tensor:
    """Return the fraction of each pixel that is in focus, from the mask (B, 1, H, W) of the subject."""
    return ((mask - BLURRED) / (SHARP - BLURRED)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class Lens:
    """What blurs the background: a radius in pixels, and the shape of the aperture."""

    radius: float
    aperture: Aperture

    @property
    def reach(self) -> int:
        """Radius of the kernel in pixels; for a Gaussian, three standard deviations."""
        return math.ceil(self.radius + 0.5) if self.aperture == "disc" else math.ceil(1.5 * self.radius)

    def kernel(self) -> Tensor:
        """Compute a square kernel of unit sum: a disc with a soft rim, or a Gaussian of the same variance."""
        axis = torch.arange(-self.reach, self.reach + 1, dtype=torch.float64)
        squared = axis.square().unsqueeze(0) + axis.square().unsqueeze(1)
        if self.aperture == "disc":
            kernel = (self.radius + 0.5 - squared.sqrt()).clamp(0.0, 1.0)
        else:
            kernel = torch.exp(-squared / (2 * (self.radius / 2) ** 2))
        return kernel / kernel.sum()

    def finish(self, image: Tensor, masks: Tensor, _: Inner) -> Tensor:
        """Blur an image behind the subject that masks (B, 1, H, W) show."""
        return self.blur_behind(image, focus_of(masks))

    def blur_behind(self, image: Tensor, focus: Tensor) -> Tensor:
        """Blur the background of an image by itself, and blend it by the fraction of each pixel that is in focus."""
        behind = (1 - focus).square() + SUBJECT_WEIGHT  # which matters only where there is no background nearby
        sums = convolve(torch.cat([image * behind, behind], dim=1), self.kernel().to(image))
        blurred = torch.lerp(sums[:, :-1] / sums[:, -1:], image, focus)
        return torch.where(focus == 1, image, blurred)


def convolve(planes: Tensor, kernel: Tensor) -> Tensor:
    """Convolve planes (B, C, H, W) with a symmetric kernel (k, k), with zeros outside the image.

    By Fourier transforms of some rows at a time, which stay in the cache.
    """
    height, width = planes.shape[-2:]
    half = kernel.shape[0] // 2
    rows = min(height, max(ROWS, 8 * half))
    size = tuple(math.ceil((length + 2 * half) / FAST) * FAST for length in (rows, width))
    step = size[0] - 2 * half
    spectrum, parts = torch.fft.rfft2(kernel, s=size), []
    for first in range(0, height, step):
        top = max(0, first - half)
        strip = planes[..., top : first + step + half, :]
        blurred = torch.fft.irfft2(torch.fft.rfft2(strip, s=size) * spectrum, s=size)
        start = first - top + half
        parts.append(blurred[..., start : start + min(step, height - first), half : half + width])
    return torch.cat(parts, dim=-2)
