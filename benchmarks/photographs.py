"""Photographs that ship with scikit-image, as tensors: colours and sizes that the figures ask for."""

from functools import cache
from pathlib import Path

import numpy as np
import skimage.data
import torch
from PIL import Image
from skimage.transform import resize

LOADERS = {"motorcycle": lambda: skimage.data.stereo_motorcycle()[0]}


@cache
def photograph(name: str, height: int | None = None, width: int | None = None) -> torch.Tensor:
    """A photograph (1, C, H, W) in [0, 1], float32; with a size, its middle is cut to that shape and then reduced."""
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


def pictures(folder: Path, size: int) -> dict[str, torch.Tensor]:
    """All pictures (1, 3, H, W) of a folder by name, their longer side reduced to ``size``."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp"):
            with Image.open(path) as opened:
                opened.thumbnail((size, size), Image.Resampling.LANCZOS)
                picture = np.asarray(opened.convert("RGB"), np.float32) / 255
            found[path.stem] = torch.from_numpy(picture).permute(2, 0, 1)[None]
    if not found:
        raise SystemExit(f"{folder} must hold pictures (PNG, JPEG, TIFF or WebP), but holds none; name another folder")
    return found
