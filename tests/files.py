"""Pixels, metadata and comparisons for tests of image files."""

from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import torch
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from nlfilter_torch.photo.io.photographs import Photograph
from nlfilter_torch.photo.io.rows import open_picture

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
INTEGERS = ("uint8", "uint16")
CHANNELS = (1, 2, 3, 4)  # grey, grey + alpha, RGB, RGBA


def stored_values(channels: int, depth: str) -> np.ndarray:
    """Pseudo-random values (5, 7, channels) of ``depth``, including the extremes."""
    draw = np.random.default_rng(channels)
    if depth.startswith("float"):
        return draw.normal(0.5, 1, (5, 7, channels)).astype(depth)
    limit = np.iinfo(depth).max
    values = draw.integers(0, limit, (5, 7, channels), dtype=depth, endpoint=True)
    values[0, :2] = [[0], [limit]]
    return values


def photograph(values: np.ndarray, **fields: bytes) -> Photograph:
    """The photograph expected from a file with ``values``."""
    integer = np.issubdtype(values.dtype, np.integer)
    kind = np.float64 if values.dtype == np.float64 else np.float32
    scaled = values.astype(kind) / (np.iinfo(values.dtype).max if integer else 1)
    planes = torch.from_numpy(scaled.astype(kind)).permute(2, 0, 1)[None]
    colours = 3 if planes.shape[1] >= 3 else 1
    alpha = planes[:, colours:] if planes.shape[1] > colours else None
    return Photograph(planes[:, :colours], values.dtype.name, alpha, **fields)  # type: ignore[arg-type]


def exif_block(orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    exif[ExifTags.Base.Orientation] = orientation
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.ExifImageWidth] = 7
    details[ExifTags.Base.ExifImageHeight] = 5
    details[ExifTags.Base.LensModel] = "a lens with a long name"
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    return exif.tobytes()


def tags(block: bytes | None) -> tuple[dict[int, object], dict[int, object], dict[int, object]]:
    exif = Image.Exif()
    exif.load(block or b"")
    folders = (int(ExifTags.IFD.Exif), int(ExifTags.IFD.GPSInfo))
    main = {code: value for code, value in exif.items() if code not in folders}
    return main, dict(exif.get_ifd(folders[0])), dict(exif.get_ifd(folders[1]))


def same(opened: Photograph, wanted: Photograph) -> None:
    assert opened.depth == wanted.depth
    assert opened.pixels.dtype == wanted.pixels.dtype
    assert torch.equal(opened.pixels, wanted.pixels)
    assert (opened.alpha is None) == (wanted.alpha is None)
    assert opened.alpha is None or torch.equal(opened.alpha, wanted.alpha)
    assert opened.icc == wanted.icc
    assert tags(opened.exif) == tags(wanted.exif)


Array = NDArray[Any]
PLENTY = 1 << 30


def cat(height: int = 200, width: int = 150, channels: int = 3) -> Array:
    """(height, width, channels) of 8 bits; the fourth channel is a ramp."""
    picture = skimage.data.chelsea()[20 : 20 + height, 90 : 90 + width]
    ramp = np.broadcast_to(np.arange(width, dtype=np.uint8)[:, None], (height, width, 1))
    return np.ascontiguousarray(np.concatenate([picture, ramp], axis=2)[..., :channels])


def rows_of(path: Path, step: int = 37) -> Array:
    with open_picture(path, PLENTY) as picture:
        height = picture.shape[0]
        parts = [picture.rows[slice(top, min(top + step, height))] for top in range(0, height, step)]
        return np.concatenate(parts)
