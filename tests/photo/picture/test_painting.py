"""Brush strokes as masks and colours."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.picture.painting import colour_of, cover, mask_of, paint, painted_on_mask

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
    soft = painted_on_mask([line], "in", SIZE)[0, 0]
    inner, outer = (cover(replace(LINE, radius=radius / 40), SIZE) for radius in (1.62, 2.62))
    assert torch.equal(soft == 1, inner)
    assert torch.equal(soft > 0, outer)
    rows = slice(5, 13)
    assert torch.equal(painted_on_mask([line], "in", SIZE, rows), soft[None, None, rows])


def test_brush_and_eraser_act_in_the_order_drawn() -> None:
    brush, eraser = replace(LINE, paint="add #ff0033"), replace(HORIZONTAL, paint="remove")
    planes = painted_on_mask([eraser, brush, eraser], "add colour", SIZE)[0]
    soft = painted_on_mask([brush], "add colour", SIZE)[0, 3]
    erased = painted_on_mask([eraser], "remove", SIZE)[0, 0]
    torch.testing.assert_close(planes[3], soft * (1 - erased))
    assert torch.equal(planes[:3, soft > 0], colour_of("#ff0033").unsqueeze(1).expand(-1, int((soft > 0).sum())))
    removed = painted_on_mask([eraser, brush], "remove", SIZE)[0, 0]
    torch.testing.assert_close(removed, erased * (1 - soft))


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
