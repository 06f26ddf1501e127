"""Photographs that ship with scikit-image, as tensors in the colours and sizes that benchmarks need."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import skimage.data
import torch
import torch.nn.functional as F
from skimage.color import rgb2gray
from skimage.transform import resize
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.picture.photographs import read_photograph

LOADERS = {"motorcycle": lambda: skimage.data.stereo_motorcycle()[0]}

CHOOSING = ("astronaut", "coffee", "chelsea", "motorcycle", "rocket")  # defaults of edits were chosen on these
REPORTING = ("hubble_deep_field", "immunohistochemistry", "retina", "colorwheel")  # and not on these
HELD_OUT = ("motorcycle", "immunohistochemistry", "coins")  # nothing of layers was chosen on these
HELD_OUT_OF_KODAK = (1, 13, 19)  # of Kodak's photographs
PIECES = (2, 3, 7, 9, 14, 15, 17, 21, 22)  # of a large picture, of Kodak's
SIZE = 640  # longer side of a scene, in pixels
Box = tuple[int, int, int, int]  # column, row, width, height, in pixels of the full-size photograph


@cache
def photograph(name: str, height: int | None = None, width: int | None = None) -> Tensor:
    """A photograph (1, C, H, W) in [0, 1], float32; with a size, its middle is cropped to that shape and reduced."""
    picture = (LOADERS.get(name) or getattr(skimage.data, name))() / 255.0
    picture = picture[..., :3] if picture.ndim == 3 else picture[..., None]
    if height is not None and width is not None:
        rows, columns = picture.shape[:2]
        scale = min(rows / height, columns / width)
        cut = (round(height * scale), round(width * scale))
        top, left = (rows - cut[0]) // 2, (columns - cut[1]) // 2
        picture = resize(picture[top : top + cut[0], left : left + cut[1]], (height, width), anti_aliasing=True)
    tensor = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None].float()
    return tensor.clamp(0, 1)


def pictures(folder: Path | None, side: int, names: Sequence[str]) -> dict[str, Tensor]:
    """Photographs (1, 3, H, W), reduced to a short side: all PNG, JPEG and TIFF files of a folder, or scikit-image's.

    Args:
        folder: None takes scikit-image's photographs.
        side: pixels of the short side; smaller photographs are not changed.
        names: of scikit-image's photographs.
    """
    if folder is None:
        images = {name: photograph(name) for name in names}
    else:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif"))
        images = {path.stem: read_photograph(path).pixels for path in paths}
    if not images:
        raise SystemExit(f"{folder} must hold pictures (PNG, JPEG or TIFF), but holds none; name another folder")
    return {name: reduced_to(picture.expand(-1, 3, -1, -1), side) for name, picture in images.items()}


def kodak(folder: Path, number: int) -> Tensor:
    """One of Kodak's 24 photographs (1, 3, H, W), from a folder of files with their usual names (kodim07.png)."""
    return read_photograph(folder / f"kodim{number:02d}.png").pixels.float()


def held_out(folder: Path | None) -> dict[str, Tensor]:
    """Three photographs (1, C, H, W) for figures that are reported: scikit-image's, or Kodak's if a folder is told."""
    if folder is None:
        return {name: photograph(name) for name in HELD_OUT}
    return {f"kodim{number:02d}": kodak(folder, number) for number in HELD_OUT_OF_KODAK}


def large(folder: Path | None, side: int) -> Tensor:
    """A square picture (1, 3, side, side): a retina, or the middles of nine of Kodak's photographs."""
    if folder is None:
        return photograph("retina", side, side)
    length = -(-side // 3)
    pieces = []
    for number in PIECES:
        picture = kodak(folder, number)
        top, left = ((size - length) // 2 for size in picture.shape[-2:])
        pieces.append(picture[..., top : top + length, left : left + length])
    rows = [torch.cat(pieces[first : first + 3], dim=3) for first in (0, 3, 6)]
    return torch.cat(rows, dim=2)[..., :side, :side].contiguous()


def middle(picture: Tensor, height: int, width: int) -> Tensor:
    """The middle of a photograph (1, C, H, W), as large as fits the shape, reduced to (height, width) by area."""
    rows, columns = picture.shape[-2:]
    scale = min(rows / height, columns / width)
    cut = (round(height * scale), round(width * scale))
    top, left = (rows - cut[0]) // 2, (columns - cut[1]) // 2
    part = picture[..., top : top + cut[0], left : left + cut[1]].float()
    return F.interpolate(part, (height, width), mode="area").contiguous()


def reduced_to(picture: Tensor, side: int) -> Tensor:
    """Reduce a photograph to a short side; smaller ones are not changed."""
    scale = side / min(picture.shape[-2:])
    if scale >= 1:
        return picture.float()
    size = [round(length * scale) for length in picture.shape[-2:]]
    return F.interpolate(picture.float(), size, mode="bicubic", antialias=True).clamp(0, 1)


def enlarged(name: str, height: int, width: int) -> Tensor:
    """A photograph (1, 3, height, width) of any size, whatever its proportions."""
    return F.interpolate(photograph(name), (height, width), mode="bicubic", antialias=True).clamp(0, 1)


def retina(side: int) -> Tensor:
    """The middle of the retina in grey, (1, 1, side, side), enlarged if ``side`` exceeds its 1411 pixels."""
    grey = rgb2gray(skimage.data.retina())
    top, left = (max(0, length - side) // 2 for length in grey.shape)
    grey = grey[top : top + side, left : left + side] if side <= min(grey.shape) else resize(grey, (side, side))
    return torch.from_numpy(np.ascontiguousarray(grey, dtype=np.float32))[None, None]


def luminance(image: Tensor) -> Tensor:
    """Luminance of an image, (B, 1, H, W)."""
    return reduce_channels(image, "luminance")


def scene(name: str, size: int) -> tuple[Tensor, float]:
    """A photograph (1, C, H, W) whose longer side is at most ``size``, and its scale relative to the original."""
    height, width = photograph(name).shape[-2:]
    scale = min(1.0, size / max(height, width))
    if scale == 1.0:
        return photograph(name), scale
    return photograph(name, round(height * scale), round(width * scale)), scale


def spots(image: Tensor, scale: float, *boxes: Box) -> Tensor:
    """Mask (1, 1, H, W) that is 1 inside rectangles, each at least one pixel in size."""
    mask = torch.zeros_like(image[:, :1])
    for x, y, width, height in boxes:
        left, top = round(x * scale), round(y * scale)
        mask[..., top : top + max(1, round(height * scale)), left : left + max(1, round(width * scale))] = 1
    return mask


def strokes(image: Tensor, scale: float, *painted: tuple[Box, tuple[float, float, float]]) -> tuple[Tensor, Tensor]:
    """Strokes (1, 3, H, W) and their mask (1, 1, H, W) from coloured rectangles."""
    colours, mask = torch.zeros_like(image).expand(-1, 3, -1, -1).clone(), torch.zeros_like(image[:, :1])
    for box, colour in painted:
        spot = spots(image, scale, box)
        colours = torch.where(spot > 0, torch.tensor(colour).view(1, 3, 1, 1), colours)
        mask = torch.maximum(mask, spot)
    return colours, mask


def scribbled(image: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """An RGB image with strokes drawn on it, outlined in white."""
    rim = F.max_pool2d(mask, 5, 1, 2)
    return torch.where(mask > 0, colours, torch.where(rim > 0, torch.ones_like(image), image))
