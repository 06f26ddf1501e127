"""Denoising: photographs come closer to the originals, and noise is estimated."""

from typing import Any, Literal

import numpy as np
import pytest
import torch

from nlfilter_torch import NoiseProfile, estimate_noise
from nlfilter_torch.photo import denoise, stream
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.picture.colour import split_luminance
from tests.problems import colour
from tests.rounding import denoiser_rounding


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


@pytest.mark.parametrize("method", ["network", "rule"])
@pytest.mark.parametrize("scale", [1.0, 1 / 64], ids=["usual", "faint"])
def test_brightness_and_colour_have_strengths_of_their_own(method: Literal["network", "rule"], scale: float) -> None:
    draw = torch.Generator().manual_seed(0)
    noisy = colour("chelsea", 40, 56) + 0.08 * torch.randn(1, 3, 40, 56, generator=draw)
    noisy[..., 20, 30] = torch.tensor([3.0, 0.0, 0.0])  # a hot pixel
    noisy = noisy * scale
    whole = denoise(noisy, method=method, num_landmarks=40)
    before, after = split_luminance(noisy), split_luminance(whole)
    assert min(float((a - b).abs().mean()) for a, b in zip(before, after, strict=True)) > 0.01 * scale
    grain, still = (
        split_luminance(denoise(noisy, method=method, num_landmarks=40, brightness=brightness, colour=1 - brightness))
        for brightness in (0.0, 1.0)
    )
    torch.testing.assert_close(grain[0], before[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(still[1], before[1], atol=1e-6, rtol=0)
    assert torch.equal(denoise(noisy, method=method, num_landmarks=40, brightness=0.0, colour=0.0), noisy)
    assert torch.equal(denoise(noisy, method=method, num_landmarks=40, brightness=1, colour=1.0), whole)
    if scale == 1:
        torch.testing.assert_close((grain[1], still[0]), (after[1], after[0]), atol=1e-6, rtol=0)
        half = denoise(noisy, method=method, num_landmarks=40, brightness=0.5, colour=torch.tensor([0.5]))
        torch.testing.assert_close(half, (noisy + whole) / 2, atol=1e-6, rtol=0)


def test_shares_of_noise_in_steps_and_for_each_image() -> None:
    noisy = colour("rocket", 32, 40) + 0.06 * torch.randn(2, 3, 32, 40, generator=torch.Generator().manual_seed(0))
    both = denoise(noisy, noise_level=0.06, brightness=torch.tensor([0.0, 1.0]))
    alone = denoise(noisy[:1], noise_level=0.06, brightness=0.0)
    torch.testing.assert_close(both[:1], alone, atol=denoiser_rounding(0.06), rtol=0)
    torch.testing.assert_close(both[1:], denoise(noisy[1:], noise_level=0.06), atol=denoiser_rounding(0.06), rtol=0)
    step = Step("denoise", noise_level=0.06 * 255, brightness=0.0)
    torch.testing.assert_close(apply_step(step, noisy[:1]), alone, atol=1e-6, rtol=0)
    assert step.changes()
    assert not step.changed(colour=0.0).changes()
    grey = noisy[:, :1]
    assert torch.equal(denoise(grey, brightness=0.0), grey)
    torch.testing.assert_close(denoise(grey, colour=0.3), denoise(grey), atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match="brightness must be in"):
        denoise(noisy, brightness=1.5)


def finest(noise: torch.Tensor) -> torch.Tensor:
    """What differs from the mean of the 3x3 pixels around it in the luminance of noise, but in the outermost pixels."""
    luminance = split_luminance(noise)[0]
    return luminance[..., 1:-1, 1:-1] - luminance.unfold(2, 3, 1).unfold(3, 3, 1).mean((-2, -1))


def grainy(level: float, height: int = 40, width: int = 56) -> torch.Tensor:
    """A photograph with white noise of so many grey levels."""
    noise = torch.randn(1, 3, height, width, generator=torch.Generator().manual_seed(0))
    return colour("chelsea", height, width) + level / 255 * noise


@pytest.mark.parametrize("method", ["network", "rule"])
@pytest.mark.parametrize("share", [1, 0.3])
def test_grain_is_the_finest_scale_of_the_luminance_of_removed_noise(
    method: Literal["network", "rule"], share: float
) -> None:
    noisy = grainy(12)
    smooth, kept = (
        denoise(noisy, noise_level=12 / 255, method=method, num_landmarks=40, grain=grain) for grain in (0, share)
    )
    assert torch.equal(smooth, denoise(noisy, noise_level=12 / 255, method=method, num_landmarks=40))
    wanted = share * finest(noisy - smooth).expand(-1, 3, -1, -1)
    assert wanted.std() > share * 3 / 255
    torch.testing.assert_close((kept - smooth)[..., 1:-1, 1:-1], wanted, atol=1e-6, rtol=0)
    assert torch.equal(denoise(noisy, strength=0.0, grain=share), noisy)
    assert torch.equal(
        denoise(noisy[..., :1, :1], noise_level=0.1, grain=share), denoise(noisy[..., :1, :1], noise_level=0.1)
    )


def test_a_little_grain_is_kept_where_much_noise_is_estimated() -> None:
    noise = torch.randn(1, 3, 96, 96, generator=torch.Generator().manual_seed(0))
    for level, least, most in ((8.0, 0.09, 0.11), (4.5, 0.16, 0.2), (3.0, 0.05, 0.15), (1.0, 0.0, 0.0)):
        noisy = torch.linspace(0.1, 0.9, 96) + level / 255 * noise
        smooth, usual = denoise(noisy, grain=0), denoise(noisy)
        grain = finest(noisy - smooth)
        change = split_luminance(usual - smooth)[0][..., 1:-1, 1:-1]
        share = float((change * grain).sum() / grain.square().sum())
        assert least - 1e-3 <= share <= most + 1e-3
    assert torch.equal(
        denoise(noisy, method="rule", num_landmarks=40), denoise(noisy, method="rule", num_landmarks=40, grain=0)
    )


def test_grain_of_each_image_and_its_gradient() -> None:
    noisy = grainy(12, 24, 32).double().expand(2, -1, -1, -1)
    shares = torch.tensor([0.0, 0.6], dtype=torch.float64, requires_grad=True)
    both = denoise(noisy, noise_level=12 / 255, grain=shares)
    alone = [denoise(noisy[:1], noise_level=12 / 255, grain=share) for share in (0, 0.6)]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-6, rtol=0)
    (gradient,) = torch.autograd.grad(both.square().sum((1, 2, 3)).sum(), shares)
    change = (alone[1] - alone[0]) / 0.6
    wanted = torch.stack([2 * (result * change).sum() for result in alone])
    torch.testing.assert_close(gradient, wanted, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    "values", [{"noise_level": 12.0}, {}, {"method": "rule", "landmarks": 40, "sampling": "uniform"}]
)
def test_grain_in_tiles_is_that_in_memory(values: dict[str, Any]) -> None:
    noisy = grainy(12, 420, 40)
    step = Step("denoise", grain=1.0, **values)
    tiled = np.empty((420, 40, 3), np.float32)
    stream(step, noisy[0].movedim(0, 2).contiguous().numpy(), tiled, tile_rows=16)
    wanted = apply_step(step, noisy)
    torch.testing.assert_close(torch.from_numpy(tiled).movedim(2, 0)[None], wanted, atol=2e-5, rtol=0)
