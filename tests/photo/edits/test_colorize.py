"""Colours from strokes: propagation, saturation, and the comparison of both estimates."""

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo import colorize
from nlfilter_torch.photo.edits.colorize import (
    Method,
    Operators,
    bandwidth_ratio,
    colorize_guide,
    compared,
    extended,
    limit_saturation,
    weighted_mean,
)
from nlfilter_torch.photo.picture.colour import merge_luminance, split_luminance
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.measuring import reduced
from nlfilter_torch.photo.picture.source import luminance as luminance_of
from nlfilter_torch.photo.selections.local_values import RELATIVE, LocalValues
from tests.problems import box, colour, luminance, noise, paint
from tests.strokes import SIZE, dots, groups_of


def test_strokes_of_a_narrow_picture_stay_where_they_are() -> None:
    """The rounding of the reduced size makes the scales of rows and columns differ by 2 %."""
    grey = 0.5 + 0.01 * noise(1, 1, 3000, 31, dtype=torch.float32)
    above, below = box(2800, 8, 20, 16, size=(3000, 31)), box(2900, 8, 20, 16, size=(3000, 31))
    strokes, painted = paint(0.8, 0.2, 0.2, above) + paint(0.2, 0.2, 0.8, below), above + below
    coloured = colorize(grey, strokes, painted, viewing_size=0.01, num_landmarks=40)
    redness = (coloured[:, 0] - coloured[:, 2])[..., 8:24].mean((0, 2))
    assert redness[2800:2820].mean() > 0.1
    assert redness[2900:2920].mean() < -0.1


def test_colours_come_back_from_strokes() -> None:
    image = colour("coffee", 60, 90)
    mask = torch.zeros(1, 1, 60, 90)
    for row, column in np.random.default_rng(0).integers(0, (56, 86), (12, 2)):
        mask[..., row : row + 4, column : column + 4] = 1
    coloured = colorize(luminance(image), image * mask, mask)
    assert (luminance(coloured) - luminance(image)).abs().max() < 1e-4
    assert (coloured - image).square().mean() < 0.3 * (luminance(image) - image).square().mean()
    pieces = colorize(luminance(image), image * mask, mask, method="kmeans")
    assert (luminance(pieces) - luminance(image)).abs().max() < 1e-4
    assert not torch.equal(pieces, coloured)


def test_strength_decides_what_becomes_of_the_rest() -> None:
    grey = torch.full((1, 1, 40, 40), 0.2)
    grey[..., 20:] = 0.8
    stroke = box(10, 4, size=(40, 40))

    def chroma(strength: float) -> torch.Tensor:
        coloured = colorize(grey, paint(0.4, 0.1, 0.1, stroke), stroke, strength=strength, num_landmarks=40)
        return split_luminance(coloured)[1][..., 26:].abs().mean()

    assert chroma(0.0) < 0.01 < chroma(0.5) < chroma(1.0)


def test_a_line_between_equal_greys_keeps_their_colours_apart() -> None:
    grey = torch.full((1, 1, 40, 60), 0.5)
    grey[..., 29:31] = 0.1
    left, right = box(10, 24, size=(40, 60)), box(26, 33, size=(40, 60))
    coloured = colorize(grey, paint(0.8, 0.2, 0.2, left) + paint(0.2, 0.2, 0.8, right), left + right, num_landmarks=40)
    redder = (coloured[:, 0] - coloured[:, 2])[0]
    # With similarity alone, a quarter of the right half would be red.
    assert (redder[:, :28] > 0).float().mean() > 0.97
    assert (redder[:, 32:] < 0).float().mean() > 0.97


def test_the_guide_measures_brightness_of_even_areas_and_tells_textures_from_them() -> None:
    image = torch.full((1, 1, 40, 120), 0.3)
    image[..., 40:80] += 0.2
    image[..., 80:] += 0.2 + 0.3 * (torch.rand(1, 1, 40, 40, generator=torch.Generator().manual_seed(0)) - 0.5)
    dark, bright, textured = colorize_guide(image)[0, :, 20, [20, 60, 100]].unbind(1)
    torch.testing.assert_close((bright - dark).square().mean().sqrt(), torch.tensor(0.2), atol=1e-4, rtol=0)
    assert (textured - bright).square().mean().sqrt() > 0.2


