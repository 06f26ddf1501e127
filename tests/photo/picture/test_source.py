"""Guides of filters, and samples of the pixels of a picture."""

import torch

from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.source import (
    Guide,
    luminance,
    sampled_pairs,
    sampled_places,
    seeded,
)
from tests.problems import build, colour, noise
from tests.problems import luminance as luminance_of

OPTIONS = FilterOptions(num_landmarks=20)


def doubled(image: torch.Tensor) -> torch.Tensor:
    return 2 * image


def test_the_guide_is_the_image_unless_transformed() -> None:
    image = noise(1, 3, 8, 9)
    assert Guide(OPTIONS)(image) is image
    assert torch.equal(Guide(OPTIONS, doubled)(image), 2 * image)
    blurred = Guide(OPTIONS, doubled, blur=1.0)(image)
    assert blurred.shape == image.shape
    assert blurred.var() < 0.5 * (2 * image).var()


def test_a_guide_depends_on_pixels_within_its_margin() -> None:
    assert Guide(OPTIONS).margin == 0
    assert Guide(OPTIONS, doubled, radius=2, blur=0.8).blur_margin == 3
    guide = Guide(OPTIONS, doubled, radius=2, blur=0.8)
    assert guide.margin == 5
    image = noise(1, 1, 31, 31)
    changed = image.clone()
    changed[..., 15, 15] += 1
    difference = (guide(changed) - guide(image)).abs()[0, 0]
    reached = (difference > 1e-12).nonzero()
    assert (reached - 15).abs().amax() == guide.blur_margin  # its transform is pointwise


def test_the_same_pixels_are_sampled_in_every_call() -> None:
    size = (250, 400)
    count = size[0] * size[1]
    before = torch.get_rng_state()
    places = sampled_places(size)
    assert torch.equal(places, sampled_places(size))
    assert torch.equal(torch.get_rng_state(), before)
    assert places.shape == (32_768,)
    assert (places.diff() >= 0).all()
    assert 0 <= int(places[0]) < int(places[-1]) < count
    assert abs(float(places.double().mean()) / count - 0.5) < 0.01
    assert torch.equal(sampled_places((5, 10)), torch.arange(50))  # fewer pixels than a sample has


def test_generators_of_the_command_line_draw_the_same() -> None:
    assert torch.equal(torch.rand(3, generator=seeded()), torch.rand(3, generator=torch.Generator().manual_seed(0)))
    assert not torch.equal(torch.rand(3, generator=seeded(1)), torch.rand(3, generator=seeded()))


def test_the_spectrum_of_a_sample_is_scaled_to_the_picture() -> None:
    """From all pixels in several blocks, counted as a sample of as many, the eigenvalues are those of the operator."""
    operator = build(noise(1, 1, 20, 30), num_landmarks=20)
    factor, scaling, remainder = operator.factor, operator.scaling, operator.remainder
    blocks = [
        Columns(factor[:, :, part], scaling[:, part], remainder[:, part])
        for part in (slice(0, 250), slice(250, 251), slice(251, 600))
    ]
    pairs = sampled_pairs(blocks, 32_768, factor.dtype)
    assert pairs.ritz.eigenvalues.dtype == factor.dtype
    torch.testing.assert_close(pairs.ritz.eigenvalues, operator.spectrum().ritz.eigenvalues, rtol=1e-6, atol=1e-8)


def test_the_luminance_of_pixels() -> None:
    image = colour("coffee", 8, 9)
    torch.testing.assert_close(luminance(InMemory(image)), luminance_of(image))
    assert torch.equal(luminance(InMemory(image[:, :1])), image[:, :1])
