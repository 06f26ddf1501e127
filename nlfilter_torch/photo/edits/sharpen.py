"""Sharpening with little noise gain: unsharp masking of what the filter shows not to be noise. Paper: Fig. 6."""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_reach
from nlfilter_torch.core.inner import Inner
from nlfilter_torch.operator.features import blur, blur_margin, reduce_channels
from nlfilter_torch.photo.declared.parameters import SHARPEN
from nlfilter_torch.photo.edits.noise import noise_of
from nlfilter_torch.photo.picture.changes import VARIANCE_SIGMA, activity
from nlfilter_torch.photo.picture.in_memory import edit_of
from nlfilter_torch.photo.picture.limits import Limits
from nlfilter_torch.photo.picture.source import Fitted, Guide, Source, luminance
from nlfilter_torch.photo.picture.viewing import fit_change

RADIUS = 1.5  # standard deviation in pixels of the blur of the unsharp mask
UNIT = 2.0  # growth of the amount that adds the mask once
FAINT = 5 / 255  # standard deviation of luminance around a pixel below which a clean picture is sharpened less
NOISE_RATIO = 2.0  # ratio of that deviation to the noise below which a noisy one is


@edit_of("image")
def sharpen(
    source: Source,
    /,
    *,
    amount: float | Tensor = SHARPEN.defaults["amount"],
    guide_blur: float = SHARPEN.defaults["guide_blur"],
    limits: Limits = SHARPEN.defaults["limits"],
    viewing_size: float = SHARPEN.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = SHARPEN.defaults["photometric_bandwidth"],
    **options: Any,
) -> Fitted:
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
        **options: further options of :func:`nonlocal_operator`.

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
    SHARPEN.check(source.batch, amount=amount, guide_blur=guide_blur, limits=limits, viewing_size=viewing_size)
    strength = (torch.as_tensor(amount, dtype=source.dtype).reshape(-1, 1, 1, 1) - 1) / UNIT

    def change(viewed: Source) -> Fitted:
        check_reach(guide_blur, "guide_blur", viewed.size)
        filter_options = options | {"photometric_bandwidth": photometric_bandwidth}
        layers = viewed.operator(Guide(filter_options, transform=_grey, blur=guide_blur)).layers(luminance, 1)
        noise = viewed.kept("noise of luminance", [], lambda: noise_of(viewed, "luminance"))

        def finish(image: Tensor, planes: Tensor, _: Inner) -> Tensor:
            fine, smooth = planes.chunk(2, dim=1)
            variance = noise.at(_grey(image)).square()
            signal = (activity(image) - variance).clamp(min=0)
            kept = signal / (signal + NOISE_RATIO**2 * variance + FAINT**2)
            clean = smooth + kept * fine
            return strength.to(image) * kept * (clean - blur(clean, RADIUS))

        margin = blur_margin(RADIUS) + blur_margin(VARIANCE_SIGMA)
        return Fitted(lambda pixels: layers(pixels).flatten(1, 2), finish, margin)

    return fit_change(source, change, luminance, viewing_size, limits)


def _grey(image: Tensor) -> Tensor:
    """Luminance of an image: one channel to blur instead of three."""
    return reduce_channels(image, "luminance")
