"""An edit of the luminance of a photograph that leaves its colour alone."""

from collections.abc import Callable

from torch import Tensor


def edit_luminance(image: Tensor, edit: Callable[[Tensor], Tensor]) -> Tensor:
    """Put ``image`` under another luminance, with the two chroma channels of YCbCr kept.

    Since Cb and Cr are multiples of B - Y and R - Y, adding the change of Y to R, G and B keeps them. Done so, an edit
    that changes nothing gives the image back to the last bit, whatever its depth and RGB profile. The alternatives: Lab
    shifts hues as little, but holds for sRGB only; a ratio of luminances moves the saturation two to three times as
    much (RMS change of chroma on four photographs).

    Args:
        image: (B, C, H, W); with C = 3 it is RGB, with any other C all channels go through ``edit``.
        edit: from luminance (B, 1, H, W) to luminance.

    Returns:
        (B, C, H, W); values may leave [0, 1], as those of ``edit`` do. Differentiable.

    Example:
        >>> import torch
        >>> red = torch.tensor([0.5, 0.1, 0.1]).view(1, 3, 1, 1)
        >>> edit_luminance(red, lambda y: y + 0.2).flatten()
        tensor([0.7000, 0.3000, 0.3000])
    """
    if image.shape[1] != 3:
        return edit(image)
    from kornia.color import rgb_to_grayscale  # kornia takes half a second to import: only who needs it waits

    luminance = rgb_to_grayscale(image)
    return image + (edit(luminance) - luminance)
