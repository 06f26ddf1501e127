"""Masks painted by hand: exactly 1 under the brush, 0 under the eraser, and as computed elsewhere."""

import pytest
import torch

from nlfilter_torch.photo import defocus, enhance, recolor, region_mask
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.source import Fitted
from nlfilter_torch.photo.selections.by_hand import ByHand, opaque
from nlfilter_torch.photo.selections.mask import RegionMask
from tests.problems import box, noise, paint
from tests.streams import settings_of

SIZE = (40, 48)
SCRIBBLE, BRUSH, ERASER = (box(*place, size=SIZE) for place in ((14, 12, 4, 8), (30, 5, 6, 9), (9, 9, 3, 4)))
PAINTED = (BRUSH + ERASER) > 0
NOTHING = torch.zeros(1, 1, *SIZE)


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    picture = 0.2 * noise(1, 3, *SIZE, dtype=torch.float32)
    picture[:, 0, 8:24, 8:30] += 0.6
    return picture


@pytest.fixture(scope="module")
def computed(image: torch.Tensor) -> torch.Tensor:
    return region_mask(image, SCRIBBLE, num_landmarks=50)


def test_a_mask_is_set_where_it_is_painted_and_nowhere_else(image: torch.Tensor, computed: torch.Tensor) -> None:
    mask = region_mask(image, SCRIBBLE, added=BRUSH, removed=ERASER, num_landmarks=50)
    assert torch.equal(mask, torch.where(PAINTED, BRUSH, computed))
    assert torch.equal(region_mask(image, None, added=BRUSH), BRUSH)
    half = region_mask(image, SCRIBBLE, added=BRUSH / 2, removed=ERASER / 2, num_landmarks=50)
    torch.testing.assert_close(half, computed * (1 - PAINTED / 2) + BRUSH / 2)
    both = region_mask(image, None, added=BRUSH, removed=BRUSH)  # the eraser takes precedence
    assert not both.any()


def test_what_is_added_to_a_region_is_removed_from_the_others(image: torch.Tensor, computed: torch.Tensor) -> None:
    empty = torch.cat([SCRIBBLE, NOTHING], dim=1)  # the second region has no scribble
    on_first = box(15, 15, 4, 4, size=SIZE)
    mask = region_mask(image, empty, added=torch.cat([NOTHING, on_first], dim=1), num_landmarks=50)
    assert torch.equal(mask, torch.cat([computed * (1 - on_first), on_first], dim=1))
    shared = region_mask(image, None, added=torch.cat([BRUSH, BRUSH], dim=1), removed=ERASER)
    assert torch.equal(shared, torch.cat([BRUSH, BRUSH], dim=1))


def test_edits_follow_what_is_painted(image: torch.Tensor) -> None:
    blue = paint(0, 0, 1, torch.ones_like(BRUSH))
    plain = recolor(image, blue, SCRIBBLE, num_landmarks=50)
    painted = recolor(image, blue, SCRIBBLE, added=torch.cat([blue, BRUSH], dim=1), removed=ERASER, num_landmarks=50)
    assert torch.equal(torch.where(PAINTED, 0.0, painted), torch.where(PAINTED, 0.0, plain))
    assert torch.equal(painted * ERASER, image * ERASER)
    alone = recolor(image, None, None, added=torch.cat([blue, BRUSH], dim=1))
    assert torch.equal((alone != image).any(1, keepdim=True), BRUSH > 0)
    sharp = defocus(image, None, added=BRUSH, radius=2.0)
    assert torch.equal(sharp * BRUSH, image * BRUSH)
    assert (sharp - image).abs()[..., :8, 32:].mean() > 0.02
    sliders = torch.tensor([3.0, 2.0, 1.0])
    edited = enhance(image, sliders, added=BRUSH, limits="none", threshold=0.0, num_landmarks=50)
    whole = enhance(image, sliders, limits="none", threshold=0.0, num_landmarks=50)
    assert torch.equal((edited != image).any(1, keepdim=True), BRUSH > 0)
    torch.testing.assert_close(edited * BRUSH, whole * BRUSH, atol=1e-4, rtol=0)


