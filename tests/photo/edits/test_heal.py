"""Spots that are healed: with texture, without seams, in memory and in tiles."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from nlfilter_torch.photo import Region, Step, Stroke, apply_step, heal, stream
from nlfilter_torch.photo.edits import heal as module
from tests.problems import box, colour, noise

SIZE = (48, 52)
SPOT = box(20, 22, 7, 6, size=SIZE)


def test_a_repeated_texture_is_restored() -> None:
    tile = noise(1, 3, 8, 8, dtype=torch.float32)
    image = tile.repeat(1, 1, 6, 7)[..., :52]
    healed = heal(torch.where(SPOT > 0, 1.0, image), SPOT)
    assert (healed - image).abs().max() < 1e-4


def test_texture_on_a_slope_of_light_has_no_seam() -> None:
    light = torch.linspace(0.2, 0.7, 52).expand(1, 3, *SIZE)
    grain = 0.04 * (noise(1, 3, *SIZE, dtype=torch.float32) - 0.5)
    healed = heal(torch.where(SPOT > 0, 0.0, light + grain), SPOT)
    inside = (healed - light)[..., 20:27, 22:28]
    assert inside.std() > 0.5 * grain.std()
    assert inside.abs().max() < 0.05
    assert torch.equal(healed[(SPOT == 0).expand_as(healed)], (light + grain)[(SPOT == 0).expand_as(healed)])


def test_where_no_patch_fits_a_membrane_is_left() -> None:
    image = torch.linspace(0.2, 0.7, 12).expand(1, 1, 12, 12).clone()
    spot = box(2, 2, 8, 8, size=(12, 12))
    assert (heal(torch.where(spot > 0, 1.0, image), spot) - image).abs().max() < 1e-5


def test_spots_at_the_corner_and_several_at_once() -> None:
    image = colour("astronaut", *SIZE)
    corner, inner = box(0, 0, 5, 5, size=SIZE), box(30, 30, 5, 5, size=SIZE)
    both = heal(image, corner + inner)
    assert torch.isfinite(both).all()
    assert (both - image)[..., :5, :5].abs().max() > 0
    assert (heal(image, inner) - both)[..., 30:35, 30:35].abs().max() < 1e-6
    half = heal(image, 0.5 * inner)
    assert (half - (image + heal(image, inner)) / 2).abs().max() < 1e-6


def test_gradients() -> None:
    image = 0.2 + 0.6 * noise(1, 2, 9, 10)
    spot = 0.8 * box(4, 4, 2, 2, size=(9, 10)).double()
    assert gradcheck(lambda x: heal(x, spot, reach=2.0), (image.requires_grad_(),))


def test_tiles_give_the_same() -> None:
    picture = (colour("astronaut", 60, 44)[0].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    step = Step(
        "heal", (Stroke(((0.5, 0.4), (0.6, 0.5)), 0.08, "in"), Region.upright((0.1, 0.7, 0.1, 0.1), "ellipse", "in"))
    )
    whole = apply_step(step, torch.from_numpy(picture).permute(2, 0, 1)[None] / 255)
    target = np.zeros(picture.shape, np.float32)
    stream(step, picture, target, tile_rows=7)
    assert np.abs(target - whole[0].permute(1, 2, 0).numpy()).max() < 1e-6
    assert np.abs(target - picture / 255).max() > 0.01


def test_each_image_of_a_batch_has_patches_of_its_own() -> None:
    images = torch.cat([colour("astronaut", *SIZE), colour("astronaut", *SIZE).flip(3)])
    both = heal(images, SPOT)
    for number in range(2):
        assert (both[number] - heal(images[number : number + 1], SPOT)[0]).abs().max() < 1e-6


def test_what_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    image = colour("astronaut", 16, 16)
    with pytest.raises(ValueError, match=r"^spots must hold a painted pixel"):
        heal(image, torch.zeros(1, 1, 16, 16))
    with pytest.raises(TypeError, match=r"^spots must be a torch\.Tensor, got NoneType"):
        heal(image, None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^reach must be positive"):
        heal(image, torch.ones(1, 1, 16, 16), reach=0.0)
    with pytest.raises(ValueError, match=r"^spots must have visible pixels beside them, got one without"):
        heal(image, torch.ones(1, 1, 16, 16))
    monkeypatch.setattr(module, "LARGEST_SPOT", 9)
    with pytest.raises(ValueError, match=r"^spots must be at most 9 pixels wide and high, got 10; mark smaller ones"):
        heal(image, box(3, 3, 4, 10, size=(16, 16)))
