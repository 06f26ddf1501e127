"""Guides and operators that the tests share: seeded noise, photographs, and any guide at all for hypothesis."""

import torch
from hypothesis import strategies as st

from nlfilter_torch import NonlocalOperator, nonlocal_operator
from tests.images import photograph

SAMPLINGS = ("kmeans", "uniform", "random")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(shape, generator=seeded(seed), dtype=torch.float64).to(dtype)


def picture(name: str, height: int, width: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.from_numpy(photograph(name, height, width).copy()).to(dtype)[None, None]


@st.composite
def guides(draw: st.DrawFn, max_side: int = 12) -> torch.Tensor:
    """Random guides of every shape, as small as one pixel, of any contrast."""
    batch, channels = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    height, width = draw(st.integers(1, max_side)), draw(st.integers(1, max_side))
    contrast = draw(st.sampled_from([0.0, 1e-3, 0.1, 1.0]))
    levels = draw(st.sampled_from([2, 5, 1000]))  # few levels make many pixels alike
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
    """An operator, with as many landmarks as there are pixels at most."""
    count = min(int(str(kwargs.pop("num_landmarks", 100))), guide.shape[-2] * guide.shape[-1])
    return nonlocal_operator(guide, num_landmarks=count, generator=seeded(), **kwargs)  # type: ignore[arg-type]
