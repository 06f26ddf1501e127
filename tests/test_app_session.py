"""The editor without its page: what a session does, and what it shows."""

import io
import socket
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
import skimage.data
import torch
import torch.nn.functional as F
from PIL import Image

import nlfilter_torch.files
from nlfilter_torch import diffusion_mask, estimate_bandwidth, nonlocal_operator, polynomial_filter
from nlfilter_torch.app import controls, drawing
from nlfilter_torch.app.preview import MaskMaker, Preview, reduce, sampled_operator, stride_for
from nlfilter_torch.app.session import Session
from nlfilter_torch.brush import Stroke
from nlfilter_torch.cli import main
from nlfilter_torch.features import reduce_channels
from nlfilter_torch.files import Photograph, read_photograph, write_photograph
from nlfilter_torch.recipe import STEPS, Recipe
from nlfilter_torch.steps import Abstract, Defocus, Detail, Recolor

LINE = [(20.0, 20.0), (40.0, 22.0)]


def cat(step: int = 3) -> torch.Tensor:
    """(1, 3, 100, 150) in [0, 1] for a step of 3."""
    return torch.from_numpy(skimage.data.chelsea()[::step, :450:step].copy()).permute(2, 0, 1)[None].float() / 255


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    write_photograph(Photograph(cat()), tmp_path / "cat.png")
    return tmp_path / "cat.png"


@pytest.fixture
def session(photo: Path) -> Session:
    session = Session(photo.parent)
    session.open(photo)
    return session


def difference(a: torch.Tensor, b: torch.Tensor) -> float:
    """Largest difference in grey levels of 255, within what a screen can show."""
    return float((a.clamp(0, 1) - b.clamp(0, 1)).abs().max()) * 255


# The preview


def test_preview_of_a_small_photograph_is_the_photograph(session: Session) -> None:
    assert session.preview.stride == 1
    assert torch.equal(session.preview.pixels, cat())


@pytest.mark.parametrize("colour", [True, False])
def test_what_is_shown_is_what_is_saved(colour: bool) -> None:
    image = cat() if colour else reduce_channels(cat(), "luminance")
    region = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in")
    outside = Stroke(((0.8, 0.8),), 0.04, "out")
    preview = Preview(image)
    for recipe in (
        Recipe(),
        Recipe(Detail((3.0, 2.0, 1.0))),
        Recipe(Detail((3.0, 3.0, 4.0, 1.05), bandwidth=15.0, spatial_bandwidth=20.0, patch_size=3, landmarks=40)),
        Recipe(Detail((0.2, 1.0, 1.0, 1.0), (3.0, 3.0, 4.0, 1.0), 0.5, (region, outside))),
        Recipe(Detail((2.0, 1.0, 1.0, 1.0)), defocus=Defocus((region,))),
    ):
        assert difference(preview.render(recipe), recipe.apply(image)) < 1


