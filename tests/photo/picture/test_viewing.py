"""Sliders with the same effect at any resolution."""

from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch.photo import enhance
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.viewing import enlarged_and_reduced, viewed_size
from tests.brightness import ALPHA, EDITS
from tests.problems import cat, colour, luminance
from tests.streams import stream_detail


def test_the_viewing_size_of_a_picture() -> None:
    assert viewed_size((1000, 1500), 1.5) == (1000, 1500)
    assert viewed_size((2000, 3000), 1.5) == (1000, 1500)
    assert viewed_size((2000, 3000), 0) == (2000, 3000)
    assert viewed_size((1, 5_000_000), 1.5)[0] == 1


@pytest.mark.parametrize("name", EDITS)
def test_a_larger_picture_looks_alike_at_the_viewing_size(name: str) -> None:
    large, megapixels = colour("coffee", 180, 270), 60 * 90 / 1e6
    small = resize(large, (60, 90))
    wanted = EDITS[name](small, viewing_size=megapixels)
    assert torch.equal(wanted, EDITS[name](small, viewing_size=0))  # not larger: nothing is resized
    viewed = resize(EDITS[name](large, viewing_size=megapixels), (60, 90))
    per_pixel = resize(EDITS[name](large, viewing_size=0), (60, 90))

    def error(edited: torch.Tensor) -> float:
        return float((edited - wanted).square().mean().sqrt())

    change = float((wanted - small).square().mean().sqrt())
    assert error(viewed) < 0.4 * change
    assert error(viewed) < 0.7 * error(per_pixel)


def test_texture_too_fine_to_be_seen_is_changed_as_the_rest() -> None:
    generator = torch.Generator().manual_seed(0)
    image = (0.5 + 0.1 * torch.randn(1, 1, 120, 120, generator=generator)).clamp(0, 1)
    options: dict[str, Any] = {"viewing_size": 0.0036, "num_landmarks": 100, "photometric_bandwidth": 0.3}
    flat = enhance(image, torch.tensor([0.0, 0.0, 1.0]), **options)
    assert flat.std() < 0.5 * image.std()
    rich = enhance(image, torch.tensor([2.0, 2.0, 1.0]), limits="none", **options)
    assert 1.5 * image.std() < rich.std() < 2.2 * image.std()


@pytest.mark.parametrize("name", EDITS)
def test_gradients_go_through_the_viewing_size(name: str) -> None:
    image = colour("coffee", 40, 40).requires_grad_()
    EDITS[name](image, viewing_size=0.0004).square().mean().backward()
    assert image.grad is not None
    assert bool(torch.isfinite(image.grad).all())
    assert image.grad.abs().max() > 0


@pytest.mark.parametrize("saturation", [1.0, 3.0])
def test_tiles_are_those_of_the_edit_in_memory(saturation: float) -> None:
    image = colour("coffee", 120, 160)
    if saturation > 1:  # many channels at 0 and 1
        image = torch.lerp(luminance(image), image, saturation).clamp(0, 1)
    rows = image[0].permute(1, 2, 0).numpy().astype(np.float32)
    weights = np.zeros((120, 160, 1), np.float32)
    weights[20:40, 30:60] = 1
    for regions in (None, weights):
        planes = None if regions is None else torch.from_numpy(regions).permute(2, 0, 1)[None]
        for size in (0.005, 1.5):
            wanted = enhance(image, ALPHA, planes, num_landmarks=40, viewing_size=size)
            edited = [np.empty_like(rows) for _ in range(2)]
            for target, height in zip(edited, (7, 50), strict=True):
                stream_detail(
                    rows,
                    target,
                    ALPHA,
                    regions,
                    num_landmarks=40,
                    viewing_size=size,
                    statistics="full",
                    tile_rows=height,
                )
            assert np.abs(edited[0] - wanted[0].permute(1, 2, 0).numpy()).max() < 2e-3
            assert np.abs(edited[0] - edited[1]).max() < 1e-6


def test_regions_of_another_size_are_told_at_the_viewing_size_too() -> None:
    image = colour("coffee", 40, 60)
    for size in (0, 0.001):
        with pytest.raises(ValueError, match=r"region.* must have the height and width"):
            enhance(image, ALPHA, torch.ones(1, 1, 40, 50), viewing_size=size, num_landmarks=20)
        with pytest.raises(ValueError, match=r"regions must be in \[0, 1\]"):
            enhance(image, ALPHA, -torch.ones(1, 1, 40, 60), viewing_size=size, num_landmarks=20)


@pytest.mark.parametrize("stride", [2, 2.7])
def test_enlarged_and_reduced(stride: float) -> None:
    planes = cat()
    large = resize(planes, (round(100 * stride), round(150 * stride)))
    back = resize(large, (100, 150))
    error, reduction = enlarged_and_reduced(planes, stride) - back, planes - back
    assert error.square().mean().sqrt() < 0.1 * reduction.square().mean().sqrt()
