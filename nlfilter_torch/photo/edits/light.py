"""Light, white balance, tones and colours of a part of a photograph."""

from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch
from torch import Tensor

from nlfilter_torch.operator.options import Completion, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.development import LightValues, check_value
from nlfilter_torch.photo.declared.parameters import LIGHT
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.light import Light, fit_light
from nlfilter_torch.photo.picture.pixels import Box, M, Pixels, Planes
from nlfilter_torch.photo.picture.source import Fitted, Source
from nlfilter_torch.photo.selections.connected import Extent
from nlfilter_torch.photo.selections.mask import ObjectEdit


def adjust_light(
    image: Tensor,
    region: Tensor | None,
    *,
    background: Tensor | None = None,
    box: Box | None = None,
    added: Tensor | None = None,
    removed: Tensor | None = None,
    exposure: float | Tensor = LIGHT.defaults["exposure"],
    contrast: float | Tensor = LIGHT.defaults["contrast"],
    highlights: float | Tensor = LIGHT.defaults["highlights"],
    shadows: float | Tensor = LIGHT.defaults["shadows"],
    whites: float | Tensor = LIGHT.defaults["whites"],
    blacks: float | Tensor = LIGHT.defaults["blacks"],
    temperature: float | str | None = LIGHT.defaults["temperature"],
    warmth: float | Tensor = LIGHT.defaults["warmth"],
    tint: float | Tensor = LIGHT.defaults["tint"],
    vibrance: float | Tensor = LIGHT.defaults["vibrance"],
    saturation: float | Tensor = LIGHT.defaults["saturation"],
    curve: tuple[float, ...] = LIGHT.defaults["curve"],
    reach: float | Tensor = LIGHT.defaults["reach"],
    extent: Extent = LIGHT.defaults["extent"],
    photometric_bandwidth: float | Tensor = LIGHT.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = LIGHT.defaults["patch_size"],
    num_landmarks: int = LIGHT.defaults["num_landmarks"],
    landmarks: Sampling = LIGHT.defaults["landmarks"],
    completion: Completion = "diagonal",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Change light, white balance, tones and colours of a part of a photograph.

    The part is that of :func:`region_mask`, of which any share may be given as it is by ``added``: a gradient, say, or
    a mask. Each pixel is a mixture of itself and of what ``develop`` makes of it, by its mask.

    Args:
        image: (B, C, H, W) in [0, 1], C = 1 or 3, with the tone curve of sRGB. White balance and strength of colours
            leave grey pictures as they are.
        region: (B, 1, H, W) in [0, 1], above 0 on part or all of what changes; None if it is ``added``, or in a
            ``box``.
        background: (B, 1, H, W) in [0, 1], above 0 on pixels that do not change, nor do similar ones.
        box: ``(left, top, right, bottom)`` in pixels, a rectangle that holds what changes, or a tensor (B, 1, 4), see
            :func:`region_mask`.
        added: (B, 1, H, W) in [0, 1], painted on the mask by hand: 1 changes, whatever is computed.
        removed: (B, 1, H, W) in [0, 1], likewise: 1 does not change. It takes precedence over ``added``.
        exposure: stops, -5 to 5; 1 doubles the light. This and the following values but ``temperature`` and ``curve``
            are numbers or tensors of shape () or (B,); 0 changes nothing.
        contrast: -1 to 1, of all tones about middle grey.
        highlights: -1 to 1, of areas that are light, without changing their detail.
        shadows: -1 to 1, of areas that are dark.
        whites: -1 to 1, of the lightest tones.
        blacks: -1 to 1, of the darkest tones.
        temperature: kelvin of the light that falls on the part, 2000 to 15000; None is 6500, which changes nothing, and
            ``"auto"`` estimates the light from all of the picture.
        warmth: white balance, -1 (blue) to 1 (amber).
        tint: -1 (green) to 1 (magenta).
        vibrance: -1 to 1, of pale colours.
        saturation: -1 (grey) to 1 (twice), of all colours.
        curve: what 2 to 100 evenly spaced tones from 0 to 1 become, from 0 to 1.
        reach: that of :func:`region_mask`.
        extent: that of :func:`region_mask`.
        photometric_bandwidth: that of :func:`region_mask`, in hundredths of Lab.
        spatial_bandwidth: that of :func:`region_mask`, in pixels; None is 0.3 of the short side.
        patch_size: width of the compared patches.
        num_landmarks: M of the filter of the mask.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, C, H, W); equal to the image where the mask is 0. Differentiable in image, region, background, what is added
        and removed, and the values but ``temperature`` and ``curve``; what ``"auto"`` estimates counts as a constant.

    Raises:
        TypeError, ValueError: if a tensor has another size, a value leaves its range, or no part is marked.

    Example:
        >>> image = torch.full((1, 3, 8, 8), 0.5)
        >>> sky = torch.linspace(1, 0, 8).view(1, 1, 8, 1).expand(-1, -1, -1, 8)
        >>> darker = adjust_light(image, None, added=sky, exposure=-1.0)
        >>> [round(value, 2) for value in darker[0, 0, :, 0].tolist()]
        [0.36, 0.38, 0.4, 0.42, 0.44, 0.46, 0.48, 0.5]
    """
    return edited(LightEdit, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class LightEdit(ObjectEdit, LightValues):
    """The edit of :func:`adjust_light`."""

    declared: ClassVar[Edit] = LIGHT
    relative: ClassVar[bool] = True

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the change of light, and the mask of the part."""
        names = [value.name for value in fields(LightValues) if value.name not in ("temperature", "curve")]
        LIGHT.check(source.batch, **{name: getattr(self, name) for name in names})
        for name in ("temperature", "curve"):
            check_value(name, getattr(self, name))
        masks = replace(self.selection_in(source.size), names=("region", "background")).select(
            source, self.marks(drawn)
        )
        values: dict[str, float | Tensor] = {name: getattr(self, name) for name in names}
        for name, value in values.items():
            if isinstance(value, Tensor):
                values[name] = value.reshape(-1, 1, 1, 1).to(source.dtype)
        ends = torch.zeros((), dtype=source.dtype), torch.ones((), dtype=source.dtype)
        light = LightValues(temperature=self.temperature, curve=self.curve, **values)
        return Fitted(PartlyLit(fit_light(source, light, ends), masks.masks))


@dataclass(frozen=True, eq=False)
class PartlyLit:
    """Pixels in another light as far as a mask (B, 1, h, w) says."""

    light: Light
    mask: Planes

    def __call__(self, pixels: Pixels) -> Tensor:
        """The pixels."""
        return torch.lerp(pixels.image, self.light(pixels), self.mask(pixels).to(pixels.image))