def test_the_mean_of_estimates_leaves_out_what_differs_and_what_nothing_supports() -> None:
    def pixel(*chroma: float) -> torch.Tensor:
        return torch.tensor(chroma).view(1, 2, 1, 1)

    red, blue, certain, none = pixel(0.3, -0.1), pixel(-0.1, 0.3), torch.ones(1, 1, 1, 1), torch.zeros(1, 1, 1, 1)
    torch.testing.assert_close(weighted_mean((red, red, red), (certain, certain, 1.0)), red)
    assert (weighted_mean((blue, red, red), (certain, certain, 1.0)) - red).norm() < 0.3 * (blue - red).norm()
    torch.testing.assert_close(weighted_mean((blue, blue, red), (none, none, 1.0)), red)


def test_saturation_is_limited_to_that_of_another_colour() -> None:
    chroma = torch.tensor([[0.3, 0.4], [0.1, 0.0], [0.0, 0.0]]).mT.view(1, 2, 1, 3)
    other = torch.tensor([[-0.25, 0.0], [0.0, 0.2], [0.1, 0.1]]).mT.view(1, 2, 1, 3)
    wanted = torch.tensor([[0.15, 0.2], [0.1, 0.0], [0.0, 0.0]]).mT.view(1, 2, 1, 3)
    torch.testing.assert_close(limit_saturation(chroma, other), wanted, atol=1e-6, rtol=0)


def test_chroma_is_proportional_to_that_of_the_strokes() -> None:
    image = colour("coffee", 60, 90)
    grey, chroma = luminance(image), split_luminance(image)[1]
    mask = torch.zeros(1, 1, 60, 90)
    for row, column in np.random.default_rng(1).integers(0, (56, 86), (8, 2)):
        mask[..., row : row + 4, column : column + 4] = 1

    def coloured(saturation: float) -> torch.Tensor:
        return colorize(grey, (grey + saturation * chroma) * mask, mask) - grey

    strong, faint = coloured(0.2), coloured(0.01)
    assert strong.abs().max() > 0.02
    torch.testing.assert_close(20 * faint, strong, atol=1e-5, rtol=0)
    assert coloured(0.0).abs().max() < 1e-6


def test_colours_spread_farther_where_brightness_changes_less() -> None:
    bands = torch.where(torch.arange(80) < 4, 0.2, 0.5).view(1, 1, 80, 1).expand(1, 1, 80, 80)
    beside, above = box(40, 18, 4, 4, size=(80, 80)), box(20, 38, 4, 4, size=(80, 80))
    strokes, painted = paint(0.8, 0.2, 0.2, beside) + paint(0.2, 0.2, 0.8, above), beside + above

    def redness(turned: bool) -> torch.Tensor:
        arguments = (x.mT if turned else x for x in (bands, strokes, painted))
        coloured = colorize(*arguments, num_landmarks=100)
        red, _, blue = (coloured.mT if turned else coloured)[0, :, 40:44, 38:42].mean((1, 2))
        return red - blue

    assert redness(turned=False) > 0.02
    assert redness(turned=True) > 0.02


def test_the_ratio_of_bandwidths_follows_the_changes_of_brightness_at_a_large_scale() -> None:
    picture = luminance(colour("rocket", 60, 90))
    ramp = torch.linspace(0.0, 1.0, 60).view(1, 1, 60, 1).expand(1, 1, 60, 90)
    stripes = (torch.arange(96) % 2).expand(1, 1, 64, 96).float()

    def ratio(image: torch.Tensor) -> float:
        return float(bandwidth_ratio(InMemory(image)))

    assert ratio(ramp) == 3.0
    assert ratio(stripes) == 1.0
    assert ratio(torch.full((1, 1, 60, 90), 0.3)) == pytest.approx(1.0, abs=1e-4)
    assert 0.4 < ratio(picture) < 0.95
    assert ratio(picture.mT) * ratio(picture) == pytest.approx(1.0, rel=1e-4)
    odd = luminance(colour("astronaut", 161, 161))  # of a size that blocks of whole pixels do not divide
    for turned in (odd.flip(2), odd.flip(3)):
        assert ratio(turned) == pytest.approx(ratio(odd), rel=1e-6)
    assert ratio(ramp[..., :1]) == 3.0
    assert ratio(ramp[..., :1].mT) == pytest.approx(1 / 3)


def test_shadows_and_highlights_of_a_coloured_object_get_less_chroma_than_its_midtones() -> None:
    grey = torch.linspace(0.0, 1.0, 60).expand(1, 1, 40, 60)
    dot = box(20, 30, 2, 2, size=(40, 60))
    chroma = split_luminance(colorize(grey, paint(0.6, 0.5, 0.3, dot), dot, num_landmarks=40))[1][0].norm(dim=0)
    assert chroma[20, 30] > 0.9 * chroma.max()
    assert (chroma[:, [4, 57]] < 0.7 * chroma[:, 30:31]).all()
    assert (chroma[:, [4, 55]] > 0.01).all()


