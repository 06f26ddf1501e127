"""Strokes and regions as masks and colours."""

import math
import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch.photo.declared.strokes import Region, Stroke
from nlfilter_torch.photo.picture.drawn import colour_of
from nlfilter_torch.photo.picture.painting import TensorPainter, cover, opened_picture, rasterised
from tests.strokes import mask_of, paint

SIZE = (40, 60)
HORIZONTAL = Stroke(((0.25, 0.25), (0.5, 0.25)), 0.05, "in")
BLUE = replace(HORIZONTAL, paint="#2040e0")
SMALL = (48, 64)
LINE = Stroke(((0.2, 0.3), (0.8, 0.3), (0.8, 0.9)), 0.05, "in")


def test_a_stroke_covers_the_pixels_near_its_line() -> None:
    covered = cover(LINE, SIZE)
    points = [(x * 60 - 0.5, y * 40 - 0.5) for x, y in LINE.points]
    for row in range(40):
        for column in range(60):
            distances = []
            for (x0, y0), (x1, y1) in pairwise(points):
                squared = (x1 - x0) ** 2 + (y1 - y0) ** 2
                along = min(max(((column - x0) * (x1 - x0) + (row - y0) * (y1 - y0)) / squared, 0), 1)
                distances.append(math.hypot(column - x0 - along * (x1 - x0), row - y0 - along * (y1 - y0)))
            if abs(min(distances) - 2) > 1e-3:  # a radius of 0.05 of the short side
                assert bool(covered[row, column]) == (min(distances) < 2)


def test_a_dot_of_any_size_covers_a_pixel() -> None:
    for x, y in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (0.333, 0.777)):
        assert cover(Stroke(((x, y),), 1e-6, "in"), SIZE).any()


@pytest.mark.parametrize("rows", [slice(0, 40), slice(5, 13), slice(38, 40)])
def test_rows_are_those_of_the_whole(rows: slice) -> None:
    assert torch.equal(cover(LINE, SIZE, rows), cover(LINE, SIZE)[rows])
    blue = Stroke(((0.5, 0.5),), 0.2, "#0000ff")
    for part, whole in zip(paint([blue], SIZE, rows), paint([blue], SIZE), strict=True):
        assert torch.equal(part, whole[..., rows, :])


def test_what_is_painted_on_a_mask_has_a_border_of_a_pixel() -> None:
    line = replace(LINE, radius=2.12 / 40)
    soft = rasterised([((line, True),)], SIZE, soft=True)[0, 0]
    inner, outer = (cover(replace(LINE, radius=radius / 40), SIZE) for radius in (1.62, 2.62))
    assert torch.equal(soft == 1, inner)
    assert torch.equal(soft > 0, outer)
    rows = slice(5, 13)
    assert torch.equal(rasterised([((line, True),)], SIZE, rows, soft=True), soft[None, None, rows])


@pytest.mark.parametrize("rows", [None, slice(8, 20)])
def test_regions_cover_the_pixels_whose_centres_they_hold(rows: slice | None) -> None:
    y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(60) + 0.5, indexing="ij")
    box = (6 / 60, 5 / 40, 30 / 60, 20 / 40)
    within = (x > 6) & (x < 36) & (y > 5) & (y < 25)
    ellipse = ((x - 21) / 15).square() + ((y - 15) / 10).square() <= 1
    below = within & ((x - 6) / 30 > (y - 5) / 20)  # of the diagonal
    corners = ((6 / 60, 5 / 40), (36 / 60, 5 / 40), (36 / 60, 25 / 40))
    for region, wanted in (
        (Region.upright(box, "rectangle", "in"), within),
        (Region.upright(box, "ellipse", "in"), ellipse),
        (Region(corners, "polygon", "in"), below),
    ):
        covered = cover(region, SIZE, rows)
        differs = covered != (wanted if rows is None else wanted[rows])
        assert int(differs.sum()) <= (20 if region.shape == "polygon" else 0)  # centres on the diagonal


