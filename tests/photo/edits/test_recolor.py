"""Recolouring: which pixels change colour and which do not, and the underlying groups and means."""

import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch.photo import recolor
from nlfilter_torch.photo.edits.recolor import Brightening, Recoloring, split_colours, with_room
from nlfilter_torch.photo.picture.colour import group_colours, split_luminance
from nlfilter_torch.photo.selections.border_colours import colours_beside
from tests.problems import BACKGROUND, SUIT, box, colour, luminance, noise, paint


def blue_suit(image: torch.Tensor, **options: object) -> torch.Tensor:
    stroke = box(37, 8)
    return recolor(image, paint(0.1, 0.3, 0.9, stroke), stroke, **options)


def test_recolour_keeps_luminance_and_what_is_unlike() -> None:
    image = colour("astronaut")
    edited = blue_suit(image, brightness=0.0)
    assert (luminance(edited) - luminance(image)).abs().max() <= 1 / 255
    assert torch.equal(edited[BACKGROUND], image[BACKGROUND])
    assert (edited == image).all(1).float().mean() > 0.5
    suit = edited[SUIT]
    assert (suit[:, 2] > suit[:, 0]).float().mean() > 0.9
    assert (image[SUIT][:, 2] < image[SUIT][:, 0]).all()
    assert edited.min() >= -1e-6
    assert edited.max() <= 1 + 1e-6


def test_recolour_within_two_levels_outside_a_kept_region() -> None:
    image, stroke = colour("coffee", 64, 96), box(38, 20, size=(64, 96))
    keep = box(2, 40, 4, 50, size=(64, 96))
    edited = recolor(image, paint(0.1, 0.6, 0.2, stroke), stroke, keep=keep)
    kept = (keep > 0).expand_as(image)
    assert (edited - image)[kept].abs().max() <= 2 / 255
    painted = (stroke > 0)[0, 0]
    assert (edited[0, 1][painted] > edited[0, 0][painted]).all()


def test_one_stroke_does_not_spill() -> None:
    """Stray pixels under the stroke, here of the backdrop, are painted, but pixels similar to them are not."""
    image, stroke = colour("astronaut"), box(37, 8, 5, 5)
    image = torch.where(box(37, 8, 1, 5) > 0, image[..., 6:7, 42:43], image)
    edited = recolor(image, paint(0.1, 0.3, 0.9, stroke), stroke)
    assert torch.equal(edited[BACKGROUND], image[BACKGROUND])
    assert (edited[SUIT][:, 2] > edited[SUIT][:, 0]).float().mean() > 0.9
    assert (edited != image).any(1).float().mean() < 0.4


def test_a_pixel_a_hundred_dots_and_everything_may_be_painted() -> None:
    image = colour("astronaut")
    dot = box(40, 10, 1, 1)
    suit = recolor(image, paint(0.1, 0.3, 0.9, dot), dot)[SUIT]
    assert (suit[:, 2] > suit[:, 0]).float().mean() > 0.7
    dots = torch.zeros(1, 1, 64, 64)
    dots[..., 1::6, 1::6] = 1  # 121 spots of one colour
    for mask in (dots, torch.ones(1, 1, 64, 64)):
        edited = recolor(image, paint(0.1, 0.3, 0.9, mask), mask, brightness=0.0)
        inside = (mask > 0)[0, 0]
        assert (edited[0, 2][inside] >= edited[0, 0][inside] - 1e-4).all()
        assert (luminance(edited) - luminance(image)).abs().max() <= 1 / 255


