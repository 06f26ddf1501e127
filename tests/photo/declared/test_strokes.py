"""Brush strokes: points, paint, and their form in files."""

from dataclasses import replace

import torch

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import thin
from nlfilter_torch.photo.picture.painting import paint
from tests.recipes import BLUE


def test_thinning_keeps_the_ends() -> None:
    line = [(i / 1000, 0.0) for i in range(501)]
    kept = thin(line, 0.1)
    assert kept[0] == (0.0, 0.0)
    assert kept[-1] == (0.5, 0.0)
    assert len(kept) == 6


def test_colours_may_be_written_in_capitals() -> None:
    stroke = replace(BLUE, paint=BLUE.paint.upper())
    assert torch.equal(paint([stroke], (9, 9))[0], paint([BLUE], (9, 9))[0])
    recipe = Recipe((Step("recolor", (stroke,)),))
    assert Recipe.from_json(recipe.to_json(), "edit.json") == recipe
