"""What marks are for an edit: masks and colours by the names of its arguments, whatever edit they were drawn for."""

from dataclasses import replace

import pytest
import torch

from nlfilter_torch.photo.declared.parameters import COLORIZE, DEFOCUS, DETAIL, MASK, RECOLOR
from nlfilter_torch.photo.declared.strokes import Region, Stroke
from nlfilter_torch.photo.picture.drawn import colour_of, drawn_by
from nlfilter_torch.photo.picture.painting import TensorPainter, rasterised
from tests.strokes import mask_of

SIZE = (40, 60)
HORIZONTAL = Stroke(((0.25, 0.25), (0.5, 0.25)), 0.05, "in")
LINE = Stroke(((0.2, 0.3), (0.8, 0.3), (0.8, 0.9)), 0.05, "in")


def test_brush_and_eraser_act_in_the_order_drawn() -> None:
    brush, eraser = replace(LINE, paint="add #ff0033"), replace(HORIZONTAL, paint="remove")
    soft, erased = (rasterised([((mark, True),)], SIZE, soft=True)[0, 0] for mark in (brush, eraser))
    drawn = drawn_by(RECOLOR, (eraser, brush, eraser), SIZE, TensorPainter())
    planes = drawn.masks["added"][0]
    torch.testing.assert_close(planes[3], soft * (1 - erased))
    assert torch.equal(planes[:3, soft > 0], colour_of("#ff0033").unsqueeze(1).expand(-1, int((soft > 0).sum())))
    removed = drawn_by(RECOLOR, (eraser, brush), SIZE, TensorPainter()).masks["removed"]
    torch.testing.assert_close(removed[0, 0], erased * (1 - soft))


def test_every_edit_takes_every_mark() -> None:
    """Strokes saved for one edit are those of another: the colour that one has no use for means nothing to it."""
    box = (0.2, 0.2, 0.3, 0.3)
    marks = (
        replace(LINE, paint="in #2040e0"),
        Region.upright(box, "ellipse", "#2040e0"),
        Stroke(((0.9, 0.9),), 0.1, "out"),
    )
    inside = mask_of(marks[:2], SIZE)
    for edit in (RECOLOR, DEFOCUS, MASK, DETAIL):
        drawn = drawn_by(edit, marks, SIZE, TensorPainter(), (2.0, 1.0) if edit is DETAIL else ())
        first, second = edit.scribbles[:2]
        of_object = drawn.masks[first.argument] if drawn.colours is None else drawn.colours[:, 3:]
        assert torch.equal(of_object, inside)
        assert torch.equal(drawn.masks[second.argument], mask_of(marks[2:], SIZE))
    with pytest.raises(ValueError, match="paint of strokes of recolor must be one of a colour such as #c04020, out, "):
        drawn_by(RECOLOR, [LINE], SIZE, TensorPainter())
    with pytest.raises(
        ValueError, match="paint of strokes of colorize must be one of a colour such as #c04020, box, got 'out'"
    ):
        drawn_by(COLORIZE, marks, SIZE, TensorPainter())


AROUND = Region.upright((0.1, 0.2, 0.5, 0.6), "rectangle", "box")
PIXELS = [6.0, 8.0, 36.0, 32.0]  # of SIZE


def test_a_box_takes_the_place_of_scribbles() -> None:
    for edit in (MASK, DEFOCUS):
        drawn = drawn_by(edit, [AROUND], SIZE, TensorPainter())
        assert torch.as_tensor(drawn.box).tolist() == [[PIXELS]]
        assert (dict(drawn.masks), drawn.colour) == ({}, None)
    coloured = drawn_by(RECOLOR, [replace(AROUND, paint="box #ff0033")], SIZE, TensorPainter())
    assert coloured.colour is not None
    torch.testing.assert_close(coloured.colour, colour_of("#ff0033"))
    with pytest.raises(ValueError, match="strokes of recolor must be in a colour, or its box must say one, got"):
        drawn_by(RECOLOR, [AROUND], SIZE, TensorPainter())
    assert drawn_by(RECOLOR, [AROUND, replace(LINE, paint="#ff0033")], SIZE, TensorPainter()).colour is None
    with pytest.raises(ValueError, match="strokes of colorize must cover a pixel"):
        drawn_by(COLORIZE, [AROUND], SIZE, TensorPainter())


def test_each_region_has_a_box_and_there_is_one_for_each() -> None:
    other = Region.upright((0.5, 0.5, 0.5, 0.5), "rectangle", "box 3,1")
    second = replace(HORIZONTAL, paint="in 3,1")
    whole = [0.0, 0.0, 60.0, 40.0]
    for marks, wanted in (
        ((AROUND,), [PIXELS]),
        ((other,), [[30.0, 20.0, 60.0, 40.0]]),
        ((LINE, second, AROUND), [PIXELS, PIXELS]),
        ((LINE, second, AROUND, other), [PIXELS, [30.0, 20.0, 60.0, 40.0]]),
        ((LINE, other), [whole, [30.0, 20.0, 60.0, 40.0]]),
    ):
        drawn = drawn_by(DETAIL, marks, SIZE, TensorPainter(), (2.0, 1.0))
        assert drawn.sliders is not None
        assert len(drawn.sliders) == len(wanted)
        assert torch.as_tensor(drawn.box).tolist() == [wanted]
    for edit in (MASK, DETAIL):
        with pytest.raises(ValueError, match=r"strokes of \w+ must hold one box for each object, got 2; keep the one"):
            drawn_by(edit, [AROUND, replace(AROUND)], SIZE, TensorPainter(), (2.0, 1.0) if edit is DETAIL else ())


def test_marks_of_the_same_sliders_are_one_region() -> None:
    second = replace(HORIZONTAL, paint="in 3,1")
    drawn = drawn_by(DETAIL, (LINE, second, replace(LINE, paint="add 3,1")), SIZE, TensorPainter(), (2.0, 1.0))
    assert drawn.sliders is not None
    assert drawn.sliders.tolist() == [[2, 1], [3, 1]]
    assert torch.equal(drawn.masks["regions"], torch.cat([mask_of([LINE], SIZE), mask_of([second], SIZE)], dim=1))
    assert not drawn.masks["added"][:, 0].any()
    assert drawn.masks["added"][:, 1].any()