def test_strokes_of_another_scale_are_reported() -> None:
    image, mask = colour("coffee", 24, 24), box(4, 4, size=(24, 24))
    with pytest.warns(UserWarning, match=r"strokes must be in or near \[0, 1\], got values up to"):
        colorize(luminance(image), 255 * image * mask, mask, num_landmarks=20)


def test_one_pixel_and_all_pixels_may_be_painted() -> None:
    image = colour("chelsea", 40, 60)
    dot = box(20, 30, 1, 1, size=(40, 60))
    wanted = split_luminance(image)[1][..., 20:21, 30:31]
    coloured = split_luminance(colorize(luminance(image), image * dot, dot))[1]
    torch.testing.assert_close(coloured[..., 20:21, 30:31], wanted, atol=0.02, rtol=0)
    full = colorize(luminance(image), image, torch.ones(1, 1, 40, 60))
    assert (full - image).abs().mean() < 0.01


@pytest.mark.parametrize("method", ["regression", "kmeans"])
def test_what_lies_outside_a_box_stays_grey(method: Method) -> None:
    grey = 0.1 * noise(1, 1, 40, 48, dtype=torch.float32) + 0.4
    strokes, painted = paint(0.9, 0.2, 0.1, box(16, 18, 4, 8, size=(40, 48))), box(16, 18, 4, 8, size=(40, 48))
    options: dict[str, Any] = {"method": method, "num_landmarks": 50}
    limited, everywhere = (colorize(grey, strokes, painted, box=b, **options) for b in ((10, 8, 38, 30), None))
    outside = 1 - box(8, 10, 22, 28, size=(40, 48))
    torch.testing.assert_close(limited * outside, (grey * outside).expand(-1, 3, -1, -1))
    assert ((limited[:, 0] - limited[:, 2])[..., 16:20, 18:26] > 0.05).all()
    assert ((everywhere[:, 0] - everywhere[:, 2])[..., 2:6, 2:6] > 0.05).any()
    with pytest.raises(ValueError, match=r"^box must hold most of the strokes on its object"):
        colorize(grey, strokes, painted, box=(0, 0, 9, 9), **options)


def test_a_stroke_darker_or_lighter_than_what_is_under_it_gives_less_chroma() -> None:
    """One in the picture's own brightness gives all of its chroma; as a factor, the root of that of HSL saturation."""
    grey, dot = torch.full((1, 1, 40, 40), 0.6), box(16, 16, 8, 8, size=(40, 40))
    chroma = torch.tensor([-0.1, 0.08, -0.155]).view(1, 3, 1, 1)
    chroma = chroma - split_luminance(chroma)[0]

    def strength(level: float) -> float:
        coloured = colorize(grey, (level + chroma) * dot, dot, num_landmarks=40)
        return float((split_luminance(coloured)[1] * dot).norm() / (chroma * dot).norm())

    assert strength(0.6) == pytest.approx(1.0, abs=0.01)
    assert strength(0.8) == pytest.approx((0.61 / 0.81) ** 0.5, abs=0.01)
    assert strength(0.3) == pytest.approx((0.41 / 0.71) ** 0.5, abs=0.01)


def test_a_colour_too_strong_for_its_luminance_is_weakened() -> None:
    grey, chroma = torch.tensor([0.05, 0.5, 0.98]).view(1, 1, 1, 3), paint(1, 0, 0, torch.ones(1, 1, 1, 3))
    coloured = merge_luminance(grey, split_luminance(chroma)[1])
    assert coloured.min() >= 0
    assert coloured.max() <= 1
    torch.testing.assert_close(luminance(coloured), grey)


def test_segments_of_an_image_do_not_depend_on_the_colours_of_others() -> None:
    generator = torch.Generator().manual_seed(3)
    grey = F.interpolate(torch.rand(2, 1, 6, 6, generator=generator), (28, 28), mode="bilinear") * 0.8 + 0.1
    strokes, mask = torch.zeros(2, 3, 28, 28), torch.zeros(2, 1, 28, 28)
    for image, top, left, channel in ((0, 2, 2, 0), (0, 20, 20, 2), (1, 2, 2, 0), (1, 20, 20, 2), (1, 2, 20, 1)):
        strokes[image, channel, top : top + 3, left : left + 3] = 1
        mask[image, :, top : top + 3, left : left + 3] = 1
    both = colorize(grey, strokes, mask, method="kmeans", num_landmarks=40)
    for i in (slice(0, 1), slice(1, 2)):
        single = colorize(grey[i], strokes[i], mask[i], method="kmeans", num_landmarks=40)
        torch.testing.assert_close(both[i], single, atol=1e-5, rtol=0)


