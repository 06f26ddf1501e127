"""Estimates of the noise of a photograph: growing with the light, in the dark, beside texture and clipped."""

import pytest
import torch

from nlfilter_torch import estimate_noise
from nlfilter_torch.nn.denoiser.noise import Noise
from nlfilter_torch.photo import denoise
from nlfilter_torch.photo.edits.noise import noise_of
from nlfilter_torch.photo.picture.in_memory import InMemory
from tests.pairwise import each_value
from tests.problems import colour, decibels, noisy, picture

CAT = colour("chelsea", 96, 128)


def test_noise_that_grows_with_the_light_is_found() -> None:
    ramp = torch.linspace(0.1, 0.9, 200).expand(1, 3, 160, 200)
    gain, floor = 0.004, (3 / 255) ** 2
    image = noisy(ramp, (gain * ramp + floor).sqrt())
    noise = noise_of(InMemory(image))
    torch.testing.assert_close(noise.gain, torch.tensor([gain]), rtol=0.1, atol=0)
    wanted = (gain * ramp + floor).sqrt()
    assert (noise.at(image) / wanted - 1).abs().mean() < 0.06
    even = noise_of(InMemory(noisy(ramp, 0.04)))
    assert even.gain == 0
    torch.testing.assert_close(even.level, torch.tensor([0.04]), rtol=0.04, atol=0)


def test_noise_is_not_that_of_the_dark() -> None:
    """A bright disc on black: the flattest windows are black, and their noise is not that of the disc."""
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, 200), torch.linspace(-1, 1, 200), indexing="ij")
    radius = (rows.square() + columns.square()).sqrt()
    clean = torch.where(radius < 0.85, 0.6 - 0.25 * radius, 0.0)[None, None]
    image = noisy(clean, (0.01 * clean + (2 / 255) ** 2).sqrt())
    noise = noise_of(InMemory(image))
    torch.testing.assert_close(noise.gain, torch.tensor([0.01]), rtol=0.15, atol=0)
    assert decibels(denoise(image), clean) > decibels(denoise(image, noise_level=noise.level), clean)


@pytest.mark.parametrize("level", [5, 15, 25, 50])
def test_noise_is_found_beside_texture(level: int) -> None:
    """Half of the picture is gravel, whose finest detail is as strong as noise of 20 grey levels."""
    gravel = picture("gravel", 160, 160, torch.float32)
    clean = torch.cat([gravel, torch.linspace(0.3, 0.7, 160).expand(1, 1, 160, 160)], dim=3)
    result = 255 * estimate_noise(noisy(clean, level / 255))
    assert float(result) == pytest.approx(level, rel=0.1)


def test_clipped_pixels_do_not_hide_noise() -> None:
    clean = torch.ones(1, 1, 120, 160)
    clean[..., 60:] = 0.5
    assert float(estimate_noise(noisy(clean, 0.08).clamp(0, 1))) == pytest.approx(0.08, rel=0.1)


@pytest.mark.parametrize(("level", "name"), each_value([15, 30, 50], ["astronaut", "coffee"]))
def test_noise_in_8_bits_is_measured_where_clipping_does_not_truncate_it(name: str, level: int) -> None:
    """Both photographs have large dark areas; in 8 bits, 9 to 15 % of the noisy pixels are black or white."""
    result = 255 * estimate_noise(
        (noisy(picture(name, 160, 160, torch.float32), level / 255).clamp(0, 1) * 255).round() / 255
    )
    assert float(result) == pytest.approx(level, rel=0.1)


def test_even_noise_has_one_level() -> None:
    noise = Noise.even(torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(noise.level, torch.tensor([0.1, 0.2]))
    torch.testing.assert_close(noise.at(CAT.expand(2, -1, -1, -1)).mean((1, 2, 3)), torch.tensor([0.1, 0.2]))
