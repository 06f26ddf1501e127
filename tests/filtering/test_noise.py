"""Random fields have the levels of the noise that they probe."""

import torch

from nlfilter_torch import NoiseProfile, profile_of_difference
from nlfilter_torch.filtering.noise import drawn, is_noise_map, noise_map, sampled, variance_of
from tests.problems import noise, seeded


def test_maps_of_levels() -> None:
    image = noise(2, 3, 4, 5)
    levels = noise(2, 1, 4, 5, seed=1)
    assert is_noise_map(levels, (4, 5))
    assert not is_noise_map(torch.ones(2, 1, 1, 1), (4, 5))
    assert torch.equal(noise_map(levels, image), levels)
    variance = variance_of(torch.tensor([0.1, 0.2]), image)
    torch.testing.assert_close(variance[1], torch.full_like(variance[1], 0.04))
    field = drawn(levels, image, seeded())
    torch.testing.assert_close(field.abs(), levels.expand_as(image))
    volume = noise(1, 1, 3, 4, 5)
    assert noise_map(volume, volume).shape == volume.shape


def test_samples_are_normal_where_fields_are_signs() -> None:
    image = noise(1, 1, 128, 128)
    field = sampled(0.1, image, seeded())
    torch.testing.assert_close(field.std(), torch.tensor(0.1, dtype=field.dtype), rtol=0.02, atol=0)
    torch.testing.assert_close((field.abs() < 0.1).double().mean(), torch.tensor(0.6827).double(), rtol=0, atol=0.01)
    profile = NoiseProfile.white(torch.tensor([0.1]), channels=1)
    field = sampled(profile, image, seeded(1))
    torch.testing.assert_close(field.std(), torch.tensor(0.1, dtype=field.dtype), rtol=0.02, atol=0)
    probe = drawn(profile, image, seeded(1))
    torch.testing.assert_close(probe / field, (probe / field).mean().expand_as(field))
    torch.testing.assert_close(probe.square().mean(), variance_of(profile, image).mean().to(probe))


def test_drawn_noise_of_cameras_has_its_power_at_every_brightness() -> None:
    # Squared levels that fit badly: of smoothed and sharpened luminance, and of blotches of colour.
    squares = torch.tensor([[16.5, 46.5, 98.3, 184.4, 359.2], [6.9, 24.7, 78.9, 175.6, 254.3]]) / 255**2
    levels = squares.sqrt().mT[None, :, :, None] * torch.linspace(0.5, 1.5, 6)
    profile = NoiseProfile(levels, torch.tensor([0.5]))
    for light in (0.1, 0.9):
        image = torch.full((8, 3, 96, 96), light)
        field = sampled(profile, image, seeded(2))
        torch.testing.assert_close(field.square().mean(), variance_of(profile, image).mean(), rtol=0.05, atol=0)
    assert not sampled(profile.scaled(0.0), image, seeded()).any()
    assert not drawn(profile.scaled(0.0), image, seeded()).any()


def test_fields_of_a_profile_have_its_levels_at_every_scale() -> None:
    factors = torch.tensor([1.0, 1.5, 2.2, 2.6, 2.7])
    for channels in (1, 3):
        white = NoiseProfile.white(torch.tensor([0.05]), channels=channels)
        profile = NoiseProfile(white.levels * factors.view(1, -1, 1, 1), white.light)
        image = torch.full((1, channels, 256, 256), 0.5)
        field = drawn(profile, image, seeded(3))
        measured = profile_of_difference(image + field, image)
        assert torch.equal(field, drawn(profile, image, seeded(3)))
        planes = 1 if channels == 1 else 2
        ratios = (measured.levels / profile.levels)[0, :, :planes, 2:4]
        torch.testing.assert_close(ratios, torch.ones_like(ratios), rtol=0, atol=0.12)
        torch.testing.assert_close(variance_of(profile, image).mean().sqrt(), field.std(), rtol=0.05, atol=0)
