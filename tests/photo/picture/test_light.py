"""Light against plain arithmetic and curves of scipy; areas without halos; ranges, gradients, and cached areas."""

import numpy as np
import pytest
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor
from torch.autograd import gradcheck

from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.picture.developing import limits_of
from nlfilter_torch.photo.picture.light import develop_image, gains_of, in_light, light_of
from nlfilter_torch.photo.picture.source import Cache
from tests.problems import colour


def linear(values: np.ndarray) -> np.ndarray:
    """The light of values of sRGB."""
    return np.where(values > 0.04045, ((values + 0.055) / 1.055) ** 2.4, values / 12.92)


def encoded(light: np.ndarray) -> np.ndarray:
    return np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_exposure_and_white_balance_are_factors_of_light(dtype: torch.dtype) -> None:
    image = colour("chelsea", 40, 60).to(dtype)
    development = Development(exposure=-0.7, warmth=0.4, tint=-0.3)
    gains = np.array([2 ** (0.75 * 0.4), 2 ** (0.5 * 0.3), 2 ** (-0.75 * 0.4)])
    gains *= 2**-0.7 / (gains @ [0.2126, 0.7152, 0.0722])
    assert gains_of(development) == pytest.approx(gains)
    wanted = encoded(linear(image.double().numpy()) * gains[:, None, None]).clip(0, 1)
    assert np.abs(develop_image(image, development).numpy() - wanted).max() < 2e-6


def test_white_balance_keeps_the_luminance_of_grey_and_grey_pictures() -> None:
    development = Development(warmth=0.8, tint=0.5)
    warm = linear(develop_image(torch.full((1, 3, 2, 2), 0.3), development).double().numpy())
    assert np.dot([0.2126, 0.7152, 0.0722], warm[0, :, 0, 0]) == pytest.approx(float(linear(np.array(0.3))), abs=1e-6)
    assert warm[0, 0, 0, 0] > warm[0, 1, 0, 0] > warm[0, 2, 0, 0]  # amber
    grey = torch.rand(1, 1, 3, 4, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(develop_image(grey, development), grey, atol=1e-6)


def test_values_above_white_are_not_lost() -> None:
    wide = torch.tensor([0.0, 0.2, 0.9, 5.0]).view(1, 1, 1, 4)
    darker = develop_image(wide, Development(exposure=-3.0))
    assert darker[0, 0, 0, 3] > 1.5  # and not the value of white
    assert torch.allclose(develop_image(darker, Development(exposure=3.0)), wide, atol=1e-5)
    assert develop_image(wide[..., :3], Development(exposure=3.0)).max() == 1
    both = torch.cat([wide, wide.clamp(0, 1)])  # one picture of a batch does not change the other
    assert torch.equal(
        develop_image(both, Development(exposure=1.0))[1], develop_image(both[1:], Development(exposure=1.0))[0]
    )


LIGHTING = Development(
    exposure=0.2, contrast=0.3, highlights=-0.8, shadows=0.7, whites=-0.2, blacks=0.3, vibrance=0.4, saturation=-0.1
)


def chroma(image: Tensor) -> Tensor:
    return image.amax(1) - image.amin(1)


def test_kelvin_warms_above_neutral_and_cools_below() -> None:
    image = colour("chelsea", 30, 40)
    assert torch.allclose(develop_image(image, Development(temperature=6500.0)), image, atol=1e-6)
    warmer, colder = (develop_image(image, Development(temperature=kelvin)).mean((0, 2, 3)) for kelvin in (9000, 4500))
    assert warmer[0] > image[:, 0].mean() > colder[0]
    assert warmer[2] < image[:, 2].mean() < colder[2]
    assert light_of(2856.0) == pytest.approx((2.2, 1.0, 0.28), abs=0.1)  # CIE illuminant A, in linear sRGB


def test_a_cast_is_estimated() -> None:
    image = colour("astronaut", 60, 80)
    cast = develop_image(image, Development(warmth=0.4, tint=-0.3))
    auto, wanted = (develop_image(picture, Development(temperature="auto")) for picture in (cast, image))
    assert (auto - wanted).abs().mean() < 0.25 * (cast - image).abs().mean()
    assert torch.equal(develop_image(image[:, :1], Development(temperature="auto")), image[:, :1])  # grey
    dark = torch.zeros(1, 3, 4, 5)
    assert torch.equal(develop_image(dark, Development(temperature="auto")), dark)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_curve_is_that_of_scipy(dtype: torch.dtype) -> None:
    image = colour("chelsea", 20, 30).to(dtype)
    for curve in ((0.1, 0.3, 0.9), (0.0, 0.5, 0.4, 0.7, 0.7, 1.0), (1.0, 0.0)):
        wanted = PchipInterpolator(np.linspace(0, 1, len(curve)), curve)(image.double().numpy())
        assert np.abs(develop_image(image, Development(curve=curve)).numpy() - wanted).max() < 1e-6


def test_tones_rise_and_keep_their_ends() -> None:
    tones = torch.linspace(0, 1, 101).view(1, 1, 1, -1)
    for values in (
        {"contrast": 1.0},
        {"contrast": -1.0},
        {"whites": -1.0},
        {"blacks": 1.0},
        {"whites": 1, "blacks": -1},
    ):
        bent = develop_image(tones, Development(**values)).flatten()
        assert bool((bent.diff() >= 0).all())
    assert develop_image(tones, Development(whites=-1.0)).max() == pytest.approx(0.88)
    assert develop_image(tones, Development(blacks=1.0)).min() == pytest.approx(0.12)


def test_saturation_keeps_luminance_and_range() -> None:
    image = colour("astronaut", 40, 40)
    grey = develop_image(image, Development(saturation=-1.0))
    assert chroma(grey).max() < 1e-6
    strong = develop_image(image, Development(saturation=1.0))
    weights = torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)
    assert torch.allclose((strong * weights).sum(1), (image * weights).sum(1), atol=1e-5)
    assert chroma(strong).mean() > 1.3 * chroma(image).mean()
    gains = chroma(develop_image(image, Development(vibrance=1.0))) / chroma(image).clamp(min=1e-6)
    pale, vivid = chroma(image) < 0.15, chroma(image) > 0.5
    assert gains[pale].mean() > 1.4 > 1.2 > gains[vivid].mean()


