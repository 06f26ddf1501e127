"""The canonical orientation: shared by an image and its mirror images, so that landmarks turn with the image."""

from functools import partial

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor

from nlfilter_torch import NonlocalFilter, nonlocal_operator
from nlfilter_torch.operator.features import GuideFeatures, unit_window
from nlfilter_torch.operator.landmarks import canonical_candidates, orientations
from nlfilter_torch.operator.orientation import (
    ORIENTATIONS,
    Layout,
    orientation_of,
    orientation_sums,
    source_pixels,
)
from tests.images import hard_images, photograph
from tests.pairwise import each_value
from tests.problems import inverse, oriented

LEVELS = 0.05 / 255  # difference of images that counts as rounding


def every_orientation(image: Tensor) -> list[Tensor]:
    return [oriented(image, number) for number in range(ORIENTATIONS)]


def picture(name: str = "camera", dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.from_numpy(photograph(name, 48, 64).copy()).to(dtype)[None, None]


def test_pixels_of_an_orientation_are_where_it_puts_them() -> None:
    numbers = torch.arange(6 * 9)
    pixels = source_pixels(torch.arange(ORIENTATIONS), (6, 9), numbers)
    for number, indices in enumerate(pixels):
        assert torch.equal(indices, oriented(numbers.view(6, 9), number).flatten())


@example(height=1, width=6, levels=3, seed=288)  # centres of gravity in the middle
@given(height=st.integers(1, 9), width=st.integers(1, 9), levels=st.integers(1, 3), seed=st.integers(0, 1000))
def test_all_orientations_of_an_image_have_the_same_canonical_one(
    height: int, width: int, levels: int, seed: int
) -> None:
    image = torch.randint(levels, (height, width), generator=torch.Generator().manual_seed(seed)).float()
    canonical = []
    for turned in every_orientation(image):
        number = orientations(turned.reshape(1, 1, -1), turned.shape, Layout(1, coordinates=False)).numbers
        canonical.append(oriented(turned, int(number)))
    assert all(torch.equal(canonical[0], other) for other in canonical[1:])


@pytest.mark.parametrize("name", list(hard_images()))
def test_hard_images_too(name: str) -> None:
    image = torch.from_numpy(hard_images()[name].copy())
    canonical = []
    for turned in every_orientation(image):
        number = orientations(turned.reshape(1, 1, -1), turned.shape, Layout(1, coordinates=False)).numbers
        canonical.append(oriented(turned, int(number)))
    assert all(torch.equal(canonical[0], other) for other in canonical[1:])


def test_a_small_change_keeps_the_orientation() -> None:
    image = picture("coffee").reshape(1, 1, -1)
    noise = 1e-3 * torch.randn(20, 1, image.shape[2], generator=torch.Generator().manual_seed(0))
    numbers = orientations(image + noise, (48, 64), Layout(1, coordinates=False)).numbers
    assert len(numbers.unique()) == 1


def test_sums_over_tiles_are_those_of_the_image() -> None:
    image = (picture() - picture().amin()) / (picture().amax() - picture().amin())
    whole = orientations(image.flatten(2), (48, 64), Layout(1, coordinates=False)).numbers
    tiles = [orientation_sums(image[:, :, start : start + 7], start, (48, 64)) for start in range(0, 48, 7)]
    assert torch.equal(orientation_of(torch.stack(tiles).sum(0), 1).numbers, whole)


@pytest.mark.parametrize(
    ("dtype", "spatial_bandwidth"), each_value([torch.float32, torch.float64], [None, 12.0, (5.0, 7.0)])
)
def test_candidates_of_all_orientations_are_equal_to_the_last_bit(
    dtype: torch.dtype, spatial_bandwidth: float | tuple[float, float] | None
) -> None:
    image = picture("astronaut", dtype)
    window, pixels, points = unit_window(5, None).to(dtype), torch.arange(0, 48 * 64, 37), []
    for number in range(ORIENTATIONS):
        bandwidths = spatial_bandwidth
        if isinstance(bandwidths, tuple) and number & 4:
            bandwidths = (bandwidths[1], bandwidths[0])
        recipe, turned = GuideFeatures(window, 0.1, bandwidths, "luminance"), oriented(image, number)
        size = (turned.shape[2], turned.shape[3])
        assert recipe.layout is not None
        features = recipe(turned)
        orientation = orientations(features, size, recipe.layout)
        source = partial(source_pixels, orientation.numbers, size, pixels)
        points.append(canonical_candidates(features, source, orientation, recipe.layout)[2])
    assert all(torch.equal(points[0], other) for other in points[1:])


@pytest.mark.parametrize(
    ("options", "number"),
    each_value(
        [{}, {"spatial_bandwidth": 12.0}, {"num_landmarks": 300, "guide_channels": "all"}], range(1, ORIENTATIONS)
    ),
)
def test_the_layer_is_equivariant(options: dict[str, object], number: int) -> None:
    colours = torch.cat([picture(), picture("coffee"), picture().flip(2)], dim=1)
    layer = NonlocalFilter(alpha=(3, 1), photometric_bandwidth=20 / 255, **options)  # type: ignore[arg-type]
    with torch.no_grad():
        result, turned = layer(colours), layer(oriented(colours, number))
    assert (inverse(turned, number) - result).abs().max() < LEVELS


def test_each_image_of_a_batch_has_its_own_orientation() -> None:
    batch = torch.cat([oriented(picture(), number) for number in range(4)])
    operator = nonlocal_operator(batch, photometric_bandwidth=20 / 255)
    alone = nonlocal_operator(picture(), photometric_bandwidth=20 / 255) @ picture()
    for number, result in enumerate((operator @ batch).split(1)):
        assert (inverse(result, number) - alone).abs().max() < LEVELS


def test_compiled_layers_choose_the_same_landmarks() -> None:
    image = oriented(picture(), 5)
    program = torch.export.export(NonlocalFilter(alpha=(3, 1), photometric_bandwidth=0.1), (image,)).module()
    expected = NonlocalFilter(alpha=(3, 1), photometric_bandwidth=0.1)(image)
    torch.testing.assert_close(program(image), expected, atol=1e-5, rtol=0)
