"""A look: sliders of detail and blurs, tone curves, colours, levels, local contrast, as found by :func:`fit_look`."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.inner import EVERYWHERE, Inner
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.declared.shared_parameters import LOOK
from nlfilter_torch.photo.edits.synthesis import polynomial
from nlfilter_torch.photo.looks.histogram import LocalCurves, Stretch, ramps, tones
from nlfilter_torch.photo.looks.look_filter import BAND_MARGIN, acts, band_change, check_part, pointwise, texture_change
from nlfilter_torch.photo.picture.in_memory import edit_of
from nlfilter_torch.photo.picture.pixels import corner
from nlfilter_torch.photo.picture.source import Fitted, Guide, Pixels, Planes, Source, luminance
from nlfilter_torch.photo.picture.viewing import fit_change

Numbers = Tensor | Sequence[float]


@edit_of("image")
def apply_look(
    source: Source,
    /,
    *,
    alpha: Numbers = LOOK.defaults["alpha"],
    bands: Numbers = LOOK.defaults["bands"],
    texture: Numbers = LOOK.defaults["texture"],
    red: Numbers = LOOK.defaults["red"],
    green: Numbers = LOOK.defaults["green"],
    blue: Numbers = LOOK.defaults["blue"],
    matrix: Numbers = LOOK.defaults["matrix"],
    saturation: Numbers = LOOK.defaults["saturation"],
    stretch: Numbers = LOOK.defaults["stretch"],
    local: Numbers = LOOK.defaults["local"],
    amount: float | Tensor = LOOK.defaults["amount"],
    viewing_size: float = LOOK.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = LOOK.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | str | None = LOOK.defaults["spatial_bandwidth"],
    num_landmarks: int = LOOK.defaults["num_landmarks"],
    **options: Any,
) -> Fitted:
    """Put a photograph under a look: the image plus what each part changes.

    Args:
        image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and a grey one stays grey.
        alpha: sliders of the detail layers of luminance, (k+1,) or (B, k+1).
        bands: gains of six bands of detail that blurs find, each twice as wide, and of the rest around its mean, (7,)
            or (B, 7).
        texture: gains of the six bands of luminance where it varies little, not at edges, (6,) or (B, 6).
        red: what red becomes at equal steps from 0 to 1, (K,) or (B, K), in straight lines between.
        green: likewise, as many.
        blue: likewise.
        matrix: 9 numbers or (B, 9), the rows of the matrix that colours are multiplied by.
        saturation: how many times as far each channel is to be from the largest one of its pixel, (K,) or (B, K), for
            colours whose saturation in HSV is at equal steps from 0 to 1.
        stretch: how much of the change that stretches brightness, from the darkest to the lightest pixel of the picture
            to the range from 0 to 1, is added: of luminance, for all channels alike; of the largest channel, which
            scales colours; and of each channel for itself, (3,) or (B, 3); 0 is none.
        local: how much of the change that equalises the histogram around each pixel is added, under limits of contrast
            of 1.5, 2, 3 and 5: four strengths for luminance, and four for the largest channel, whose change scales
            colours, (8,) or (B, 8); 0 is none. Histograms are those of 8 x 8 tiles of the picture.
        amount: a number or a tensor of shape () or (B,); 1 is the look, 0 the image.
        viewing_size: in megapixels; the details of a larger image are those of its reduction to this size; 0 is the
            size of the image.
        photometric_bandwidth: h_y, or ``"auto"``.
        spatial_bandwidth: h_x in pixels; None is a twelfth of the short side, ``"none"`` compares spots however far
            apart they are.
        num_landmarks: M.
        **options: further ones of :func:`nonlocal_operator`.

    Returns:
        (B, C, H, W) in the image's dtype; values may leave [0, 1]. Differentiable in image and look.

    Raises:
        TypeError, ValueError: if a part has another shape, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> sepia = (0.393, 0.769, 0.189, 0.349, 0.686, 0.168, 0.272, 0.534, 0.131)
        >>> apply_look(image, matrix=sepia).shape
        torch.Size([1, 3, 24, 24])
    """
    if source.channels not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels, got {source.channels}; pass grey or RGB")
    LOOK.check(source.batch, amount=amount, viewing_size=viewing_size)
    given = {"alpha": alpha, "bands": bands, "texture": texture, "saturation": saturation}
    given |= {"stretch": stretch, "local": local, "red": red, "green": green, "blue": blue}
    sliders, gains, textured, factors, levels, strengths, *channels = (
        _numbers(value, name, source) for name, value in given.items()
    )
    if len({channel.shape[-1] for channel in channels}) > 1:
        lengths = ", ".join(str(channel.shape[-1]) for channel in channels)
        raise ValueError(f"red, green and blue must be equally many numbers, got {lengths}; add or drop some")
    batch = max(channel.shape[0] if channel.ndim == 2 else 1 for channel in channels)
    curves = torch.stack([channel.expand(batch, -1) for channel in channels], dim=1)
    colours = _numbers(matrix, "matrix", source)
    if colours.shape[-1] != 9:
        raise ValueError(f"matrix must be 9 numbers, row by row, got {colours.shape[-1]}; add or drop some")
    colours = colours.unflatten(-1, (3, 3))
    parts = {"alpha": sliders, "bands": gains, "texture": textured, "curves": curves, "matrix": colours}
    parts |= {"saturation": factors, "stretch": levels, "local": strengths}
    for name, value in parts.items():
        check_part(value, name, source.batch)
    strength = torch.as_tensor(amount).to(source.dtype).reshape(-1, 1, 1, 1)

    def change(viewed: Source) -> Fitted:
        moved: Planes | None = None
        if acts(sliders):
            filter_options = options | {
                "photometric_bandwidth": photometric_bandwidth,
                "spatial_bandwidth": LOOK["spatial_bandwidth"].distance(spatial_bandwidth, viewed.size),
                "num_landmarks": num_landmarks,
            }
            filtered = polynomial(viewed.operator(Guide(filter_options)), luminance, sliders.shape[-1] - 1, None)

            moved = partial(filtered, alpha=sliders - 1)

        def pixels(some: Pixels) -> Tensor:
            return torch.zeros_like(some.image) if moved is None else moved(some).expand_as(some.image)

        if not acts(gains) and not acts(textured):
            return Fitted(pixels)
        mean = viewed.mean(luminance) if acts(gains) else None

        def around(image: Tensor, found: Tensor, _: Inner) -> Tensor:
            found = found if mean is None else found + band_change(image, gains, mean)
            return found + texture_change(image, textured) if acts(textured) else found

        return Fitted(pixels, around, BAND_MARGIN)

    fitted = fit_change(source, change, lambda pixels: pixels.image, viewing_size, "none")

    brightened = _change_of_brightness(source, levels, strengths)

    def result(image: Tensor, moved: Tensor) -> Tensor:
        coloured = image.expand(-1, 3, -1, -1)
        shown = pointwise(coloured, curves, colours, factors) - coloured
        shown = reduce_channels(shown, "luminance") if image.shape[1] == 1 else shown
        return image + strength * (moved - image + shown)

    def planes(pixels: Pixels) -> Tensor:
        """The change of some pixels, and that of their brightness as further planes."""
        moved = fitted.pixels(pixels)
        return moved if brightened is None else torch.cat([moved, brightened(pixels)], dim=1)

    def finished(image: Tensor, found: Tensor, inner: Inner) -> Tensor:
        moved, light = (found, None) if brightened is None else found.tensor_split([-image.shape[1]], dim=1)
        shown = result(image, moved if fitted.finish is None else fitted.finish(image, moved, inner))
        return shown if light is None else shown + strength * light

    if fitted.finish is None:
        return Fitted(lambda pixels: finished(pixels.image, planes(pixels), EVERYWHERE))
    return Fitted(planes, finished, fitted.margin)


def _change_of_brightness(source: Source, levels: Tensor, strengths: Tensor) -> Planes | None:
    """The change (B, C, h, W) by automatic levels and local tone curves, or None if there is none."""
    if not acts(levels, 0.0) and not acts(strengths, 0.0):
        return None

    stretch = source.kept(
        "range of brightness", [], lambda: Stretch.of(source.ends(lambda pixels: tones(pixels.image)))
    )
    if not acts(strengths, 0.0):
        return lambda pixels: stretch.change(pixels.image, levels)

    def curves() -> LocalCurves:
        ramped = partial(source.reduced, lambda pixels: ramps(pixels.image, stretch))
        return LocalCurves.of(source.size, stretch, ramped)

    weighed = source.kept("local curves", [], curves).weighed(strengths)

    def change(pixels: Pixels) -> Tensor:
        found = weighed.rectangle(pixels.image, corner(pixels)).sum(1)
        return found + stretch.change(pixels.image, levels) if acts(levels, 0.0) else found

    return change


def _numbers(value: Numbers, name: str, source: Source) -> Tensor:
    """A part of a look as a tensor of at least one dimension."""
    try:
        numbers = value if isinstance(value, Tensor) else torch.tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be a list of numbers or a tensor, got {value!r}; pass numbers") from error
    if numbers.ndim == 0:
        raise ValueError(f"{name} must be several numbers, got a single one; pass a list or a tensor of them")
    return numbers.to(source.dtype)