def test_areas_get_lighter_without_halos() -> None:
    """A dark and a light field, textured, with a sharp edge between them."""
    texture = 0.04 * torch.randn(1, 1, 80, 120, generator=torch.Generator().manual_seed(0)).clamp(-2, 2)
    image = torch.where(torch.arange(120) < 60, 0.2, 0.8) + texture
    edited = develop_image(image, Development(shadows=1.0, highlights=-1.0))
    dark, light = slice(20, 40), slice(80, 100)
    assert edited[..., dark].mean() > image[..., dark].mean() + 0.08
    assert edited[..., light].mean() < image[..., light].mean() - 0.08
    assert 0.85 < edited[..., dark].std() / image[..., dark].std() < 1.15
    columns = edited.mean((0, 1, 2))
    assert abs(columns[57:60].mean() - columns[dark].mean()) < 0.015  # beside the edge as far from it
    assert abs(columns[60:63].mean() - columns[light].mean()) < 0.015


def test_areas_are_kept_for_other_values() -> None:
    image, cache = colour("chelsea", 40, 60), Cache()
    first = in_light(image, LIGHTING, limits_of(image), cache)
    areas = dict(cache)
    again = in_light(image, Development(highlights=0.5), limits_of(image), cache)
    assert all(cache[name] is value for name, value in areas.items())
    assert torch.equal(again, develop_image(image, Development(highlights=0.5)))
    assert torch.equal(first, develop_image(image, LIGHTING))
    batch = torch.cat([image, 1 - image])
    assert torch.allclose(develop_image(batch, LIGHTING)[:1], first, atol=1e-4)


def test_gradients_of_light() -> None:
    image = 0.2 + 0.6 * torch.rand(1, 3, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for development in (LIGHTING, Development(curve=(0.1, 0.4, 0.95))):
        assert gradcheck(lambda values, d=development: develop_image(values, d), image.requires_grad_())
