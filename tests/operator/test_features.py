"""Guide to features: patch weights, borders, channels, coordinates, and the automatic bandwidth."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch import (
    estimate_bandwidth,
    nonlocal_operator,
)
from nlfilter_torch.operator.features import GuideFeatures, pad_border, patch_window, reduce_channels
from tests import reference
from tests.images import photograph
from tests.pairwise import pairwise
from tests.problems import picture

SIZES = [(1, 1), (1, 7), (7, 1), (2, 2), (3, 3), (4, 9), (12, 10)]


def random_guide(channels: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((channels, height, width))


def test_window_is_the_reference_window() -> None:
    for size in [1, 3, 5, 7, 11]:
        np.testing.assert_allclose(patch_window(size), reference.patch_weights(size), rtol=1e-14)


@pytest.mark.parametrize(("size", "patch_size", "h_x"), pairwise(SIZES, [1, 3, 5, 7], [None, 2.5, (2.5, 4.0)]))
def test_features_are_the_reference_features(
    size: tuple[int, int], patch_size: int, h_x: float | tuple[float, float] | None
) -> None:
    guides = np.stack([random_guide(2, *size, seed) for seed in (0, 1)])
    result = GuideFeatures(patch_window(patch_size), 0.1, h_x, "all")(torch.from_numpy(guides))
    expected = [reference.features(guide, patch_size, 0.1, h_x).T for guide in guides]
    np.testing.assert_allclose(result, np.stack(expected), rtol=1e-12)


@given(height=st.integers(1, 9), width=st.integers(1, 9), margin=st.integers(0, 5))
def test_borders_are_the_reference_borders(height: int, width: int, margin: int) -> None:
    image = random_guide(1, height, width)
    padded = pad_border(torch.from_numpy(image)[None], margin)[0, 0]
    np.testing.assert_array_equal(padded, reference.pad(image[0], margin))


def test_every_image_of_a_batch_has_its_own_bandwidths() -> None:
    guides = torch.from_numpy(random_guide(2, 6, 5)).unsqueeze(1)  # (2, 1, 6, 5)
    h_y, h_x = torch.tensor([0.1, 0.3]), torch.tensor([2.0, 5.0])
    together = GuideFeatures(patch_window(3), h_y, h_x, "all")(guides)
    for i in range(2):
        alone = reference.features(guides[i].numpy(), 3, h_y[i].item(), h_x[i].item()).T
        np.testing.assert_allclose(together[i], alone, rtol=1e-6)
    wide = GuideFeatures(patch_window(3), h_y, (h_x, 4.0), "all")(guides)
    for i in range(2):
        alone = reference.features(guides[i].numpy(), 3, h_y[i].item(), (h_x[i].item(), 4.0)).T
        np.testing.assert_allclose(wide[i], alone, rtol=1e-6)


@pytest.mark.parametrize("patch_size", [1, 3, 7])
def test_a_bandwidth_is_a_difference_in_grey_whatever_the_patch(patch_size: int) -> None:
    guide = torch.zeros(1, 1, 20, 40, dtype=torch.float64)
    guide[..., 20:] = 0.2
    x = GuideFeatures(patch_window(patch_size), 0.2, None, "all")(guide)
    assert (x[0, :, 0] - x[0, :, 39]).square().sum().item() == pytest.approx(1)


def test_three_channels_are_reduced_to_luminance_and_others_taken_whole() -> None:
    rgb = torch.from_numpy(random_guide(3, 4, 5))[None]
    weights = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64).view(1, 3, 1, 1)
    torch.testing.assert_close(reduce_channels(rgb, "luminance"), (rgb * weights).sum(1, keepdim=True))
    assert reduce_channels(rgb, "all") is rgb
    for channels in (1, 2, 4):
        guide = torch.rand(1, channels, 4, 5, generator=torch.Generator().manual_seed(0))
        assert reduce_channels(guide, "luminance") is guide


def test_strides_do_not_matter() -> None:
    guide = torch.from_numpy(random_guide(2, 8, 9))[None]
    strided = guide.permute(0, 3, 2, 1).contiguous().permute(0, 3, 2, 1)
    assert not strided.is_contiguous()
    features = GuideFeatures(patch_window(5), 0.1, None, "all")
    for g in (strided, guide.flip(-1).flip(-1), torch.stack([guide, guide], dim=-1)[..., 0]):
        torch.testing.assert_close(features(g), features(guide), atol=0, rtol=0)


# --- the automatic bandwidth, eq. 20


@pytest.mark.parametrize("name", ["camera", "coffee"])
def test_bandwidth_is_two_and_a_half_mean_gradients(name: str) -> None:
    image = photograph(name, 60, 80)
    padded = np.pad(image, 1, mode="edge")
    vertical, horizontal = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2, (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    expected = 2.5 * np.hypot(vertical, horizontal).mean()
    result = estimate_bandwidth(torch.from_numpy(image.copy())[None, None])
    assert result.shape == (1,)
    assert result.item() == pytest.approx(expected, rel=1e-6)


@given(scale=st.floats(0.1, 10), offset=st.floats(-1, 1))
def test_bandwidth_scales_with_contrast_and_ignores_brightness(scale: float, offset: float) -> None:
    guide = torch.from_numpy(photograph("camera", 30, 40).copy())[None, None]
    torch.testing.assert_close(estimate_bandwidth(scale * guide + offset), scale * estimate_bandwidth(guide))


def test_bandwidth_of_a_flat_image_is_a_grey_level() -> None:
    assert estimate_bandwidth(torch.full((1, 1, 5, 5), 0.3)).item() == pytest.approx(1 / 255)
    assert estimate_bandwidth(torch.rand(1, 1, 1, 1, generator=torch.Generator())).item() == pytest.approx(1 / 255)


def test_bandwidth_of_a_batch_is_that_of_each_image() -> None:
    guides = torch.from_numpy(random_guide(3, 20, 21))[:, None]
    torch.testing.assert_close(estimate_bandwidth(guides), torch.cat([estimate_bandwidth(g[None]) for g in guides]))


def test_a_strided_guide_takes_patches_of_the_whole_one() -> None:
    image = picture("camera", 41, 50)
    recipe = nonlocal_operator(image, spatial_bandwidth=7.0).kernel.recipe
    whole = recipe(image).unflatten(2, (41, 50))
    strided = recipe(image, stride=3).unflatten(2, (13, 16))
    torch.testing.assert_close(strided[:, :-2], whole[:, :-2, 1::3, 1::3][..., :13, :16], atol=0, rtol=0)
    torch.testing.assert_close(strided[:, -2:], whole[:, -2:, ::3, ::3][..., :13, :16], atol=1e-12, rtol=0)
