"""Steps with strokes for tests, and recipes on pictures read by rows."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits import recipe as whole_edit
from nlfilter_torch.photo.picture.tiles import Passes

LINE = ((0.25, 0.25), (0.5, 0.3))
IN, OUT = Stroke(LINE, 0.06, "in"), Stroke(((0.8, 0.8),), 0.1, "out")
BLUE, KEEP = Stroke(LINE, 0.06, "#2040e0"), Stroke(((0.8, 0.8),), 0.1, "out")
ALPHA, INSIDE = (0.5, 1.0, 1.0, 1.0), (3.0, 3.0, 2.0, 1.0)
DETAIL = Step("detail", (IN, OUT), alpha=ALPHA, inside=INSIDE, reach=0.5, landmarks=40)
RECOLOR = Step("recolor", (BLUE, KEEP), reach=0.5, tolerance=20.0)
COLORIZE = Step("colorize", (BLUE,), strength=0.5)
DEFOCUS = Step("defocus", (IN,), radius=4.0)
ABSTRACT = Step("abstract", power=0.2, edges=0.5, edge_width=0.3, tones=5)
WHOLE = Recipe((DETAIL, COLORIZE, RECOLOR, DEFOCUS, ABSTRACT))


def rows_of(image: torch.Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())


def from_rows(rows: NDArray[Any]) -> torch.Tensor:
    return torch.from_numpy(rows).permute(2, 0, 1)[None].clamp(0, 1)


def by_rows(recipe: Recipe, source: NDArray[Any], folder: Path, **options: Any) -> NDArray[Any]:
    passes = Passes("float32", "full", folder=folder, **options)
    return np.concatenate([rows for _, rows in whole_edit.edit_rows(passes, source, recipe.steps, "scan.tif")])
