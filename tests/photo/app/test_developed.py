"""A session whose photograph is developed: its preview, its parts, its file, and strokes in place."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.nn.functional import avg_pool2d

from nlfilter_torch.photo.app.developed import DEVELOPING
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.parts import Rectangle
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.light import balance_of, develop_image
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from tests.browser import difference
from tests.pairwise import each_value
from tests.problems import cat

ALL = Development(exposure=0.4, warmth=0.2, tint=0.1, straighten=4.0, crop=(0.1, 0.0, 1.0, 0.9))
BLUE = Stroke(((0.37, 0.35), (0.45, 0.37)), 0.04, "#2040e0")


def test_preview_part_and_file_agree(session: Session, tiled: bool) -> None:
    recipe = Recipe((Step("recolor", (BLUE,)), Step("tone", contrast=1.3)), ALL)
    wanted = apply_recipe(recipe, cat()).clamp(0, 1)
    session.load(recipe)
    assert difference(session.render(), wanted) < 1
    assert session.size == wanted.shape[-2:] == session.developed.frame.size
    assert difference(read_photograph(session.save("out.png")).pixels, wanted) < (1.5 if tiled else 0.51)
    part = Rectangle(range(10, 40), range(20, 90))
    assert difference(session.part(part, recipe), wanted[..., 10:40, 20:90]) < 1.5
    before = develop_image(cat(), ALL.geometry)
    assert torch.equal(session.developed.original(part), before[..., 10:40, 20:90])
    assert torch.equal(session.developed.before, before)


def test_the_preview_at_rest_is_the_file(tmp_path: Path) -> None:
    write_photograph(Photograph(cat(1)), tmp_path / "large.png")
    session = Session(tmp_path, tmp_path / "large.png", pixels=15_000)
    session.load(Recipe((Step("tone", contrast=1.3),), ALL))
    preview = session.render()
    assert session.is_reduced
    rest = session.at_rest(session.recipe)
    saved = read_photograph(session.save("out.png")).pixels
    size = (preview.shape[-2], preview.shape[-1])
    assert rest.shape == preview.shape
    assert difference(rest, resize(saved, size)) < 0.3
    assert difference(preview, rest) < 2
    assert max(read_photograph(session.save("small.png", side=60)).size) == 60


def test_a_part_without_steps_is_computed_alone(session: Session) -> None:
    light = replace(ALL, shadows=0.7, contrast=0.3)
    session.load(Recipe((), light))
    session.render()
    part = Rectangle(range(10, 40), range(20, 90))
    assert difference(session.part(part, session.recipe), develop_image(cat(), light)[..., 10:40, 20:90]) < 0.01
    assert "photograph" not in vars(session.developed)
    saved = read_photograph(session.save("out.png")).pixels
    assert difference(saved[..., 10:40, 20:90], session.part(part, session.recipe)) < 0.51


def test_strokes_are_stored_in_coordinates_of_the_original(session: Session) -> None:
    session.load(Recipe((), Development(straighten=5.0, crop=(0.3, 0.2, 1.0, 1.0))))
    session.render()
    height, width = session.preview.size
    session.add_stroke("recolor", [(width / 4, height / 2), (width / 2, height / 2)], 0.05, "#2040e0")
    (stroke,) = session.recipe.steps[0].strokes
    frame = session.developed.frame
    assert stroke.points[0] == pytest.approx(frame.outward(0.25, 0.5))
    assert stroke.radius == pytest.approx(0.05 / frame.scale)
    (shown,) = session.step_in_view("recolor").strokes
    assert shown.points[0] == pytest.approx((0.25, 0.5))
    assert shown.radius == pytest.approx(0.05)
    session.load(replace(session.recipe, develop=Development()))
    session.render()
    assert session.step_in_view("recolor").strokes == (stroke,)  # another crop moves none


def test_strokes_that_are_cropped_away_select_nothing(session: Session, tiled: bool) -> None:
    region = Step("detail", (replace(BLUE, paint="in"),), alpha=(1.0, 1.0), inside=(3.0, 1.0))
    recipe = Recipe((Step("recolor", (BLUE,)), region), Development(crop=(0.6, 0.6, 1.0, 1.0)))
    session.load(recipe)
    wanted = develop_image(cat(), recipe.develop)
    assert difference(session.render(), wanted) == 0
    assert session.mask("recolor") is session.mask("detail") is session.ignored("recolor") is None
    assert session.step_in_view("recolor").strokes == ()
    assert session.recipe == recipe  # no stroke is lost
    assert torch.equal(session.at_rest(recipe), wanted)
    assert torch.equal(session.part(Rectangle(range(5), range(9)), recipe), wanted[..., :5, :9])
    assert difference(read_photograph(session.save("out.png")).pixels, wanted) < 0.51
    assert torch.equal(apply_recipe(recipe, cat()), wanted)


def test_strokes_of_which_a_crop_leaves_hidden_pixels_select_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alpha = torch.ones_like(cat()[:, :1])
    alpha[..., 30:90] = 0
    write_photograph(Photograph(cat(), alpha=alpha), tmp_path / "holed.png")
    across = replace(BLUE, points=((0.3, 0.35), (0.7, 0.35)))
    session = Session(tmp_path, tmp_path / "holed.png")
    session.load(Recipe((Step("recolor", (across,)),), Development(crop=(0.0, 0.0, 0.7, 1.0))))
    assert (session.render() - session.developed.before).abs().max() > 0.1  # some pixels are left
    assert session.mask("recolor") is not None
    session.load(replace(session.recipe, develop=Development(crop=(0.0, 0.0, 0.5, 1.0))))
    assert torch.equal(session.render(), session.developed.before)
    assert session.mask("recolor") is session.ignored("recolor") is None
    monkeypatch.setattr("nlfilter_torch.photo.app.developed.left_by_crop", None)
    session.set("recolor", tolerance=0.2)
    assert torch.equal(session.render(0), session.developed.before)  # without painting at full size again
    saved = read_photograph(session.save("out.png")).pixels
    assert difference(saved[..., :30], session.developed.before[..., :30]) < 0.51
    assert len(session.step_in_view("recolor").strokes) == 1  # it is still shown


def test_a_moving_slider_is_followed_and_later_steps_stay(session: Session) -> None:
    session.load(Recipe((Step("tone", contrast=1.5),), Development(crop=(0.1, 0.0, 1.0, 1.0))))
    session.render()
    session.recipe = session.developing({"exposure": 0.5})
    wanted = apply_recipe(session.recipe, cat()).clamp(0, 1)
    assert difference(session.render(DEVELOPING), wanted) < 3
    assert not session.developed.development.exposure  # until the slider is released
    assert difference(session.render(), wanted) < 1
    session.recipe = session.developing({"straighten": 3.0})
    shown, wanted = session.render(DEVELOPING), apply_recipe(session.recipe, cat()).clamp(0, 1)
    assert shown.shape[-2:] == session.recipe.develop.frame((100, 150)).size
    assert difference(shown, wanted) < 3  # with the steps
    assert difference(shown, develop_image(cat(), session.recipe.develop)) > 8


def test_a_photograph_of_floats_is_straightened_in_its_own_light(tmp_path: Path) -> None:
    write_photograph(Photograph(1.8 * cat(), depth="float32"), tmp_path / "bright.tif")
    session = Session(tmp_path, tmp_path / "bright.tif")
    session.load(Recipe((Step("tone", contrast=1.3),)))
    session.render()
    for straighten in (0.5, 3.0):
        session.recipe = session.developing({"straighten": straighten})
        shown, wanted = session.render(DEVELOPING), apply_recipe(session.recipe, 1.8 * cat()).clamp(0, 1)
        assert difference(shown, wanted) < 3


def test_a_point_becomes_grey(session: Session) -> None:
    session.load(Recipe((), Development(warmth=-0.5, tint=0.3, crop=(0.2, 0.0, 1.0, 1.0))))
    session.render()
    means = avg_pool2d(session.developed.before, 5)
    least = int((means.amax(1) - means.amin(1)).argmin())  # the least saturated of the places
    row, column = 5 * (least // means.shape[3]), 5 * (least % means.shape[3])
    session.load(session.developing(session.balance(column + 2, row + 2)))
    place = session.render()[..., row : row + 5, column : column + 5].mean((0, 2, 3))
    assert place.amax() - place.amin() < 0.01
    assert session.recipe.develop.warmth > -0.4
    assert session.balance(-5, -5) == session.balance(0.9, 0.9)
    assert session.balance(1e4, 1e4) == session.balance(149.5, 99.5)
    with pytest.raises(ValueError, match="a grey point must have red, green and blue light"):
        balance_of(torch.zeros(1, 3, 5, 5))
    with pytest.raises(ValueError, match="must have colours to balance, got a grey one"):
        balance_of(torch.ones(1, 1, 5, 5))


def test_undo_redo_and_the_sidecar(session: Session) -> None:
    session.load(session.developing({"exposure": 1.0}))
    session.load(session.developing({"crop": (0.2, 0.0, 0.9, 1.0)}))
    assert session.undo()
    assert session.recipe.develop == Development(exposure=1.0)
    assert session.redo()
    assert session.recipe.develop.crop == pytest.approx((0.2, 0.0, 0.9, 1.0))
    preset = session.save_preset("edit.json").read_bytes()
    session.load(Recipe())
    session.load_preset(preset, "edit.json")
    assert session.recipe.develop.exposure == 1


@pytest.mark.parametrize(("straighten", "aspect"), each_value([0.0, 3.0], [None, 16 / 9, 2 / 3]))
def test_a_crop_keeps_its_size_where_it_is_moved(session: Session, straighten: float, aspect: float | None) -> None:
    session.load(session.developing({"straighten": straighten}))
    session.load(session.developing({"crop": (0.2, 0.2, 0.75, 0.8)}, aspect))
    size = session.recipe.develop.frame((100, 150)).size
    for _ in range(12):
        left, top, right, bottom = session.crop
        session.load(
            session.developing({"crop": (left + 0.0047, top - 0.0033, right + 0.0047, bottom - 0.0033)}, aspect)
        )
        assert session.recipe.develop.frame((100, 150)).size == size
    assert session.crop[0] > left + 0.004
    session.load(session.developing({"crop": session.crop}, 1.0))  # other proportions are cut all the same
    height, width = session.recipe.develop.frame((100, 150)).size
    assert height == width


def test_a_crop_is_what_the_photograph_can_have(session: Session) -> None:
    session.load(session.developing({"straighten": 10.0}))
    session.load(session.developing({"crop": (0.0, 0.0, 1.0, 1.0)}))
    assert session.crop == session.recipe.develop.crop == session.recipe.develop.frame((100, 150)).edges
    session.load(session.developing({"crop": (0.0, 0.0, 1.0, 1.0)}, 1.0))
    height, width = session.recipe.develop.frame((100, 150)).size
    assert height == width > 75  # as large as it can be
    again = session.developing({"crop": session.crop})
    assert again == session.recipe  # it does not shrink any further
    whole = session.uncropped
    assert whole.shape == (1, 3, 100, 150)
    assert whole[..., 0, 0].max() == 0  # an empty corner
    with pytest.raises(ValueError, match="crop must have its middle within the photograph"):
        session.developing({"straighten": 45.0, "crop": (0.0, 0.0, 0.1, 0.1)})
    outside = '{"version": 1, "develop": {"straighten": 45, "crop": [0, 0, 0.1, 0.1]}, "steps": []}'
    with pytest.raises(ValueError, match="move it inwards"):
        session.load_preset(outside.encode(), "edit.json")
