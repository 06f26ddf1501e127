"""Denoising: photographs come closer to the originals, and noise is estimated."""

import pytest
import torch

from nlfilter_torch import NoiseProfile, denoise, estimate_noise
from tests.problems import colour


@pytest.mark.parametrize("level", [10, 25])
def test_denoising_brings_the_photograph_closer(level: int) -> None:
    clean = colour("chelsea", 64, 96)
    noisy = clean + level / 255 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    for noise_level in (level / 255, None):
        gain = 10 * torch.log10(
            (noisy - clean).square().mean() / (denoise(noisy, noise_level=noise_level) - clean).square().mean()
        )
        assert gain > (2.0 if level == 10 else 5.0)


def test_no_noise_means_no_change() -> None:
    image = colour("coffee", 32, 48)
    assert torch.equal(denoise(image, noise_level=0.0), image)
    flat = torch.full((1, 1, 20, 20), 0.5)
    assert torch.equal(denoise(flat), flat)
    denoised = denoise(torch.cat([image, image]), noise_level=torch.tensor([0.0, 0.1]))
    assert torch.equal(denoised[:1], image)
    assert not torch.equal(denoised[1:], image)


def test_noise_is_estimated() -> None:
    level = 15 / 255
    noisy = 0.5 + level * torch.randn(2, 3, 80, 80, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(estimate_noise(noisy), torch.full((2,), level), atol=0.003, rtol=0)
    ramp = torch.linspace(0, 1, 80).expand(1, 1, 80, 80) + torch.linspace(0, 1, 80).unsqueeze(1)
    assert estimate_noise(ramp).item() < 1e-6
    assert estimate_noise(torch.rand(1, 1, 2, 2, generator=torch.Generator().manual_seed(0))).item() == 0


def test_images_of_a_batch_that_differ_in_rank_are_denoised_as_alone() -> None:
    images = torch.cat([colour("rocket", 32, 32), colour("astronaut", 32, 32)]).double()
    both = denoise(images, noise_level=4 / 255)
    for i in range(2):
        torch.testing.assert_close(both[i : i + 1], denoise(images[i : i + 1], noise_level=4 / 255), atol=1e-6, rtol=0)


def test_noise_may_be_told_as_a_profile() -> None:
    image = colour("rocket", 48, 64)
    noisy = image + 0.05 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    white = NoiseProfile.white(torch.tensor([0.05]))
    torch.testing.assert_close(denoise(noisy, noise_level=white), denoise(noisy, noise_level=0.05), atol=1e-5, rtol=0)
    assert torch.equal(denoise(noisy, noise_level=white.scaled(0.0)), noisy)
    with pytest.raises(ValueError, match="noise_level must be the profile of 1 or 1 images, got 2; select"):
        denoise(noisy, noise_level=NoiseProfile.white(torch.tensor([0.05, 0.1])))