def test_two_colours_reach_their_own_likes() -> None:
    image = torch.full((1, 3, 40, 40), 0.5)
    image[:, 0, :, :20], image[:, 2, :, 20:] = 0.8, 0.8  # reddish, bluish
    left, right = box(4, 4, size=(40, 40)), box(30, 30, size=(40, 40))
    strokes = paint(0, 1, 0, left) + paint(1, 1, 0, right)
    edited = recolor(image, strokes, left + right, num_landmarks=40)
    wanted = split_luminance(paint(0, 1, 0, torch.ones(1, 1, 1, 1)))[1]
    chroma = split_luminance(edited)[1]
    for columns, chroma_wanted in (
        (slice(0, 16), wanted),
        (slice(24, 40), split_luminance(paint(1, 1, 0, torch.ones(1, 1, 1, 1)))[1]),
    ):
        cosine = F.cosine_similarity(chroma[..., columns], chroma_wanted.expand_as(chroma[..., columns]), dim=1)
        assert cosine.min() > 0.99


def test_overlapping_strokes_are_decided_by_the_colour_on_top() -> None:
    """Strokes are a single picture, which shows the colour painted last."""
    image = colour("astronaut")
    under, over = box(36, 8, 6, 6), box(37, 9, 4, 4)
    strokes = torch.where(over > 0, paint(0.1, 0.3, 0.9, over), paint(0, 0.8, 0, under))
    regions, colours, counts = group_colours(split_luminance(strokes)[1], torch.maximum(under, over))
    assert counts.all()
    assert regions.sum((2, 3)).tolist() == [[20.0, 16.0]]
    edited = recolor(image, strokes, torch.maximum(under, over))
    assert torch.isfinite(edited).all()
    assert colours.shape == (1, 2, 3)


def test_the_shading_of_an_object_stays_in_a_colour_that_is_too_strong_for_it() -> None:
    image = torch.tensor([1.0, 0.2, 0.1]).view(1, 3, 1, 1) * torch.linspace(0.4, 0.9, 40).view(1, 1, 1, 40).expand(
        1, 3, 40, 40
    )
    dot = box(10, 10, 20, 20, size=(40, 40))
    edited = recolor(image, paint(0.0, 0.0, 1.0, dot), dot, num_landmarks=40, brightness=0.0)
    brightness, chroma = split_luminance(edited)
    assert (brightness - split_luminance(image)[0]).abs().max() < 1e-5
    saturation = chroma[0, 2, 20] / brightness[0, 0, 20]
    assert saturation[8:32].min() > 0.8 * saturation[8:32].max() > 1  # the frame counts a little as background


def test_a_stroke_on_the_black_part_of_an_object_colours_its_lighter_parts() -> None:
    image = torch.full((1, 3, 40, 40), 0.75)
    image[..., 8:32, 8:32] = torch.linspace(0.0, 0.25, 24)
    dark = box(14, 8, 12, 3, size=(40, 40))
    edited = recolor(image, paint(1.0, 1.0, 0.0, dark), dark, num_landmarks=40, brightness=0.0)
    assert (edited[:, 0] - edited[:, 2])[0, 20, 26] > 0.15


def test_a_grey_stroke_takes_colour_away() -> None:
    stroke = box(37, 8)
    edited = recolor(colour("astronaut"), paint(0.5, 0.5, 0.5, stroke), stroke)
    assert (
        split_luminance(edited[SUIT])[1].abs().mean() < 0.1 * split_luminance(colour("astronaut")[SUIT])[1].abs().mean()
    )


def test_a_batch_is_recoloured_like_its_images_where_only_one_has_a_background() -> None:
    image = noise(2, 3, 20, 24, dtype=torch.float64)
    dot, other = box(4, 4, 5, 5, size=(20, 24)), box(13, 15, 4, 4, size=(20, 24))
    blue, green = paint(0.1, 0.3, 0.9, dot), paint(0.1, 0.8, 0.1, other)
    second = torch.cat([other, 0 * other])  # a second colour, or a scribble on the background, in the first image only
    for keep in (None, second):
        strokes, painted = torch.cat([blue, blue]), torch.cat([dot, dot])
        if keep is None:
            strokes, painted = torch.cat([blue + green, blue]), painted + second
        together = recolor(image, strokes, painted, keep=keep, num_landmarks=20)
        own = None if keep is None else keep[1:]
        alone = recolor(image[1:], strokes[1:], painted[1:], keep=own, num_landmarks=20)
        torch.testing.assert_close(together[1:], alone)


