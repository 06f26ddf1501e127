"""Commands besides those of single edits: ``apply`` and ``develop``."""

from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image

from nlfilter_torch.photo.cli import editing, main
from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.pairwise import each_value
from tests.problems import cat, colour
from tests.recipes import COLORIZE, DEFOCUS, DETAIL, RECOLOR


def test_the_command_line_goes_by_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.sampling.PILOT", 4000)
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 6000)
    photo, preset = tmp_path / "in.tif", tmp_path / "edit.json"
    pixels = F.interpolate(cat(), scale_factor=2, mode="bicubic").clamp(0, 1)  # more than tiles need
    write_photograph(Photograph(pixels, "uint16"), photo)
    preset.write_text(Recipe((DETAIL, RECOLOR)).to_json())
    names = [tmp_path / "whole.tif", tmp_path / "rows.tif"]
    for name, options in zip(names, ([], ["--memory", "0.044", "--full"]), strict=True):
        assert main(["apply", str(photo), str(name), "--preset", str(preset), *options]) == 0
    whole, rows = (read_photograph(name).pixels for name in names)
    # Rounding in the first step may change the k-means of the second: noise of 1e-7 changes pixels by 1.4 levels, and
    # a pixel as near to another object as to the painted one may change sides.
    changes = 255 * (whole - rows).abs().amax(1)
    assert changes.max() > 0
    assert (changes > 8).float().mean() < 1e-4
    assert 255 * (whole - rows).square().mean().sqrt() < 0.5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["edit.json", "in.tif", "rows.tif", "whole.tif"]


def test_apply(pixels: torch.Tensor, tmp_path: Path) -> None:
    photo, edit, out = tmp_path / "in.png", tmp_path / "edit.json", tmp_path / "out.png"
    write_photograph(Photograph(pixels), photo)
    recipe = Recipe((DETAIL, Step("tone"), DEFOCUS))
    edit.write_text(recipe.to_json())
    assert main(["apply", str(photo), str(out), "--preset", str(edit)]) == 0
    assert (read_photograph(out).pixels - apply_recipe(recipe, pixels).clamp(0, 1)).abs().max() < 0.6 / 255

    assert main(["apply", str(photo), str(out), "--preset", "crisp", "--depth", "16"]) == 0
    assert main(["detail", str(photo), str(tmp_path / "same.png"), "--preset", "crisp", "--depth", "16"]) == 0
    assert torch.equal(read_photograph(out).pixels, read_photograph(tmp_path / "same.png").pixels)


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        (Step.idle("tone"), "edit.json holds no step that changes anything: the photograph is written without an edit"),
        (COLORIZE, "in.png is in colour: colorize replaces its colours everywhere by those of the scribbles"),
    ],
    ids=["idle", "colorize"],
)
def test_apply_notes(
    pixels: torch.Tensor,
    tmp_path: Path,
    step: Step,
    sentence: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_photograph(Photograph(pixels), tmp_path / "in.png")
    (tmp_path / "edit.json").write_text(Recipe((step,)).to_json(drawn=True))
    files = [str(tmp_path / name) for name in ("in.png", "out.png", "edit.json")]
    assert main(["apply", *files[:2], "--preset", files[2]]) == 0
    (note,) = capsys.readouterr().err.splitlines()
    assert sentence in note
    assert read_photograph(files[1]).size == (48, 64)


def test_apply_refuses_what_is_no_edit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["apply", "in.png", str(tmp_path / "out.png"), "--preset", "nothing"]) == 2
    assert "nothing is neither a file nor one of the presets" in capsys.readouterr().err


SIZE = (300, 420)  # more than a block that is turned at once
ALL = ["--exposure", "0.5", "--warmth", "0.2", "--straighten", "3", "--crop", "5%,0%,95%,90%"]


def written(path: Path, kind: str) -> Path:
    """A photograph as a TIFF: of 8 bits, with transparency, without data in places, or of floats beyond white."""
    picture = colour("chelsea", *SIZE)[0].permute(1, 2, 0).numpy()
    if kind == "floats":
        tifffile.imwrite(path, 3 * picture - 0.2, photometric="rgb")
        return path
    stored = np.rint(254 * picture + 1).astype(np.uint8)
    tags = None
    if kind == "transparent":
        alpha = np.full((*SIZE, 1), 255, np.uint8)
        alpha[60:180, 90:220], alpha[:, 250:280] = 0, 128
        stored = np.concatenate([stored, alpha], axis=2)
    if kind == "nodata":
        stored[60:180, 90:220] = 0
        tags = [(42113, "s", 0, "0", True)]
    tifffile.imwrite(path, stored, photometric="rgb", extratags=tags, metadata=None)
    return path


