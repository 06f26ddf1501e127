"""Photographs that ship with scikit-image, as tensors in the colours and sizes that benchmarks need."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import skimage.data
import torch
import torch.nn.functional as F
from skimage.transform import resize

from nlfilter_torch.photo.picture.photographs import read_photograph

LOADERS = {"motorcycle": lambda: skimage.data.stereo_motorcycle()[0]}

LETTERS = 27  # height of captions in pixels: phones show pictures of three columns at less than half their size


@cache
def photograph(name: str, height: int | None = None, width: int | None = None) -> torch.Tensor:
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


def pictures(folder: Path | None, side: int, names: Sequence[str]) -> dict[str, torch.Tensor]:
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


def kodak(folder: Path, number: int) -> torch.Tensor:
    """One of Kodak's 24 photographs (1, 3, H, W), from a folder of files with their usual names (kodim07.png)."""
    return read_photograph(folder / f"kodim{number:02d}.png").pixels.float()


def middle(picture: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """The middle of a photograph (1, C, H, W), as large as fits the shape, reduced to (height, width) by area."""
    rows, columns = picture.shape[-2:]
    scale = min(rows / height, columns / width)
    cut = (round(height * scale), round(width * scale))
    top, left = (rows - cut[0]) // 2, (columns - cut[1]) // 2
    part = picture[..., top : top + cut[0], left : left + cut[1]].float()
    return F.interpolate(part, (height, width), mode="area").contiguous()


def reduced_to(picture: torch.Tensor, side: int) -> torch.Tensor:
    """Reduce a photograph to a short side; smaller ones are not changed."""
    scale = side / min(picture.shape[-2:])
    if scale >= 1:
        return picture.float()
    size = [round(length * scale) for length in picture.shape[-2:]]
    return F.interpolate(picture.float(), size, mode="bicubic", antialias=True).clamp(0, 1)
