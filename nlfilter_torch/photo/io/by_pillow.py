"""Decoding of PNG, JPEG, WebP and AVIF files by Pillow, or by imagecodecs if they have more than 8 bits."""

import struct
import warnings
from pathlib import Path

import imagecodecs
import numpy as np
from PIL import AvifImagePlugin, Image, ImageFile, PngImagePlugin, UnidentifiedImageError, WebPImagePlugin  # noqa: F401

from nlfilter_torch.photo.io import colours, tiff
from nlfilter_torch.photo.io import exif as exif_tags
from nlfilter_torch.photo.io.decoded import Channels, CheckSize, Decoded


def read_by_pillow(path: Path, deep_png: bool, check_size: CheckSize) -> Decoded:
    """Read a PNG, JPEG, WebP or AVIF file; ``deep_png`` if it is a PNG file of 16 bits."""
    with tiff.decoding(path), _identified(path) as image:
        frames = getattr(image, "n_frames", 1)
        if frames > 1 and image.format != "MPO":
            raise tiff.UnhandledImage(f"{path} is an animation of {frames} frames; save one of them as a picture")
        check_size(image.size)
        if "icc_profile" not in image.info:
            _check_colours(path, image)
        orientation, exif = exif_tags.split(image.getexif)
        channels = imagecodecs.png_decode(path.read_bytes()) if deep_png else _decoded(path, image)
        channels = channels.reshape(*channels.shape[:2], -1)
        return Decoded(channels, orientation, image.info.get("icc_profile"), exif)


def _identified(path: Path) -> ImageFile.ImageFile:
    """Open a file; raises UnhandledImage unless it is an image of a known kind."""
    try:
        return _opened(path)
    except Image.DecompressionBombError as error:
        raise MemoryError(f"{path} is too large ({error}); make the picture smaller") from error
    except UnidentifiedImageError as error:
        sentence = f"{path} is not a PNG, JPEG, TIFF, WebP or AVIF image; convert it to one of these"
        raise tiff.UnhandledImage(sentence) from error


def _decoded(path: Path, image: ImageFile.ImageFile) -> Channels:
    """The pixels (H, W) or (H, W, S) of an open file, as 16 bits if an AVIF file has 10 or 12."""
    if image.format == "AVIF" and (bits := _bits_of_avif(path)) > 8:  # Pillow would reduce them to 8
        levels = imagecodecs.avif_decode(path.read_bytes())
        return np.rint(levels * (65535 / (2**bits - 1))).astype(np.uint16)
    if image.format == "PNG":  # load() ignores wrong checksums
        with _opened(path) as again:
            again.verify()
    return np.asarray(_plain_mode(image, path))


def _opened(path: Path) -> ImageFile.ImageFile:
    with warnings.catch_warnings():
        # Pillow's limit on picture sizes is independent of the memory; check_memory replaces it.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        warnings.simplefilter("ignore", UserWarning)  # warnings about EXIF, see exif.split
        return Image.open(path, formats=["PNG", "JPEG", "WEBP", "AVIF"])


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(1 << 16)


def _check_colours(path: Path, image: Image.Image) -> None:
    """Check the colours of a PNG or AVIF file without a profile, see :mod:`nlfilter_torch.photo.io.colours`."""
    if image.format == "AVIF":
        _, marker, numbers = _head(path).partition(b"colrnclx")
        if marker and len(numbers) >= 4:
            colours.check_numbers(path, *struct.unpack(">HH", numbers[:4]))
    elif image.format == "PNG":
        _, marker, numbers = _head(path).partition(b"IDAT")[0].partition(b"cICP")
        if marker and len(numbers) >= 2:
            colours.check_numbers(path, *numbers[:2])
        elif "srgb" not in image.info:
            colours.check_png(path, image.info.get("gamma"), image.info.get("chromaticity"))


def _bits_of_avif(path: Path) -> int:
    """Read the bits per channel from the codec configuration, which is among the first boxes."""
    head = _head(path)
    place = head.find(b"av1C") + 6  # after the version, the profile and the level
    flags = head[place] if 6 <= place < len(head) else 0
    return (12 if flags & 0x20 else 10) if flags & 0x40 else 8


def _plain_mode(image: Image.Image, path: Path) -> Image.Image:
    """Convert an image to one of the modes L, LA, RGB, RGBA."""
    transparent = "transparency" in image.info
    modes = {"LA": "LA", "PA": "RGBA", "RGBA": "RGBA"}
    modes |= dict.fromkeys(("1", "L"), "LA" if transparent else "L")
    modes |= dict.fromkeys(("P", "RGB"), "RGBA" if transparent else "RGB")
    if image.mode not in modes:
        sentence = f"{path} is stored in {image.mode} colours, which are not supported; convert it to grey or RGB"
        raise tiff.UnhandledImage(sentence)
    image.load()
    return image.convert(modes[image.mode])
