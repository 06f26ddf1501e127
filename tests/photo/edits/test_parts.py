"""A rectangle of a picture under an edit is that part of the whole picture under it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits import recipe as whole_edit
from nlfilter_torch.photo.edits.applying import fit_step
from nlfilter_torch.photo.edits.parts import Parts, Rectangle
from nlfilter_torch.photo.picture.tiles import Passes
from nlfilter_torch.photo.selections.local_values import ABSOLUTE, RELATIVE
from tests.pairwise import each_value
from tests.problems import cat
from tests.recipes import ALPHA, COLORIZE, DETAIL, IN, INSIDE, RECOLOR, rows_of

SMALL = 0.002  # megapixels, fewer than the cat has
BRUSH, ERASER = Stroke(((0.6, 0.7), (0.8, 0.3)), 0.08, "add"), Stroke(((0.3, 0.3), (0.6, 0.7)), 0.06, "remove")
PLACES = [
    Rectangle(range(60), range(90)),
    Rectangle(range(8, 36), range(19, 58)),
    Rectangle(range(12), range(72, 90)),
    Rectangle(range(43, 60), range(1)),
]
EDITS = {
    "nothing": Recipe(),
    "detail": Recipe((Step("detail", alpha=(3.0, 1.0), landmarks=60),)),
    "detail, reduced": Recipe((Step("detail", alpha=(3.0, 2.0, 1.0), landmarks=60, viewing_size=SMALL),)),
    "detail of a region": Recipe((DETAIL,)),
    "detail of a region, reduced": Recipe((DETAIL.changed(viewing_size=SMALL),)),
    "detail by hand, reduced": Recipe(
        (Step("detail", (IN, BRUSH, ERASER), alpha=ALPHA, inside=INSIDE, landmarks=40, viewing_size=SMALL),)
    ),
    "all channels": Recipe((DETAIL.changed(channels="all", residual=0.5),)),
    "colorize": Recipe((COLORIZE,)),
    "recolor": Recipe((RECOLOR,)),
    "denoise": Recipe((Step("denoise", noise_level=8.0, brightness=0.3),)),
    "denoise by rule": Recipe((Step("denoise", noise_level=8.0, method="rule", colour=0.4, landmarks=60),)),
    "sharpen": Recipe((Step("sharpen", landmarks=60),)),
    "sharpen, reduced": Recipe((Step("sharpen", landmarks=60, viewing_size=SMALL),)),
    "tone": Recipe((Step("tone", contrast=1.3, clarity=1.5, landmarks=60),)),
    "abstract": Recipe((Step("abstract", landmarks=60, edges=0.7, tones=6),)),
    "defocus": Recipe((Step("defocus", (IN,), landmarks=60, radius=3.0),)),
    "look": Recipe((Step("look", alpha=(2.0, 1.0, 1.0), bands=(1.5, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0), landmarks=60),)),
    "several": Recipe((Step("denoise", noise_level=8.0, method="rule", landmarks=60), DETAIL, RECOLOR)),
}


def whole(recipe: Recipe, source: NDArray[Any], passes: Passes) -> torch.Tensor:
    rows = [rows for _, rows in whole_edit.edit_rows(passes, source, recipe.steps, "scan.tif")]
    return torch.from_numpy(np.concatenate(rows)).permute(2, 0, 1)[None].clamp(0, 1)


@pytest.mark.parametrize(("name", "options"), each_value(EDITS, [{"statistics": "full"}, {"sample": 4096}]))
def test_a_part_is_that_of_the_whole(
    name: str, options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "sample" in options:  # and in blocks, like a large picture
        monkeypatch.setattr("nlfilter_torch.photo.selections.mask.SOLVED_PIXELS", 2000)
        for kind, links in (("ABSOLUTE", ABSOLUTE), ("RELATIVE", RELATIVE)):
            monkeypatch.setattr(f"nlfilter_torch.photo.edits.colorize.{kind}", replace(links, pixels=2000))
        monkeypatch.setattr("nlfilter_torch.photo.edits.parts.STRIP_PIXELS", 1000)
    source, passes = rows_of(cat(5)), Passes("float32", folder=tmp_path, **options)
    wanted = whole(EDITS[name], source, passes)
    parts = Parts(source, "scan.tif")
    parts.fit(EDITS[name].steps, passes)
    for place in PLACES:
        part = wanted[..., place.rows.start : place.rows.stop, place.columns.start : place.columns.stop]
        torch.testing.assert_close(parts.edited(place), part, atol=2e-4, rtol=0)  # 0.05 grey levels
    parts.close()
    assert list(tmp_path.iterdir()) == []


def test_only_what_a_change_affects_is_fitted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[str] = []

    def counted(step: Step, *arguments: Any) -> Any:
        fitted.append(step.edit)
        return fit_step(step, *arguments)

    monkeypatch.setattr("nlfilter_torch.photo.edits.parts.fit_step", counted)
    source, passes, place = rows_of(cat(5)), Passes("float32", "full"), PLACES[1]
    parts = Parts(source, "scan.tif")
    detail, tone, recolor = Step("detail", alpha=(2.0, 1.0), landmarks=40), Step("tone", landmarks=40), RECOLOR
    for steps, wanted in (
        ((detail, tone), ["detail", "tone"]),
        ((detail, tone), []),
        ((detail, tone.changed(contrast=1.4)), ["tone"]),
        ((detail, tone.changed(contrast=1.4), recolor), ["recolor"]),
        ((detail,), []),
        ((detail.changed(alpha=(3.0, 1.0)), tone), ["detail", "tone"]),
        ((), []),
        ((recolor,), ["recolor"]),
    ):
        fitted.clear()
        parts.fit(steps, passes)
        assert fitted == wanted
        part = parts.edited(place)
        fresh = Parts(source, "scan.tif")
        fresh.fit(steps, passes)
        assert torch.equal(part, fresh.edited(place))
    fitted.clear()
    parts.fit((recolor,), replace(passes, statistics="sample"))  # a sample gives other sums
    assert fitted == ["recolor"]


@pytest.mark.parametrize("after", [1, 4, 8])
def test_a_fit_that_is_interrupted_leaves_what_was_known(after: int) -> None:
    """The progress report raises an exception; the next fit equals an uninterrupted one."""
    source, recipe, place = (
        rows_of(cat(5)),
        Recipe((Step("detail", alpha=(2.0, 1.0), landmarks=40), RECOLOR)),
        PLACES[1],
    )
    calls = 0

    def interrupt(stage: str, done: int, rows: int) -> None:
        nonlocal calls
        calls += 1
        if calls == after:
            raise InterruptedError

    parts, fresh = Parts(source, "scan.tif"), Parts(source, "scan.tif")
    passes = Passes("float32", "full")
    parts.fit((RECOLOR,), passes)
    with pytest.raises(InterruptedError):
        parts.fit(recipe.steps, replace(passes, report=interrupt))
    parts.fit(recipe.steps, passes)
    fresh.fit(recipe.steps, passes)
    assert torch.equal(parts.edited(place), fresh.edited(place))


def test_a_part_of_a_picture_of_many_tiles_of_the_network() -> None:
    """The tiles are at the same positions as in the whole picture."""
    image = torch.cat([cat(1), cat(1).flip(3)], dim=3)  # 900 pixels wide
    source, passes = rows_of(image), Passes("float32")
    recipe = Recipe((Step("denoise", noise_level=8.0),))
    wanted = whole(recipe, source, passes)
    parts = Parts(source, "scan.tif")
    parts.fit(recipe.steps, passes)
    for place in (Rectangle(range(150, 190), range(400, 470)), Rectangle(range(290, 300), range(870, 900))):
        part = wanted[..., place.rows.start : place.rows.stop, place.columns.start : place.columns.stop]
        torch.testing.assert_close(parts.edited(place), part, atol=2e-4, rtol=0)
