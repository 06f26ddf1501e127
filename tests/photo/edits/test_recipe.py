"""Recipes on pictures read by rows: the result in memory, and errors that name their cause."""

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits import recipe as whole_edit
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.tiles import Passes
from nlfilter_torch.photo.selections.matting import pyramid_levels
from tests.problems import cat, difference
from tests.recipes import BLUE, COLORIZE, DETAIL, IN, RECOLOR, by_rows, from_rows, rows_of
from tests.tiles import cat as photograph

ADD, REMOVE = Stroke(((0.2, 0.7), (0.6, 0.8)), 0.08, "add"), Stroke(((0.4, 0.5),), 0.1, "remove")
FAR = Stroke(((1.8, 1.8),), 0.05, "out")  # covers no pixel


def test_denoising_by_a_sample_is_within_a_grey_level() -> None:
    noise = np.random.default_rng(0).normal(0, 0.06, (200, 260, 3))
    picture = (photograph(200, 260) + noise).clip(0, 1).astype(np.float32)
    step, options = Recipe((Step("denoise", landmarks=60),)), {"sample": 4096}
    rows = [rows for _, rows in whole_edit.edit_rows(Passes("float32", **options), picture, step.steps, "scan.tif")]
    assert difference(from_rows(np.concatenate(rows)), apply_recipe(step, from_rows(picture))) < 1  # grey level


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe(),
        Recipe((Step("detail", alpha=(3.0, 1.0)),)),
        Recipe((DETAIL,)),
        Recipe((DETAIL.changed(strokes=(IN, FAR)),)),
        Recipe((COLORIZE,)),
        Recipe((RECOLOR,)),
        Recipe((RECOLOR.changed(strokes=(BLUE, replace(FAR, paint="out"))),)),
        Recipe((Step("denoise", landmarks=60),)),
        Recipe((Step("denoise", noise_level=8.0, landmarks=60),)),
        Recipe((Step("sharpen", landmarks=60).mixed(opacity=0.3),)),
        Recipe((COLORIZE.mixed(opacity=0.6), RECOLOR.mixed(on=False))),
        Recipe((Step("tone", contrast=1.3, clarity=1.5, landmarks=60),)),
        Recipe((Step("abstract", landmarks=60),)),
        Recipe((Step("abstract", landmarks=60, edges=0.7, tones=6),)),
        Recipe((Step("defocus", (IN, ADD, REMOVE), landmarks=60, radius=3.0),)),
        Recipe((Step("recolor", (replace(ADD, paint="add #2040e0"), REMOVE), landmarks=60),)),
        Recipe((DETAIL, COLORIZE, RECOLOR)),
        Recipe((RECOLOR, Step("detail", alpha=(1.5, 1.0)))),
    ],
)
def test_an_edit_by_rows_is_the_one_in_memory(recipe: Recipe, tmp_path: Path) -> None:
    image = cat(5)
    edited = by_rows(recipe, rows_of(image), tmp_path, tile_rows=17)
    # Differences of 1e-5 before recolouring may change its landmarks, so its input is that of the steps by rows.
    before, last = recipe.steps[:-1], recipe.steps[-1:]
    image_before = from_rows(by_rows(Recipe(before), rows_of(image), tmp_path, tile_rows=17)) if before else image
    wanted = rows_of(apply_recipe(Recipe(last), image_before))
    # In memory the balancing stops at 1e-5.
    assert np.abs(edited - wanted).max() < (1e-4 if RECOLOR in last else 2e-5)
    assert not list(tmp_path.iterdir())


def test_a_mask_by_a_pyramid_is_the_same_by_rows(tmp_path: Path) -> None:
    image = cat()[..., :97, :149]  # large enough to be halved once, and no multiple of two
    assert pyramid_levels(97) == 1
    recipe = Recipe((Step("defocus", (IN,), landmarks=60, radius=3.0),))
    edited = by_rows(recipe, rows_of(image), tmp_path, tile_rows=17)
    assert np.abs(edited - rows_of(apply_recipe(recipe, image))).max() < 2e-5


def test_grey_becomes_colour_and_transparency_stays(tmp_path: Path) -> None:
    grey = cat()[:, :1]
    source = np.concatenate([rows_of(grey), np.full(15000, 1, np.float32).reshape(100, 150, 1)], axis=2)
    detail, colorize = Step("detail", alpha=(2.0, 1.0), landmarks=30), Step("colorize", (BLUE,))
    edited = by_rows(Recipe((detail, colorize)), source, tmp_path)
    # Differences of 1e-5 before colorizing may change its landmarks, so its input is that of the first step by rows.
    image_before = from_rows(by_rows(Recipe((detail,)), rows_of(grey), tmp_path))
    assert np.abs(edited[..., :3] - rows_of(apply_recipe(Recipe((colorize,)), image_before))).max() < 2e-5
    np.testing.assert_allclose(edited[..., 3], source[..., 1], atol=1e-7)


def test_no_room_between_two_steps_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        """A file on a full disk."""

        def __enter__(self) -> "Full":
            return self

        def __exit__(self, *_: object) -> None: ...

        def write(self, _: bytes) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("nlfilter_torch.photo.picture.tiles.TemporaryFile", lambda **_: Full())
    sentence = "No space left on device, for a temporary file of 1 MB"
    with pytest.raises(OSError, match=sentence) as raised:
        by_rows(Recipe((Step("detail", alpha=(2.0, 1.0), landmarks=30), RECOLOR)), rows_of(cat()), tmp_path)
    assert raised.value.filename == str(tmp_path)
    assert raised.value.errno == errno.ENOSPC