def test_neither_estimate_predicts_a_stroke_from_itself() -> None:
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(1, 1, *SIZE, generator=generator)
    mask = box(2, 3, 3, 3, size=SIZE) + box(12, 20, 3, 3, size=SIZE) + box(4, 16, 3, 3, size=SIZE)
    groups, places = groups_of(mask)
    weights, source = torch.ones(1, 1, len(places)), InMemory(image)

    options = FilterOptions(photometric_bandwidth=0.2, patch_size=1, num_landmarks=30)
    operators = Operators(options, source, (torch.tensor([9.0]), torch.tensor([9.0])))

    def predictions(values: Tensor) -> tuple[Tensor, Tensor]:
        sets = [weights, *groups.weights_without_each(weights)]
        (far, near), residuals = extended(operators, places, sets, values, 1.0)
        whole = (far(source) + near(source))[:, :2].flatten(2)[:, :, places]
        torch.testing.assert_close(values - residuals[0], whole, rtol=1e-4, atol=1e-5)
        guide = reduced(source, luminance_of, 1)
        local = LocalValues.of(RELATIVE, guide, SIZE, places, weights, values, groups, values).left_out
        assert local is not None
        return values - groups.of_own(residuals[1:]), (local[:, :2] / local[:, 2:]).to(values)

    values = torch.rand(1, 2, len(places), generator=generator)
    changed = torch.where(groups.strokes[0] == 1, values + 0.5, values)
    for before, after in zip(predictions(values), predictions(changed), strict=True):
        torch.testing.assert_close(before[:, :, groups.strokes[0] == 1], after[:, :, groups.strokes[0] == 1])
        assert (before - after)[:, :, groups.strokes[0] != 1].abs().max() > 1e-3


def test_the_regression_counts_more_if_it_predicts_strokes_better_and_if_there_are_more_of_them() -> None:
    mask = torch.cat([dots((2, 3), (9, 20), (15, 8))] * 2 + [dots((2, 3))])
    groups, places = groups_of(mask)
    weights, wanted = mask.flatten(2)[:, :, places], torch.zeros(3, 2, 3)
    flow = torch.full((3, 3, 3), 0.5, dtype=torch.float64)
    flow[:, :2] *= 0.13**0.5  # all predictions are off by this
    flow[2] = 0  # a single stroke: nothing is compared
    residual = torch.full((3, 2, 3), 0.13**0.5)
    residual[1] = 0.0
    factors = compared(groups, weights, residual, wanted, flow).flatten()
    few, none = 4 / (4 + 5), 1 / (1 + 5)  # for three strokes and for no comparison
    torch.testing.assert_close(factors, torch.tensor([few, 3 * few, none]))
    assert compared(groups, weights, residual * 9, wanted, flow)[0] < 0.01


def test_colours_do_not_depend_on_other_images_of_a_batch() -> None:
    image = torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(4))
    mask = torch.cat([dots((2, 3), (9, 20), (15, 8), (4, 24), (10, 9)), dots((3, 3), (9, 21))])
    grey = image.mean(1, keepdim=True)
    both = colorize(grey, image, mask, num_landmarks=30)
    for k in range(2):
        alone = colorize(grey[k : k + 1], image[k : k + 1], mask[k : k + 1], num_landmarks=30)
        torch.testing.assert_close(both[k : k + 1], alone, atol=1e-4, rtol=0)


def test_what_no_stroke_is_connected_with_takes_the_colour_of_its_like(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(3)
    rough = 0.5 + 0.2 * torch.randn(1, 1, 48, 72, generator=generator)
    grey = torch.where(torch.arange(72) // 24 == 1, torch.full_like(rough, 0.5), rough).clamp(0, 1)
    left, middle = box(20, 6, size=(48, 72)), box(20, 34, size=(48, 72))
    strokes = paint(0.8, 0.3, 0.3, left) + paint(0.3, 0.3, 0.8, middle)

    def red_on_the_right() -> float:
        coloured = colorize(grey, strokes, left + middle, num_landmarks=60)
        return float((coloured[:, 0] > coloured[:, 2])[..., 52:].float().mean())

    assert red_on_the_right() > 0.8
    monkeypatch.setattr("nlfilter_torch.photo.edits.colorize.MOST_CUT", 0)
    assert red_on_the_right() < 0.5
