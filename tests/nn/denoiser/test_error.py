"""Standard errors of denoised pixels hold what they are meant to."""

from functools import partial

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NoiseProfile, NonlocalDenoiser, standard_error
from nlfilter_torch.nn.denoiser.error import SHAPES, TRAINED
from nlfilter_torch.nn.denoiser.weights import read_weights
from tests.problems import colour, noise, seeded

LEVEL = 25 / 255


@pytest.fixture(scope="module")
def denoiser() -> NonlocalDenoiser:
    return NonlocalDenoiser.trained().requires_grad_(False)


def noisy(clean: Tensor, level: float | Tensor = LEVEL) -> Tensor:
    return clean + level * torch.randn(clean.shape, generator=seeded(1))


def covered(error: Tensor, difference: Tensor) -> float:
    return float((difference.abs() <= 1.645 * error).double().mean())


def test_intervals_hold_nine_of_ten_pixels(denoiser: NonlocalDenoiser) -> None:
    clean = colour("coffee", 96, 128).float()
    image, function = noisy(clean), partial(denoiser, noise=LEVEL)
    error = standard_error(function, image, LEVEL)
    assert error.shape == image.shape
    assert covered(error, function(image) - clean) == pytest.approx(0.9, abs=0.04)
    # Wider where pixels are wrong, and of little use if it were the same everywhere.
    wrong = (function(image) - clean).abs() > 0.05
    assert error[wrong].mean() > 1.3 * error[~wrong].mean()


def test_what_is_left_of_the_noise_counts() -> None:
    clean = torch.full((1, 1, 64, 64), 0.5)
    image = noisy(clean)
    for share in (0.3, 1.0):  # of the noise that is kept
        error = standard_error(lambda y, share=share: 0.5 + share * (y - 0.5), image, LEVEL)
        assert float(error.mean()) == pytest.approx(share * LEVEL, rel=0.15)


def test_noise_as_a_map_and_a_profile(denoiser: NonlocalDenoiser) -> None:
    clean = colour("coffee", 48, 48).float().mean(1, keepdim=True).expand(2, -1, -1, -1)
    level = torch.full_like(clean, LEVEL)
    level[1, :, :, 24:] = 0.0
    image = noisy(clean, level)
    error = standard_error(partial(denoiser, noise=level), image, level)
    assert bool((error[1, :, :, 24:] == 0).all())
    assert bool((error[0] > 0).all())
    profile = NoiseProfile.white(torch.tensor([LEVEL]), channels=1)
    by_profile = standard_error(partial(denoiser, noise=profile), image[:1], profile)
    difference = denoiser(image[:1], LEVEL) - clean[:1]
    assert all(0.75 < covered(found, difference) < 0.99 for found in (by_profile, error[:1]))


def test_the_same_in_every_call_and_dtype(denoiser: NonlocalDenoiser) -> None:
    image, state = noisy(noise(1, 3, 24, 24, dtype=torch.float32)), torch.get_rng_state()
    function = partial(denoiser, noise=0.1)
    error = standard_error(function, image.requires_grad_(), 0.1)
    assert not error.requires_grad
    assert torch.equal(error, standard_error(function, image, 0.1))
    assert not torch.equal(error, standard_error(function, image, 0.1, generator=seeded(5)))
    assert torch.equal(state, torch.get_rng_state())
    double = standard_error(function, image.double(), 0.1)
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), error, rtol=0.02, atol=1e-4)
    assert standard_error(function, image.half(), 0.1).dtype == torch.float16


def test_strips_do_not_matter(denoiser: NonlocalDenoiser, monkeypatch: pytest.MonkeyPatch) -> None:
    image, function = noisy(noise(1, 1, 20, 17, dtype=torch.float32)), partial(denoiser, noise=0.1)
    error = standard_error(function, image, 0.1)
    monkeypatch.setattr("nlfilter_torch.nn.denoiser.error.STRIP", 40)
    torch.testing.assert_close(standard_error(function, image, 0.1), error)


def test_the_smallest_images() -> None:
    for size in ((1, 1), (1, 7), (3, 2)):
        assert bool(standard_error(torch.Tensor.clone, torch.full((1, 3, *size), 0.5), 0.1).isfinite().all())


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_large_noise_and_values_give_finite_errors(dtype: torch.dtype) -> None:
    image = noise(1, 3, 9, 8).to(dtype)
    for scale, level in ((1.0, 1e20), (0.3 * torch.finfo(dtype).max, 0.1), (1e-3, 0.0)):
        error = standard_error(lambda y: 0.4 * y, scale * image, level)
        assert bool(error.isfinite().all())
        assert bool((error > 0).all()) == (level > 0)


def test_the_weights_of_the_package() -> None:
    assert read_weights(TRAINED, SHAPES).keys() == SHAPES.keys()