def test_a_box_in_a_colour_recolours_its_object_alone() -> None:
    image = 0.1 * noise(1, 3, 40, 48, dtype=torch.float32) + 0.2
    objects = box(10, 8, 16, 12, size=(40, 48)) + box(10, 30, 16, 12, size=(40, 48))
    image[:, :1] += 0.5 * objects
    blue = torch.tensor([0.1, 0.2, 0.9]).view(1, 3, 1, 1)
    results = [
        recolor(image, strokes, None, box=(5, 6, 24, 30), num_landmarks=50)
        for strokes in (blue, blue.expand(-1, -1, 40, 48))
    ]
    torch.testing.assert_close(*results)
    changed = (results[0] - image).abs().amax(1, keepdim=True) > 0.05
    assert changed[..., 12:24, 10:18].float().mean() > 0.9
    assert torch.equal(results[0][..., 24:], image[..., 24:])
    assert torch.equal(results[0][..., :6, :], image[..., :6, :])
    with pytest.raises(TypeError, match=r"stroke_mask must be a torch.Tensor, got NoneType"):
        recolor(image, None, None, box=(5, 6, 24, 30))


def test_a_background_under_the_strokes_is_refused() -> None:
    image, stroke = noise(2, 3, 20, 24), box(4, 4, 8, 8, size=(20, 24)).expand(2, 1, -1, -1)
    strokes = paint(0.1, 0.3, 0.9, stroke)
    beside, under = box(13, 15, 4, 4, size=(20, 24)), box(5, 5, 4, 4, size=(20, 24))
    for keep in (under, torch.cat([beside, under])):
        with pytest.raises(ValueError, match="keep must hold a painted pixel outside the scribbles on the object"):
            recolor(image, strokes, stroke, keep=keep, num_landmarks=20)
    # A keep that reaches beyond the stroke, and none in one image, are valid.
    recolor(image, strokes, stroke, keep=torch.cat([under + beside, 0 * under]), num_landmarks=20)


def lit(*tint: float, low: float = 0.3, high: float = 0.95) -> torch.Tensor:
    """A surface (1, 3, 40, 40) of one colour, from shade at the left to light at the right."""
    shade = torch.linspace(low, high, 40).view(1, 1, 1, 40).expand(1, 1, 40, 40)
    return torch.tensor(tint).view(1, 3, 1, 1) * shade


def changed(image: torch.Tensor, *stroke: float, brightness: float = 1.0) -> torch.Tensor:
    """A picture that is all of one object, with a stroke in its middle."""
    new, old = torch.tensor(stroke).view(1, 1, 3), image[..., 16:24, 16:24].mean((2, 3)).view(1, 1, 3)
    (before, chroma), whole = split_colours(old), torch.ones_like(image[:, :1])
    brightening = Brightening.of(before, new, brightness)
    colours = with_room(split_colours(new)[1], brightening.new)
    change = Recoloring(colours, chroma, torch.ones(1, 1, dtype=torch.bool), before, brightening)
    return change(image, whole, [colours_beside(image, whole)])


MIDDLE = box(16, 16, 8, 8, size=(40, 40))


@pytest.mark.parametrize(
    ("old", "new"),
    [((1.0, 0.85, 0.1), (0.8, 0.05, 0.05)), ((1.0, 1.0, 1.0), (0.1, 0.1, 0.6)), ((0.4, 0.15, 0.15), (0.5, 0.4, 0.1))],
)
def test_an_object_in_the_brightness_of_the_stroke_keeps_its_shading(
    old: tuple[float, ...], new: tuple[float, ...]
) -> None:
    image = lit(*old)
    edited = changed(image, *new)
    painted = (edited * MIDDLE).sum((2, 3)) / MIDDLE.sum()
    assert (painted - torch.tensor([new])).abs().max() < 0.06
    before, after = luminance(image)[0, 0, 20], luminance(edited)[0, 0, 20]
    assert after.diff().min() > 0  # lighter where it was lighter
    dark = slice(2, 18)
    torch.testing.assert_close((after / after[20])[dark], (before / before[20])[dark], atol=0.02, rtol=0)
    hue = F.cosine_similarity(split_luminance(edited)[1], split_luminance(torch.tensor(new).view(1, 3, 1, 1))[1], dim=1)
    assert hue[..., 2:38].min() > 0.99
    assert edited.min() >= -1e-6
    assert edited.max() <= 1 + 1e-6