def test_a_region_turns_with_the_picture() -> None:
    region = Region.upright((0.2, 0.25, 0.4, 0.5), "ellipse", "in")
    turned = region.mapped(lambda x, y: (1 - y, x), 1.0)  # a quarter
    assert torch.equal(cover(turned, (40, 40)), cover(region, (40, 40)).rot90(-1))
    assert turned != region
    assert Region.upright((0.0, 0.0, 1.0, 0.0), "rectangle", "in").outline  # a line covers a pixel
    assert cover(Region.upright((0.0, 0.5, 1.0, 0.0), "rectangle", "in"), (41, 41)).sum() == 1


def test_a_small_region_does_not_vanish_in_a_preview() -> None:
    for shape in ("rectangle", "ellipse"):
        region = Region.upright((0.42, 0.31, 0.001, 0.001), shape, "in")
        assert cover(region, SIZE).nonzero().tolist() == [[12, 25]]
        assert cover(region, SIZE, slice(10, 14)).nonzero().tolist() == [[2, 25]]
        assert not cover(region, SIZE, slice(0, 10)).any()
        assert not cover(replace(region, points=tuple((x + 2, y) for x, y in region.points)), SIZE).any()


def test_regions_of_pictures(tmp_path: Path) -> None:
    mask = np.zeros((*SIZE, 1), np.uint8)
    mask[10:20, 12:30], mask[20:22, 12:30], mask[30:, :] = 255, 200, 100  # the last are too dark
    Image.fromarray(mask[..., 0]).save(tmp_path / "mask.png")
    layer = np.zeros((*SIZE, 4), np.uint8)
    layer[5:9, 7:20] = 0, 0, 255, 255
    Image.fromarray(layer).save(tmp_path / "layer.png")
    region = Region.of_file(str(tmp_path / "mask.png"), "mask", "in")
    plane = mask_of([region], SIZE)[0, 0]
    assert torch.equal(plane, torch.from_numpy(np.where(mask[..., 0] > 127, mask[..., 0], 0)) / 255)
    assert torch.equal(mask_of([region], SIZE, slice(15, 25))[0, 0], plane[15:25])
    half = mask_of([region], (20, 30))[0, 0]  # of a preview
    assert torch.equal(half, plane[1::2, 1::2])
    right = region.mapped(lambda x, y: (2 * x - 1, y), 1.0)  # of a picture cropped to its right half
    assert torch.equal(mask_of([right], (40, 30))[0, 0], plane[:, 30:])
    painted = Region.of_file(str(tmp_path / "layer.png"), "layer", "in")
    colours, covered = paint([painted], SIZE)
    assert torch.equal(covered[0, 0] > 0, torch.from_numpy(layer[..., 3] > 0))
    assert torch.equal(colours[0, :, 6, 8], torch.tensor([0.0, 0.0, 1.0]))
    assert torch.equal(
        paint([replace(painted, paint="in #ff0000")], SIZE)[0][0, :, 6, 8], torch.tensor([1.0, 0.0, 0.0])
    )
    with pytest.raises(ValueError, match=r"none\.png must be a picture of marks"):
        opened_picture(str(tmp_path / "none.png"))


def test_strokes_above_hide_those_below() -> None:
    dot = Stroke(((0.5, 0.3),), 0.2, "out")
    mask, hidden = mask_of([LINE], SIZE), cover(dot, SIZE)
    visible = mask_of([LINE], SIZE, above=[dot])
    assert mask.dtype == torch.float32
    assert not visible[0, 0][hidden].any()
    assert torch.equal(visible[0, 0][~hidden], mask[0, 0][~hidden])
    assert mask[0, 0][hidden].any()


def test_later_strokes_cover_earlier_ones() -> None:
    red, blue = Stroke(((0.5, 0.5),), 0.3, "#ff0000"), Stroke(((0.5, 0.5),), 0.1, "#0000ff")
    colours, painted = paint([red, blue], SIZE)
    assert torch.equal(colours[0, :, 20, 30], colour_of("#0000ff"))
    assert torch.equal(colours[0, :, 20, 22], colour_of("#ff0000"))
    assert torch.equal(painted, mask_of([red], SIZE))
    assert not colours[:, :, painted[0, 0] == 0].any()


