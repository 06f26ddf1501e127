"""Turning against kornia at once and against numpy; strokes in place; errors and gradients."""

import math
from dataclasses import replace

import pytest
import torch
from kornia.geometry import rotate
from torch.autograd import gradcheck

from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.developing import develop_planes, reframed, turned_canvas
from nlfilter_torch.photo.picture.light import develop_image
from nlfilter_torch.photo.picture.resizing import resize
from tests.pairwise import each_value
from tests.problems import colour


def test_turned_as_kornia_does_at_once() -> None:
    image = colour("astronaut", 300, 420)
    frame = Development(straighten=7.0).frame((300, 420))
    whole = rotate(image.double(), torch.tensor([-7.0]).double(), mode="bicubic", padding_mode="border")
    wanted = whole[..., frame.top : frame.top + frame.height, frame.left : frame.left + frame.width].clamp(0, 1)
    edited = develop_image(image, Development(straighten=7.0))
    assert edited.shape[-2:] == frame.size
    assert (edited - wanted).abs().max() < 1e-3


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarters_of_a_turn_move_pixels(quarters: int) -> None:
    image = colour("chelsea", 30, 40)
    turned = image.rot90(-quarters, (2, 3))
    assert torch.equal(develop_image(image, Development(rotate=90 * quarters)), turned)
    crop = Development(rotate=90 * quarters, crop=(0.1, 0.2, 0.8, 0.9))
    assert torch.equal(develop_image(image, crop), develop_image(turned, replace(crop, rotate=0)))
    both = Development(rotate=90 * quarters, straighten=6.0)
    assert torch.equal(develop_image(image, both), develop_image(turned, Development(straighten=6.0)))
    assert turned_canvas(image, both).shape == turned.shape
    frame = crop.frame((30, 40))
    column, row = frame.inward((12 + 0.5) / 40, (17 + 0.5) / 30)
    place = int(row * frame.height), int(column * frame.width)
    assert torch.equal(develop_image(image, crop)[..., *place], image[..., 17, 12])
    assert frame.outward(column, row) == pytest.approx((12.5 / 40, 17.5 / 30))
    again = Development(crop=(0.1, 0.2, 0.8, 0.9)).quartered(quarters)
    shown = develop_image(image, Development(crop=(0.1, 0.2, 0.8, 0.9)))
    assert torch.equal(develop_image(image, again), shown.rot90(-quarters, (2, 3)))


def test_a_point_is_where_its_stroke_is() -> None:
    """The middle of a bright spot, before and after, in pixels of the developed picture."""
    y, x = torch.meshgrid(torch.arange(200.0), torch.arange(300.0), indexing="ij")
    spot = torch.exp(-((x + 0.5 - 120) ** 2 + (y + 0.5 - 80) ** 2) / 50)[None, None]
    development = Development(straighten=-12.0, crop=(0.1, 0.2, 0.8, 0.9))
    turned, frame = develop_image(spot, development), development.frame((200, 300))
    rows, columns = (torch.arange(n) + 0.5 for n in frame.size)
    middle = [float((turned.sum(axis) * places).sum() / turned.sum()) for axis, places in ((2, columns), (3, rows))]
    share = frame.inward(120 / 300, 80 / 200)
    assert middle == pytest.approx([share[0] * frame.width, share[1] * frame.height], abs=0.05)


@pytest.mark.parametrize(("size", "degrees"), each_value([(1, 1), (1, 7), (2, 3), (5, 1)], [-45.0, 3.0]))
def test_tiny_pictures(size: tuple[int, int], degrees: float) -> None:
    edited = develop_image(torch.full((2, 3, *size), 0.4), Development(straighten=degrees, exposure=1.0))
    assert torch.allclose(edited, edited[:1, :1, :1, :1].expand_as(edited), atol=1e-6)
    assert math.prod(edited.shape[-2:]) >= 1


def test_what_changes_nothing_returns_the_image() -> None:
    image = torch.rand(1, 3, 4, 5)
    assert develop_image(image, Development()) is image
    assert torch.equal(develop_image(image, Development(crop=(0.2, 0.0, 1.0, 0.5))), image[..., :2, 1:])


@pytest.mark.parametrize("channels", [2, 4])
def test_only_grey_and_rgb_are_developed(channels: int) -> None:
    sentence = (
        rf"image must have shape \(B, C, H, W\) with 1 or 3 channels, got \(1, {channels}, 5, 6\); pass grey or RGB"
    )
    with pytest.raises(ValueError, match=sentence):
        develop_image(torch.zeros(1, channels, 5, 6), Development(warmth=1.0))
    with pytest.raises(TypeError, match="image must have a floating-point dtype"):
        develop_image(torch.zeros(1, 3, 5, 6, dtype=torch.uint8), Development(exposure=1.0))


def test_gradients() -> None:
    image = torch.rand(1, 3, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for development in (Development(exposure=-0.5, warmth=0.3, tint=0.1), Development(straighten=5.0, rotate=270)):
        assert gradcheck(lambda values, d=development: develop_image(values, d), (0.1 + 0.5 * image).requires_grad_())


def test_a_recipe_develops_first() -> None:
    image = colour("chelsea", 60, 80)
    development = Development(exposure=0.3, straighten=4.0, crop=(0.0, 0.0, 0.8, 1.0))
    stroke = Stroke(((0.3, 0.4), (0.4, 0.4)), 0.05, "in")
    steps = (Step("detail", (stroke,), inside=(2.0, 1.0), alpha=(1.0, 1.0), landmarks=30), Step("tone"))
    recipe = Recipe(steps, development)
    edited = apply_recipe(recipe, image)
    wanted = apply_recipe(recipe.on_developed((60, 80)), develop_image(image, development))
    assert torch.allclose(edited, wanted, atol=1e-6)


def test_a_developed_picture_in_another_frame() -> None:
    image = resize(colour("chelsea", 20, 30), (100, 150))  # smooth
    before = Development(straighten=2.0).frame((100, 150))
    after = Development(straighten=5.0, crop=(0.2, 0.2, 0.9, 0.8)).frame((100, 150))
    shown = reframed(develop_planes(image, before), before, after, after.size)
    assert (shown - develop_planes(image, after)).abs().max() < 0.02
    same = develop_planes(image, before)
    assert torch.allclose(reframed(same, before, before, before.size), same, atol=1e-5)
