"""The layers: results equal to those of the functions, and parameters that can be saved, moved and learned."""

import copy

import pytest
import torch
from torch import nn

from nlfilter_torch import (
    DiffusionMask,
    Look,
    NonlocalAffinity,
    NonlocalFilter,
    PolynomialSliders,
    SegmentMask,
    detail_layers,
    diffusion_mask,
    nonlocal_operator,
    polynomial_filter,
    segment_mask,
)
from tests.problems import noise, picture

ALPHA = (3.0, 0.5, 4.0, 1.05)
OPTIONS = {"photometric_bandwidth": 0.2, "num_landmarks": 20}


def image(*, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return noise(2, 3, 12, 13, dtype=dtype)


@pytest.mark.parametrize("residual", [None, 0.0, 1.0])
def test_filter_is_the_function(residual: float | None) -> None:
    layer = NonlocalFilter(ALPHA, residual=residual, **OPTIONS)
    expected = polynomial_filter(nonlocal_operator(image(), **OPTIONS), image(), torch.tensor(ALPHA), residual=residual)
    torch.testing.assert_close(layer(image()), expected, atol=0, rtol=0)


@pytest.mark.parametrize("channels", [1, 2, 5])
@pytest.mark.parametrize("guide_channels", [1, 2, 3])
def test_guide_may_be_another_picture(channels: int, guide_channels: int) -> None:
    guide, picture_ = noise(2, guide_channels, 12, 13, seed=1), noise(2, channels, 12, 13)
    found = NonlocalFilter(ALPHA, **OPTIONS)(picture_, guide=guide)
    expected = polynomial_filter(nonlocal_operator(guide, **OPTIONS), picture_, torch.tensor(ALPHA))
    torch.testing.assert_close(found, expected)


def test_mask_blends() -> None:
    layer, mask = NonlocalFilter(ALPHA, **OPTIONS), noise(2, 1, 12, 13, seed=2, dtype=torch.float32)
    filtered = layer(image())
    expected = image() + mask * (filtered - image())
    torch.testing.assert_close(layer(image(), mask=mask), expected)
    torch.testing.assert_close(layer(image(), mask=torch.zeros_like(mask)), image(), atol=0, rtol=0)
    torch.testing.assert_close(layer(image(), mask=torch.ones_like(mask)), filtered)


def test_affinity_and_sliders_are_the_parts_of_the_filter() -> None:
    affinity, sliders = NonlocalAffinity(**OPTIONS), PolynomialSliders(ALPHA)
    operator = affinity(image())
    expected = NonlocalFilter(ALPHA, **OPTIONS)(image())
    torch.testing.assert_close(sliders(operator, image()), expected)
    torch.testing.assert_close(sliders.combine(detail_layers(operator, image())), expected)


def test_masks_are_the_functions() -> None:
    spectrum = nonlocal_operator(picture("camera", 12, 13), **OPTIONS).spectrum()
    region = noise(1, 2, 12, 13, seed=3)
    torch.testing.assert_close(
        DiffusionMask(time=2.0, width=10.0)(spectrum, region), diffusion_mask(spectrum, region, time=2.0, width=10.0)
    )
    torch.testing.assert_close(SegmentMask(time=2.0)(spectrum, region), segment_mask(spectrum, region, time=2.0))


def test_ones_are_the_identity() -> None:
    torch.testing.assert_close(NonlocalFilter(**OPTIONS)(image()), image(), atol=1e-5, rtol=0)


def test_alpha_is_the_parameter_and_is_saved() -> None:
    layer = NonlocalFilter(ALPHA, **OPTIONS)
    assert [tuple(p.shape) for p in layer.parameters()] == [(4,)]
    assert next(layer.parameters()) is layer.alpha
    other = NonlocalFilter((1, 1, 1, 1), **OPTIONS)
    other.load_state_dict(layer.state_dict())
    torch.testing.assert_close(other(image()), layer(image()), atol=0, rtol=0)
    torch.testing.assert_close(copy.deepcopy(layer)(image()), layer(image()), atol=0, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_layer_converts_and_images_keep_their_dtype(dtype: torch.dtype) -> None:
    layer = NonlocalFilter(ALPHA, **OPTIONS).to(dtype)
    assert layer.sliders.alpha.dtype == dtype
    filtered = layer(image(dtype=dtype))
    assert filtered.dtype == dtype
    assert filtered.isfinite().all()
    assert layer(image()).dtype == torch.float32


def test_every_option_is_shown() -> None:
    layer = NonlocalFilter(ALPHA, patch_size=3, landmarks="uniform", spatial_bandwidth=7.5, **OPTIONS)
    text = repr(layer)
    for part in ("3.0, 0.5, 4.0, 1.05", "patch_size=3", "'uniform'", "spatial_bandwidth=7.5", "num_landmarks=20"):
        assert part in text
    assert "time=2.5" in repr(DiffusionMask(time=2.5))
    assert "time=2.5" in repr(SegmentMask(time=2.5))


def test_layer_is_part_of_a_network_that_learns() -> None:
    clean = picture("camera", 24, 26, torch.float32)
    target = polynomial_filter(nonlocal_operator(clean, **OPTIONS), clean, torch.tensor([2.0, 1.5, 1.0, 1.0]))
    layer = NonlocalFilter(**OPTIONS)
    optimizer = torch.optim.Adam(layer.parameters(), lr=0.05)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = (layer(clean) - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 20


def test_gradients_reach_the_network_before_the_layer() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Conv2d(3, 4, 3, padding=1)
    layer = NonlocalFilter(ALPHA, guide_channels="all", **OPTIONS)
    layer(image(), guide=network(image())).square().mean().backward()
    for parameter in [*network.parameters(), *layer.parameters()]:
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all()
    assert network.weight.grad.abs().max() > 0
    assert layer.sliders.alpha.grad.abs().min() > 0


def test_modules_without_values_can_be_printed() -> None:
    with torch.device("meta"):
        layer = NonlocalFilter(learn=("alpha", "photometric_bandwidth"), photometric_bandwidth=0.1)
    assert "alpha=(4,) without values" in repr(layer)


def test_an_unknown_option_of_a_look_is_refused() -> None:
    with pytest.raises(TypeError, match="num_landmark"):
        Look(num_landmark=3)


def test_patch_weights_that_need_a_gradient_are_constants_of_the_layer() -> None:
    layer = NonlocalFilter(patch_weights=torch.ones(3, 3, requires_grad=True), photometric_bandwidth=0.3)
    image = noise(1, 1, 12, 12, dtype=torch.float32).requires_grad_()
    for _ in range(2):
        copy.deepcopy(layer)(image).sum().backward()
    assert image.grad is not None
