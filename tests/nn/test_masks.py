"""Layers that compute masks."""

import pytest
import torch

from nlfilter_torch import (
    DiffusionMask,
    NonlocalAffinity,
    SegmentMask,
    diffusion_map,
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_segments_are_hard_at_zero_temperature_and_soft_above(dtype: torch.dtype) -> None:
    spectrum = nonlocal_operator(picture("camera", 12, 13).to(dtype), **OPTIONS).spectrum()
    regions = noise(1, 3, 12, 13, seed=3, dtype=dtype)
    hard = segment_mask(spectrum, regions)
    assert set(hard.unique().tolist()) == {0.0, 1.0}
    assert torch.equal(segment_mask(spectrum, regions, temperature=1e-7).round(), hard)
    assert torch.equal(segment_mask(spectrum, regions, temperature=torch.tensor([0.0], dtype=dtype)).round(), hard)
    for temperature in (0.1, 1.0, 100.0):
        soft = segment_mask(spectrum, regions, temperature=temperature)
        torch.testing.assert_close(soft.sum(1), torch.ones_like(soft[:, 0]))
        assert torch.equal(soft.argmax(1), hard.argmax(1))
    torch.testing.assert_close(segment_mask(spectrum, regions, temperature=1e9), torch.full_like(hard, 1 / 3))


def test_soft_segments_are_the_softmax_of_diffusion_distances() -> None:
    spectrum = nonlocal_operator(picture("camera", 12, 13), **OPTIONS).spectrum()
    regions = noise(1, 3, 12, 13, seed=3)
    places = diffusion_map(spectrum, time=1.5).flatten(2)[0]  # (R, N), without the nearly constant eigenvector
    hard = segment_mask(spectrum, regions, time=1.5).flatten(2)[0]
    centres = places @ (hard / hard.sum(1, keepdim=True)).T
    squares = (places.unsqueeze(2) - centres.unsqueeze(1)).square().sum(0)
    expected = (-squares / 0.7).softmax(1).T.view(1, 3, 12, 13)
    torch.testing.assert_close(segment_mask(spectrum, regions, time=1.5, temperature=0.7), expected, atol=1e-4, rtol=0)


def test_segments_learn_time_and_temperature() -> None:
    spectrum = nonlocal_operator(picture("camera", 12, 13), **OPTIONS).spectrum()
    regions = noise(1, 2, 12, 13, seed=3)
    layer = SegmentMask(time=1.5, temperature=2.0, learn=("time", "temperature")).double()
    for gradient in backward(layer, spectrum, regions).values():
        assert gradient.isfinite()
        assert gradient != 0

    def masks(time: torch.Tensor, temperature: torch.Tensor) -> torch.Tensor:
        return segment_mask(spectrum, regions, time=time, temperature=temperature)

    values = tuple(torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (1.2, 0.8))
    assert torch.autograd.gradcheck(masks, values)
    with pytest.raises(ValueError, match=r"temperature must be positive to learn it or the time, .*, got 0; start"):
        SegmentMask(learn="temperature")
    with pytest.raises(ValueError, match=r"temperature must be at least 0"):
        SegmentMask(temperature=-1.0)
