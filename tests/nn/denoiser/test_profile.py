"""Noise by scale, plane and brightness: white noise, blotches, noise that grows with the light, and its maps."""

import math

import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch.nn.denoiser.profile import KNOTS, NoiseProfile, profile_of_difference
from tests.pairwise import each_value

SCALES = NoiseProfile.SCALES


def noise_like(clean: torch.Tensor, seed: int = 0) -> torch.Tensor:
    return torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed), dtype=clean.dtype)


def grey(light: float, channels: int = 3) -> torch.Tensor:
    return torch.full((1, channels, 256, 256), light)


@pytest.mark.parametrize(("dtype", "channels"), each_value([torch.float32, torch.float64], [1, 2, 3]))
def test_white_noise_has_one_level(channels: int, dtype: torch.dtype) -> None:
    clean = grey(0.5, channels).to(dtype)
    profile = profile_of_difference(clean + 0.1 * noise_like(clean), clean)
    wanted = NoiseProfile.white(torch.tensor([0.1], dtype=dtype), channels=channels)
    torch.testing.assert_close(profile.levels, wanted.levels, rtol=0.12, atol=1e-6)
    torch.testing.assert_close(profile.level, wanted.level, rtol=0.01, atol=0)
    torch.testing.assert_close(profile.coarseness, wanted.coarseness, rtol=0.05, atol=0)
    torch.testing.assert_close(wanted.level, torch.tensor([0.1], dtype=dtype))
    assert profile.levels.dtype == dtype


def test_blotches_of_colour_are_coarse() -> None:
    """The same value in blocks of 4x4 pixels: levels grow up to that scale, by less for means across their borders."""
    clean = grey(0.5)
    blotches = F.interpolate(noise_like(clean[..., ::4, ::4]), scale_factor=4.0)
    blotches = 0.1 * (blotches - blotches.mean(1, keepdim=True))
    profile = profile_of_difference(clean + blotches, clean)
    assert float(profile.levels[:, :, 0].max()) < 1e-6
    ratios = profile.levels[0, :, 1, 2] / profile.levels[0, 0, 1, 2]
    torch.testing.assert_close(ratios, torch.tensor([1.0, 1.75, 3.0, 4.0, 4.0]), rtol=0.1, atol=0)
    assert float(profile.coarseness) == pytest.approx(3, rel=0.1)


def test_noise_that_grows_with_the_light() -> None:
    clean = torch.linspace(0, 1, 600).expand(1, 3, 400, 600)
    deviation = (0.004 * clean + 0.0004).sqrt()
    profile = profile_of_difference(clean + deviation * noise_like(clean), clean)
    wanted = (0.004 * torch.linspace(0, 1, KNOTS) + 0.0004).sqrt()
    torch.testing.assert_close(profile.levels[0, 0, 1], wanted, rtol=0.06, atol=0)
    at = profile.at(clean, scales=(1,))
    assert at.shape == (1, 2, 400, 600)
    assert float((at[:, 1] / deviation[:, 0] - 1).abs().mean()) < 0.03
    torch.testing.assert_close(at[:, 0] * 3**0.5, at[:, 1], rtol=0.1, atol=0)
    torch.testing.assert_close(profile.level, torch.tensor([0.0024**0.5]), rtol=0.05, atol=0)


def test_brightnesses_that_do_not_occur_take_the_nearest_level() -> None:
    clean = grey(0.4)
    profile = profile_of_difference(clean + 0.05 * noise_like(clean), clean)
    torch.testing.assert_close(profile.levels, profile.levels[..., 2:3].expand_as(profile.levels))


def test_maps_list_planes_within_scales() -> None:
    levels = torch.arange(20.0).view(2, 5, 2, 1).expand(-1, -1, -1, KNOTS)
    profile = NoiseProfile(levels, torch.tensor([0.3, 0.3]))
    image = torch.rand(2, 3, 5, 7, generator=torch.Generator().manual_seed(0))
    at = profile.at(image)
    assert at.shape == (2, 10, 5, 7)
    torch.testing.assert_close(at, torch.arange(20.0).view(2, 10, 1, 1).expand_as(at))
    torch.testing.assert_close(profile.at(image, scales=(4, 16))[1, :, 0, 0], torch.tensor([14.0, 15.0, 18.0, 19.0]))


def test_scaling_is_per_image() -> None:
    profile = NoiseProfile.white(torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(profile.scaled(0.5).level, torch.tensor([0.05, 0.1]))
    torch.testing.assert_close(profile.scaled(torch.tensor([0.0, 2.0])).level, torch.tensor([0.0, 0.4]))
    assert profile.scaled(0.0).coarseness.tolist() == [1, 1]


@pytest.mark.parametrize(("size", "channels"), each_value([(1, 1), (1, 20), (3, 2), (17, 9)], [1, 3]))
def test_small_pictures(size: tuple[int, int], channels: int) -> None:
    clean = torch.full((2, channels, *size), 1.5)
    profile = profile_of_difference(clean + 0.1, clean)
    assert bool(profile.levels.isfinite().all())
    area = math.prod(min(16, length) for length in size)
    torch.testing.assert_close(profile.levels[:, -1, 0], torch.full((2, KNOTS), 0.1 * area**0.5))
    assert bool(profile.at(clean).isfinite().all())


def test_images_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="clean must have the height and width of the noisy, 4x4, got 4x5; resize"):
        profile_of_difference(torch.rand(1, 3, 4, 4), torch.rand(1, 3, 4, 5))


def test_levels_are_finite_beside_a_pixel_of_1e20() -> None:
    clean = grey(0.5)
    noisy = clean.clone()
    noisy[..., 3, 5] = 1e20
    profile = profile_of_difference(noisy, clean)
    assert profile.levels.isfinite().all()
    assert profile.level > 1e3