def test_several_colours_are_painted_on_several_pictures(image: torch.Tensor) -> None:
    red, blue = (paint(*rgb, torch.ones_like(BRUSH)) for rgb in ((1, 0, 0), (0, 0, 1)))
    two = torch.cat([torch.where(ERASER > 0, red, blue), BRUSH + ERASER], dim=1)
    one = torch.cat([blue, BRUSH], dim=1)
    batch = recolor(torch.cat([image, image]), None, None, added=torch.cat([two, one]), brightness=0.5)
    for number, added in enumerate((two, one)):
        torch.testing.assert_close(batch[number : number + 1], recolor(image, None, None, added=added, brightness=0.5))
    erased = recolor(image, None, None, added=0 * one)
    assert torch.equal(erased, image)


def test_pictures_of_a_batch_may_have_scribbles_or_a_brush(image: torch.Tensor) -> None:
    pictures = torch.cat([image, image.flip(3)])
    scribbles, brush = torch.cat([SCRIBBLE, NOTHING]), torch.cat([NOTHING, BRUSH])
    blue, sliders = paint(0, 0, 1, torch.ones_like(BRUSH)), torch.tensor([3.0, 1.0])
    colour = torch.cat([blue.expand(2, -1, -1, -1), brush], dim=1)
    batches = (
        region_mask(pictures, scribbles, added=brush, num_landmarks=20),
        defocus(pictures, scribbles, added=brush, radius=2.0, num_landmarks=20),
        enhance(pictures, sliders, scribbles, added=brush, num_landmarks=20),
        recolor(pictures, blue, scribbles, added=colour, num_landmarks=20),
    )
    for number, (drawn, added, shown) in enumerate(
        zip(scribbles.split(1), brush.split(1), colour.split(1), strict=True)
    ):
        picture = pictures[number : number + 1]
        alone = (
            region_mask(picture, drawn, added=added, num_landmarks=20),
            defocus(picture, drawn, added=added, radius=2.0, num_landmarks=20),
            enhance(picture, sliders, drawn, added=added, num_landmarks=20),
            recolor(picture, blue, drawn, added=shown, num_landmarks=20),
        )
        for batch, single in zip(batches, alone, strict=True):
            torch.testing.assert_close(batch[number : number + 1], single, atol=1e-5, rtol=0)


def test_gradients_of_a_batch_are_finite_where_a_picture_has_no_scribble(image: torch.Tensor) -> None:
    tensors = [torch.cat(pair) for pair in ((image, image), (SCRIBBLE, NOTHING), (NOTHING, BRUSH))]
    pictures, scribbles, brush = (tensor.requires_grad_() for tensor in tensors)
    region_mask(pictures, scribbles, added=brush, num_landmarks=20).square().sum().backward()
    for tensor in (pictures, scribbles, brush):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()


def test_painting_ignores_how_opaque_the_picture_is(image: torch.Tensor) -> None:
    source = InMemory(image, weights=torch.full_like(BRUSH, 0.25))
    scribbles = source.scribbles(BRUSH / 2, None, "added")
    assert scribbles.weights.max() == 0.125
    assert opaque(source, scribbles).weights.unique() == 0.5
    edit = settings_of(RegionMask)
    mask = source.all(Fitted(edit.select(source, Drawn({"added": BRUSH / 2})).masks))
    assert torch.equal(mask, BRUSH / 2)
    assert ByHand.of(source, None, None) is None


def test_gradients_reach_what_is_painted(image: torch.Tensor) -> None:
    shares = torch.tensor([0.3, 0.6], dtype=torch.float64, requires_grad=True)
    picture, scribble, brush, eraser = (part.double() for part in (image, SCRIBBLE, BRUSH, ERASER))

    def edited(shares: torch.Tensor) -> torch.Tensor:
        added, removed = shares[0] * (brush + eraser), shares[1] * eraser
        return region_mask(picture, scribble, added=added, removed=removed, num_landmarks=20)

    torch.autograd.gradcheck(edited, (shares,))


def test_an_edit_needs_something_that_is_painted(image: torch.Tensor) -> None:
    with pytest.raises(TypeError, match=r"scribbles must be a torch.Tensor, got NoneType; paint some, or pass"):
        region_mask(image, None)
    with pytest.raises(TypeError, match=r"focus_region must be a torch.Tensor, got NoneType; paint some, or pass"):
        defocus(image, None, removed=ERASER)
    with pytest.raises(TypeError, match=r"stroke_mask must be a torch.Tensor, got NoneType; paint some, or pass"):
        recolor(image, None, None, removed=ERASER)
    with pytest.raises(ValueError, match=r"added must have 4 channel\(s\), got 1"):
        recolor(image, image, SCRIBBLE, added=BRUSH)
    with pytest.raises(ValueError, match="removed must be given together with regions"):
        enhance(image, torch.ones(3), removed=ERASER)
