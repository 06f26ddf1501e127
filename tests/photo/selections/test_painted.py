"""Strokes of colour on objects and on their masks: what is painted, in which colours, and over which pixels."""

from dataclasses import replace

import torch

from nlfilter_torch.photo import recolor
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.selections.painted import Painted
from tests.problems import box, noise, paint

SIZE = (24, 32)
STROKE, BRUSH = box(4, 4, 5, 9, size=SIZE), box(16, 10, 4, 12, size=SIZE)
NOTHING = torch.zeros(1, 1, *SIZE)
IMAGE = noise(1, 3, *SIZE, dtype=torch.float32)
RED, BLUE = (paint(*rgb, torch.ones_like(BRUSH)) for rgb in ((1, 0, 0), (0, 0, 1)))


def read(images: torch.Tensor, mask: torch.Tensor, added: torch.Tensor | None) -> Painted | None:
    colours = RED.expand(len(images), -1, -1, -1)
    masks = {"stroke_mask": mask} if added is None else {"stroke_mask": mask, "added": added}
    return Painted.of(InMemory(images), Drawn(masks, colours))


def test_each_colour_has_its_pixels_and_the_mean_under_its_strokes() -> None:
    painted = read(IMAGE, STROKE, torch.cat([torch.where(STROKE > 0, RED, BLUE), STROKE + BRUSH], dim=1))
    assert painted is not None
    shown, valid, groups = painted.grouped(SIZE, matches=True)
    order = shown[0, :, 0].argsort(descending=True)  # red first
    torch.testing.assert_close(shown[0, order], torch.eye(3)[[0, 2]])
    assert valid.all()
    luminance, chroma = groups.means()
    for number, mask in zip(order, (STROKE, BRUSH), strict=True):
        wanted = (IMAGE * mask).sum((0, 2, 3)) / mask.sum()
        torch.testing.assert_close(luminance[0, number] + chroma[0, number], wanted)
    by_hand = groups.by_hand(InMemory(IMAGE), None)
    assert by_hand is not None
    masks = by_hand.over(torch.zeros(1, 2, *SIZE), InMemory(IMAGE))
    assert torch.equal(masks[:, order], torch.cat([STROKE, BRUSH], dim=1))
    erased = replace(groups, on_mask=None).by_hand(InMemory(IMAGE), BRUSH)  # an eraser alone, for both colours
    assert erased is not None
    assert erased.count == 2


def test_what_is_painted_depends_on_the_weights_alone() -> None:
    nothing = torch.cat([BLUE, NOTHING], dim=1)
    for added in (nothing, nothing.clone().requires_grad_()):
        assert read(IMAGE, NOTHING, added) is None
        assert torch.equal(recolor(IMAGE, None, None, added=added), IMAGE)
    painted = read(IMAGE, STROKE, nothing.requires_grad_())
    assert painted is not None
    assert painted.on_mask is None
    assert len(painted.marks) == 1


def test_a_picture_of_a_batch_without_paint_stays_as_it_is() -> None:
    images = torch.cat([IMAGE, IMAGE]).requires_grad_()
    added = torch.cat([BLUE.expand(2, -1, -1, -1), torch.cat([BRUSH, NOTHING])], dim=1).requires_grad_()
    edited = recolor(images, None, None, added=added, brightness=0.5)
    assert torch.equal(edited[1:], IMAGE)
    torch.testing.assert_close(edited[:1], recolor(IMAGE, None, None, added=added[:1], brightness=0.5))
    edited.square().sum().backward()
    for tensor in (images, added):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
    strokes = torch.cat([STROKE, NOTHING])
    both = recolor(images.detach(), RED, strokes, added=torch.zeros(2, 4, *SIZE), num_landmarks=20)
    assert torch.equal(both[1:], IMAGE)
    assert not torch.equal(both[:1], IMAGE)
