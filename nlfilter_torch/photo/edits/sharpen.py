"""Sharpening with little noise gain: unsharp masking of what the filter shows not to be noise. Paper: Fig. 6."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.core.checks import check_reach
from nlfilter_torch.nn.denoiser.noise import Noise
from nlfilter_torch.operator.features import blur, blur_margin, reduce_channels
from nlfilter_torch.operator.options import Completion, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import SHARPEN
from nlfilter_torch.photo.edits.noise import noise_of
from nlfilter_torch.photo.picture.changes import VARIANCE_SIGMA, activity
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.limits import Limits
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.source import Fitted, Guide, Pixels, Planes, Source, kept, luminance
from nlfilter_torch.photo.picture.viewing import fit_change

RADIUS = 1.5  # standard deviation in pixels of the blur of the unsharp mask
UNIT = 2.0  # growth of the amount that adds the mask once
FAINT = 10 / 255  # standard deviation of luminance around a pixel below which a clean picture is sharpened less: skin
NOISE_RATIO = 2.0  # ratio of that deviation to the noise below which a noisy one is


def sharpen(
    image: Tensor,
    *,
    amount: float | Tensor = SHARPEN.defaults["amount"],
    guide_blur: float = SHARPEN.defaults["guide_blur"],
    limits: Limits = SHARPEN.defaults["limits"],
    viewing_size: float = SHARPEN.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = SHARPEN.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = SHARPEN.defaults["spatial_bandwidth"],
    patch_size: int = SHARPEN.defaults["patch_size"],
    num_landmarks: int = SHARPEN.defaults["num_landmarks"],
    landmarks: Sampling = SHARPEN.defaults["landmarks"],
    completion: Completion = "diagonal",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Sharpen a photograph, noisy or not.

    An unsharp mask of what is left of luminance without its noise. The finest layer of the filter, which contains the
    noise, is kept as far as the variance around a pixel exceeds that of the noise, which is estimated; elsewhere the
    layer is left out of the mask, and the mask is weaker. A clean photograph is sharpened almost as by an unsharp mask.
    With noise in the guide, pixels would be similar by their noise, so the guide is blurred. At equal gain on strong
    edges, noise grows less than by unsharp masking (``python -m benchmarks.sharpening``).

    Args:
        image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and its colours are kept.
        amount: a number or a tensor of shape () or (B,); 1 changes nothing, 4 is visible, 8 is strong.
        guide_blur: standard deviation in pixels of the blur of the guide, at most half the short side, 0 for none.
        limits: ``"soft"`` keeps detail in highlights and shadows, ``"none"`` adds the change as it is and lets them
            clip.
        viewing_size: in megapixels; larger images are edited like their reduction to this size, with patches and
            bandwidths in its pixels; 0 is the size of the image.
        photometric_bandwidth: h_y of the blurred guide.
        spatial_bandwidth: h_x in pixels; None is no limit.
        patch_size: width of the compared patches.
        num_landmarks: M of the filter.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, C, H, W); values may leave [0, 1]. Differentiable in image and amount; the estimated noise
        counts as a constant.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> sharp = sharpen(image, photometric_bandwidth=0.2, num_landmarks=60)
        >>> sharp.shape, bool(sharp.std() > image.std())
        (torch.Size([1, 3, 32, 32]), True)
    """
    return edited(Sharpen, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Sharpen(PhotoEdit):
    """The edit of :func:`sharpen`."""

    declared: ClassVar[Edit] = SHARPEN
    relative: ClassVar[bool] = True
    amount: float | Tensor
    guide_blur: float
    limits: Limits
    viewing_size: float

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the unsharp mask of a picture."""
        SHARPEN.check(source.batch, amount=self.amount, guide_blur=self.guide_blur, limits=self.limits)
        SHARPEN.check(source.batch, viewing_size=self.viewing_size)
        return fit_change(source, self._change, luminance, self.viewing_size, self.limits)

    def guide(self, size: tuple[int, int]) -> Guide:
        """The guide of a picture (H, W) at the viewing size, and the options of the filter."""
        return Guide(self.filter_options(size), transform=_grey, blur=self.guide_blur)

    def _change(self, viewed: Source[M]) -> Fitted:
        """The unsharp mask of a picture at the viewing size."""
        check_reach(self.guide_blur, "guide_blur", viewed.size)
        layers = viewed.operator(self.guide(viewed.size)).layers(luminance, 1)
        noise = kept(viewed, "noise of luminance", [], noise_of, viewed, "luminance")
        strength = (torch.as_tensor(self.amount, dtype=viewed.dtype).reshape(-1, 1, 1, 1) - 1) / UNIT
        margin = blur_margin(RADIUS) + blur_margin(VARIANCE_SIGMA)
        mask = UnsharpMask(layers, noise, strength)
        return Fitted(mask.planes, mask.finish, margin)


@dataclass(frozen=True, eq=False)
class UnsharpMask:
    """An unsharp mask of luminance without its noise, times a strength (B or 1, 1, 1, 1), from its detail layers."""

    layers: Planes
    noise: Noise
    strength: Tensor

    def planes(self, pixels: Pixels) -> Tensor:
        """The layers, (B, 2, h, w)."""
        return self.layers(pixels).flatten(1, 2)

    def finish(self, image: Tensor, planes: Tensor, _: Inner) -> Tensor:
        """The mask (B, 1, H, W) of an image, from the fine and the smooth layer of its luminance."""
        fine, smooth = planes.chunk(2, dim=1)
        variance = self.noise.at(_grey(image)).square()
        signal = (activity(image) - variance).clamp(min=0)
        kept = signal / (signal + NOISE_RATIO**2 * variance + FAINT**2)
        clean = smooth + kept * fine
        return self.strength.to(image) * kept * (clean - blur(clean, RADIUS))


def _grey(image: Tensor) -> Tensor:
    """Luminance of an image: one channel to blur instead of three."""
    return reduce_channels(image, "luminance")