def test_steps_are_held_until_one_before_them_changes(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    work = Abstract.apply
    monkeypatch.setattr(Abstract, "apply", lambda step, image: calls.append(step) or work(step, image))
    session.set("abstract", power=0.1)
    first = session.render()
    assert torch.equal(session.render(), first)
    assert len(calls) == 1
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    assert not torch.equal(session.render(), first)
    assert len(calls) == 2
    assert torch.equal(session.render("detail"), Preview(cat()).render(Recipe(session.recipe.detail)))
    assert len(calls) == 2


def test_a_slider_moves_without_the_operator(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    session.render()
    monkeypatch.setattr("nlfilter_torch.app.preview.sampled_operator", None)
    session.set("detail", alpha=(2.0, 1.0, 1.0, 1.0))
    assert difference(session.render(), session.recipe.apply(cat())) < 1
    session.set("detail", bandwidth=12.0)
    with pytest.raises(TypeError):
        session.render()


def test_stride_keeps_a_preview_small() -> None:
    for height, width in ((1000, 1000), (1001, 1000), (4000, 6000), (1, 3_000_001)):
        stride = stride_for(height, width)
        assert (height // stride) * (width // stride) <= 1_000_000
    assert stride_for(4000, 6000) == 5


def test_sampled_operator_is_a_sample_of_the_whole() -> None:
    image = reduce_channels(cat(1), "luminance")  # 300x450
    bandwidth = float(estimate_bandwidth(image))
    alpha = torch.tensor([3.0, 3.0, 4.0, 1.05])
    whole = polynomial_filter(nonlocal_operator(image, photometric_bandwidth=bandwidth), image, alpha)
    for stride in (1, 2, 3):
        first = (stride - 1) // 2
        operator = sampled_operator(image, stride, Detail(), bandwidth=bandwidth, channels="luminance", patch_size=5)
        height, width = operator.size
        assert operator.size == (300 // stride, 450 // stride)
        points = image[..., first::stride, first::stride][..., :height, :width]
        found = polynomial_filter(operator, points, alpha)
        wanted = whole[..., first::stride, first::stride][..., :height, :width]
        assert (found - wanted).square().mean().sqrt() * 255 < 1.0
        assert (wanted - points).square().mean().sqrt() * 255 > 15


def test_sampled_operator_in_colour_and_nearby() -> None:
    """As close as the whole operator is with other landmarks; half or twice the spatial bandwidth is 2.4 levels off."""
    image = cat(1)
    options = {"patch_size": 3, "photometric_bandwidth": 0.1, "spatial_bandwidth": 60.0, "num_landmarks": 200}
    whole = nonlocal_operator(image, guide_channels="all", **options) @ image  # type: ignore[arg-type]
    detail = Detail(landmarks=200, spatial_bandwidth=60.0, patch_size=3)
    operator = sampled_operator(image, 2, detail, bandwidth=0.1, channels="all", patch_size=3)
    found, wanted = operator @ image[..., ::2, ::2], whole[..., ::2, ::2]
    assert (found - wanted).square().mean().sqrt() * 255 < 0.8


def test_preview_of_a_large_photograph_shows_what_saving_gives() -> None:
    """A preview that filtered the reduced picture would be twice as far off."""
    image = cat(1)
    recipe = Recipe(Detail((3.0, 3.0, 4.0, 1.05)))
    preview = Preview(image, pixels=40_000)
    assert preview.stride == 2
    wanted = reduce(recipe.apply(image).clamp(0, 1), 2)

    def error(found: torch.Tensor) -> float:
        return float((found - wanted).square().mean().sqrt()) * 255

    assert error(preview.render(recipe)) < error(recipe.apply(preview.pixels).clamp(0, 1)) / 2


def test_masks_are_those_of_the_library() -> None:
    image = cat()
    spectrum = nonlocal_operator(image, photometric_bandwidth=25 / 255, guide_channels="all").spectrum()
    maker = MaskMaker(spectrum, ())
    first, second = torch.zeros(2, 1, 1, 100, 150).unbind()
    first[..., 20:25, 30:40], second[..., 80:90, 5:9] = 1, 1
    for region, negative, time in ((first, None, 1.0), (second, None, 1.0), (first, second, 1.0), (first, None, 0.3)):
        wanted = diffusion_mask(spectrum, region, time=time, negative=negative)
        assert (maker.mask(region, negative, time) - wanted).abs().max() < 2e-3


# Editing


def test_undo_and_redo(session: Session) -> None:
    assert not session.undo()
    session.set("detail", alpha=(2.0, 1.0, 1.0, 1.0))
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))  # still the same drag
    session.commit()
    session.set("abstract", power=0.1)
    session.commit()
    session.commit()  # nothing new
    edited = session.recipe
    assert session.undo()
    assert session.recipe == Recipe(Detail((3.0, 1.0, 1.0, 1.0)))
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
    assert not session.redo()  # another way was taken


def test_undo_in_the_midst_of_a_drag_takes_it_back_whole(session: Session) -> None:
    session.set("abstract", power=0.1)
    session.commit()
    session.set("abstract", power=0.5)
    session.undo()
    assert session.recipe == Recipe()


def test_strokes(session: Session) -> None:
    session.add_stroke("detail", LINE, 0.03, "in")
    (stroke,) = session.recipe.detail.strokes
    assert stroke.points[0] == (round(20 / 150, 4), 0.2)
    assert stroke.paint == "in"
    mask = session.preview.mask(session.recipe.detail)
    assert mask is not None
    assert mask[0, 0, 20, 30] > 0.9
    session.add_stroke("recolor", LINE, 0.03, "#2040e0")
    assert session.recipe.recolor == Recolor((Stroke(stroke.points, 0.03, "#2040e0"),))
    with pytest.raises(ValueError, match="abstract takes no strokes"):
        session.add_stroke("abstract", LINE, 0.03, "in")
    with pytest.raises(ValueError, match="must be one of in, got 'red'"):
        session.add_stroke("defocus", LINE, 0.03, "red")


def test_what_was_set_for_all_goes_to_the_first_region(session: Session) -> None:
    session.set("detail", alpha=(3.0, 3.0, 4.0, 1.05))
    session.add_stroke("detail", LINE, 0.03, "in")
    assert session.recipe.detail.inside == (3.0, 3.0, 4.0, 1.05)
    assert session.recipe.detail.alpha == (1.0, 1.0, 1.0, 1.0)
    session.set("detail", alpha=(0.0, 1.0, 1.0, 1.0))
    session.add_stroke("detail", LINE, 0.03, "in")
    assert session.recipe.detail.alpha == (0.0, 1.0, 1.0, 1.0)


def test_a_stroke_before_a_photograph(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="open a photograph first"):
        Session(tmp_path).add_stroke("detail", LINE, 0.03, "in")


# Files


def test_saving_is_what_the_command_line_does(session: Session, photo: Path) -> None:
    """All steps together, to 1/255."""
    session.set("detail", alpha=(1.5, 1.5, 1.5, 1.0))
    session.add_stroke("detail", LINE, 0.03, "in")
    session.set("detail", inside=(0.2, 0.5, 1.0, 1.0))
    session.add_stroke("recolor", LINE, 0.03, "#2040e0")
    session.add_stroke("defocus", LINE, 0.05, "in")
    session.set("abstract", edges=0.5)
    saved = read_photograph(session.save("out.png")).pixels
    edit = session.save_preset("edit.json")
    assert Recipe.find(str(edit)) == session.recipe
    assert main(["apply", str(photo), str(photo.with_name("cli.png")), "--preset", str(edit)]) == 0
    assert difference(saved, read_photograph(photo.with_name("cli.png")).pixels) <= 1
    assert difference(saved, session.recipe.apply(cat())) <= 1


def test_sliders_alone_are_a_preset_of_detail(session: Session, photo: Path) -> None:
    session.set("detail", alpha=(3.0, 3.0, 4.0, 1.05), bandwidth=12.0)
    saved, edit = session.save("out.png"), session.save_preset("edit.json")
    assert main(["detail", str(photo), str(photo.with_name("cli.png")), "--preset", str(edit)]) == 0
    assert difference(read_photograph(saved).pixels, read_photograph(photo.with_name("cli.png")).pixels) <= 1


def test_grey_photographs_become_coloured_files(tmp_path: Path) -> None:
    write_photograph(Photograph(reduce_channels(cat(), "luminance"), "uint16"), tmp_path / "grey.png")
    session = Session(tmp_path)
    session.open(tmp_path / "grey.png")
    session.add_stroke("colorize", LINE, 0.03, "#2040e0")
    assert session.render().shape == (1, 3, 100, 150)
    saved = read_photograph(session.save("colour.png"))
    assert saved.pixels.shape == (1, 3, 100, 150)
    assert saved.depth == "uint16"


def test_another_photograph_begins_a_new_edit(session: Session, tmp_path: Path) -> None:
    session.set("abstract", power=0.1)
    session.commit()
    content = io.BytesIO()
    Image.fromarray(skimage.data.coffee()[::8, ::8]).save(content, format="JPEG")
    session.open_bytes(content.getvalue(), "../coffee.jpg")
    assert session.opened is not None
    assert session.opened.name == "coffee.jpg"
    assert session.recipe == Recipe()
    assert not session.undo()
    assert session.suggested_name() == "coffee-edited.jpg"


@pytest.mark.parametrize(
    ("name", "photograph", "wanted"),
    [
        ("a.jpg", Photograph(cat(9)), "a-edited.jpg"),
        ("a.PNG", Photograph(cat(9)), "a-edited.png"),
        ("a.jpg", Photograph(cat(9), "uint16"), "a-edited.png"),
        ("a.jpg", Photograph(cat(9), alpha=cat(9)[:, :1]), "a-edited.png"),
        ("a", Photograph(cat(9), "float32"), "a-edited.tif"),
    ],
)
def test_names_to_save_under(session: Session, name: str, photograph: Photograph, wanted: str) -> None:
    assert session.opened is not None
    session.opened = type(session.opened)(name, photograph, session.preview)
    assert session.suggested_name() == wanted
    session.save(wanted)  # which can hold it
    assert Session(session.folder).suggested_name() == ""


def test_files_that_are_no_images_leave_all_as_it_was(session: Session, tmp_path: Path) -> None:
    session.set("abstract", power=0.1)
    opened, recipe = session.opened, session.recipe
    with pytest.raises(ValueError, match=r"^notes\.txt is not a PNG, JPEG, TIFF or WebP image"):
        session.open_bytes(b"dear diary", "notes.txt")
    with pytest.raises(ValueError, match=r"^empty\.png is empty"):
        session.open_bytes(b"", "empty.png")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        session.open(tmp_path / "none.png")
    assert (session.opened, session.recipe) == (opened, recipe)


def test_a_photograph_too_large_for_the_machine(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    free = type("Memory", (), {"available": 8 * 10**9})
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    content = io.BytesIO()
    Image.new("L", (10_000, 10_000)).save(content, format="PNG")
    opened = session.opened
    with pytest.raises(MemoryError, match=r"^huge\.png has 10000x10000 pixels and needs about .* GB of memory"):
        session.open_bytes(content.getvalue(), "huge.png")
    assert session.opened is opened


def test_an_edit_too_large_for_the_machine(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    free = type("Memory", (), {"available": 10**6})
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    session.add_stroke("defocus", LINE, 0.05, "in")
    with pytest.raises(MemoryError, match=r"cat\.png has 150x100 pixels and needs"):
        session.save("out.png")
    assert not (session.folder / "out.png").exists()


@pytest.mark.parametrize("name", ["", "..", "a/b.png", "/tmp/b.png", ".hidden.png", "a\0.png", "../b.png"])
def test_names_that_lead_out_of_the_folder(session: Session, name: str) -> None:
    for save in (session.save, session.save_preset):
        with pytest.raises(ValueError, match="the name must be one of a file"):
            save(name)


def test_saving_what_cannot_be_saved(session: Session, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in \.png, \.jpg"):
        session.save("out.gif")
    with pytest.raises(ValueError, match=r"must end in \.json"):
        session.save_preset("out.png")
    with pytest.raises(ValueError, match="there is nothing to save"):
        Session(tmp_path).save("out.png")
    session.folder = tmp_path / "gone"
    with pytest.raises(ValueError, match="does not exist"):
        session.save("out.png")


def test_an_interrupted_save_leaves_the_old_file(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    target = session.save("out.png")
    before = target.read_bytes()
    session.set("abstract", power=0.5)

    def break_off(image: Image.Image, stream: io.BytesIO, **options: object) -> None:
        stream.write(before[:100])
        raise OSError("no space left on device")

    monkeypatch.setattr(nlfilter_torch.files.Image.Image, "save", break_off)
    with pytest.raises(OSError, match="no space left"):
        session.save("out.png")
    assert target.read_bytes() == before
    assert sorted(file.name for file in session.folder.iterdir()) == ["cat.png", "out.png"]


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
    with pytest.raises(ValueError, match=r"photo\.jpg is no preset: it is not JSON"):
        session.load_preset(b"\xff\xd8\xff", "photo.jpg")
    assert session.recipe == Recipe()


# The verb


def test_app_says_what_it_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["app", "--out", str(tmp_path / "gone"), "--no-open"]) == 2
    assert "does not exist; make the folder first" in capsys.readouterr().err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["app", "--out", str(tmp_path), "--port", port, "--no-open"]) == 2
    assert f"cannot listen on --host 127.0.0.1 --port {port}" in capsys.readouterr().err
    monkeypatch.delitem(sys.modules, "nlfilter_torch.app.server")
    monkeypatch.setitem(sys.modules, "nicegui", None)
    assert main(["app", "--out", str(tmp_path), "--no-open"]) == 2
    assert "the editor needs nicegui, which is not installed" in capsys.readouterr().err


# What is drawn


def decoded(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)))


def test_pictures() -> None:
    image = cat()
    found = torch.from_numpy(decoded(drawing.picture(image)).copy()).permute(2, 0, 1)[None] / 255
    assert (found - image).square().mean().sqrt() * 255 < 3
    assert decoded(drawing.picture(image[:, :1])).shape == (100, 150)
    mask = torch.linspace(0, 1, 15000).view(1, 1, 100, 150)
    layer = decoded(drawing.mask_picture(mask))
    assert layer.shape == (100, 150, 4)
    assert (layer[0, 0, 3], layer[-1, -1, 3]) == (0, drawing.OPACITY)


def test_strokes_are_drawn_as_painted() -> None:
    svg = drawing.strokes_svg(
        [Stroke(((0.5, 0.25),), 0.1, "in"), Stroke(((0.0, 0.0), (1.0, 1.0)), 0.1, "#aabbcc")], (100, 200)
    )
    assert 'd="M100.0 25.0L100.0 25.0" stroke="#22c55e" stroke-width="20.0"' in svg
    assert 'd="M0.0 0.0L200.0 100.0" stroke="#aabbcc"' in svg


def test_response_has_a_line_for_each_region_and_a_dot_for_each_eigenvalue() -> None:
    eigenvalues = torch.tensor([1.0, 0.5, 0.0])
    svg = drawing.response_svg(eigenvalues, [("red", (3.0, 1.0)), ("blue", (0.0, 0.0, 1.0))])
    assert svg.count("<polyline") == 2
    assert svg.count("<circle") == 6
    assert svg.count('class="mark"') == 3
    # Gains from 0 to 3 lie between y = 112 and y = 10; sliders (3, 1) give 3, 2, 1.
    assert [f'cy="{y:.1f}" r="1.6" fill="red"' in svg for y in (10.0, 44.0, 78.0)] == [True] * 3


@pytest.mark.parametrize(
    "control", [c for step in controls.OF_STEP.values() for c in step] + list(controls.detail_sliders("inside", 3))
)
def test_controls_stay_within_what_a_step_takes(control: controls.Control) -> None:
    recipe = Recipe(Detail((1.0,) * 3, (1.0,) * 3))
    wanted, is_valid = STEPS[control.step].VALID[control.entry]
    assert control.low <= control.read(recipe) <= control.high
    for value in (control.low, control.high):
        entries = control.entries(recipe, value)
        changed = entries[control.entry]
        assert is_valid(list(changed) if isinstance(changed, tuple) else changed), wanted
        step = type(getattr(recipe, control.step))(**entries) if control.index is None else Detail((1.0,) * 3, changed)
        assert control.read(Recipe(**{control.step: step})) == value


def test_areas_are_means() -> None:
    image = cat(1)
    assert reduce(image, 1) is image
    assert torch.allclose(reduce(image, 3), F.interpolate(image, scale_factor=1 / 3, mode="area"), atol=1e-6)
