"""Brush strokes: points, paint, and their form in files."""

import json
from dataclasses import replace

import pytest
import torch

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke, reaches, thin
from nlfilter_torch.photo.picture.painting import cover, paint
from tests.recipes import BLUE


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
        if reaches(stroke, size):
            assert cover(stroke, size).any()
        elif cover(stroke, size).any():  # only at the border
            assert reaches(wider, size)
            assert not cover(stroke, size)[1:-1, 1:-1].any()


def test_a_dot_reaches_a_picture_of_a_pixel() -> None:
    assert reaches(Stroke(((0.0, 1.0),), 0.001, "in"), (1, 1))
    assert not reaches(Stroke(((-1.0, 1.0), (0.5, 3.0)), 0.001, "in"), (1, 1))


def test_colours_may_be_written_in_capitals() -> None:
    stroke = replace(BLUE, paint=BLUE.paint.upper())
    assert torch.equal(paint([stroke], (9, 9))[0], paint([BLUE], (9, 9))[0])
    recipe = Recipe((Step("recolor", (stroke,)),))
    assert Recipe.from_json(recipe.to_json(), "edit.json") == recipe


def test_a_stroke_is_the_same_after_a_file() -> None:
    stroke = Stroke(((0.25, 0.5), (1.5, -0.5)), 0.05, "in")
    assert stroke.entries() == {"paint": "in", "radius": 0.05, "points": [[0.25, 0.5], [1.5, -0.5]]}
    stored = json.loads(json.dumps(stroke.entries()))
    assert Stroke.from_entries(stored, ("in", "out"), "detail") == stroke


BAD_STROKES = [
    ({"points": []}, "points of a stroke in tone must be pairs of numbers"),
    ({"points": [[0.5, 0.5, 0.5]]}, "points of a stroke in tone must be pairs of numbers"),
    ({"points": [[0.5, True]]}, "points of a stroke in tone must be pairs of numbers"),
    ({"radius": 0}, r"radius of a stroke in tone must be in \(0, 1\], got 0"),
    ({"radius": None}, r"radius of a stroke in tone must be in \(0, 1\], got null"),
    ({"paint": "colour"}, "paint of a stroke in tone must be one of a colour such as #c04020, keep, got 'colour'"),
    ({"paint": "#12345"}, "paint of a stroke in tone must be one of"),
    ({"width": 1}, "strokes of tone must have the entries points, radius and paint"),
]


def test_bad_strokes_are_refused() -> None:
    for changed, sentence in BAD_STROKES:
        with pytest.raises(ValueError, match=sentence):
            Stroke.from_entries({**BLUE.entries(), **changed}, ("colour", "keep"), "tone")


def test_thinning_keeps_single_points_and_rounds() -> None:
    assert thin([], 0.1) == ()
    assert thin([(0.123456, 0.5)], 0.1) == ((0.1235, 0.5),)
    assert thin([(0.0, 0.0), (0.01, 0.0)], 0.1) == ((0.0, 0.0), (0.01, 0.0))
