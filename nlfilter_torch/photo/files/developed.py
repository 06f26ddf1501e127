"""A photograph in memory as it is developed, with its transparency, its hidden pixels and its metadata."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.photo.declared.development import Development, Frame
from nlfilter_torch.photo.files.decoded import Channels
from nlfilter_torch.photo.files.exif import of_part
from nlfilter_torch.photo.files.photographs import HiddenPixels, Photograph
from nlfilter_torch.photo.picture.developing import develop_planes, finished, in_light, limits_of
from nlfilter_torch.photo.picture.pictures import is_hidden, stored_as


def develop_photograph(photograph: Photograph, development: Development) -> Photograph:
    """Develop a photograph, as :func:`develop_image` does its pixels.

    Transparency and pixels without data follow. Metadata that hold for the whole picture only, such as the place of the
    subject, are left out if it is cropped.

    Raises:
        ValueError: if the middle of the crop is outside the turned picture.
    """
    if development.is_idle:
        return photograph
    return lit_photograph(cut_photograph(photograph, development), development, photograph)


def cut_photograph(photograph: Photograph, development: Development) -> Photograph:
    """Straighten and crop a photograph; raises as :func:`develop_photograph`."""
    frame = development.frame(photograph.size)
    if frame.is_whole:
        return photograph
    cut = _cropped(photograph, frame) if frame.angle == 0 else _turned(photograph, frame)
    return replace(cut, exif=of_part(photograph.exif, frame.size[::-1]))


def lit_photograph(cut: Photograph, development: Development, original: Photograph) -> Photograph:
    """Change exposure and white balance of a photograph that was cut from the original."""
    if not development.changes_tones:
        return cut
    return replace(cut, pixels=in_light(cut.pixels, development, limits_of(original.pixels)))


def _cropped(photograph: Photograph, frame: Frame) -> Photograph:
    alpha, hidden = photograph.alpha, photograph.hidden
    if hidden is not None:
        rows, columns = (slice(start, start + n) for start, n in ((frame.top, frame.height), (frame.left, frame.width)))
        inside = np.zeros_like(hidden.places)
        inside[rows, columns] = True
        hidden = replace(
            hidden, places=hidden.places[rows, columns].copy(), colours=hidden.colours[inside[hidden.places]]
        )
    return replace(
        photograph,
        pixels=develop_planes(photograph.pixels, frame).contiguous(),
        alpha=None if alpha is None else develop_planes(alpha, frame).contiguous(),
        hidden=hidden,
    )


def _turned(photograph: Photograph, frame: Frame) -> Photograph:
    """A photograph that is straightened and cropped; hidden pixels have the colours around them if it has opacity."""
    hidden, colours = photograph.hidden, photograph.pixels.shape[1]
    least, most = limits_of(photograph.pixels)
    planes = [photograph.pixels]
    nodata = None if hidden is None else hidden.nodata
    if photograph.alpha is not None:
        planes.append(photograph.alpha)
    elif hidden is not None:
        planes.append(torch.from_numpy(~hidden.places)[None, None].to(photograph.pixels))
    turned = finished(develop_planes(torch.cat(planes, dim=1), frame), colours, (float(least), float(most)))
    pixels, opacity = turned[:, :colours], turned[:, colours:]
    if nodata is not None:
        places = (opacity.round() <= 0)[0, 0].numpy()
        filled = np.full((int(places.sum()), colours), nodata, photograph.depth)
        return replace(photograph, pixels=pixels, hidden=_hidden(places, filled, nodata))
    if photograph.alpha is None:
        return replace(photograph, pixels=pixels)
    places = is_hidden(opacity[0].permute(1, 2, 0).numpy())
    return replace(
        photograph, pixels=pixels, alpha=opacity, hidden=_hidden(places, _at(pixels, places, photograph.depth))
    )


def _at(pixels: Tensor, places: NDArray[np.bool_], depth: str) -> Channels:
    """The colours (n, C) of pixels at places (H, W), as they are stored."""
    return stored_as(pixels, depth)[places]


def _hidden(places: NDArray[np.bool_], colours: Channels, nodata: float | None = None) -> HiddenPixels | None:
    return HiddenPixels(places, colours, nodata) if places.any() else None
