"""Layers that compute masks."""

import pytest
import torch

from nlfilter_torch import (
    DiffusionMask,
    NonlocalAffinity,
    SegmentMask,
    diffusion_mask,
    nonlocal_operator,
    segment_mask,
)
from tests.layers import OPTIONS, backward, everything, image
from tests.problems import noise, picture


def test_masks_are_the_functions() -> None:
    spectrum = nonlocal_operator(picture("camera", 12, 13), **OPTIONS).spectrum()
    region = noise(1, 2, 12, 13, seed=3)
    torch.testing.assert_close(
        DiffusionMask(time=2.0, width=10.0)(spectrum, region), diffusion_mask(spectrum, region, time=2.0, width=10.0)
    )
    torch.testing.assert_close(SegmentMask(time=2.0)(spectrum, region), segment_mask(spectrum, region, time=2.0))


LEARNED = ("photometric_bandwidth", "spatial_bandwidth")


def test_mask_learns_time_and_width() -> None:
    spectrum = nonlocal_operator(image(), **OPTIONS).spectrum()
    region = noise(2, 1, 12, 13, dtype=torch.float32)
    layer = DiffusionMask(time=1.5, width=6.0, learn=("time", "width"))
    torch.testing.assert_close(layer(spectrum, region), diffusion_mask(spectrum, region, time=1.5, width=6.0))
    for gradient in backward(layer, spectrum, region).values():
        assert gradient.isfinite()
        assert gradient != 0


def test_learned_weights_and_widths_need_a_layer_that_learns_them() -> None:
    affinity = everything().affinity
    fixed = NonlocalAffinity(learn=LEARNED, spatial_bandwidth=9.0, photometric_bandwidth=0.2)
    with pytest.raises(RuntimeError, match=r"patch_weights must be learned .* add 'patch_weights' to learn when"):
        fixed.load_state_dict(affinity.state_dict())
    with pytest.raises(RuntimeError, match=r"width must be learned .* add 'width' to learn and pass width=4 when"):
        DiffusionMask().load_state_dict(DiffusionMask(learn="width").state_dict())
