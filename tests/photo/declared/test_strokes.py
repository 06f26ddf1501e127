"""Marks: points, paint, and their form in files."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.parameters import COLORIZE, DEFOCUS, DETAIL, EDITS, MASK, RECOLOR
from nlfilter_torch.photo.declared.presets import Recipe, on_frame
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Region, Stroke, box_in, meaning_of, thin
from nlfilter_torch.photo.picture.painting import cover
from tests.recipes import BLUE
from tests.strokes import paint


def test_thinning_keeps_the_ends() -> None:
    line = [(i / 1000, 0.0) for i in range(501)]
    kept = thin(line, 0.1)
    assert kept[0] == (0.0, 0.0)
    assert kept[-1] == (0.5, 0.0)
    assert len(kept) == 6


def test_what_reaches_a_picture_covers_a_pixel() -> None:
    """All that begins inside does, and from outside all that does not just graze the border."""
    generator = torch.Generator().manual_seed(0)
    size = (7, 11)
    for points in (torch.rand(400, 2, 2, generator=generator) * 3 - 1).tolist():
        stroke = Stroke(tuple(map(tuple, points)), 0.15, "in")
        wider = replace(stroke, radius=0.15 + 0.8 / 7)
        if stroke.reaches(size):
            assert cover(stroke, size).any()
        elif cover(stroke, size).any():  # only at the border
            assert wider.reaches(size)
            assert not cover(stroke, size)[1:-1, 1:-1].any()


def test_a_dot_reaches_a_picture_of_a_pixel() -> None:
    assert Stroke(((0.0, 1.0),), 0.001, "in").reaches((1, 1))
    assert not Stroke(((-1.0, 1.0), (0.5, 3.0)), 0.001, "in").reaches((1, 1))


def test_colours_may_be_written_in_capitals() -> None:
    stroke = replace(BLUE, paint=BLUE.paint.upper())
    assert torch.equal(paint([stroke], (9, 9))[0], paint([BLUE], (9, 9))[0])
    recipe = Recipe((Step("recolor", (stroke,)),))
    assert Recipe.from_json(recipe.to_json(), "edit.json") == recipe


def test_a_stroke_is_the_same_after_a_file() -> None:
    stroke = Stroke(((0.25, 0.5), (1.5, -0.5)), 0.05, "in")
    assert stroke.entries() == {"paint": "in", "radius": 0.05, "points": [[0.25, 0.5], [1.5, -0.5]]}
    stored = json.loads(json.dumps(stroke.entries()))
    assert DETAIL.mark_of(stored, "detail") == stroke


BAD_STROKES = [
    ({"points": []}, "points of a stroke in tone must be pairs of numbers"),
    ({"points": [[0.5, 0.5, 0.5]]}, "points of a stroke in tone must be pairs of numbers"),
    ({"points": [[0.5, True]]}, "points of a stroke in tone must be pairs of numbers"),
    ({"radius": 0}, r"radius of a stroke in tone must be in \(0, 1\], got 0"),
    ({"radius": None}, r"radius of a stroke in tone must be in \(0, 1\], got null"),
    ({"paint": "colour"}, "paint of a stroke in tone must be one of a colour such as #c04020, out, box with"),
    ({"paint": "#12345"}, "paint of a stroke in tone must be one of"),
    ({"width": 1}, "strokes of tone must have the entries points, radius and paint"),
]


def test_bad_strokes_are_refused() -> None:
    for changed, sentence in BAD_STROKES:
        with pytest.raises(ValueError, match=sentence):
            RECOLOR.mark_of({**BLUE.entries(), **changed}, "tone")


def test_thinning_keeps_single_points_and_rounds() -> None:
    assert thin([], 0.1) == ()
    assert thin([(0.123456, 0.5)], 0.1) == ((0.1235, 0.5),)
    assert thin([(0.0, 0.0), (0.01, 0.0)], 0.1) == ((0.0, 0.0), (0.01, 0.0))


@pytest.mark.parametrize(
    ("paint", "role", "colour", "sliders"),
    [
        ("in", "object", None, None),
        ("out", "background", None, None),
        ("remove", "removed", None, None),
        ("#2040E0", "object", "#2040E0", None),
        ("in #2040e0", "object", "#2040e0", None),
        ("add 3,2.5,-1", "added", None, (3.0, 2.5, -1.0)),
        ("box", "box", None, None),
        ("box #2040e0", "box", "#2040e0", None),
    ],
)
def test_a_paint_has_a_role_and_may_say_a_colour_or_sliders(
    paint: str, role: str, colour: str | None, sliders: tuple[float, ...] | None
) -> None:
    assert meaning_of(paint) == (role, colour, sliders)


@pytest.mark.parametrize("paint", ["", "keep", "in ", "out #2040e0", "in blue", "in 3", "in 3,nan"])
def test_other_paints_mean_nothing(paint: str) -> None:
    assert meaning_of(paint) is None
    with pytest.raises(ValueError, match="paint of a mark must be in, out, add, remove, box or a colour, got"):
        _ = Stroke(((0.5, 0.5),), 0.1, paint).role


@pytest.mark.parametrize(
    "entries",
    [
        {"paint": "in", "rectangle": [0.1, 0.2, 0.3, 0.4]},
        {"paint": "out", "ellipse": [0.1, 0.2, 0.7, 0.1]},
        {"paint": "add", "polygon": [[0.1, 0.2], [0.5, 0.25], [0.3, 0.9], [-0.5, 0.5]]},
        {"paint": "in", "rectangle": [[0.5, 0.0], [1.0, 0.5], [0.0, 0.5]]},
        {"paint": "box", "rectangle": [0.1, 0.2, 0.3, 0.4]},
        {"paint": "in", "mask": "mask.png"},
        {"paint": "in", "layer": "paint.png"},
    ],
)
def test_a_region_is_the_same_after_a_file(entries: dict[str, object]) -> None:
    region = DEFOCUS.mark_of(json.loads(json.dumps(entries)), "defocus")
    assert isinstance(region, Region)
    assert region.entries() == entries
    recipe = Recipe((Step("defocus", (region,)),))
    (stored,) = Recipe.from_json(recipe.to_json(drawn=True), "edit.json").steps[0].strokes
    assert isinstance(stored, Region)
    assert replace(stored, file=Path(stored.file).name if stored.file else "") == region


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        (
            {"paint": "in", "rectangle": [0.1, 0.2, 0.3, 0.0]},
            "rectangle of a stroke in tone must be left and",
        ),
        ({"paint": "in", "ellipse": [0.1, 0.2, 0.3]}, "ellipse of a stroke in tone must be left and upper edge"),
        (
            {"paint": "in", "polygon": [[0.1, 0.2], [0.3, 4.0], [0, 0]]},
            "polygon of a stroke in tone must be three or",
        ),
        ({"paint": "in", "polygon": [[0.1, 0.2], [0.3, 0.4]]}, "polygon of a stroke in tone must be three or"),
        ({"paint": "in", "mask": 3}, "mask of a stroke in tone must be the path of a file, got 3"),
        (
            {"paint": "in", "mask": "a.png", "radius": 0.1},
            "strokes of tone must have the entries points, ",
        ),
        ({"paint": 3, "mask": "a.png"}, "paint of a stroke in tone must be one of in, out, box, add, remove, got 3"),
        ("in", "strokes of tone must have the entries"),
        (
            {"paint": "box", "ellipse": [0.1, 0.2, 0.3, 0.3]},
            "paint of a stroke in tone must be box for rectangles only, got a different shape, ellipse",
        ),
        (
            {"paint": "box", "points": [[0.1, 0.2]], "radius": 0.1},
            "paint of a stroke in tone must be box for rectangles only, got a different shape, line",
        ),
    ],
)
def test_bad_regions_are_refused(entries: object, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        DEFOCUS.mark_of(entries, "tone")


def test_an_edit_takes_what_was_drawn_for_another() -> None:
    entries = {"paint": "#2040e0", "radius": 0.1, "points": [[0.5, 0.5]]}
    assert DEFOCUS.mark_of(entries, "defocus") == RECOLOR.mark_of(entries, "recolor")
    with pytest.raises(ValueError, match="paint of a stroke in recolor must be one of a colour such as #c04020"):
        RECOLOR.mark_of(entries | {"paint": "in"}, "recolor")
    with pytest.raises(ValueError, match="paint of a stroke in colorize must be one of a colour"):
        COLORIZE.mark_of(entries | {"paint": "out"}, "colorize")


def test_a_box_is_the_upright_rectangle_around_a_region_within_the_photograph() -> None:
    region = Region.upright((0.25, 0.5, 0.5, 0.25), "rectangle", "box")
    assert box_in(region, (40, 80)) == (20.0, 20.0, 60.0, 30.0)
    turned = replace(region, points=((0.5, 0.25), (0.75, 0.5), (0.25, 0.5)))
    assert box_in(turned, (40, 80)) == (20.0, 10.0, 60.0, 30.0)
    assert box_in(Region.upright((-0.5, 0.5, 1.0, 1.0), "rectangle", "box"), (40, 80)) == (0.0, 20.0, 40.0, 40.0)
    left, top, right, bottom = box_in(Region.upright((0.99, 0.0, 0.005, 0.001), "rectangle", "box"), (40, 80))
    assert 79 >= left >= 78
    assert (right - left, top, bottom) == (1.0, 0.0, 1.0)
    with pytest.raises(ValueError, match=r"a box must meet the photograph, got one outside it, 96,.*; move it"):
        box_in(Region.upright((1.2, 0.5, 0.2, 0.2), "rectangle", "box"), (40, 80))


def test_a_box_marks_an_object_of_edits_that_compute_masks() -> None:
    box = Region.upright((0.25, 0.5, 0.5, 0.25), "rectangle", "box")
    for edit in ("mask", "defocus", "recolor", "detail", "colorize"):
        declared = MASK if edit == "mask" else EDITS[edit]
        assert declared.marks_object([box]) == (edit != "colorize")
        declared.check_mark(box, "a stroke")
        declared.check_mark(replace(box, paint="box #2040e0"), "a stroke")
    assert Step("defocus", (box,)).changes()
    assert not Step("colorize", (box,)).changes()


def test_sliders_of_regions_in_files_are_those_of_the_step() -> None:
    entries = {"alpha": [1.0, 1.0, 1.0], "strokes": [{"paint": "in 3,2,1", "rectangle": [0.1, 0.2, 0.3, 0.4]}]}
    step = Step.from_entries("detail", entries, "detail")
    assert step.changes()
    assert not step.changed(strokes=(replace(step.strokes[0], paint="in"),)).changes()
    with pytest.raises(ValueError, match="must be one of in, out, box, add, remove, got 'in 3,1e9'"):
        DETAIL.mark_of({"paint": "in 3,1e9", "mask": "a.png"}, "detail")
    with pytest.raises(ValueError, match="sliders in paint of detail must be as many numbers as alpha"):
        Step.from_entries("detail", entries | {"alpha": [1.0, 1.0]}, "detail")


def test_what_reaches_a_picture_of_a_region() -> None:
    for shape in ("rectangle", "ellipse"):
        box = [Region.upright((left, 0.2, 0.3, 0.4), shape, "in") for left in (-0.2, -0.4, 0.9, 1.1)]
        assert [region.reaches((20, 30)) for region in box] == [True, False, True, False]
    assert Region.upright((-1.0, -1.0, 3.0, 3.0), "rectangle", "in").reaches((20, 30))  # all of it
    assert Region.of_file("mask.png", "mask", "in").reaches((20, 30))
    assert not Region(((1.2, 0.0), (1.8, 0.0), (1.5, 0.9)), "polygon", "in").reaches((20, 30))


def test_pictures_of_marks_lie_beside_their_file() -> None:
    text = Recipe((Step("defocus", (Region.of_file("mask.png", "mask", "in"),)),)).to_json()
    recipe = Recipe.from_json(text, "folder/edit.json")
    assert recipe.steps[0].strokes == (Region.of_file(str(Path("folder/mask.png").absolute()), "mask", "in"),)
    assert Recipe.from_json(recipe.to_json(), "folder/edit.json") == recipe


def test_a_box_moves_with_a_crop_and_a_turned_picture() -> None:
    box = Region.upright((0.25, 0.5, 0.5, 0.25), "rectangle", "box")
    frame = Development(crop=(0.1, 0.0, 0.6, 0.9)).frame((40, 80))
    (moved,) = on_frame(Step("defocus", (box,)), frame).strokes
    assert isinstance(moved, Region)
    assert box_in(moved, frame.size) == pytest.approx((12.0, 20.0, 40.0, 30.0))
    turned = Development(straighten=10.0).frame((40, 80))
    (moved,) = on_frame(Step("defocus", (box,)), turned).strokes
    assert isinstance(moved, Region)
    left, top, right, bottom = box_in(moved, turned.size)
    corners = [turned.inward(*corner) for corner in box.outline]
    inside = [(min(max(x, 0), 1) * turned.size[1], min(max(y, 0), 1) * turned.size[0]) for x, y in corners]
    assert all(left - 1e-6 <= x <= right + 1e-6 and top - 1e-6 <= y <= bottom + 1e-6 for x, y in inside)
    gone = Development(crop=(0.0, 0.0, 0.2, 0.4)).frame((40, 80))
    assert on_frame(Step("defocus", (box,)), gone).strokes == ()


GRADIENTS = [
    {"paint": "add", "linear": [[0.5, -0.1], [0.4, 1.2]]},
    {"paint": "remove", "radial": [0.1, 0.2, 0.3, 0.4]},
    {"paint": "add", "radial": [[0.1, 0.2], [0.4, 0.3], [0.0, 0.5]], "softness": 1.0},
]


@pytest.mark.parametrize("entries", GRADIENTS)
def test_gradients_in_files(entries: dict[str, object]) -> None:
    assert DEFOCUS.mark_of(entries, "edit.json").entries() == entries


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ({"paint": "add", "linear": [[0.5, 0.5], [0.5, 0.5]]}, "linear of a stroke in edit.json must be two different"),
        ({"paint": "add", "linear": [0.5, 0.5, 0.6, 0.7]}, "linear of a stroke in edit.json must be two different"),
        ({"paint": "add", "radial": [0, 0, 1, 1], "softness": 0}, r"softness of .* must be in \(0, 1\], got 0"),
        ({"paint": "add", "ellipse": [0, 0, 1, 1], "softness": 1}, "must have the entries points, radius and paint"),
        ({"paint": "in", "linear": [[0, 0], [0, 1]]}, "must be add or remove for gradients, got in; correct it"),
    ],
)
def test_bad_gradients(entries: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        DEFOCUS.mark_of(entries, "edit.json")


def test_a_linear_gradient_reaches_what_lies_before_its_end() -> None:
    upper = Region(((0.5, 0.2), (0.5, 0.4)), "linear", "add")
    assert upper.reaches((10, 10))
    assert not replace(upper, points=((0.5, -0.2), (0.5, 0.04))).reaches((10, 10))
