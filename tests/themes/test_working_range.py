"""Pictures that use little of their range, or go far beyond it: every edit sees them in the range that they use."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch.nn.denoiser.profile import NoiseProfile
from nlfilter_torch.photo import (
    Recipe,
    Step,
    abstract,
    adjust_tone,
    apply_recipe,
    defocus,
    denoise,
    enhance,
    filter_frames,
    region_mask,
    sharpen,
)
from nlfilter_torch.photo.app.preview import Preview
from nlfilter_torch.photo.edits.film import FilmEdit
from nlfilter_torch.photo.edits.parts import Parts, Rectangle
from nlfilter_torch.photo.edits.recipe import stream
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.measuring import LEAST_STEPS, range_of
from nlfilter_torch.photo.picture.tiles import Passes
from tests.problems import colour

BLACK, SCALE = 0.02, 0.01
SIZE = (72, 88)
SCRIBBLE = torch.zeros(1, 1, *SIZE)
SCRIBBLE[..., 30:40, 30:50] = 1
STEPS = (
    Step("denoise"),
    Step("detail", alpha=(2.0, 1.5, 1.0), landmarks=40),
    Step("tone", contrast=1.3, landmarks=40),
    Step("sharpen", landmarks=40),
    Step("abstract", landmarks=40),
)
EDITS: dict[str, Callable[[Tensor], Tensor]] = {
    "denoise": denoise,
    "rule": lambda x: denoise(x, method="rule", num_landmarks=40),
    "detail": lambda x: enhance(x, torch.tensor([2.0, 1.5, 1.0]), num_landmarks=40),
    "region": lambda x: enhance(x, torch.tensor([2.0, 1.5, 1.0]), SCRIBBLE, num_landmarks=40),
    "tone": lambda x: adjust_tone(x, contrast=1.3, num_landmarks=40),
    "sharpen": lambda x: sharpen(x, num_landmarks=40),
    "abstract": lambda x: abstract(x, num_landmarks=40),
    "defocus": lambda x: defocus(x, SCRIBBLE, radius=3.0, num_landmarks=40),
    "frames": lambda x: next(filter_frames([x], torch.tensor([2.0, 1.0]), references=[x], num_landmarks=40)),
}


def noisy(deviation: float = 0.06) -> Tensor:
    """A photograph with white noise."""
    image = colour("astronaut", *SIZE).float()
    return image + deviation * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))


def faint(image: Tensor, scale: float = SCALE, white: int = 65535) -> Tensor:
    """The image as a faint picture of whole steps."""
    return ((image * scale + BLACK).clamp(0, 1) * white).round() / white


def stretched(picture: Tensor, scale: float = SCALE) -> Tensor:
    """A faint picture in the units of the image."""
    return (picture - BLACK) / scale


def test_the_range_is_measured_where_it_is_small_or_large() -> None:
    image = noisy(0).clamp(0, 1)
    assert range_of(InMemory(image)) is None
    assert range_of(InMemory(0.4 * image)) is None
    assert range_of(InMemory(12 * image)) is None  # a picture of high dynamic range
    working = range_of(InMemory(faint(image)))
    assert working is not None
    assert float(working.black) < BLACK < float(working.black + working.span) < BLACK + 1.4 * SCALE
    large = range_of(InMemory(65535 * image))
    assert large is not None
    assert float(large.black) == 0
    assert float(large.span) == pytest.approx(65535, rel=0.3)
    both = range_of(InMemory(torch.cat([image, 0.01 * image])))
    assert both is not None
    assert both.stretched.flatten().tolist() == [False, True]
    assert range_of(InMemory(0.01 * image.expand(2, -1, -1, -1).flatten(0, 1)[None])) is None  # a feature map
    assert range_of(InMemory(torch.zeros(1, 3, 8, 8))) is None


def test_steps_of_the_depth_limit_the_stretching() -> None:
    for white in (255, 65535):
        working = range_of(InMemory(faint(torch.rand(1, 1, 40, 40), 3 / white, white)))
        assert working is not None
        assert float(working.span) > 0.99 * LEAST_STEPS / white
    flat = torch.full((1, 3, 20, 20), 128 / 255)
    assert torch.equal(enhance(flat, torch.tensor([2.0, 1.0]), num_landmarks=20), flat)


def test_black_and_white_stay_black_and_white() -> None:
    dark = range_of(InMemory(0.1 * noisy(0).clamp(0, 1)))
    assert dark is not None
    assert float(dark.black) == 0
    bright = range_of(InMemory(0.9 + 0.1 * noisy(0).clamp(0, 1)))
    assert bright is not None
    assert float(bright.seen(torch.ones(1, 1, 1, 1))) == 1


@pytest.mark.parametrize("edit", list(EDITS))
def test_edits_do_not_depend_on_the_units_of_a_picture(edit: str) -> None:
    picture = faint(noisy())
    usual = EDITS[edit](picture)
    assert (usual - picture).abs().mean() > 0.002 * SCALE
    for scale, black in ((0.1, 0.5), (20.0, -0.1), (65535.0, 0.0), (65535.0, -1000.0)):
        other = (EDITS[edit](picture * scale + black) - black) / scale
        assert (other - usual).abs().mean() < 5e-3 * SCALE  # float32 resolves 1e-4 of the first range


@pytest.mark.parametrize("scale", [0.2, 0.02, 0.002])
def test_faint_noise_is_removed_like_that_of_stretched_data(scale: float) -> None:
    clean = colour("chelsea", 160, 160).float()
    noise = 0.06 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    picture = faint(clean + noise, scale)
    errors = [
        10 * float((result - clean).square().mean().log10())
        for result in (stretched(denoise(picture), scale), denoise(stretched(picture, scale)))
    ]
    assert errors[0] < errors[1] + 0.3


def test_given_levels_are_in_units_of_the_image() -> None:
    picture = faint(noisy())
    level = 0.06 * SCALE
    edited = denoise(picture, noise_level=level)
    assert (stretched(edited) - colour("astronaut", *SIZE)).square().mean().sqrt() < 0.05
    for same in (torch.tensor([level]), torch.full((1, 1, *SIZE), level), NoiseProfile.white(torch.tensor([level]))):
        assert (denoise(picture, noise_level=same) - edited).abs().max() < 0.1 * SCALE
    with pytest.raises(ValueError, match="noise_level must be at least 0"):
        denoise(picture, noise_level=-1.0)


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.edit)
def test_tiles_parts_floats_and_films_agree(step: Step) -> None:
    picture = faint(noisy())
    whole = apply_recipe(Recipe((step,)), picture)[0].permute(1, 2, 0).numpy()
    stored = np.rint(picture[0].permute(1, 2, 0).numpy() * 65535).astype(np.uint16)
    tiles = np.empty(stored.shape, np.float32)
    stream(step, stored, tiles, tile_rows=16)
    assert np.abs(tiles - whole).max() < 1e-4 * SCALE
    floats = np.empty(stored.shape, np.float32)
    stream(step, stored.astype(np.float32), floats)
    assert np.abs(floats / 65535 - whole).max() < 1e-2 * SCALE
    parts = Parts(stored, "picture")
    parts.fit([step], Passes("float32", statistics="full"))
    part = parts.edited(Rectangle(range(20, 50), range(10, 60)))[0].permute(1, 2, 0).numpy()
    assert np.abs(part - whole[20:50, 10:60]).max() < 1e-4 * SCALE
    frame = picture[0].permute(1, 2, 0).numpy()
    film = FilmEdit([step], [frame, frame], Passes("float32"))(frame)
    assert np.abs(film - whole).mean() < 0.05 * SCALE
    shown = Preview(picture).render(Recipe((step,)))[0].permute(1, 2, 0).numpy()
    assert np.abs(shown - whole).max() < 1e-4 * SCALE


def test_a_smaller_preview_sees_the_range_of_the_photograph() -> None:
    picture = faint(noisy())
    step = Step("detail", alpha=(2.0, 1.5, 1.0), landmarks=40, strokes=())
    shown = Preview(picture, 36 * 44).render(Recipe((step,)))
    assert shown.shape[-2:] == (36, 44)
    assert (shown - Preview(picture, 36 * 44).pixels).abs().mean() > 0.005 * SCALE


def test_masks_of_faint_pictures_are_those_of_stretched_ones() -> None:
    image = noisy(0)
    masks = [region_mask(picture, SCRIBBLE) for picture in (image, faint(image))]
    assert (masks[0] - masks[1]).abs().mean() < 0.05


def test_what_lies_far_outside_is_kept() -> None:
    picture = faint(noisy())
    picture[..., 10:12, 10:12] = 1.0  # a star
    edited = denoise(picture)
    assert float(edited[..., 10:12, 10:12].min()) > 0.97
    assert (edited[..., 20:, 20:] - denoise(faint(noisy()))[..., 20:, 20:]).abs().mean() < 0.02 * SCALE


def test_gradients_pass() -> None:
    image = faint(noisy())[..., :24, :24].requires_grad_()
    enhance(image, torch.tensor([2.0, 1.0]), num_landmarks=20).sum().backward()
    assert image.grad is not None
    assert bool(image.grad.isfinite().all())
    assert 0.5 < float(image.grad.mean()) < 1.5