def test_brightness_goes_from_that_of_the_object_to_that_of_the_stroke() -> None:
    image = lit(1.0, 0.85, 0.1)
    red = paint(0.8, 0.05, 0.05, MIDDLE)
    amounts = torch.tensor([0.0, 0.3, 0.7, 1.0])
    edited = [recolor(image, red, MIDDLE, num_landmarks=40, brightness=float(amount)) for amount in amounts]
    assert torch.equal(edited[3], recolor(image, red, MIDDLE, num_landmarks=40))
    levels = torch.stack([(luminance(each) * MIDDLE).sum() / MIDDLE.sum() for each in edited])
    torch.testing.assert_close(levels, torch.lerp(levels[0], levels[3], amounts), atol=2e-3, rtol=0)
    batch = recolor(
        image.expand(2, -1, -1, -1),
        red.expand(2, -1, -1, -1),
        MIDDLE.expand(2, -1, -1, -1),
        num_landmarks=40,
        brightness=amounts[1:3],
    )
    torch.testing.assert_close(batch, torch.cat(edited[1:3]), atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match=r"brightness must be in \[0, 1\], got 1\.5"):
        recolor(image, red, MIDDLE, brightness=1.5)


def test_highlights_stay_white_and_shading_is_never_flat() -> None:
    image = lit(1.0, 0.6, 0.1)
    image[..., 19:21, 30:34] = 0.98
    black = changed(image, 0.0, 0.0, 0.0)
    assert black[..., 19:21, 30:34].min() > 0.7
    assert luminance(black)[0, 0, 10].max() < 0.1
    assert luminance(black)[0, 0, 10].diff().min() > 0
    white = changed(lit(0.2, 0.2, 0.2), 1.0, 1.0, 1.0)
    assert luminance(white)[0, 0, 10].diff().min() > 0
    assert luminance(white)[0, 0, 20, 20] > 0.85


def test_borders_in_the_brightness_of_the_stroke_have_no_rim() -> None:
    share = F.avg_pool2d(box(10, 10, 20, 20, size=(40, 40)), 5, 1, 2)
    ground = torch.tensor([0.15, 0.3, 0.15]).view(1, 3, 1, 1)
    image = share * 0.9 + (1 - share) * ground
    edited = recolor(image, paint(0.1, 0.1, 0.6, MIDDLE), MIDDLE, num_landmarks=40, brightness=1.0)
    wanted = share * torch.tensor([0.1, 0.1, 0.6]).view(1, 3, 1, 1) + (1 - share) * ground
    assert (edited - wanted).abs().max() < 0.1
    assert (luminance(edited) - luminance(wanted)).abs().max() < 0.1


def test_strokes_of_one_hue_are_told_apart_by_their_brightness() -> None:
    image = torch.cat([lit(0.9, 0.3, 0.3)[..., :20], lit(0.3, 0.4, 0.9)[..., 20:]], dim=3)
    left, right = box(16, 4, 8, 8, size=(40, 40)), box(16, 28, 8, 8, size=(40, 40))
    strokes = paint(0.1, 0.1, 0.1, left) + paint(0.8, 0.8, 0.8, right)
    edited = recolor(image, strokes, left + right, num_landmarks=40, brightness=1.0)
    assert luminance(edited)[0, 0, 20, 8] < 0.2
    assert luminance(edited)[0, 0, 20, 32] > 0.7


