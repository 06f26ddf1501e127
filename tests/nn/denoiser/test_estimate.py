"""Estimates of noise by scale: white and coarse noise, clean and drawn pictures, and pictures of any kind and size."""

import math

import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch import estimate_noise
from nlfilter_torch.nn.denoiser.estimate import (
    INPUTS,
    KINDS,
    MOST,
    QUANTILES,
    SIDE,
    has_few_colours,
    inputs_of,
    measured_profile,
    noise_profile,
    profile_of_measured,
    profile_places,
    statistics_of,
    white_profile,
    window_pixels,
)
from nlfilter_torch.nn.denoiser.noise import Noise
from nlfilter_torch.nn.denoiser.profile import KNOTS, NoiseProfile, profile_of_difference
from nlfilter_torch.photo import denoise
from nlfilter_torch.photo.edits.noise import profile_of
from nlfilter_torch.photo.picture.in_memory import InMemory
from tests.pairwise import each_value, pairwise
from tests.problems import colour, decibels, noisy, picture

CAT = colour("chelsea", 256, 320).float()


def camera_noise(clean: torch.Tensor, level: float, seed: int = 0) -> torch.Tensor:
    """Noise as cameras make it: smoothed, most of all in colour, and rounded to 8 bits."""
    generator = torch.Generator().manual_seed(seed)
    luminance = torch.randn(*clean.shape[:1], 1, *clean.shape[2:], generator=generator)
    colours = torch.randn(clean.shape, generator=generator)
    luminance = _averaged(luminance)
    for _ in range(3):
        colours = _averaged(colours)
    colours = colours - colours.mean(1, keepdim=True)
    noise = luminance / luminance.std() + 0.7 * colours / colours.std()
    return ((clean + level * noise).clamp(0, 1) * 255).round() / 255


def _averaged(planes: torch.Tensor) -> torch.Tensor:
    return F.avg_pool2d(F.pad(planes, (1, 1, 1, 1), mode="reflect"), 3, 1)


@pytest.mark.parametrize(("level", "channels"), each_value([5, 15, 40], [1, 3]))
def test_white_noise_is_estimated_by_its_own_rule(channels: int, level: int) -> None:
    clean = CAT if channels == 3 else picture("camera", 256, 320, torch.float32)
    image = noisy(clean, level / 255)
    profile = noise_profile(image)
    torch.testing.assert_close(profile.level, estimate_noise(image), rtol=0.03, atol=0)
    torch.testing.assert_close(profile.coarseness, torch.ones(1), rtol=0.05, atol=0)


@pytest.mark.parametrize("level", [4, 8])
def test_coarse_noise_is_seen(level: int) -> None:
    image = camera_noise(CAT, level / 255)
    truth, profile = profile_of_difference(image, CAT), noise_profile(image)
    assert float(estimate_noise(image)) < 0.4 * float(truth.level)
    ratios = profile.levels[0, :, :, 2] / truth.levels[0, :, :, 2]
    assert float((ratios[:3].log().abs()).max()) < math.log(1.5)
    assert float(profile.coarseness) == pytest.approx(float(truth.coarseness), rel=0.25)
    assert decibels(denoise(image), CAT) > decibels(image, CAT) + 1


@pytest.mark.parametrize("name", ["coffee", "astronaut", "camera"])
def test_clean_photographs_stay(name: str) -> None:
    clean = (picture(name, 256, 256, torch.float32) * 255).round() / 255
    assert 255 * float(noise_profile(clean).level) < 3
    assert decibels(denoise(clean), clean) > 40


def test_drawn_and_dithered_pictures_stay() -> None:
    generator = torch.Generator().manual_seed(0)
    ramp = torch.linspace(0, 1, 160).expand(1, 1, 120, 160)
    dithered = (ramp > torch.rand(1, 1, 120, 160, generator=generator)).float()
    palette = (4 * (CAT + 0.1 * torch.rand(CAT.shape, generator=generator))).round() / 4
    for image in (dithered, palette.clamp(0, 1), torch.zeros(1, 3, 50, 50), torch.ones(1, 1, 9, 9)):
        assert float(noise_profile(image).levels.abs().max()) == 0
        assert torch.equal(denoise(image), image)


@pytest.mark.parametrize(
    ("size", "channels", "dtype"),
    pairwise(
        [(1, 1), (2, 30), (3, 3), (16, 16), (40, 200)], [1, 2, 3, 4], [torch.float32, torch.float64, torch.bfloat16]
    ),
)
def test_any_picture(size: tuple[int, int], channels: int, dtype: torch.dtype) -> None:
    image = torch.rand(2, channels, *size, generator=torch.Generator().manual_seed(0)).mul(1.5).to(dtype)
    profile = noise_profile(image)
    assert profile.levels.shape == (2, 5, 2, KNOTS)
    assert bool(profile.levels.isfinite().all())
    assert float(profile.levels.min()) >= 0
    assert profile.levels.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    if channels != 3:
        assert float(profile.levels[:, :, 1].max()) == 0
    if min(size) < 3:
        assert float(profile.levels.max()) == 0


def test_images_of_a_batch_are_estimated_as_alone() -> None:
    both = torch.cat([camera_noise(CAT, 6 / 255), noisy(CAT, 0.05)])
    levels = noise_profile(both).levels
    for i in range(2):
        torch.testing.assert_close(levels[i : i + 1], noise_profile(both[i : i + 1]).levels)


