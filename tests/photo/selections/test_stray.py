"""Stray parts of scribbles: what a stroke covers by mistake does not count, and what is meant does."""

import json
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch

from benchmarks.free_photographs import edited_photographs
from benchmarks.photographs import photograph, reduced_to
from benchmarks.recolor import CHANGED, HATS, hat_scene
from benchmarks.scribbles import STORED, Job, as_mask, jobs, line
from nlfilter_torch.photo import recolor, region_mask
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.regions import read_regions
from nlfilter_torch.photo.selections.stray import strays
from tests.problems import box, paint

SIZE = (96, 128)
BESIDE = 4  # pixels beside a stray part that may not count, either: they may hold colours of both sides
RED, GREEN, WHITE = (0.7, 0.15, 0.1), (0.2, 0.5, 0.25), (0.95, 0.95, 0.9)


def scene(noise: float = 0.02) -> torch.Tensor:
    """A red thing on green, with a white bar on its right, (1, 3, H, W)."""
    thing, bar = box(20, 20, 60, 70, SIZE), box(20, 90, 60, 12, SIZE)
    image = paint(*RED, thing) + paint(*WHITE, bar) + paint(*GREEN, 1 - thing - bar)
    shade = torch.linspace(0.8, 1.2, SIZE[0]).view(1, 1, -1, 1)
    texture = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    return (image * shade + noise * texture).clamp(0, 1)


def ignored(image: torch.Tensor, *masks: torch.Tensor) -> torch.Tensor:
    """The plane (H, W) of the pixels of a region's scribbles that do not count."""
    scribbles = read_regions(InMemory(image), sum(masks, torch.zeros(1, 1, *SIZE)).clamp(max=1), "scribbles")[0]
    plane = torch.zeros(SIZE[0] * SIZE[1])
    plane[scribbles.places] = strays(scribbles, SIZE)[0, 0].float()
    return plane.unflatten(0, SIZE)


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.05])
def test_the_end_of_a_stroke_on_something_else_does_not_count(noise: float) -> None:
    ends = ignored(scene(noise), box(40, 50, 5, 49, SIZE)) > 0
    assert ends[40:45, 90:99].all()
    assert not ends[:, : 90 - BESIDE].any()


def test_a_gap_that_a_stroke_crosses_does_not_count() -> None:
    gap = box(30, 50, 30, 8, SIZE)
    image = scene() * (1 - gap) + paint(*GREEN, gap)
    gaps = ignored(image, box(40, 25, 5, 55, SIZE)) > 0
    assert gaps[40:45, 50:58].all()
    assert not gaps[:, : 50 - BESIDE].any()
    assert not gaps[:, 58 + BESIDE :].any()


def test_what_is_meant_counts() -> None:
    image = scene()
    assert not ignored(image, box(40, 30, 5, 40, SIZE)).any()  # on one thing
    assert not ignored(image, box(40, 87, 2, 5, SIZE)).any()  # a dab, which has no end
    assert not ignored(image, box(40, 72, 5, 30, SIZE)).any()  # two fifths are no accident
    assert not ignored(image, box(40, 79, 15, 14, SIZE)).any()  # a box
    assert not ignored(image, box(22, 22, 50, 80, SIZE)).any()  # a rough mask
    stroke, other = box(40, 50, 5, 49, SIZE), box(60, 92, 15, 6, SIZE)
    assert not ignored(image, stroke, other).any()  # another stroke is meant for it


def test_shading_and_patterns_count() -> None:
    shade = torch.linspace(0.05, 0.95, SIZE[1]).view(1, 1, 1, -1).expand(1, 3, *SIZE)
    assert not ignored(shade, box(40, 10, 5, 110, SIZE)).any()
    stripes = ((torch.arange(SIZE[1]) % 16) < 4).view(1, 1, 1, -1).float().expand(1, 1, *SIZE)
    striped = paint(*RED, 1 - stripes) + paint(*WHITE, stripes)
    assert not ignored(striped, box(40, 10, 5, 80, SIZE)).any()


def test_half_a_stroke_and_one_pixel_and_everything() -> None:
    image = scene()
    assert not ignored(image, box(40, 78, 5, 24, SIZE)).any()
    assert not ignored(image, box(40, 78, 1, 1, SIZE)).any()
    assert not ignored(image, torch.ones(1, 1, *SIZE)).any()
    assert not ignored(image[:, :1], box(40, 50, 5, 30, SIZE)).any()  # grey