def test_brightness_is_differentiable() -> None:
    image = lit(1.0, 0.85, 0.1).double().requires_grad_()
    amount = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    strokes = paint(0.8, 0.05, 0.05, MIDDLE).double()
    edited = recolor(image, strokes, MIDDLE.double(), num_landmarks=30, brightness=amount)
    (slope,) = torch.autograd.grad(edited.sum(), amount, retain_graph=True)
    above, below = (
        recolor(image.detach(), strokes, MIDDLE.double(), num_landmarks=30, brightness=0.5 + step).sum()
        for step in (1e-5, -1e-5)
    )
    torch.testing.assert_close(slope, (above - below) / 2e-5, rtol=1e-4, atol=1e-4)
    assert torch.autograd.grad(edited.sum(), image)[0].isfinite().all()


def synthetic(*parts: tuple[tuple[slice, slice], tuple[float, float, float]]) -> torch.Tensor:
    """A grey picture (1, 3, 96, 96) with rectangles of colours, all slightly textured."""
    image = torch.full((1, 3, 96, 96), 0.45)
    for where, channels in parts:
        image[..., *where] = torch.tensor(channels).view(1, 3, 1, 1)
    return image * (1 + 0.05 * torch.rand((1, 1, 96, 96), generator=torch.Generator().manual_seed(0)))


RED_PAINT, STROKE = ((slice(20, 80), slice(10, 50)), (0.6, 0.1, 0.1)), box(30, 15, 8, 30, size=(96, 96))


def blue(image: torch.Tensor, **options: object) -> torch.Tensor:
    """What changes, (H, W), with a blue stroke on the red paint."""
    return (recolor(image, paint(0.1, 0.2, 0.9, STROKE), STROKE, **options) - image).abs().amax(1)[0]


def test_another_hue_of_the_same_brightness_stays() -> None:
    image = synthetic(RED_PAINT, ((slice(20, 80), slice(50, 90)), (0.4, 0.2, 0.1)))
    changed = blue(image)
    assert changed[24:76, 14:46].min() > 0.1
    assert changed[24:76, 56:86].max() < 0.01


def test_enclosed_shade_takes_the_colour_and_what_is_unlike_less() -> None:
    pixels = torch.tensor([[0.05, 0.004, 0.004], [0.3, 0.3, 0.3], [0.6, 0.1, 0.1]]).T.view(1, 3, 1, 3)
    under, old = (part.view(1, 1, -1) for part in split_luminance(torch.tensor(RED_PAINT[1]).view(1, 3, 1, 1)))
    change = Recoloring(old, old, torch.ones(1, 1, dtype=torch.bool), under)
    shares, factor = torch.tensor([0.0, 0.0, 0.8]).view(1, 1, 1, 3), torch.tensor([1.0, 1.0, 0.5]).view(1, 1, 1, 3)
    for enclosed, wanted in ((1.0, [1.0, 0.0, 0.4]), (0.0, [0.0, 0.0, 0.4])):
        by_hue = [(factor, torch.full_like(factor, enclosed))]
        share = change.corrected(*split_luminance(pixels), shares, by_hue)
        torch.testing.assert_close(share, torch.tensor(wanted).view(1, 1, 1, 3))


def test_shade_of_a_grey_object_takes_less_colour() -> None:
    image, stroke = lit(1.0, 1.0, 1.0, low=0.15, high=0.6), box(4, 2, 32, 36, size=(40, 40))
    added = split_luminance(recolor(image, paint(0.1, 0.2, 0.9, stroke), stroke))[1].norm(dim=1)[0, 20]
    assert added[4] < 0.7 * added[20]  # lighter parts have less room for it


@pytest.mark.parametrize(("level", "brightness"), [((0.0, 0.0, 0.0), 1.0), ((3.0, 1.2, 1.2), 0.0)])
def test_black_objects_and_objects_above_white_change(level: tuple[float, float, float], brightness: float) -> None:
    image = synthetic((RED_PAINT[0], level))
    assert blue(image, brightness=brightness)[24:76, 14:46].min() > 0.1
