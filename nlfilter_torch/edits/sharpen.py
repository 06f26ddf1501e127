"""Sharpening with little noise gain: the middle sliders of a filter with a blurred guide. Paper: Fig. 6."""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_reach
from nlfilter_torch.edits.in_memory import edit_of
from nlfilter_torch.edits.limits import Limits
from nlfilter_torch.edits.parameters import SHARPEN
from nlfilter_torch.edits.source import Fitted, Guide, Source, luminance
from nlfilter_torch.edits.synthesis import polynomial
from nlfilter_torch.edits.viewing import fit_change
from nlfilter_torch.operator.features import reduce_channels


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

    The finest layer, which contains the noise, and the smooth one stay unchanged; the two between are amplified. With
    noise in the guide, pixels would be similar by their noise, and the noise would be sharpened, so the guide is
    blurred first: at equal gain on strong edges, the noise gain is half that of unsharp masking
    (``python -m benchmarks.sharpening``).

    Args:
        image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and its colours are kept.
        amount: sliders alpha_2 and alpha_3, a number or a tensor of shape () or (B,); 1 changes nothing, 4 is visible,
            8 is strong.
        guide_blur: standard deviation in pixels of the blur of the guide, at most half the short side, 0 for none.
        limits: ``"soft"`` keeps detail in highlights and shadows, ``"none"`` adds the change as it is and lets them
            clip.
        viewing_size: in megapixels; larger images are edited like their reduction to this size, with patches and
            bandwidths in its pixels; 0 is the size of the image.
        photometric_bandwidth: h_y of the blurred guide.
        **options: further options of :func:`nonlocal_operator`.

    Returns:
        (B, C, H, W); values may leave [0, 1]. Differentiable in image and amount.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> sharp = sharpen(image, photometric_bandwidth=0.2, num_landmarks=60)
        >>> sharp.shape, bool(sharp.std() > image.std())
        (torch.Size([1, 3, 32, 32]), True)
    """
    SHARPEN.check(source.batch, amount=amount, guide_blur=guide_blur, limits=limits, viewing_size=viewing_size)
    middle = torch.as_tensor(amount, dtype=source.dtype).reshape(-1).expand(source.batch)
    still = torch.zeros_like(middle)
    sliders = torch.stack([still, middle - 1, middle - 1, still], dim=1)  # less 1, so that the filter gives the change

    def change(viewed: Source) -> Fitted:
        check_reach(guide_blur, "guide_blur", viewed.size)
        filter_options = options | {"photometric_bandwidth": photometric_bandwidth}
        operator = viewed.operator(Guide(filter_options, transform=_grey, blur=guide_blur))
        changed = polynomial(operator, luminance, 3, None)
        return Fitted(lambda pixels: changed(pixels, sliders))

    return fit_change(source, change, luminance, viewing_size, limits)


def _grey(image: Tensor) -> Tensor:
    """Luminance of an image: one channel to blur instead of three."""
    return reduce_channels(image, "luminance")
