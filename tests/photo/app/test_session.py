"""A session of the editor without its page: steps, strokes and history."""

import json
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import skimage.data
import torch
from PIL import Image

from nlfilter_torch.photo.app.drawing import strokes_svg
from nlfilter_torch.photo.app.page import PRESET_KINDS
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.colour_tables import cube_of, hald_of
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Region, Stroke
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.problems import LINE, cat, difference


def test_undo_and_redo(session: Session) -> None:
    assert not session.can_undo
    assert not session.undo()
    session.set("detail", alpha=(2.0, 1.0, 1.0, 1.0))
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))  # still the same drag
    session.commit()
    session.set("abstract", power=0.1)
    session.commit()
    session.commit()  # nothing new
    edited = session.recipe
    assert session.can_undo
    assert not session.can_redo
    assert session.undo()
    assert session.can_redo
    assert session.recipe == Recipe((Step("detail", alpha=(3.0, 1.0, 1.0, 1.0)),))
    assert session.undo()
    assert session.recipe == Recipe()
    assert not session.undo()
    assert session.redo()
    assert session.redo()
    assert not session.redo()
    assert session.recipe == edited
    session.undo()
    session.set("abstract", edges=1.0)
    session.commit()
    assert not session.redo()  # a new edit discards what was undone


def test_a_file_of_several_pages(session: Session, tmp_path: Path) -> None:
    assert session.pages == 1
    Image.new("L", (30, 20)).save(tmp_path / "two.tif", save_all=True, append_images=[Image.new("L", (30, 20), 255)])
    with pytest.warns(UserWarning, match="only the first is read"):
        several = Session(tmp_path, tmp_path / "two.tif")
    assert several.pages == 2


def test_undo_in_the_midst_of_a_drag_takes_it_back_whole(session: Session) -> None:
    session.set("abstract", power=0.1)
    session.commit()
    session.set("abstract", power=0.5)
    session.undo()
    assert session.recipe == Recipe()


def test_strokes(session: Session) -> None:
    session.add_stroke("detail", LINE, 0.03, "in")
    (stroke,) = session.recipe.current("detail").strokes
    assert stroke.points[0] == (round(20 / 150, 4), 0.2)
    assert stroke.paint == "in"
    mask = session.preview.masks(session.recipe.current("detail"))
    assert mask is not None
    assert mask[0, 0, 20, 30] > 0.9
    session.add_stroke("recolor", LINE, 0.03, "#2040e0")
    assert session.recipe.current("recolor") == Step("recolor", (Stroke(stroke.points, 0.03, "#2040e0"),))
    with pytest.raises(ValueError, match="abstract takes no strokes"):
        session.add_stroke("abstract", LINE, 0.03, "in")
    with pytest.raises(ValueError, match="must be one of in, out, box, add, remove, got 'red'"):
        session.add_stroke("defocus", LINE, 0.03, "red")


def test_a_box_takes_the_place_of_the_one_before(session: Session) -> None:
    session.add_box("defocus", (30, 20), (120, 80), "box")
    session.add_stroke("defocus", LINE, 0.03, "in")
    session.add_box("defocus", (130, 90), (-5, 10), "box")
    stroke, box = session.recipe.current("defocus").strokes
    assert (stroke.paint, box) == ("in", Region.upright((0.0, 0.1, 0.8667, 0.8), "rectangle", "box"))
    mask = session.mask("defocus")
    assert mask is not None
    assert mask[..., :10, :].max() == 0
    session.add_box("recolor", (10, 10), (140, 90), "box #2040e0")
    assert session.recipe.current("recolor").changes()
    for sliders in ("", " 3,1,1,1", " 2,1,1,1", " 3,1,1,1"):
        session.add_box("detail", (10, 10), (140, 90), f"box{sliders}")
    paints = [mark.paint for mark in session.recipe.current("detail").strokes]
    assert paints == ["box", "box 2,1,1,1", "box 3,1,1,1"]
    with pytest.raises(ValueError, match="abstract takes no strokes"):
        session.add_box("abstract", (10, 10), (140, 90), "box")


