"""Short digests of values, files and texts, equal exactly if these are equal."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import av
import imagecodecs
import numpy as np
import tifffile
import torch
import zarr
from numpy.typing import NDArray
from PIL import Image

import nlfilter_torch

Digest = str | list["Digest"] | dict[str, "Digest"]

PLAIN = (bool, int, float, complex, type(None), torch.dtype, torch.Size)
PLACES = re.compile("Offset|ByteCount")  # of TIFF tags that say where pixels are
TEXTS = (".json", ".txt", ".svg")
SECRETS = re.compile(r"0x[0-9a-f]{6,}")  # addresses of objects in memory
PROGRESS = re.compile(r"^.*(, about .* left| so far)\n", re.MULTILINE)  # printed only by slow commands
SOURCE = Path(nlfilter_torch.__file__).resolve().parent  # folder of the package


def hashed(data: bytes) -> str:
    """The first half of the SHA-256 of bytes, in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()[:32]


def of_array(array: NDArray[Any]) -> str:
    """Digest of the dtype, the shape and the bytes of an array."""
    return f"{array.dtype} {array.shape} {hashed(np.ascontiguousarray(array).tobytes())}"


def of_text(text: str, folder: Path | None = None) -> str:
    """A text without what differs from run to run: the working folder, that of the package, addresses and progress."""
    for place, name in ((folder, "FOLDER"), (SOURCE, "PACKAGE")):
        if place is not None:
            text = text.replace(str(place.resolve()), name)
    return PROGRESS.sub("", SECRETS.sub("ADDRESS", text))


def of_value(value: Any) -> Digest:
    """Digest of tensors, numbers, texts and containers of these.

    Of a dataclass only the fields that hold such values count: the others are internal.
    """
    if isinstance(value, torch.Tensor):
        return of_array(value.detach().numpy())
    if isinstance(value, np.ndarray):
        return of_array(value)
    if isinstance(value, bytes):
        return hashed(value)
    if isinstance(value, str):
        return of_text(value)
    if isinstance(value, Mapping):
        return {str(key): of_value(entry) for key, entry in value.items()}
    if isinstance(value, PLAIN):
        return repr(value)
    if isinstance(value, list | tuple | set | frozenset):
        return [of_value(entry) for entry in value]
    if is_dataclass(value):
        entries = {field.name: getattr(value, field.name) for field in fields(value)}
        return {name: of_value(entry) for name, entry in entries.items() if is_digestible(entry)}
    raise TypeError(f"value must be of a kind that has a digest, got {type(value).__name__}; add it to of_value")


def is_digestible(value: Any) -> bool:
    """Whether a field of a dataclass holds a result, and no internal object."""
    return isinstance(value, (torch.Tensor, str, bytes, list, tuple, dict, *PLAIN))


def of_file(path: Path, folder: Path) -> Digest:
    """Digest of a file or of an array of zarr: its bytes, the pixels it decodes to, and what else it says."""
    suffix = path.suffix.lower()
    if suffix == ".zarr":
        return of_zarr(path)
    if suffix in TEXTS:
        return of_text(path.read_text(encoding="utf-8"), folder)
    data = path.read_bytes()
    if suffix == ".tif":
        return {"bytes": hashed(data), **of_tiff(path)}
    if suffix == ".mp4":
        return {"bytes": hashed(data), **of_film(path)}
    if suffix in (".png", ".jpg", ".webp", ".avif"):
        with Image.open(path) as image:
            tags = {str(name): of_value(entry) for name, entry in image.info.items()}
            tags |= {"mode": image.mode, "EXIF": of_text(str(dict(image.getexif())))}
            pixels = imagecodecs.png_decode(data) if suffix == ".png" else np.asarray(image)  # Pillow reads 8 bits only
        return {"bytes": hashed(data), "pixels": of_array(pixels), "tags": tags}
    return {"bytes": hashed(data)}


def of_tiff(path: Path) -> dict[str, Digest]:
    """Digest of the pixels and tags of all pages of a TIFF file."""
    with tifffile.TiffFile(path) as file:
        pages = [page.aspage() for page in file.pages]
        tags: list[Digest] = [
            {tag.name: of_tag(tag.value) for tag in page.tags if not PLACES.search(tag.name)} for page in pages
        ]
        return {"pixels": [of_array(page.asarray()) for page in pages], "tags": tags}


def of_tag(value: Any) -> str:
    """Digest of the value of a tag: texts and numbers as they are."""
    return hashed(value) if isinstance(value, bytes) else of_text(str(value))


def of_zarr(path: Path) -> dict[str, Digest]:
    """Digest of an array of zarr with its metadata and the names of its files."""
    names = " ".join(str(file.relative_to(path)) for file in sorted(path.rglob("*")) if file.is_file())
    described = (path / "zarr.json").read_text(encoding="utf-8")
    return {"pixels": of_array(np.asarray(zarr.open_array(path, mode="r")[:])), "tags": described, "files": names}


def of_film(path: Path) -> dict[str, Digest]:
    """Digest of the frames of a film, of their times, and of the streams."""
    with av.open(str(path)) as film:
        streams: list[Digest] = [
            f"{stream.type} {stream.codec_context.name} {stream.time_base} {stream.frames} {dict(stream.metadata)}"
            for stream in film.streams
        ]
        frames = [(frame.pts, frame.format.name, frame.to_ndarray()) for frame in film.decode(video=0)]
        tags: dict[str, Digest] = {name: str(entry) for name, entry in film.metadata.items()}
    pixels: list[Digest] = [f"{time} {kind} {of_array(array)}" for time, kind, array in frames]
    return {"pixels": pixels, "streams": streams, "tags": tags}
