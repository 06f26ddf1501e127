"""Abstraction: power, tones, lines, and pixels unlike all others."""

import pytest
import torch

from nlfilter_torch import nonlocal_operator, spectral_filter
from nlfilter_torch.photo import abstract
from nlfilter_torch.photo.declared.parameters import ABSTRACT
from tests.problems import colour, luminance


def test_abstraction_fades_with_its_power() -> None:
    image = colour("chelsea", 48, 72)
    torch.testing.assert_close(abstract(image, power=0.0), image, atol=1e-5, rtol=0)
    changes = [float((abstract(image, power=p) - image).square().mean().sqrt()) for p in (1e-5, 1e-3, 0.3, 1.0, 2.5)]
    assert changes == sorted(changes)
    assert changes[0] < 1e-4
    assert changes[2] > 0.01


def test_what_is_like_nothing_else_is_not_blackened() -> None:
    """A border that few landmarks represent keeps values between those of its two sides, which are unchanged."""
    image = torch.full((1, 1, 40, 60), 0.4)
    image[..., 30:] = 0.9
    image[..., 29] = 0.65
    edited = abstract(image, num_landmarks=100)
    torch.testing.assert_close(edited[..., 29], image[..., 29], atol=0.01, rtol=0)
    assert edited.min() > 0.34
    assert edited.max() < 0.98


def test_tones_and_lines() -> None:
    image = colour("chelsea", 48, 72)
    plain, toned, lined = abstract(image), abstract(image, tones=4), abstract(image, edges=1.0)

    def near_a_tone(picture: torch.Tensor) -> float:
        """Return the share of pixels close to one of the tones, which are the midpoints of thirds."""
        return float(((luminance(picture) * 3 - 0.5).frac().sub(0.5).abs() > 0.4).float().mean())

    assert near_a_tone(toned) > 2 * near_a_tone(plain)
    assert (luminance(lined) <= luminance(plain) + 1e-5).all()
    assert (luminance(lined) < 0.5 * luminance(plain)).float().mean() > 0.02
    torch.testing.assert_close(abstract(image, edges=0.5) + 0, (plain + lined) / 2, atol=0.1, rtol=0)
    grey = abstract(luminance(image), tones=4, edges=1.0)
    assert grey.shape == (1, 1, 48, 72)


def test_flat_images_leave_the_gradient_of_a_batch_alone() -> None:
    image = torch.cat([colour("chelsea", 16, 16), torch.full((1, 3, 16, 16), 0.5)])
    power = torch.tensor(0.1, requires_grad=True)
    abstract(image, power=power, tones=4, num_landmarks=20).sum().backward()
    assert power.grad is not None
    assert power.grad.isfinite()
    assert power.grad != 0


def test_channels_of_the_guide_can_be_chosen() -> None:
    image = colour("chelsea", 24, 32)
    edited = [abstract(image, num_landmarks=20, guide_channels=channels) for channels in ("all", "luminance")]
    torch.testing.assert_close(edited[0], abstract(image, num_landmarks=20), rtol=0, atol=0)
    assert not torch.equal(edited[0], edited[1])


@pytest.mark.parametrize("power", [0.05, 0.3, 1.0, 2.5])
def test_the_picture_is_that_of_a_power_of_the_filter(power: float) -> None:
    image = colour("coffee", 60, 80)
    operator = nonlocal_operator(
        image,
        photometric_bandwidth="auto",
        spatial_bandwidth=ABSTRACT["spatial_bandwidth"].distance(None, (60, 80)),
        patch_size=3,
        num_landmarks=200,
        guide_channels="all",
    )
    wanted = spectral_filter(operator, image, lambda values: values**power)
    torch.testing.assert_close(abstract(image, power=power), wanted, atol=1 / 255, rtol=0)
    powers = torch.tensor([power, 0.5])
    both = abstract(image.expand(2, -1, -1, -1), power=powers)
    torch.testing.assert_close(both[:1], wanted, atol=1 / 255, rtol=0)


def test_no_pixel_leaves_the_range_of_the_picture() -> None:
    for name in ("rocket", "coffee", "astronaut"):
        image = colour(name, 96, 120)
        edited = abstract(image, photometric_bandwidth=10 / 255)
        assert edited.min() > image.min() - 1 / 255
        assert edited.max() < image.max() + 1 / 255
        assert not bool((edited < image - 50 / 255).any())