def test_regions_of_files_are_those_of_the_preview(session: Session, tmp_path: Path) -> None:
    """A file with regions, and with strokes that were drawn for other edits, is shown as it is applied."""
    mask = np.zeros((100, 150), np.uint8)
    mask[60:80, 100:130] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    strokes = [
        {"paint": "#2040e0", "rectangle": [0.1, 0.1, 0.2, 0.2]},
        {"paint": "in 3,1,1,1", "ellipse": [0.4, 0.4, 0.2, 0.2]},
        {"paint": "in", "mask": "mask.png"},
        {"paint": "out", "polygon": [[0.7, 0.1], [0.9, 0.1], [0.9, 0.3]]},
    ]
    steps = [
        {"edit": "detail", "alpha": [1, 1, 1, 1], "inside": [2, 2, 1, 1], "strokes": strokes},
        {"edit": "defocus", "strokes": strokes},
        {"edit": "recolor", "strokes": strokes[:1] + strokes[3:]},
    ]
    content = json.dumps({"version": 1, "steps": steps}).encode()
    session.load_preset(content, str(tmp_path / "edit.json"))
    for edit in ("detail", "defocus", "recolor"):
        selected = session.mask(edit)
        assert selected is not None
        assert selected[0, 0, 20, 30] > 0.9
    masks = session.preview.masks(session.recipe.current("detail"))
    assert masks is not None
    assert masks[0, 0, 70, 115] > 0.9
    assert masks[0, 1, 50, 75] > 0.9  # of other sliders
    assert strokes_svg(session.step_in_view("defocus").strokes, (100, 150)).count("Z") == 4  # borders of regions
    shown = session.render()
    assert shown.isfinite().all()
    assert difference(shown, session.preview.pixels) > 0


def test_strokes_under_others_count_as_absent(session: Session) -> None:
    session.add_stroke("detail", LINE, 0.06, "in")
    session.set("detail", inside=(3.0, 3.0, 2.0, 1.0))
    session.commit()
    without, alone = session.render(), session.preview.masks(session.recipe.current("detail"))
    session.add_stroke("detail", LINE, 0.03, "out")
    mask = session.preview.masks(session.recipe.current("detail"))
    assert mask is not None
    assert alone is not None
    assert torch.equal(mask, alone)
    assert torch.equal(session.render(), without)
    session.add_stroke("detail", LINE, 0.1, "out")  # reaches beyond the others
    assert not torch.equal(session.render(), without)


def test_the_first_region_begins_with_the_sliders_of_the_rest(session: Session) -> None:
    """A scribble alone therefore changes nothing."""
    session.set("detail", alpha=(3.0, 3.0, 4.0, 1.05))
    before = session.render()
    session.add_stroke("detail", LINE, 0.03, "in")
    assert (
        session.recipe.current("detail")["inside"] == session.recipe.current("detail")["alpha"] == (3.0, 3.0, 4.0, 1.05)
    )
    assert difference(session.render(), before) <= 1e-3
    session.set("detail", alpha=(0.0, 1.0, 1.0, 1.0))
    session.add_stroke("detail", LINE, 0.03, "in")
    assert session.recipe.current("detail")["inside"] == (3.0, 3.0, 4.0, 1.05)


def test_the_last_step_of_an_edit_is_the_one_at_work(session: Session) -> None:
    """The first step of a kind is inserted in its usual place."""
    session.load(Recipe((Step("abstract"), Step("tone"), Step("detail"), Step("tone", clarity=3.0))))
    session.set("tone", contrast=0.9)
    assert [step["contrast"] for step in session.recipe.steps if step.edit == "tone"] == [1.2, 0.9]
    session.recipe = session.recipe.choosing(1)
    session.commit()
    session.set("tone", contrast=0.7)
    session.commit()
    assert session.undo()
    assert session.recipe.current("tone") == Step("tone")
    session.redo()
    session.set("denoise", noise_level=5.0)
    session.set("tone", clarity=1.5)
    assert [(step["contrast"], step["clarity"]) for step in session.recipe.steps if step.edit == "tone"] == [
        (0.7, 1.5),
        (0.9, 3.0),
    ]
    session.set("recolor", reach=0.5)
    assert [step.edit for step in session.recipe.steps] == ["denoise", "abstract", "tone", "detail", "tone", "recolor"]


def test_what_is_changed_is_seen(session: Session) -> None:
    for hidden in (Step("tone").mixed(on=False), Step("tone").mixed(opacity=0.0)):
        session.load(Recipe((hidden,)))
        session.set("tone", contrast=0.9)
        assert session.recipe.steps == (Step("tone", contrast=0.9),)
    session.load(Recipe((Step("tone").mixed(opacity=0.3),)))
    session.set("tone", contrast=0.9)
    assert session.recipe.steps[0].opacity == 0.3


def test_a_copy_has_the_name_of_the_original(tmp_path: Path) -> None:
    Image.fromarray(skimage.data.coffee()[::8, ::8]).save(tmp_path / "copy", format="JPEG")
    session = Session(tmp_path, tmp_path / "copy", "coffee.jpg")
    assert session.name == "coffee.jpg"
    assert session.recipe == Recipe()
    assert not session.undo()
    assert session.suggested_name() == "coffee-edited.jpg"


