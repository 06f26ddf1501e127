"""Recolouring: which pixels change colour and which do not, and the underlying groups and means."""

import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch import recolor
from nlfilter_torch.photo.picture.colour import group_colours, split_luminance
from tests.problems import BACKGROUND, SUIT, box, colour, luminance, noise, paint


def blue_suit(image: torch.Tensor, **options: object) -> torch.Tensor:
    stroke = box(37, 8)
    return recolor(image, paint(0.1, 0.3, 0.9, stroke), stroke, **options)


def test_recolour_keeps_luminance_and_what_is_unlike() -> None:
    image = colour("astronaut")
    edited = blue_suit(image)
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
        edited = recolor(image, paint(0.1, 0.3, 0.9, mask), mask)
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
    edited = recolor(image, paint(0.0, 0.0, 1.0, dot), dot, num_landmarks=40)
    brightness, chroma = split_luminance(edited)
    assert (brightness - split_luminance(image)[0]).abs().max() < 1e-5
    saturation = chroma[0, 2, 20] / brightness[0, 0, 20]
    assert saturation[5:35].min() > 0.8 * saturation[5:35].max() > 1


def test_a_stroke_on_the_black_part_of_an_object_colours_its_lighter_parts() -> None:
    image = torch.full((1, 3, 40, 40), 0.75)
    image[..., 8:32, 8:32] = torch.linspace(0.0, 0.25, 24)
    dark = box(14, 8, 12, 3, size=(40, 40))
    edited = recolor(image, paint(1.0, 1.0, 0.0, dark), dark, num_landmarks=40)
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


def test_a_background_under_the_strokes_is_refused() -> None:
    image, stroke = noise(2, 3, 20, 24), box(4, 4, 8, 8, size=(20, 24)).expand(2, 1, -1, -1)
    strokes = paint(0.1, 0.3, 0.9, stroke)
    beside, under = box(13, 15, 4, 4, size=(20, 24)), box(5, 5, 4, 4, size=(20, 24))
    for keep in (under, torch.cat([beside, under])):
        with pytest.raises(ValueError, match="keep must hold a painted pixel outside the scribbles on the object"):
            recolor(image, strokes, stroke, keep=keep, num_landmarks=20)
    # A keep that reaches beyond the stroke, and none in one image, are valid.
    recolor(image, strokes, stroke, keep=torch.cat([under + beside, 0 * under]), num_landmarks=20)
