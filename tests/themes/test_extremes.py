"""Bandwidths, widths and images near the ends of the range of floating-point numbers."""

from typing import Any

import pytest
import torch

from nlfilter_torch import (
    diffusion_mask,
    estimate_bandwidth,
    nonlocal_operator,
)
from tests.problems import noise

IMAGE = noise(2, 3, 8, 9, dtype=torch.float32)
GREY = IMAGE[:, :1]
OPTIONS: dict[str, Any] = {"num_landmarks": 20, "photometric_bandwidth": 0.3}


def test_a_mask_of_no_width_is_one_on_its_region_alone() -> None:
    flat = torch.zeros(1, 1, 8, 9).index_fill(3, torch.tensor([2]), 1.0)
    mask = diffusion_mask(nonlocal_operator(flat, **OPTIONS).spectrum(), flat, width=1e-40)
    assert mask.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["photometric_bandwidth", "spatial_bandwidth"])
def test_bandwidths_under_which_features_overflow(name: str, dtype: torch.dtype) -> None:
    tiny = 1e-40 if dtype == torch.float32 else 1e-300
    with pytest.raises(ValueError, match=rf"^{name} must be at least ([^ ]+) for .+, got .+; raise it$") as caught:
        nonlocal_operator(GREY.to(dtype), **OPTIONS | {name: tiny})
    least = float(str(caught.value).split("at least ")[1].split()[0])
    operator = nonlocal_operator(GREY.to(dtype), **OPTIONS | {name: least})
    assert operator.factor.isfinite().all()
    assert (operator.row_sums() - 1).abs().max() < 1e-4


def test_the_same_of_a_batch_names_the_image_that_fails() -> None:
    bandwidths = torch.tensor([0.2, 1e-30])
    with pytest.raises(ValueError, match=r"^photometric_bandwidth must be at least .+, got 1e-30; raise it$"):
        nonlocal_operator(GREY, num_landmarks=20, photometric_bandwidth=bandwidths)


@pytest.mark.parametrize("scale", [1e20, 1e37, -1e20])
def test_automatic_bandwidth_of_huge_values(scale: float) -> None:
    guide = noise(1, 5, 12, 13, dtype=torch.float32)
    expected = estimate_bandwidth(guide)
    torch.testing.assert_close(estimate_bandwidth(guide * scale) / abs(scale), expected)
    operator = nonlocal_operator(guide * scale, num_landmarks=20)
    assert (operator.row_sums() - 1).abs().max() < 1e-4


def test_gradients_between_the_largest_values_do_not_overflow() -> None:
    stripes = torch.tensor([-3e38, -3e38, 3e38, 3e38]).expand(1, 1, 4, 4)
    assert estimate_bandwidth(stripes).isfinite().all()
