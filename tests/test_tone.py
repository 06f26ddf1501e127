"""Tone, sharpening and the detail of regions: what they change, and what they leave unchanged."""

from typing import Any

import pytest
import torch

from nlfilter_torch import abstract, adjust_tone, enhance, nonlocal_operator, polynomial_filter, sharpen
from nlfilter_torch.photo.picture.colour import split_luminance
from tests.problems import BACKGROUND, SUIT, box, colour, luminance

#: The filter of the paper, without limits.
PLAIN: dict[str, Any] = {
    "limits": "none",
    "photometric_bandwidth": "auto",
    "spatial_bandwidth": "none",
    "num_landmarks": 100,
}


def test_tone_holds_mean_and_colours() -> None:
    image = colour("coffee", 40, 60)
    strong = adjust_tone(image, contrast=1.4, clarity=3.0, **PLAIN)
    torch.testing.assert_close(strong.mean((2, 3)), image.mean((2, 3)), atol=1e-5, rtol=0)
    torch.testing.assert_close(split_luminance(strong)[1], split_luminance(image)[1], atol=1e-5, rtol=0)
    assert luminance(strong).std() > 1.2 * luminance(image).std()
    assert torch.equal(adjust_tone(image), image)
    grey = luminance(image)
    operator = nonlocal_operator(grey)
    mean = grey.mean()
    expected = mean + polynomial_filter(operator, grey - mean, torch.tensor([1.0, 1.0, 3.0, 1.4]))
    torch.testing.assert_close(adjust_tone(grey, contrast=1.4, clarity=3.0, **PLAIN), expected)


def test_sharpening_raises_edges_and_spares_noise() -> None:
    clean = luminance(colour("astronaut", 96, 96))
    noisy = clean + 10 / 255 * torch.randn(2, 1, 96, 96, generator=torch.Generator().manual_seed(0))
    sharp = sharpen(noisy, amount=5.0)
    direction = torch.stack([clean.diff(dim=3)[..., :-1, :], clean.diff(dim=2)[..., :-1]])
    strength = direction.norm(dim=0)
    strong = strength > strength.quantile(0.95)

    def slope(image: torch.Tensor) -> torch.Tensor:
        mean = image.mean(0, keepdim=True)
        gradient = torch.stack([mean.diff(dim=3)[..., :-1, :], mean.diff(dim=2)[..., :-1]])
        return ((gradient * direction).sum(0) / strength)[strong].mean()

    wall = (slice(None), slice(None), slice(2, 18), slice(58, 70))
    assert slope(sharp) > 1.2 * slope(noisy)
    assert (sharp[0] - sharp[1])[wall[1:]].std() < 1.2 * (noisy[0] - noisy[1])[wall[1:]].std()
    assert torch.equal(sharpen(clean, amount=1.0), clean)
    assert not torch.equal(sharpen(noisy), sharpen(noisy, guide_blur=0.0))
    gains = [slope(sharpen(clean, amount=amount)) / slope(clean) for amount in (2.0, 4.0, 8.0)]
    assert gains == sorted(gains)
    assert 1.2 < gains[1] < 1.6
    shading = torch.linspace(0.2, 0.8, 96).expand(1, 1, 96, 96)
    torch.testing.assert_close(sharpen(shading, amount=8.0), shading, atol=0.5 / 255, rtol=0)


def test_small_pictures_have_fewer_landmarks_than_the_default_without_a_warning() -> None:
    image = colour("astronaut", 8, 9)
    for edited in (enhance(image, torch.tensor([2.0, 1.0])), adjust_tone(image, contrast=1.2)):
        assert torch.isfinite(edited).all()


@pytest.mark.parametrize("viewing_size", [0.0, 0.001])
def test_regions_are_checked_at_every_viewing_size(viewing_size: float) -> None:
    image, sliders = colour("astronaut"), torch.tensor([2.0, 1.0])
    for negative in (box(1, 1).numpy(), box(1, 1)[0], box(1, 1).long(), box(1, 1).bool()):
        with pytest.raises((TypeError, ValueError), match=r"^negative must (have|be a torch\.Tensor)"):
            enhance(image, sliders, box(37, 8), negative=negative, viewing_size=viewing_size)


def test_detail_reaches_the_likes_of_a_region_only() -> None:
    image = colour("astronaut")
    sliders = torch.tensor([4.0, 4.0, 4.0, 1.0])
    whole = enhance(image, sliders)
    assert torch.equal(enhance(image, torch.ones(4)), image)
    part = enhance(image, sliders, box(37, 8))
    change, full = (part - image).abs().mean(1), (whole - image).abs().mean(1)
    assert change[0, 36:50, 8:15].mean() > 0.4 * full[0, 36:50, 8:15].mean()
    assert change[0, 2:18, 40:46].mean() < 0.15 * full[0, 2:18, 40:46].mean()
    less = enhance(image, sliders, box(37, 8), negative=box(45, 10))
    assert (less - image).abs()[SUIT].mean() < 0.7 * (part - image).abs()[SUIT].mean()
    with pytest.raises(ValueError, match="negative must hold a painted pixel outside the scribbles of each region"):
        enhance(image, sliders, box(37, 8), negative=box(37, 8))
    two = enhance(
        image, torch.stack([sliders, torch.tensor([0.0, 0.0, 1.0, 1.0])]), torch.cat([box(37, 8), box(4, 42)], 1)
    )
    assert (two - part).abs()[BACKGROUND].max() > 0
    everything = enhance(image, sliders, torch.ones(1, 1, 64, 64))
    assert torch.isfinite(everything).all()
    dot = enhance(image, sliders, box(40, 10, 1, 1))
    share = [((dot - image).abs()[place].mean() / (whole - image).abs()[place].mean()) for place in (SUIT, BACKGROUND)]
    assert share[0] > 3 * share[1]
    with pytest.raises(ValueError, match="negative must be given together with regions, got no regions"):
        enhance(image, sliders, negative=box(1, 1))
    with pytest.raises(ValueError, match=r"alpha must have shape \(1, k\+1\)"):
        enhance(image, torch.ones(2, 4), box(1, 1))


@pytest.mark.parametrize("name", ["astronaut", "coffee"])
def test_saturated_highlights_keep_their_chroma(name: str) -> None:
    """Also if chroma gained elsewhere could make up for the loss."""
    image = colour(name, 64, 96)
    before = split_luminance(image)[1].norm(dim=1)
    edits = ((adjust_tone(image, contrast=1.4), 0.03), (enhance(image, torch.tensor([3.0, 3.0, 3.0, 1.0])), 0.015))
    for edited, limit in edits:
        after = split_luminance(edited)[1].norm(dim=1)
        assert (before - after).clamp(min=0).mean() < limit * before.mean()
        assert after.mean() == pytest.approx(float(before.mean()), rel=0.01)


def test_numbers_do_not_take_the_default_dtype() -> None:
    image = colour("coffee", 30, 40)
    edits = (
        lambda: adjust_tone(image, contrast=1.4, num_landmarks=40),
        lambda: abstract(image, num_landmarks=40),
        lambda: nonlocal_operator(image, num_landmarks=40) @ image,
    )
    expected = [edit() for edit in edits]
    for dtype in (torch.bfloat16, torch.float64):
        torch.set_default_dtype(dtype)
        try:
            found = [edit() for edit in edits]
        finally:
            torch.set_default_dtype(torch.float32)
        for a, b in zip(found, expected, strict=True):
            assert torch.equal(a, b)
