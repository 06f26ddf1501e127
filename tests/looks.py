"""Pictures, edits and measurements for tests of looks."""

import skimage.data
import torch
from torch import Tensor

from nlfilter_torch.photo import FittedLook
from nlfilter_torch.photo.declared.steps import Step

ALPHA = (2.2, 1.6, 1.3, 1.02)
SEPIA = (0.393, 0.769, 0.189, 0.349, 0.686, 0.168, 0.272, 0.534, 0.131)
BENT = tuple((i / 16) ** 0.7 for i in range(17))
VIVID = (1.3, 1.2, 1.1, 1.05, 1.0)
BANDS = (1.5, 1.0, 1.3, 1.0, 1.0, 0.8, 1.1)
TEXTURE = (1.4, 0.8, 1.2, 1.0, 1.1, 0.9)
STRETCH = (0.3, 0.4, -0.2)
LOCAL = (0.2, 0.3, -0.1, 0.2, 0.1, -0.1, 0.2, 0.1)
FEW = Step("look", landmarks=40)


def rgb(name: str, rows: slice, columns: slice) -> Tensor:
    return torch.from_numpy(getattr(skimage.data, name)()[rows, columns].copy()).permute(2, 0, 1)[None].float() / 255


CAT = rgb("chelsea", slice(60, 140), slice(100, 200))
CUP = rgb("coffee", slice(100, 180), slice(150, 250))
SUIT = rgb("astronaut", slice(60, 140), slice(150, 250))


def in_bytes(image: Tensor) -> Tensor:
    return (image.clamp(0, 1) * 255).round() / 255


def single_look(look: FittedLook | tuple[FittedLook, ...]) -> FittedLook:
    assert isinstance(look, FittedLook)
    return look


def explained(before: Tensor, after: Tensor, result: Tensor) -> float:
    return 1 - float((after - result.clamp(0, 1)).square().sum() / (after - before).square().sum())
