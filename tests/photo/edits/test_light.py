"""Light of a part of a photograph: as for the whole photograph, by a mask, in memory and in tiles."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from nlfilter_torch.photo import (
    Development,
    Recipe,
    Region,
    Step,
    Stroke,
    adjust_light,
    apply_recipe,
    apply_step,
    stream,
)
from nlfilter_torch.photo.declared.strokes import Mark
from nlfilter_torch.photo.edits.recipe import edit_rows
from nlfilter_torch.photo.picture.light import develop_image
from nlfilter_torch.photo.picture.painting import rasterised
from nlfilter_torch.photo.picture.tiles import Passes
from tests.problems import box, colour, noise

VALUES = {
    "exposure": 0.7,
    "contrast": 0.3,
    "highlights": -0.6,
    "shadows": 0.5,
    "whites": 0.2,
    "blacks": -0.3,
    "warmth": 0.4,
    "tint": -0.2,
    "vibrance": 0.5,
    "saturation": -0.3,
}
LINEAR = Region(((0.3, 0.1), (0.6, 0.9)), "linear", "add")
RADIAL = Region.upright((0.1, 0.2, 0.7, 0.6), "radial", "add")


def test_a_full_mask_develops_all_and_an_empty_one_nothing() -> None:
    image = colour("astronaut", 48, 40)
    whole = develop_image(image, Development(temperature=4000.0, curve=(0.1, 0.4, 0.9), **VALUES))
    edited = adjust_light(
        image, None, added=torch.ones(1, 1, 48, 40), temperature=4000.0, curve=(0.1, 0.4, 0.9), **VALUES
    )
    assert (edited - whole).abs().max() < 1e-6
    half = box(0, 0, 24, 40, size=(48, 40))
    edited = adjust_light(image, None, added=half, **VALUES)
    assert torch.equal(edited[..., 24:, :], image[..., 24:, :])
    assert (edited[..., :24, :] - develop_image(image, Development(**VALUES))[..., :24, :]).abs().max() < 1e-6


def test_an_object_changes_alone() -> None:
    image = 0.2 + 0.1 * noise(1, 3, 32, 32, dtype=torch.float32)
    image[:, 0, 8:24, 8:24] += 0.5
    edited = adjust_light(image, box(14, 12, 4, 8, size=(32, 32)), exposure=1.0, num_landmarks=50)
    changed = (edited - image).abs().amax(1)[0]
    assert changed[10:22, 10:22].min() > 0.1
    assert changed[:6].max() < 0.02


@pytest.mark.parametrize("name", VALUES)
def test_gradients_of_values_and_image(name: str) -> None:
    image = 0.2 + 0.6 * noise(1, 3, 4, 3)
    mask = rasterised([((LINEAR, True),)], (4, 3)).double()
    value = torch.full((1,), VALUES[name], dtype=torch.float64, requires_grad=True)

    def edit(x: torch.Tensor, v: torch.Tensor, m: torch.Tensor) -> torch.Tensor:
        return adjust_light(x, None, added=m, **{name: v})

    assert gradcheck(edit, (image.requires_grad_(), value, mask.clamp(0.01, 0.99).requires_grad_()))


def test_each_image_has_its_own_values() -> None:
    image = 0.2 + 0.6 * noise(2, 3, 8, 9, dtype=torch.float32)
    values = {name: torch.tensor([value, 0.0]) for name, value in VALUES.items()}
    mask = torch.full((1, 1, 8, 9), 0.5)
    both = adjust_light(image, None, added=mask, **values)
    assert (both[:1] - adjust_light(image[:1], None, added=mask, **VALUES)).abs().max() < 1e-6
    assert (both[1:] - image[1:]).abs().max() < 1e-6


@pytest.mark.parametrize("marks", [(LINEAR,), (RADIAL, Stroke(((0.2, 0.3),), 0.1, "remove")), (LINEAR, RADIAL)])
def test_tiles_give_the_same(marks: tuple[Mark, ...]) -> None:
    picture = (colour("astronaut", 60, 44)[0].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    step = Step("light", marks, **VALUES)
    whole = apply_step(step, torch.from_numpy(picture).permute(2, 0, 1)[None] / 255)
    target = np.zeros(picture.shape, np.float32)
    stream(step, picture, target, tile_rows=7)
    assert np.abs(target - whole[0].permute(1, 2, 0).numpy()).max() < 2e-6


@pytest.mark.parametrize("mark", [LINEAR, RADIAL])
@pytest.mark.parametrize(
    "development",
    [Development(crop=(0.25, 0.1, 1.0, 0.75)), Development(rotate=90), Development(straighten=8.0)],
)
def test_gradients_follow_crop_and_turns(mark: Region, development: Development) -> None:
    """A mask of the picture that is then developed is that of the developed picture."""
    size = (80, 120)
    frame = development.frame(size)
    (moved,) = Recipe((Step("light", (mark,), exposure=1.0),), development).on_developed(size).steps[0].strokes
    before = develop_image(rasterised([((mark, True),)], size), development)
    assert (rasterised([((moved, True),)], frame.size) - before).abs().max() < 0.02


def test_a_gradient_that_the_crop_leaves_out_changes_nothing() -> None:
    image = colour("astronaut", 40, 40)
    upper = Step("light", (Region(((0.5, 0.0), (0.5, 0.4)), "linear", "add"),), exposure=1.0)
    below = Development(crop=(0.0, 0.5, 1.0, 1.0))
    assert torch.equal(apply_recipe(Recipe((upper,), below), image), develop_image(image, below))
    rows = list(edit_rows(Passes("float32"), image[0].permute(1, 2, 0).numpy(), (upper,), "photo"))
    assert (
        np.abs(np.concatenate([part for _, part in rows])[20:] - image[0, :, 20:].permute(1, 2, 0).numpy()).max() == 0
    )


def test_values_out_of_range_are_refused() -> None:
    image, mask = colour("astronaut", 16, 16), torch.ones(1, 1, 16, 16)
    for values, sentence in (
        ({"exposure": 6.0}, r"exposure must be in \[-5, 5\]"),
        ({"contrast": torch.tensor(2.0)}, r"contrast must be in \[-1, 1\]"),
        ({"temperature": 500.0}, "temperature must be a number from 2000"),
        ({"curve": (0.0, 2.0)}, "curve must be"),
        ({"temperature": torch.tensor(5000.0)}, r"temperature must be a number from 2000 .*, got tensor\(5000.\)"),
    ):
        with pytest.raises(ValueError, match=sentence):
            adjust_light(image, None, added=mask, **values)
    with pytest.raises(TypeError, match=r"^region must be a torch\.Tensor"):
        adjust_light(image, None, exposure=1.0)
