"""Region masks: single scribbles, small and large pictures, tiles, gradients and errors."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import InMemory, in_blocks
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.resizing import block_means
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from nlfilter_torch.photo.selections import mask as masks
from nlfilter_torch.photo.selections.connected import Extent
from nlfilter_torch.photo.selections.mask import RegionMask
from tests.pairwise import each_value, pairwise
from tests.problems import box, colour, noise, seeded
from tests.streams import settings_of

SIZE = (40, 48)


def square(height: int = 40, width: int = 48) -> tuple[torch.Tensor, torch.Tensor]:
    """A reddish square with grain on a bluish ground, and its true mask."""
    inside = box(height // 4, width // 4, height // 2, width // 2, size=(height, width))
    image = 0.15 * noise(1, 3, height, width, dtype=torch.float32) + 0.2
    image[:, :1] += 0.4 * inside
    image[:, 2:] += 0.4 * (1 - inside)
    return image, inside


def test_one_scribble_is_enough_and_the_background_may_be_painted() -> None:
    image, inside = square()
    scribble, ground = box(18, 20, 3, 6, size=SIZE), box(3, 3, 3, 6, size=SIZE)
    for background in (None, ground):
        mask = region_mask(image, scribble, background)
        assert mask.shape == inside.shape
        assert (mask - inside).abs().mean() < 0.03
        assert ((mask > 0.5) == (inside > 0.5)).float().mean() > 0.99


def test_masks_far_away_are_zero() -> None:
    image, inside = square()
    away = torch.nn.functional.max_pool2d(inside, 19, 1, 9) == 0
    extents: tuple[Extent, ...] = ("near", "everywhere", "object")
    for extent in extents:
        assert region_mask(image, box(18, 20, 3, 6, size=SIZE), extent=extent)[away].max() == 0


def test_regions_are_background_to_each_other_and_batches_are_their_images() -> None:
    image, inside = square()
    ground = box(3, 3, 3, 6, size=SIZE)
    both = torch.cat([box(18, 20, 3, 6, size=SIZE), ground], dim=1)
    mask = region_mask(image, both, spatial_bandwidth=math.inf)
    assert ((mask[:, :1] > 0.5) == (inside > 0.5)).float().mean() > 0.99
    assert ((mask[:, 1:] > 0.5) == (inside < 0.5)).float().mean() > 0.95
    alone = region_mask(image, both[:, :1], ground, spatial_bandwidth=math.inf)
    torch.testing.assert_close(mask[:, :1], alone)
    images = torch.cat([image, image.flip(3)])
    together = region_mask(images, torch.cat([both, both.flip(3)]), spatial_bandwidth=math.inf)
    torch.testing.assert_close(together[:1], mask, atol=2e-3, rtol=0)


def test_a_dot_counts_beside_pixels_that_are_not_painted_or_painted_in_another_image() -> None:
    image, _ = square()
    dot, broad = box(18, 20, 2, 2, size=SIZE), box(5, 5, 30, 40, size=SIZE)
    alone = region_mask(image, dot, num_landmarks=20)
    recorded = region_mask(image, dot.clone().requires_grad_(), num_landmarks=20)  # with every pixel
    torch.testing.assert_close(recorded.detach(), alone, atol=1e-3, rtol=0)
    both = region_mask(image.repeat(2, 1, 1, 1), torch.cat([dot, broad]), num_landmarks=20)
    torch.testing.assert_close(both[:1], alone, atol=1e-3, rtol=0)


def test_what_is_scribbled_over_stays() -> None:
    image, inside = square()
    assert (region_mask(image, inside)[inside > 0] > 0.95).all()  # the whole subject
    assert (region_mask(image, torch.ones_like(inside)) > 0.95).all()  # the whole picture
    over = box(18, 20, 6, 6, size=SIZE)
    mask = region_mask(image, over, over + box(3, 3, size=SIZE))  # background below the scribble does not count
    torch.testing.assert_close(mask, region_mask(image, over, box(3, 3, size=SIZE)))


@pytest.mark.parametrize(
    ("size", "dtype"), each_value([(1, 1), (1, 9), (3, 2), (30, 5)], [torch.float32, torch.float64])
)
def test_small_and_flat_pictures(size: tuple[int, int], dtype: torch.dtype) -> None:
    for image in (torch.full((1, 3, *size), 0.4, dtype=dtype), noise(1, 1, *size, dtype=dtype)):
        scribble = torch.zeros(1, 1, *size, dtype=dtype)
        scribble[..., 0, 0] = 1
        mask = region_mask(image, scribble)
        assert mask.shape == scribble.shape
        assert mask.dtype == dtype
        assert torch.isfinite(mask).all()
        assert mask[..., 0, 0] > 0.9


def test_it_is_the_same_again_and_leaves_the_generator_alone() -> None:
    image, _ = square()
    state = torch.random.get_rng_state()
    scribble = box(18, 20, 3, 6, size=SIZE)
    first = region_mask(image, scribble)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        again = region_mask(image, scribble)
    assert torch.equal(first, again)
    assert torch.equal(torch.random.get_rng_state(), state)


def test_gradients() -> None:
    image = colour("coffee", 10, 12).double()
    front, back = box(4, 5, 2, 3, size=(10, 12)).double(), box(0, 0, 2, 3, size=(10, 12)).double()
    direction = noise(1, 1, 10, 12, seed=3)

    def loss(image: torch.Tensor, front: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
        mask = region_mask(image, front, back, reach=reach, num_landmarks=20, landmarks="uniform")
        return (mask * direction).sum()

    at = [image, 0.8 * front, torch.tensor(0.5, dtype=torch.float64)]
    inputs = [t.clone().requires_grad_() for t in at]
    gradients = torch.autograd.grad(loss(*inputs), inputs)
    for number, gradient in enumerate(gradients):
        step = 1e-6 * noise(*at[number].shape, seed=5) if at[number].ndim else torch.tensor(1e-6).double()
        if number == 1:
            step = step * front  # weights remain above 0
        ends = [loss(*(t + sign * step if i == number else t for i, t in enumerate(at))) for sign in (-1, 1)]
        assert float(ends[1] - ends[0]) / 2 == pytest.approx(float((gradient * step).sum()), rel=2e-3, abs=1e-12)


@pytest.mark.parametrize(
    ("extent", "scribbled", "held"), pairwise(["near", "object", "everywhere"], [False, True], [(12, 10), (7, 6)])
)
def test_a_box_takes_the_place_of_scribbles_and_all_outside_is_background(
    extent: Extent, scribbled: bool, held: tuple[int, int]
) -> None:
    image, inside = square()
    left, top = held
    scribble = box(18, 20, 3, 6, size=SIZE) if scribbled else None
    mask = region_mask(image, scribble, box=(left, top, 48 - left, 40 - top), extent=extent)
    assert ((mask > 0.5) == (inside > 0.5)).float().mean() > 0.99
    outside = 1 - box(top, left, 40 - 2 * top, 48 - 2 * left, size=SIZE)
    assert mask[outside > 0].max() == 0


def test_each_region_has_its_box_and_images_without_scribbles_have_one() -> None:
    image, inside = square()
    images, boxes = torch.cat([image, image.flip(3)]), torch.tensor([[[10.0, 8, 38, 32]], [[11, 7, 37, 33]]])
    scribbles = torch.cat([box(18, 20, 3, 6, size=SIZE), 0 * inside])
    together = region_mask(images, scribbles, box=boxes)
    alone = region_mask(images[1:], None, box=boxes[1:])
    torch.testing.assert_close(together[1:], alone, atol=2e-3, rtol=0)
    assert ((together > 0.5) == (torch.cat([inside, inside.flip(3)]) > 0.5)).float().mean() > 0.99
    both = region_mask(image, None, box=torch.tensor([[[10.0, 8, 38, 32], [0, 0, 8, 8]]]))
    assert both.shape == (1, 2, *SIZE)
    assert both[:, 1, 8:].max() == 0
    painted = box(0, 44, size=SIZE)
    by_hand = region_mask(image, None, box=(10, 8, 38, 32), added=painted, removed=box(18, 20, size=SIZE))
    assert by_hand[painted > 0].min() == 1
    assert by_hand[..., 18:22, 20:24].max() == 0


@pytest.mark.parametrize("tile_rows", [16, 40])
def test_tiles_are_as_in_memory(tile_rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "CHUNK", 300)
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 2500)
    monkeypatch.setattr(masks, "SOLVED_PIXELS", 5000)
    image = colour("coffee", 110, 130)
    front, back = box(50, 50, 8, 12, size=(110, 130)), box(4, 8, 8, 12, size=(110, 130))
    wanted = region_mask(image, front, back, num_landmarks=40)
    rows: list[Any] = [t[0].permute(1, 2, 0).numpy() for t in (image, front, back)]
    tiled = Tiled(Picture(rows[0]), Passes("float32", "full", tile_rows=tile_rows))
    fitted = settings_of(RegionMask, num_landmarks=40).fit(tiled, Drawn({"scribbles": rows[1], "background": rows[2]}))
    mask = np.concatenate([values for _, values in tiled.rows(fitted)])
    np.testing.assert_allclose(mask[..., 0], wanted[0, 0].numpy(), atol=1e-5)
    held = (30, 20, 100, 90)
    alone = region_mask(image, None, box=held, num_landmarks=40)
    fitted = settings_of(RegionMask, num_landmarks=40).fit(tiled, Drawn(box=held))
    mask = np.concatenate([values for _, values in tiled.rows(fitted)])
    np.testing.assert_allclose(mask[..., 0], alone[0, 0].numpy(), atol=1e-5)


def test_masks_of_a_reduced_picture_follow_the_borders_of_the_large_one(monkeypatch: pytest.MonkeyPatch) -> None:
    image, inside = square(96, 112)
    scribble, ground = box(44, 50, 6, 10, size=(96, 112)), box(6, 6, 6, 10, size=(96, 112))
    whole = region_mask(image, scribble, ground)
    monkeypatch.setattr(masks, "SOLVED_PIXELS", 96 * 112 // 4)
    mask = region_mask(image, scribble, ground)
    assert (mask - inside).abs().mean() < 0.02
    assert ((mask > 0.5) == (inside > 0.5)).float().mean() > 0.99
    assert (mask - whole).abs().mean() < 0.02
    assert not torch.equal(mask, whole)


def test_no_spatial_term_finds_what_is_alike_anywhere() -> None:
    image, _ = square(40, 96)
    image = torch.cat([image, image], dim=3)
    scribble = box(18, 40, 3, 6, size=(40, 192))
    far = box(14, 130, 12, 30, size=(40, 192)) > 0
    assert region_mask(image, scribble, spatial_bandwidth=math.inf, extent="near")[far].min() > 0.9


def test_thin_parts_of_the_same_colour_belong_to_an_object() -> None:
    """The regression alone leaves out hair and fades away from the scribble."""
    texture = torch.rand(1, 3, 64, 96, generator=seeded(0)) * torch.tensor([0.1, 0.4, 0.1]).view(1, 3, 1, 1)
    inside = torch.zeros(1, 1, 64, 96)
    inside[..., 16:48, 20:76] = 1
    inside[..., 4:60, 22:74:6] = 1  # hair, one pixel wide
    image = torch.where(inside > 0, 0.62, texture)
    scribble = torch.zeros_like(inside)
    scribble[..., 30:33, 22:30] = 1
    mask = region_mask(image, scribble)
    hair = inside.clone()
    hair[..., 14:50, :] = 0
    assert mask[hair > 0].mean() > 0.75
    assert mask[..., 18:46, 22:74].min() > 0.7
    assert mask[inside == 0].mean() < 0.1


@pytest.mark.parametrize("building", [True, False])
def test_one_scribble_selects_a_sky_whose_colour_changes(building: bool) -> None:
    down = torch.linspace(0, 1, 120).view(1, 1, -1, 1)
    top, horizon = (torch.tensor(colours).view(1, 3, 1, 1) for colours in ((0.25, 0.45, 0.85), (0.85, 0.8, 0.7)))
    image = torch.lerp(top, horizon, down).expand(1, 3, 120, 160).clone()
    image[..., 90:, :] = torch.rand(1, 3, 30, 160, generator=torch.Generator().manual_seed(0)) * 0.3
    if building:
        image[..., 30:90, 60:90] = torch.tensor([0.5, 0.35, 0.3]).view(1, 3, 1, 1)
    mask = region_mask(image, box(10, 20, 6, 40, size=(120, 160)).float())
    assert mask[..., 80:86, :50].min() > 0.8
    assert mask[..., 80:86, 100:].min() > 0.8
    assert mask[..., 96:, :].mean() < 0.1
    if building:
        assert mask[..., 36:84, 66:84].mean() < 0.5


@pytest.mark.parametrize("step", [4, 2.5])
def test_weights_of_blocks_are_the_means_of_their_pixels(step: float) -> None:
    source = InMemory(colour("chelsea", 41, 57))
    small = in_blocks(source, step, 1)
    painted = torch.zeros(1, 1, 41, 57)
    painted[..., 37:, :], painted[..., 54:] = 1, 0.5
    steps = (41 / small.size[0], 57 / small.size[1])
    mask = masks.blocks_of(source.scribbles(painted, None, "mask"), small, source.size, steps).planes(small)
    torch.testing.assert_close(mask, block_means(painted, step))


def test_options_of_the_guide_are_refused() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'guide_channels'"):
        region_mask(colour("chelsea"), box(8, 8), guide_channels="luminance")
    with pytest.raises(TypeError, match="photometric_bandwidth must be a number or a tensor, got str; pass a number"):
        region_mask(colour("chelsea"), box(8, 8), photometric_bandwidth="auto")


@pytest.mark.parametrize("turned", [False, True])
def test_masks_of_a_narrow_picture_are_where_its_scribbles_are(monkeypatch: pytest.MonkeyPatch, turned: bool) -> None:
    """The rounding of the reduced size makes the scales of rows and columns differ by 2 %."""
    monkeypatch.setattr(masks, "VIEWED", 0.01)
    image, bars = 0.4 + 0.05 * noise(1, 3, 3000, 31, seed=1, dtype=torch.float32), torch.zeros(1, 1, 3000, 31)
    for top in range(100, 3000, 400):
        bars[..., top : top + 60, 6:25] = 1
    image[:, :1] += 0.4 * bars
    scribble = box(2920, 10, 20, 6, size=(3000, 31))
    mask = region_mask(image.mT, scribble.mT, num_landmarks=40).mT if turned else region_mask(image, scribble)
    part, wanted = mask[..., 2600:, :], bars[..., 2600:, :]
    assert (part - wanted).abs().mean() < 0.05


@pytest.mark.parametrize("brightest", [50.0, 1e4, 1e9])
@pytest.mark.filterwarnings("ignore:image must be in or near")
def test_a_far_brighter_pixel_of_a_float_file_leaves_masks_as_they_are(brightest: float) -> None:
    image, scribble = colour("coffee", 64, 96), box(20, 40, 12, 20, size=(64, 96))
    usual = region_mask(image, scribble)
    bright = image.clone()
    bright[..., 5, 5] = brightest
    white = image.clone()
    white[..., 5, 5] = 1.0
    torch.testing.assert_close(region_mask(bright, scribble), region_mask(white, scribble), atol=1e-3, rtol=0)
    assert (region_mask(bright, scribble) - usual).abs().mean() < 0.02


def test_masks_do_not_depend_on_the_default_dtype() -> None:
    image, scribble = colour("coffee", 480, 640), box(160, 320, 64, 96, size=(480, 640))
    usual = region_mask(image, scribble, num_landmarks=50)
    try:
        torch.set_default_dtype(torch.bfloat16)
        mask = region_mask(image, scribble, num_landmarks=50)
    finally:
        torch.set_default_dtype(torch.float32)
    torch.testing.assert_close(mask, usual, atol=2e-3, rtol=0)
