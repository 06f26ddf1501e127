"""Filters fitted to one image and applied to others."""

import pytest
import torch

from nlfilter_torch import detail_layers, fit_filter, nonlocal_operator, polynomial_filter
from tests.problems import build, noise, picture

ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.05], dtype=torch.float64)


@pytest.mark.parametrize("completion", ["diagonal", "none"])
@pytest.mark.parametrize("spatial_bandwidth", [None, 10.0])
def test_on_its_own_image_it_is_the_filter(completion: str, spatial_bandwidth: float | None) -> None:
    guide, image = picture("coffee", 24, 26), noise(1, 2, 24, 26)
    operator = build(
        guide,
        num_landmarks=60,
        photometric_bandwidth=0.2 if completion == "diagonal" else 0.6,
        spatial_bandwidth=spatial_bandwidth,
        completion=completion,
    )
    fitted = fit_filter(operator, image, order=4)
    torch.testing.assert_close(fitted.layers(image, guide), detail_layers(operator, image, order=4), atol=1e-7, rtol=0)
    alpha = torch.tensor([2.0, 0.5, 3.0, 1.0, 1.1], dtype=torch.float64)
    for residual in (None, 0.0, 1.0):
        result, expected = (
            fitted(image, alpha, guide, residual=residual),
            polynomial_filter(operator, image, alpha, residual=residual),
        )
        torch.testing.assert_close(result, expected, atol=1e-6, rtol=0)


def test_a_tile_is_a_part_of_the_whole() -> None:
    """The tile has a margin of half a patch, whose border is padded."""
    image = picture("astronaut", 40, 44)
    operator = build(image, num_landmarks=60, photometric_bandwidth=0.2, spatial_bandwidth=15.0)
    fitted, whole = fit_filter(operator, image), detail_layers(operator, image)
    tile = fitted.layers(image[..., 10:30, 8:40], origin=(10, 8))
    torch.testing.assert_close(tile[..., 2:-2, 2:-2], whole[..., 12:28, 10:38], atol=1e-7, rtol=0)


def test_equal_patches_are_edited_equally_whatever_is_around() -> None:
    image = picture("astronaut", 40, 44)
    fitted = fit_filter(build(image, num_landmarks=60, photometric_bandwidth=0.2), image)
    other = noise(1, 1, 30, 30)
    other[..., 5:25, 5:25] = image[..., 10:30, 12:32]
    result = fitted(other, ALPHA)[..., 7:23, 7:23]
    torch.testing.assert_close(result, fitted(image, ALPHA)[..., 12:28, 14:30], atol=1e-9, rtol=0)


def test_what_the_references_do_not_show_stays() -> None:
    dark = 0.1 + 0.05 * noise(1, 1, 20, 20)
    fitted = fit_filter(build(dark, num_landmarks=40, photometric_bandwidth=0.02), dark)
    bright = 0.8 + 0.1 * noise(1, 1, 20, 20, seed=1)
    torch.testing.assert_close(fitted(bright, ALPHA.new_tensor([3.0, 1.0, 1.0, 1.0])), bright, atol=1e-6, rtol=0)


def test_layers_of_frames_sum_to_them_in_their_dtype() -> None:
    image = picture("coffee", 24, 26)
    fitted = fit_filter(build(image, num_landmarks=40), image)
    for dtype in (torch.float16, torch.float32, torch.float64):
        frames = noise(3, 1, 20, 30, dtype=dtype)
        layers = fitted.layers(frames)
        assert layers.dtype == dtype
        tolerance = 5e-3 if dtype == torch.float16 else 1e-5
        torch.testing.assert_close(layers.sum(1), frames, atol=tolerance, rtol=0)


def test_gradients_reach_frame_and_reference() -> None:
    reference, frame = noise(1, 1, 6, 7).requires_grad_(), noise(2, 1, 5, 6, seed=1).requires_grad_()

    def way(reference: torch.Tensor, frame: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        operator = nonlocal_operator(reference, photometric_bandwidth=0.5, num_landmarks=8, landmarks="uniform")
        return fit_filter(operator, reference)(frame, alpha, residual=0.5)

    assert torch.autograd.gradcheck(way, (reference, frame, ALPHA.clone().requires_grad_()), fast_mode=True)


def test_bad_fits_and_frames() -> None:
    image = noise(1, 1, 12, 13)
    operator = build(image, num_landmarks=20)
    with pytest.raises(ValueError, match=r"image and operator must have batch size 1, got 2 and 1"):
        fit_filter(operator, image.expand(2, -1, -1, -1))
    with pytest.raises(ValueError, match="order must be at least 1, got 0"):
        fit_filter(operator, image, order=0)
    fitted = fit_filter(operator, image)
    with pytest.raises(ValueError, match=r"image must have 1 channel\(s\), got 3"):
        fitted.layers(noise(1, 3, 9, 9))
    with pytest.raises(ValueError, match="guide must have the height and width of the image, 9x9, got 8x9"):
        fitted.layers(noise(1, 1, 9, 9), noise(1, 1, 8, 9))
    with pytest.raises(ValueError, match="alpha must have one entry per layer, 4, got 3"):
        fitted(image, ALPHA[:3])
