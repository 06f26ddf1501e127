"""A photograph that can be opened, its thumbnail, and the edit that another one gives it."""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from PIL import Image, ImageOps
from torch import Tensor

from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.sidecar import Sidecar
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.picture.photographs import read_photograph
from nlfilter_torch.photo.picture.resizing import resize

THUMBNAIL = 160  # pixels of the longest side of a thumbnail, twice as many as on the page


@dataclass(frozen=True)
class Shot:
    """A photograph that can be opened.

    Attributes:
        path: the file that is read, which may be a copy.
        name: of the file for the user.
        original: the file beside which its edit is kept, or None.
        address: by which a page finds it again.
        version: the time of the last change of the file, or 0.
    """

    path: Path
    name: str
    original: Path | None
    address: str
    version: float

    @cached_property
    def sidecar(self) -> Sidecar:
        """What keeps its edit."""
        return Sidecar.of(self.original, self.name, digest_of(self.path))


@dataclass(eq=False)
class Thumbnail:
    """A small picture of a photograph.

    Attributes:
        pixels: as it is, (1, C, h, w) in [0, 1].
        size: (height, width) of the photograph.
        recipe: the edit that the file shows.
        file: a JPEG.
    """

    pixels: Tensor
    size: tuple[int, int]
    recipe: Recipe | None = None
    file: bytes = b""

    @staticmethod
    def of(shot: Shot) -> "Thumbnail":
        """That of a photograph, without its edit; of a JPEG file, only as much is decoded as is needed."""
        with (
            suppress(OSError, ValueError, Image.DecompressionBombError),
            Image.open(shot.path, formats=["JPEG"]) as image,
        ):
            if image.mode in ("L", "RGB"):
                width, height = image.size
                image.draft(image.mode, (2 * THUMBNAIL, 2 * THUMBNAIL))
                upright = ImageOps.exif_transpose(image)
                turned = (upright.width > upright.height) != (width > height)
                return Thumbnail(thumbnail(drawing.planes(upright)), (width, height) if turned else (height, width))
        photograph = read_photograph(shot.path)
        return Thumbnail(thumbnail(photograph.pixels.float()), photograph.size)


def carried(recipe: Recipe, onto: Recipe) -> Recipe:
    """An edit as it is given to another photograph, which has its own edit ``onto``.

    What is painted, the crop and turning belong to their photographs, and stay.
    """
    light = {**vars(recipe.develop), **{name: vars(onto.develop)[name] for name in ("rotate", "straighten", "crop")}}
    steps = [
        step.changed(strokes=(), **({"inside": None} if step.has_region() else {}))
        for step in recipe.steps
        if not step.declared.requires_strokes
    ]
    given = Recipe(tuple(steps), type(recipe.develop)(**light))
    for step in onto.steps:
        if step.strokes and given.place_of(step.edit) is None:
            given = given.with_current(step)
    return given


def thumbnail(pixels: Tensor) -> Tensor:
    """A picture (1, C, H, W), reduced, with values in [0, 1]."""
    scale = min(1.0, THUMBNAIL / max(pixels.shape[-2:]))
    height, width = (max(1, round(length * scale)) for length in pixels.shape[-2:])
    return resize(pixels, (height, width)).clamp(0, 1)


def free_name(check: Callable[[str], Path], name: str) -> str:
    """A name like another that no file has, where ``check`` returns the file of a name."""
    stem, suffix, number, free = Path(name).stem, Path(name).suffix, 1, name
    while check(free).exists():
        number += 1
        free = f"{stem}-{number}{suffix}"
    return free


def digest_of(path: Path) -> str:
    """The SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