def test_masks_of_a_loaded_edit_are_files_of_the_folder(session: Session, tmp_path: Path) -> None:
    """Whoever sends an edit to the editor cannot have it open files elsewhere."""
    (tmp_path / "inside").mkdir()
    for file, inside in (("inside/mask.png", True), ("../mask.png", False), (str(tmp_path.parent / "mask.png"), False)):
        strokes = [{"paint": "in", "mask": file}]
        content = json.dumps({"version": 1, "steps": [{"edit": "defocus", "strokes": strokes}]}).encode()
        if inside:
            session.load_preset(content, "edit.json")
            (mark,) = session.recipe.current("defocus").strokes
            assert mark.file == str(tmp_path / file)
        else:
            with pytest.raises(ValueError, match=r"masks of edit\.json must be files in .*, got .*mask\.png; move"):
                session.load_preset(content, "edit.json")


def test_colour_tables_are_loaded_as_looks(session: Session) -> None:
    colours = np.stack(np.meshgrid(*[np.arange(4) / 3] * 3, indexing="ij"))
    table = np.stack([colours[0] ** 1.4, colours[1], 0.7 * colours[2]])
    uploads = {"look.cube": cube_of(table, "look").encode(), "hald.png": imagecodecs.png_encode(hald_of(table))}
    lattices = []
    for name, content in uploads.items():
        assert Path(name).suffix in PRESET_KINDS.split(",")
        session.load_preset(content, name)
        assert [step.edit for step in session.recipe.steps] == ["look"]
        lattices.append(torch.tensor(session.recipe.steps[0]["lattice"]))
    torch.testing.assert_close(*lattices, atol=1e-4, rtol=0)
    with pytest.raises(ValueError, match=r"LUT_3D_SIZE of look\.cube must be a whole number"):
        session.load_preset(b"LUT_3D_SIZE 500\n", "look.cube")
    with pytest.raises(ValueError, match=r"photo\.png must be a Hald, a square picture in colour of 8, 27"):
        session.load_preset(imagecodecs.png_encode(np.zeros((60, 60, 3), np.uint8)), "photo.png")
    assert torch.equal(torch.tensor(session.recipe.steps[0]["lattice"]), lattices[1])


def test_presets_come_back(session: Session) -> None:
    session.add_stroke("detail", LINE, 0.03, "in")
    session.set("detail", inside=(3.0, 1.0, 1.0, 1.0))
    session.commit()
    recipe = session.recipe
    content = session.save_preset("edit.json").read_bytes()
    session.load(Recipe())
    session.load_preset(content, "edit.json")
    assert session.recipe == recipe
    session.undo()
    assert session.recipe == Recipe()
    with pytest.raises(ValueError, match=r"edit\.txt is not a preset: it is not JSON"):
        session.load_preset(b"{no", "edit.txt")
    with pytest.raises(ValueError, match=r"photo\.jpg must be a Hald, got a picture that cannot be read"):
        session.load_preset(b"\xff\xd8\xff", "photo.jpg")
    assert session.recipe == Recipe()


def test_grey_photographs_have_no_colours(session: Session, tmp_path: Path) -> None:
    assert session.has_colours
    write_photograph(Photograph(cat().mean(1, keepdim=True).expand(-1, 3, -1, -1)), tmp_path / "grey.png")
    assert not Session(tmp_path, tmp_path / "grey.png").has_colours


@pytest.mark.parametrize("recipe", [Recipe((Step("tone", contrast=1.4),)), Recipe((Step("detail", alpha=(1.0, 3.0)),))])
def test_a_draft_is_near_the_preview(session: Session, recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is the preview itself with the change of a smaller picture, and nothing where that is no faster."""
    assert session.draft() is None  # a small photograph
    monkeypatch.setattr("nlfilter_torch.photo.app.developed.DRAFT_PIXELS", 5000)
    session = Session(session.folder, session.path)
    assert session.draft() is None  # without a step
    session.prepare(recipe.steps[0].edit)
    session.load(recipe)
    draft = session.draft(0)
    assert draft is not None
    before, complete = session.preview.pixels, session.render()
    assert draft.shape == complete.shape
    assert not draft.equal(complete)
    assert (draft - complete).square().mean() < 0.25 * (complete - before).square().mean()
    if recipe.steps[0].edit == "detail":
        assert session.draft(0) is None  # the layers of the preview are there now, and only have to be weighed
    session.recipe = session.developing({"exposure": 1.0})
    assert session.draft() is None  # it has to be developed first