def test_a_stroke_covers_what_is_nearer_than_its_radius() -> None:
    covered = cover(HORIZONTAL, SMALL)
    y, x = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    across = torch.maximum((16 - x).clamp(min=0), (x - 32).clamp(min=0))
    assert torch.equal(covered, torch.hypot(across, y - 12) <= 0.05 * 48)
    dot = cover(Stroke(((0.5, 0.5),), 1e-6, "in"), (49, 65))
    assert dot.sum() == 1
    assert dot[24, 32]


def test_strokes_that_leave_the_picture_cover_what_is_in_it() -> None:
    crossing = cover(Stroke(((-0.5, 0.5), (1.5, 0.5)), 0.05, "in"), SMALL)
    assert torch.equal(crossing.any(1).nonzero().flatten(), torch.arange(22, 26))
    assert crossing[22:26].all()
    assert not cover(Stroke(((1.5, 1.5),), 0.05, "in"), SMALL).any()


def test_a_larger_picture_is_painted_alike() -> None:
    small, large = mask_of([HORIZONTAL], SMALL), mask_of([HORIZONTAL], (480, 640))
    assert (torch.nn.functional.avg_pool2d(large, 10) - small).abs().mean() < 0.01


def test_later_paint_covers_earlier() -> None:
    colours, painted = paint([BLUE, replace(BLUE, paint="#ff0000", points=BLUE.points[:1])], SMALL)
    assert torch.equal(colours[0, :, 12, 16], torch.tensor([1.0, 0.0, 0.0]))
    assert torch.allclose(colours[0, :, 12, 30], torch.tensor([0x20, 0x40, 0xE0]) / 255)
    assert torch.equal(painted, mask_of([BLUE], SMALL))


def test_a_painter_sees_that_a_picture_of_marks_has_changed(tmp_path: Path) -> None:
    path, painter = tmp_path / "mask.png", TensorPainter()
    region = Region.of_file(str(path), "mask", "in")
    planes = []
    for time, value in enumerate((255, 255, 0)):
        if value == 0 or time == 0:
            Image.fromarray(np.full(SIZE, value, np.uint8)).save(path)
            os.utime(path, ns=(time, time))
        planes.append(painter.planes([((region, True),)], SIZE))
    assert planes[1] is planes[0]
    assert bool(planes[0].all())
    assert not bool(planes[2].any())


def test_gradients_fall_smoothly_from_1_to_0() -> None:
    """Along their axis alone, whatever the proportions of the picture, and the same for any rows of it."""
    linear = Region(((0.25, 0.5), (0.75, 0.5)), "linear", "add")
    weights = rasterised([((linear, True),)], (10, 40))[0, 0]
    assert (weights == weights[:1]).all()
    assert (weights[0, :10] == 1).all()
    assert (weights[0, 30:] == 0).all()
    assert (weights[0].diff() <= 0).all()
    assert weights[0, 19] + weights[0, 20] == pytest.approx(1)
    slanted = Region(((0.0, 0.0), (1.0, 1.0)), "linear", "add")  # alike across it, in pixels
    weights = rasterised([((slanted, True),)], (20, 40))[0, 0]
    assert weights[0, 10] == pytest.approx(float(weights[4, 8]), abs=1e-6)
    for gradient in (linear, slanted, Region.upright((0.1, 0.2, 0.6, 0.7), "radial", "add")):
        whole = rasterised([((gradient, True),)], (20, 40))
        assert torch.equal(rasterised([((gradient, True),)], (20, 40), slice(5, 9)), whole[:, :, 5:9])


def test_a_radial_gradient_is_full_within_and_none_beyond_its_ellipse() -> None:
    radial = Region.upright((0.0, 0.0, 1.0, 1.0), "radial", "add")
    weights = rasterised([((radial, True),)], (41, 81))[0, 0]
    assert (weights[20, 21:60] == 1).all()
    assert weights[20, 10] == pytest.approx(0.5, abs=0.05)
    assert weights[0, 0] == weights[40, 80] == 0
    wide = rasterised([((replace(radial, softness=1.0), True),)], (41, 81))[0, 0]
    assert wide[20, 20] == pytest.approx(0.5, abs=0.02)
    assert (wide <= weights).all()
    both = rasterised([((radial, True), (Region(((0.5, 0.0), (0.5, 1.0)), "linear", "remove"), False))], (41, 81))
    assert both[0, 0, 20, 40] == pytest.approx(0.5, abs=0.02)
