"""Inputs shared by tests: seeded noise, photographs, strokes on them, operators, and random guides for hypothesis."""

from functools import cache

import skimage.data
import torch
from hypothesis import strategies as st
from skimage.transform import resize

from nlfilter_torch import NonlocalOperator, nonlocal_operator
from nlfilter_torch.photo.declared.parameters import EDITS, MASK
from tests.images import photograph

#: Functions of the application that take images.
IMAGE_FUNCTIONS = {
    *(edit.function or edit.name for edit in (*EDITS.values(), MASK)),
    *("Look", "apply_look", "filter_frames", "fit_look"),
}


SAMPLINGS = ("kmeans", "uniform", "random")
LUMINANCE = torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)

# Rectangles of the astronaut, reduced to 64x64, that show a single object.
SUIT = (slice(None), slice(None), slice(36, 50), slice(8, 15))
BACKGROUND = (slice(None), slice(None), slice(2, 18), slice(40, 46))

# A stroke over the small cat, in pixels.
LINE = [(20.0, 20.0), (40.0, 22.0)]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(shape, generator=seeded(seed), dtype=torch.float64).to(dtype)


def picture(name: str, height: int, width: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.from_numpy(photograph(name, height, width).copy()).to(dtype)[None, None]


@cache
def colour(name: str, height: int = 64, width: int = 64) -> torch.Tensor:
    """A photograph (1, 3, height, width), reduced."""
    picture = getattr(skimage.data, name)() / 255
    return torch.from_numpy(resize(picture, (height, width), anti_aliasing=True)).permute(2, 0, 1)[None].float()


def cat(step: int = 3) -> torch.Tensor:
    """(1, 3, 100, 150) in [0, 1] for a step of 3."""
    return torch.from_numpy(skimage.data.chelsea()[::step, :450:step].copy()).permute(2, 0, 1)[None].float() / 255


def box(top: int, left: int, height: int = 4, width: int = 4, size: tuple[int, int] = (64, 64)) -> torch.Tensor:
    mask = torch.zeros(1, 1, *size)
    mask[..., top : top + height, left : left + width] = 1
    return mask


def paint(red: float, green: float, blue: float, mask: torch.Tensor) -> torch.Tensor:
    return torch.tensor([red, green, blue]).view(1, 3, 1, 1) * mask


def luminance(image: torch.Tensor) -> torch.Tensor:
    return (image * LUMINANCE.to(image)).sum(1, keepdim=True)


def difference(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the largest difference in grey levels of 255, after clipping to [0, 1]."""
    return float((a.clamp(0, 1) - b.clamp(0, 1)).abs().max()) * 255


@st.composite
def guides(draw: st.DrawFn, max_side: int = 12) -> torch.Tensor:
    """Random guides of any shape from one pixel upwards, and of any contrast."""
    batch, channels = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    height, width = draw(st.integers(1, max_side)), draw(st.integers(1, max_side))
    contrast = draw(st.sampled_from([0.0, 1e-3, 0.1, 1.0]))
    levels = draw(st.sampled_from([2, 5, 1000]))  # with few levels, many pixels are equal
    values = (noise(batch, channels, height, width, seed=draw(st.integers(0, 99))) * levels).floor() / levels
    return 0.5 + contrast * (values - 0.5)


options = st.fixed_dictionaries(
    {
        "patch_size": st.sampled_from([1, 3, 5, 7]),
        "photometric_bandwidth": st.sampled_from([1 / 255, 0.05, 0.4, 4.0, "auto"]),
        "spatial_bandwidth": st.sampled_from([None, None, 1.5, 20.0]),
        "num_landmarks": st.integers(1, 25),
        "landmarks": st.sampled_from(SAMPLINGS),
        "guide_channels": st.sampled_from(["luminance", "all"]),
    }
)


def build(guide: torch.Tensor, **kwargs: object) -> NonlocalOperator:
    """Build an operator, with at most as many landmarks as pixels."""
    count = min(int(str(kwargs.pop("num_landmarks", 100))), guide.shape[-2] * guide.shape[-1])
    return nonlocal_operator(guide, num_landmarks=count, generator=seeded(), **kwargs)  # type: ignore[arg-type]


def noisy(image: torch.Tensor, noise: float | torch.Tensor, seed: int = 0) -> torch.Tensor:
    """The image with white noise of that standard deviation."""
    return image + noise * torch.randn(image.shape, generator=seeded(seed))


def decibels(image: torch.Tensor, clean: torch.Tensor) -> float:
    """Peak signal-to-noise ratio."""
    return float(-10 * (image - clean).square().mean().log10())


def oriented(image: torch.Tensor, number: int) -> torch.Tensor:
    """An image (..., H, W) in an orientation of eight: 1 flips rows, 2 columns, 4 exchanges the axes afterwards."""
    flipped = image.flip([axis for axis, bit in ((-2, 1), (-1, 2)) if number & bit])
    return flipped.mT if number & 4 else flipped


def inverse(image: torch.Tensor, number: int) -> torch.Tensor:
    """The image of which this is the orientation."""
    return oriented(image.mT if number & 4 else image, number & 3)