def test_images_of_a_batch_are_judged_alone() -> None:
    images, masks = torch.cat([scene(), scene().flip(3)]), torch.cat([box(40, 50, 5, 49, SIZE)] * 2)
    scribbles = read_regions(InMemory(images), masks, "scribbles")[0]
    both = strays(scribbles, SIZE)
    for number in range(2):
        alone = read_regions(InMemory(images[number : number + 1]), masks[:1], "scribbles")[0]
        assert torch.equal(both[number : number + 1], strays(alone, SIZE))
    assert 45 <= both[0].sum() <= 45 + 5 * BESIDE


def test_masks_and_colours_do_not_follow_strays() -> None:
    image, clean, whole = scene(), box(40, 50, 5, 40, SIZE), box(40, 50, 5, 49, SIZE)
    selected = region_mask(image, whole)
    assert (selected - region_mask(image, clean)).abs().max() < 0.05
    assert selected[..., 25:75, 92:100].max() < 0.5
    blue = [recolor(image, paint(0.1, 0.2, 0.9, mask), mask) for mask in (clean, whole)]
    assert (blue[0] - blue[1]).abs().max() < 0.06


def gap_in_a_suit() -> Job:
    """A stroke on the suit of scikit-image's astronaut that crosses its white strap."""
    points = ((0.18, 0.66), (0.3, 0.62), (0.42, 0.65), (0.52, 0.65), (0.6, 0.63))
    return drawn(photograph("astronaut")[:, :3], points, (0.15, 0.35, 0.9), slice(2, 4))


def bar_beside_the_sky() -> Job:
    """A stroke on the sky that touches the white rocket."""
    points = ((0.15, 0.12), (0.3, 0.2), (0.42, 0.3), (0.45, 0.35), (0.51, 0.47))
    return drawn(photograph("rocket")[:, :3], points, (0.7, 0.3, 0.1), slice(3, 5))


def hat_on_a_face() -> Job:
    """A stroke on a hat of the colour of skin that touches the face."""
    points = ((0.34, 0.15), (0.38, 0.1), (0.46, 0.07), (0.52, 0.11), (0.49, 0.17), (0.46, 0.24))
    return drawn(hat_scene(HATS[1])[0], points, (0.15, 0.6, 0.3), slice(4, 6))


def drawn(
    image: torch.Tensor, points: Sequence[tuple[float, float]], colour: tuple[float, float, float], stray: slice
) -> Job:
    """A stroke through points in columns and rows, from 0 to 1, of which some are the ends of the stray part."""
    image = reduced_to(image, 120)
    size = (image.shape[-2], image.shape[-1])
    at = np.array(points)[:, ::-1] * size
    clean = line(at[: stray.start + 1], size, 3)
    clean = clean | line(at[stray.stop - 1 :], size, 3) if stray.stop < len(at) else clean
    return Job("", "", image, torch.tensor(colour).view(1, 3, 1, 1), as_mask(clean), as_mask(line(at, size, 3)))


def test_what_two_strokes_of_one_colour_share_is_meant() -> None:
    image = scene()
    first, second = box(30, 25, 4, 60, SIZE), box(60, 72, 4, 50, SIZE)  # two thirds of the second one lie beside it
    scribbles = read_regions(InMemory(image), first + second, "scribbles")[0]
    stray = strays(scribbles, SIZE, of_one_colour=True)[0, 0]
    columns, rows = scribbles.places % SIZE[1], scribbles.places // SIZE[1]
    assert stray[(rows >= 60) & (columns >= 92 + BESIDE)].all()
    assert not stray[columns < 90 - BESIDE].any()
    assert not strays(scribbles, SIZE).all()


@pytest.mark.parametrize("case", [gap_in_a_suit, bar_beside_the_sky, hat_on_a_face])
def test_recolouring_on_photographs_does_not_follow_strays(case: Callable[[], Job]) -> None:
    job = case()
    clean, whole = ((job.result(mask) - job.image).abs().amax(1) > 5 * CHANGED for mask in (job.clean, job.whole))
    assert whole[~clean].float().mean() < 0.05  # single pixels count at this size
    assert whole[job.clean[0] > 0].float().mean() > clean[job.clean[0] > 0].float().mean() - 0.02


def test_an_object_of_several_colours_with_a_stroke_on_each_stays_whole() -> None:
    image = scene()
    assert not ignored(image, box(30, 25, 4, 60, SIZE), box(25, 94, 50, 4, SIZE)).any()


def test_strokes_are_stored_for_thirty_free_photographs() -> None:
    entries = json.loads(STORED.read_text(encoding="utf-8"))
    names = {entry["photograph"] for entry in entries}
    assert len(names) >= 30
    assert names <= edited_photographs().keys()
    for entry in entries:
        assert 0 < entry["stray"] < len(entry["points"]) - 1
        assert all(0 <= value <= 1 for point in entry["points"] for value in point)
    assert len(list(jobs("reporting"))) == 2  # on scikit-image's photographs
