"""Stray parts of scribbles: what a stroke covers by mistake does not count, and what is meant does."""

import pytest
import torch

from benchmarks.scribbles import jobs
from nlfilter_torch import recolor, region_mask
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.selections.stray import strays
from tests.problems import box, paint

SIZE = (96, 128)
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
    scribbles = InMemory(image).regions(sum(masks, torch.zeros(1, 1, *SIZE)).clamp(max=1), "scribbles")[0]
    plane = torch.zeros(SIZE[0] * SIZE[1])
    plane[scribbles.places] = strays(scribbles, SIZE)[0, 0].float()
    return plane.unflatten(0, SIZE)


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.05])
def test_the_end_of_a_stroke_on_something_else_does_not_count(noise: float) -> None:
    assert torch.equal(ignored(scene(noise), box(40, 50, 5, 49, SIZE)), box(40, 90, 5, 9, SIZE)[0, 0])


def test_a_gap_that_a_stroke_crosses_does_not_count() -> None:
    gap = box(30, 50, 30, 8, SIZE)
    image = scene() * (1 - gap) + paint(*GREEN, gap)
    assert torch.equal(ignored(image, box(40, 25, 5, 55, SIZE)), box(40, 50, 5, 8, SIZE)[0, 0])


def test_what_is_meant_counts() -> None:
    image = scene()
    assert not ignored(image, box(40, 30, 5, 40, SIZE)).any()  # on one thing
    assert not ignored(image, box(40, 87, 2, 5, SIZE)).any()  # a dab, which has no end
    assert not ignored(image, box(40, 66, 5, 36, SIZE)).any()  # a third of it is no accident
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
    scribbles = InMemory(images).regions(masks, "scribbles")[0]
    both = strays(scribbles, SIZE)
    for number in range(2):
        alone = InMemory(images[number : number + 1]).regions(masks[:1], "scribbles")[0]
        assert torch.equal(both[number : number + 1], strays(alone, SIZE))
    assert both[0].sum() == 45


def test_masks_and_colours_do_not_follow_strays() -> None:
    image, clean, whole = scene(), box(40, 50, 5, 40, SIZE), box(40, 50, 5, 49, SIZE)
    selected = region_mask(image, whole)
    assert (selected - region_mask(image, clean)).abs().max() < 0.05
    assert selected[..., 25:75, 92:100].max() < 0.5
    blue = [recolor(image, paint(0.1, 0.2, 0.9, mask), mask) for mask in (clean, whole)]
    assert (blue[0] - blue[1]).abs().max() < 0.05


def test_stored_strokes_on_photographs_lose_what_leaves_the_object() -> None:
    """Strokes of benchmarks.scribbles, whose stray part is known, on photographs of scikit-image."""
    names = ("the suit, with its collar", "the sky, with the rocket", "the retina, with the frame")
    stored = [*jobs("choosing"), *jobs("reporting")]
    chosen = [job for job in stored if job.name.split(": ")[1] in names]
    assert len(chosen) == len(names)
    for job in chosen:
        size = (job.image.shape[-2], job.image.shape[-1])
        scribbles = InMemory(job.image).regions(job.whole, "scribbles")[0]
        ignored = strays(scribbles, size)[0, 0]
        stray = (job.whole - job.clean).flatten()[scribbles.places] > 0
        assert ignored[stray].float().mean() > 0.5
        assert ignored[~stray].float().mean() < 0.05