def test_estimates_do_not_depend_on_flips() -> None:
    image = camera_noise(CAT, 6 / 255)
    for turned in (image.flip(3), image.rot90(1, (2, 3))):
        torch.testing.assert_close(noise_profile(turned).levels, noise_profile(image).levels, rtol=0.05, atol=1e-4)


def test_a_source_is_estimated_from_the_same_pixels() -> None:
    image = camera_noise(CAT, 6 / 255)
    places = profile_places((256, 320))
    assert torch.equal(places, places.sort().values)
    measured = measured_profile((256, 320), image.flatten(2)[:, :, places])
    assert torch.equal(profile_of_measured(measured).levels, noise_profile(image).levels)
    assert torch.equal(profile_of(InMemory(image)).levels, noise_profile(image).levels)


def test_white_noise_as_a_profile() -> None:
    noise = Noise(torch.tensor([1e-4]), torch.tensor([4e-3]), torch.tensor([0.37]))
    profile = white_profile(noise)
    torch.testing.assert_close(profile.level, noise.level)
    image = CAT[..., :60, :80]
    torch.testing.assert_close(
        profile.at(image, (2,))[:, 1], noise.at(image).square().mean(1).sqrt(), rtol=1e-4, atol=1e-6
    )


def test_inputs_of_the_network() -> None:
    statistics, shares = statistics_of(torch.rand(2, 3, 128, 128, generator=torch.Generator().manual_seed(0)))
    inputs = inputs_of(statistics, shares)
    assert inputs.shape == (KNOTS, INPUTS)
    torch.testing.assert_close(inputs_of(statistics[None], shares[None])[0], inputs)


MEDIAN = QUANTILES.index(0.5)


def windows_of(image: torch.Tensor) -> torch.Tensor:
    places = window_pixels((image.shape[-2], image.shape[-1]))
    return image[0].flatten(1)[:, places].transpose(0, 1)


def white_noise(*size: int, level: float = 0.05, light: float = 0.5) -> torch.Tensor:
    return light + level * torch.randn(*size, generator=torch.Generator().manual_seed(0))


WINDOWS = [(1, 1), (5, 40), (128, 128), (129, 300), (700, 431), (3000, 4001), (20, 100_000)]


def test_windows_lie_in_the_picture_and_are_the_same_seen_from_either_side() -> None:
    for size in WINDOWS:
        places = window_pixels(size)
        assert len(places) <= MOST
        assert places.shape[1:] == (SIDE, SIDE)
        assert int(places.min()) >= 0
        assert int(places.max()) < size[0] * size[1]
        rows, columns = places // size[1], places % size[1]
        for flipped in ((size[0] - 1 - rows) * size[1] + columns, rows * size[1] + size[1] - 1 - columns):
            if min(size) >= SIDE:
                assert torch.equal(flipped.unique(), places.unique())
        if size[0] * size[1] <= MOST * SIDE**2 / 4:
            assert len(places.unique()) == size[0] * size[1]


def test_white_noise_has_its_level_everywhere() -> None:
    statistics, shares = statistics_of(windows_of(white_noise(1, 3, 400, 400)))
    assert statistics.shape == (KNOTS, len(NoiseProfile.SCALES), KINDS, 2, len(QUANTILES))
    levels = statistics.exp()[2, ..., MEDIAN]
    wanted = torch.tensor([3**-0.5, 3**-0.5, 1, 1])[:, None] * 0.05
    torch.testing.assert_close(levels[:3], wanted.expand(3, -1, 2), rtol=0.05, atol=0)
    torch.testing.assert_close(levels[3:], wanted.expand(2, -1, 2), rtol=0.2, atol=0)
    torch.testing.assert_close(shares.sum(0), torch.ones(5), rtol=1e-3, atol=0)
    assert float(shares[2:4].sum(0).min()) > 0.95


def test_statistics_do_not_depend_on_flips_and_rotations() -> None:
    image = white_noise(1, 3, 260, 330).clamp(0, 1)
    statistics, shares = statistics_of(windows_of(image))
    for turned in (image.flip(2), image.flip(3), image.rot90(1, (2, 3))):
        other, others = statistics_of(windows_of(turned))
        torch.testing.assert_close(other, statistics, rtol=0, atol=0.02)
        torch.testing.assert_close(others, shares, rtol=0, atol=1e-3)


def test_clipped_cells_do_not_count() -> None:
    image = white_noise(1, 3, 256, 256)
    image[..., :128] = 0
    statistics, shares = statistics_of(windows_of(image))
    assert float(shares[0].max()) < 1e-3
    torch.testing.assert_close(statistics[2, 0, 2, 1, MEDIAN].exp(), torch.tensor(0.05), rtol=0.05, atol=0)
    _, none = statistics_of(windows_of(torch.zeros(1, 1, 64, 64)))
    assert float(none.abs().max()) == 0


def test_pictures_of_few_colours() -> None:
    image = white_noise(1, 3, 200, 200)
    assert not bool(has_few_colours(windows_of(image)))
    assert not bool(has_few_colours(windows_of((255 * image).round() / 255)))
    assert not bool(has_few_colours(windows_of(white_noise(1, 1, 200, 200, level=1e-4))))
    palette = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
    indices = torch.randint(64, (200, 200), generator=torch.Generator().manual_seed(0))
    assert bool(has_few_colours(windows_of(palette[indices].permute(2, 0, 1)[None])))
    assert bool(has_few_colours(windows_of((white_noise(1, 1, 200, 200) > 0.5).float())))
    for channels in (2, 4):  # pictures may have any number
        windows = white_noise(9, channels, 48, 48)
        assert not bool(has_few_colours(windows))
        assert bool(has_few_colours(windows.round()))