def by_both(monkeypatch: pytest.MonkeyPatch, source: Path, *arguments: str) -> list[NDArray[np.generic]]:
    """The pixels that a command writes, in memory and in tiles."""
    target = source.with_name("out.tif")
    pictures = []
    for _ in range(2):
        assert main([arguments[0], str(source), str(target), *arguments[1:]]) == 0
        pictures.append(tifffile.imread(target))
        monkeypatch.setattr(editing, "read_if_it_fits", lambda *_: None)
    return pictures


@pytest.mark.parametrize(
    ("kind", "arguments"),
    each_value(
        ["plain", "transparent", "nodata", "floats"],
        [ALL, ["--crop", "84,10%,50%,270"], ["--exposure", "-1", "--tint", "0.3"]],
    ),
)
def test_tiles_give_the_same(kind: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = written(tmp_path / "in.tif", kind)
    whole, tiled = by_both(monkeypatch, source, "develop", *arguments)
    assert whole.dtype == tiled.dtype == tifffile.imread(source).dtype
    assert whole.shape == tiled.shape
    seen = whole[..., -1:] > 0 if kind == "transparent" else True
    assert np.array_equal(whole * seen, tiled * seen)
    if arguments[0] == "--crop":
        assert np.array_equal(whole, tifffile.imread(source)[30:, 84:294])
    if kind == "nodata":
        hidden = (whole == 0).all(2)
        assert 0.05 < hidden.mean() < 0.3
        assert whole[~hidden].min() > 0  # no pixel has the colour of those without data mixed in
    if kind == "transparent":
        assert (whole[..., 3] == 0).any()
        assert (whole[..., 3] == 128).any()


def test_a_crop_is_trimmed_to_proportions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = written(tmp_path / "in.tif", "plain")
    for picture in by_both(monkeypatch, source, "develop", "--crop", "20%,0,80%,100%", "--aspect", "1:1"):
        assert np.array_equal(picture, tifffile.imread(source)[:, 102:402])
    for picture in by_both(monkeypatch, source, "develop", "--straighten", "4", "--aspect", "16:9"):
        assert picture.shape[1] == pytest.approx(picture.shape[0] * 16 / 9, abs=1)
        assert picture.shape[1] > 340


def test_strokes_stay_where_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a stroke selects in the whole photograph, it selects in the developed one."""
    picture = np.full((*SIZE, 3), 60, np.uint8)
    picture[100:140, 200:260] = (200, 40, 40)
    tifffile.imwrite(tmp_path / "in.tif", picture, photometric="rgb")
    stroke = Stroke(((215 / 420, 120 / 300), (245 / 420, 120 / 300)), 0.02, "#2040e0")
    recipe = Recipe((Step("recolor", (stroke,)),), Development(straighten=5.0, crop=(0.3, 0.0, 1.0, 1.0)))
    (tmp_path / "edit.json").write_text(recipe.to_json())
    whole, tiled = by_both(monkeypatch, tmp_path / "in.tif", "apply", "--preset", str(tmp_path / "edit.json"))
    assert np.abs(whole.astype(int) - tiled).max() <= 1
    assert whole.shape[:2] == recipe.develop.frame(SIZE).size
    blue = whole[..., 2].astype(int) > whole[..., 0] + 40
    assert blue.sum() == pytest.approx(40 * 60, rel=0.1)


def test_the_file_keeps_its_depth_and_its_exif_tells_its_size(tmp_path: Path, tiled: bool) -> None:
    exif = Image.Exif()
    exif[271] = "Maker"
    exif.get_ifd(34665).update({40962: 30, 40963: 20, 37396: (15, 10)})  # size, and the place of the subject
    Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(tmp_path / "in.jpg", exif=exif)
    assert main(["develop", str(tmp_path / "in.jpg"), str(tmp_path / "out.jpg"), "--crop", "0,0,50%,10"]) == 0
    with Image.open(tmp_path / "out.jpg") as after:
        assert after.size == (15, 10)
        assert after.getexif()[271] == "Maker"
        assert dict(after.getexif().get_ifd(34665)) == {40962: 15, 40963: 10}


BAD_OPTIONS = [
    (["--crop", "1,2"], "--crop must be column and row of the upper left corner, width and height, X,Y,W,H, in"),
    (["--crop", "0.1,0,1,0.9"], "or in %, such as 10%,0%,80%,100%, got '0.1,0,1,0.9'; correct it"),
    (["--crop", "0,0,9999,10"], "--crop must lie within the photograph, which is"),
    (["--exposure", "9"], "--exposure"),
    (
        ["--aspect", "3/2"],
        "--aspect must be a width and a height from 0.01 to 100000, such as 3:2, got '3/2'; correct it",
    ),
    (["--straighten", "45", "--crop", "0,0,2,2"], "crop must have its middle within the photograph turned"),
    (["--workers", "2"], "--workers takes zarr arrays"),
]


def test_bad_options(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, sentence in BAD_OPTIONS:
        assert main(["develop", str(photo), str(photo.with_name("out.png")), *arguments]) == 2
        assert sentence in capsys.readouterr().err
        assert not photo.with_name("out.png").exists()


def test_notes(tmp_path: Path, tiled: bool, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = tmp_path / "in.png", tmp_path / "out.png"
    source.write_bytes(imagecodecs.png_encode(np.full((20, 30), 90, np.uint8)))
    assert main(["develop", str(source), str(target), "--warmth", "0.5"]) == 0
    assert "in.png is grey: white balance changes nothing" in capsys.readouterr().err
    assert (imagecodecs.png_decode(target.read_bytes()) == 90).all()
    for options, is_idle in (([], True), (["--aspect", "3:2"], True), (["--aspect", "1:1"], False)):
        assert main(["develop", str(source), str(target), *options]) == 0
        assert ("no option changes anything" in capsys.readouterr().err) == is_idle


def test_steps_outside_the_crop_are_named(photo: Path, tiled: bool, capsys: pytest.CaptureFixture[str]) -> None:
    away = Step("recolor", (Stroke(((0.2, 0.2),), 0.05, "#2040e0"),))
    region = Step("detail", (Stroke(((0.2, 0.2),), 0.05, "in"),), alpha=(1.0, 1.0), inside=(3.0, 1.0))
    edit, out = photo.with_name("edit.json"), photo.with_name("out.png")
    crop = Development(crop=(0.6, 0.6, 1.0, 1.0))
    edit.write_text(Recipe((Step("tone"), away, region), crop).to_json())
    assert main(["apply", str(photo), str(out), "--preset", str(edit)]) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if "crop" in line]
    assert notes == [
        "nlfilter-torch: note: recolor, step 2, has no strokes within the crop 0.6,0.6,1,1: it changes nothing",
        "nlfilter-torch: note: detail, step 3, has no strokes within the crop 0.6,0.6,1,1: its region is left out",
    ]
    alone = photo.with_name("alone.png")
    edit.write_text(Recipe((Step("tone"),), crop).to_json())
    assert main(["apply", str(photo), str(alone), "--preset", str(edit)]) == 0
    assert imagecodecs.png_decode(out.read_bytes()).tolist() == imagecodecs.png_decode(alone.read_bytes()).tolist()


def test_strokes_of_which_a_crop_leaves_pixels_without_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, edit = written(tmp_path / "in.tif", "nodata"), tmp_path / "edit.json"
    away = Step("recolor", (Stroke(((150 / 420, 0.4), (300 / 420, 0.4)), 0.02, "#2040e0"),))
    crop = Development(crop=(0.0, 0.0, 0.5, 1.0))
    edit.write_text(Recipe((away,), crop).to_json())
    whole, tiled = by_both(monkeypatch, source, "apply", "--preset", str(edit))
    note = "recolor, step 1, has no strokes within the crop 0,0,0.5,1: it changes nothing"
    assert capsys.readouterr().err.count(note) == 2
    for picture in (whole, tiled):
        assert np.array_equal(picture, tifffile.imread(source)[:, :210])


def test_regions_and_films_are_not_developed(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit = photo.with_name("edit.json")
    edit.write_text(Recipe((), Development(exposure=1.0)).to_json())
    out = str(photo.with_name("out.png"))
    assert main(["apply", str(photo), out, "--preset", str(edit), "--mask", str(photo)]) == 2
    assert "--mask must come with edits that do not develop the photograph, got" in capsys.readouterr().err
    assert main(["frames", str(photo.parent), str(photo.with_name("f")), "--preset", str(edit)]) == 2
    assert "--preset must not develop the photographs of a film" in capsys.readouterr().err
    assert main(["detail", str(photo), out, "--preset", str(edit)]) == 2
    assert "without develop or strokes, switched on and at full opacity, got" in capsys.readouterr().err
