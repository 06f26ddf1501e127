"""Colours: luminance at constant chroma, chroma within gamut, and groups of colours."""

import pytest
import skimage.color
import torch

from nlfilter_torch.photo.picture.colour import (
    colour_guide,
    dot,
    edit_luminance,
    group_colours,
    hundredths_of_lab,
    merge_luminance,
    region_means,
    split_luminance,
    with_green,
)
from tests.problems import box, cat, colour, luminance, noise


def test_an_edit_of_luminance_keeps_the_differences_of_the_channels() -> None:
    image = colour("coffee", 20, 30).double()
    edited = edit_luminance(image, lambda y: y.sqrt())
    torch.testing.assert_close(luminance(edited), luminance(image).sqrt())
    torch.testing.assert_close(edited - luminance(edited), image - luminance(image))
    two = image[:, :2]
    assert torch.equal(edit_luminance(two, lambda planes: 2 * planes), 2 * two)  # not RGB: all channels are edited


def test_luminance_and_chroma_are_the_image() -> None:
    image = colour("coffee", 20, 30).double()
    grey, chroma = split_luminance(image)
    torch.testing.assert_close(merge_luminance(grey, chroma), image)
    torch.testing.assert_close(luminance(chroma), torch.zeros_like(grey), atol=1e-7, rtol=0)
    torch.testing.assert_close(with_green(chroma[:, ::2]), chroma, atol=1e-6, rtol=0)


def test_chroma_beyond_the_gamut_is_scaled_down_and_luminance_kept() -> None:
    grey, chroma = noise(1, 1, 9, 9), with_green(noise(1, 2, 9, 9, seed=1) - 0.5)
    merged = merge_luminance(grey, 4 * chroma)
    assert merged.min() > -1e-9
    assert merged.max() < 1 + 1e-9
    torch.testing.assert_close(luminance(merged), grey, atol=1e-6, rtol=0)
    hues = torch.linalg.cross(merged - luminance(merged), chroma, dim=1)
    torch.testing.assert_close(hues, torch.zeros_like(hues), atol=1e-6, rtol=0)


@pytest.mark.parametrize("channels", [1, 3])
def test_lab_is_that_of_scikit_image(channels: int) -> None:
    image = colour("coffee", 20, 30)[:, :channels]
    wanted = skimage.color.rgb2lab(image[0].expand(3, -1, -1).permute(1, 2, 0).double().numpy()) / 100
    torch.testing.assert_close(
        hundredths_of_lab(image)[0].permute(1, 2, 0).double(), torch.from_numpy(wanted), atol=2e-4, rtol=0
    )


def test_lightness_counts_less_than_colour() -> None:
    image = colour("coffee", 20, 30)
    torch.testing.assert_close(
        colour_guide(image), hundredths_of_lab(image) * torch.tensor([0.3, 1.0, 1.0]).view(1, 3, 1, 1)
    )


def test_products_are_summed_along_any_dimension() -> None:
    a, b = noise(2, 3, 4, 5), noise(2, 3, 4, 5, seed=1)
    for dim in (1, 2):
        torch.testing.assert_close(dot(a, b, dim), (a * b).sum(dim, keepdim=True))


def test_strokes_of_more_than_sixteen_colours_join_the_nearest_group() -> None:
    reds = torch.linspace(-0.5, 0.5, 20).view(1, 1, 1, 20)
    chroma = torch.cat([reds, torch.zeros(1, 2, 1, 20)], dim=1)
    weights = torch.ones(1, 1, 1, 20)
    weights[..., 19] = 0
    regions, means, valid = group_colours(chroma, weights)
    double = chroma.double()
    assert torch.equal(group_colours(double, weights.double())[0], regions.double())
    assert torch.equal(double, chroma.double())  # it is only read
    assert regions.shape == (1, 16, 1, 20)
    assert valid.all()
    assert torch.equal(regions.sum(1), weights[:, 0])  # each painted pixel is in one of them
    assert float(regions[0, 15, 0, 15:19].sum()) == 4  # the last colours are nearest to the sixteenth
    torch.testing.assert_close(means[0, 15, 0], reds[..., 15:19].mean())


def test_edit_luminance_keeps_colour() -> None:
    image = cat()
    torch.testing.assert_close(edit_luminance(image, lambda y: y), image, atol=0, rtol=0)
    torch.testing.assert_close(edit_luminance(image, lambda y: y + 0.1), image + 0.1)
    grey = image[:, :1]
    assert torch.equal(edit_luminance(grey, lambda y: 2 * y), 2 * grey)


def test_a_colour_is_the_same_to_the_last_bit_wherever_it_stands() -> None:
    image = colour("astronaut", 61, 83)
    guide = colour_guide(image)
    for rows in (slice(0, 1), slice(3, 10), slice(20, 61)):
        assert torch.equal(colour_guide(image[:, :, rows]), guide[:, :, rows])


def test_groups_of_colours_are_kept_apart_image_by_image() -> None:
    chroma = torch.zeros(2, 3, 1, 40)
    chroma[0, 0] = torch.arange(40) * 0.1  # forty colours
    regions, means, counts = group_colours(chroma, torch.ones(2, 1, 1, 40))
    assert regions.shape == (2, 16, 1, 40)
    assert counts[0].all()
    assert counts[1].tolist() == [True] + [False] * 15
    torch.testing.assert_close(regions[0].sum(0), torch.ones(1, 40))  # the remaining colours joined the nearest group
    assert torch.equal(means[1], torch.zeros(16, 3))


def test_means_of_regions_are_exact_on_large_images() -> None:
    mask = box(300, 300, 600, 600, size=(1400, 1400)) * 0.7
    image = 0.9 + 0.1 * noise(1, 3, 1400, 1400, dtype=torch.float32)
    wanted = (image.double() * mask.double()).sum((2, 3)) / mask.double().sum()
    torch.testing.assert_close(region_means(image, mask)[:, 0].double(), wanted, rtol=0, atol=1e-7)


def test_groups_of_colours_depend_on_the_colours_alone() -> None:
    """The order of the pixels, which changes when a picture is turned, does not matter."""
    chroma = split_luminance(colour("coffee", 24, 30))[1]
    painted = torch.ones(1, 1, 24, 30)
    regions, means, valid = group_colours(chroma, painted)
    assert valid.all()
    assert 3 < regions.shape[1] <= 16
    order = torch.randperm(24 * 30, generator=torch.Generator().manual_seed(0))
    mixed = chroma.flatten(2)[..., order].unflatten(2, (24, 30))
    other, other_means, _ = group_colours(mixed, painted)
    torch.testing.assert_close(other_means, means)
    assert torch.equal(other.flatten(2), regions.flatten(2)[..., order])


def test_groups_have_the_colours_of_most_pixels_and_take_in_the_nearest() -> None:
    """Between two colours, each with a few pixels that differ a little, lies a third, nearer to the rarer of them."""
    line = [0.0] * 30 + [0.02] * 5 + [0.2] * 12 + [0.22] * 3 + [0.13]
    chroma = torch.tensor(line).view(1, 1, 1, -1) * torch.tensor([1.0, 0.0, -1.0]).view(1, 3, 1, 1)
    regions, means, _ = group_colours(chroma, torch.ones(1, 1, 1, len(line)))
    assert regions[0, :, 0].sum(1).tolist() == [35.0, 15.0, 1.0]
    torch.testing.assert_close(means[0, :, 0], torch.tensor([0.1 / 35, (12 * 0.2 + 3 * 0.22) / 15, 0.13]))
