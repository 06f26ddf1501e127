"""The command line with masks, looks, HDR files and folders in combination, and what it says about them."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_recipe
from tests.commands import refused
from tests.problems import colour

SIZE = (64, 96)
IN_TILES = ("--memory", "0.05")
SEPIA = (0.393, 0.769, 0.189, 0.349, 0.686, 0.168, 0.272, 0.534, 0.131)
GREYS = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # a matrix that leaves colours as they are


@pytest.fixture(params=[False, True], ids=["in memory", "in tiles"])
def tiled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    if request.param:
        monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_if_it_fits", lambda *_: None)
    return bool(request.param)


def cat() -> np.ndarray:
    """A photograph (H, W, 3) in [0, 1]."""
    return colour("chelsea", *SIZE)[0].permute(1, 2, 0).numpy()


def saved(path: Path, values: np.ndarray) -> Path:
    """Write 8 bits, or floats to a TIFF."""
    if path.suffix == ".tif":
        tifffile.imwrite(path, values.astype(np.float32), photometric="rgb" if values.ndim == 3 else "minisblack")
    else:
        Image.fromarray((values * 255).round().astype(np.uint8)).save(path)
    return path


def recipe(path: Path, *steps: Step) -> Path:
    path.write_text(Recipe(steps).to_json())
    return path


def loaded(path: Path) -> np.ndarray:
    if path.suffix == ".tif":
        return tifffile.imread(path).astype(float)
    with Image.open(path) as opened:
        return np.asarray(opened).astype(float) / 255


def test_faint_parts_of_a_mask_are_not_selected(tmp_path: Path, tiled: bool) -> None:
    source, target = saved(tmp_path / "in.png", cat()), tmp_path / "out.png"
    mask = np.full(SIZE, 0.02)  # not exactly black
    mask[20:40, 30:60] = 1
    faint, hard = saved(tmp_path / "faint.png", mask), saved(tmp_path / "hard.png", mask.round())
    assert main(["defocus", str(source), str(target), "--mask", str(hard)]) == 0
    wanted = loaded(target)
    assert np.abs(wanted - cat()).mean() > 0.002
    assert main(["defocus", str(source), str(target), "--mask", str(faint)]) == 0
    np.testing.assert_array_equal(loaded(target), wanted)


def test_transparent_and_excessive_parts_of_a_mask_of_an_edit(tmp_path: Path, tiled: bool) -> None:
    source, target = saved(tmp_path / "in.png", cat()), tmp_path / "out.png"
    edit = recipe(tmp_path / "edit.json", Step("tone", contrast=1.5))
    opaque = np.zeros((*SIZE, 2), np.uint8)
    opaque[..., 0], opaque[:, :48, 1] = 255, 255  # white everywhere, but transparent on the right
    Image.fromarray(opaque, "LA").save(tmp_path / "mask.png")
    floats = saved(tmp_path / "mask.tif", np.where(np.arange(SIZE[1]) < 48, 3.0, -1.0) * np.ones(SIZE))
    for mask in (tmp_path / "mask.png", floats):
        assert main(["apply", str(source), str(target), "--preset", str(edit), "--mask", str(mask)]) == 0
        changed = np.abs(loaded(target) - loaded(source))
        assert changed[:, 48:].max() == 0
        assert 0.01 < changed[:, :48].mean() < 0.2


def test_colours_of_a_look_are_left_out_of_a_grey_photograph_with_a_note(
    tmp_path: Path, tiled: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = saved(tmp_path / "in.png", cat().mean(2)), tmp_path / "out.png"
    sepia = recipe(tmp_path / "sepia.json", Step("look", matrix=SEPIA))
    assert main(["apply", str(source), str(target), "--preset", str(sepia)]) == 0
    assert "in.png is grey and stays grey" in capsys.readouterr().err
    bright = recipe(tmp_path / "bright.json", Step("look", matrix=tuple(1.1 * value for value in GREYS)))
    assert main(["apply", str(source), str(target), "--preset", str(bright)]) == 0
    assert "grey" not in capsys.readouterr().err
    assert main(["apply", str(saved(tmp_path / "rgb.png", cat())), str(target), "--preset", str(sepia)]) == 0
    assert "grey" not in capsys.readouterr().err


def test_steps_keep_values_above_white(tmp_path: Path, tiled: bool) -> None:
    source, target = saved(tmp_path / "in.tif", 4 * cat() - 0.5), tmp_path / "out.tif"
    edit = recipe(tmp_path / "edit.json", Step("tone", contrast=1.2), Step("tone", contrast=1 / 1.2))
    assert main(["apply", str(source), str(target), "--preset", str(edit)]) == 0
    found, before = loaded(target), loaded(source)
    assert found.max() > 0.9 * before.max() > 2
    assert found.min() >= before.min()


def test_steps_of_integers_are_limited_to_black_and_white() -> None:
    strong = Step("look", matrix=tuple(4 * value for value in GREYS))
    weak = Step("look", matrix=tuple(0.5 * value for value in GREYS))
    image = torch.rand(2, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    image[1] *= 3
    found = apply_recipe(Recipe((strong, weak)), image)
    assert found[0].max() == 0.5
    assert found[1].max() == pytest.approx(0.5 * float(image[1].max()))


@pytest.mark.filterwarnings("always::UserWarning")
def test_the_scale_of_floats_is_noted(tmp_path: Path, tiled: bool, capsys: pytest.CaptureFixture[str]) -> None:
    source = saved(tmp_path / "in.tif", 255 * cat())
    assert main(["tone", str(source), str(tmp_path / "out.tif"), "--contrast", "1.2"]) == 0
    noted = capsys.readouterr().err
    assert noted.count("must be in or near [0, 1]") == 1
    assert "divide by the value of white" in noted


def test_damaged_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    png, target = saved(tmp_path / "in.png", cat()), tmp_path / "out.png"
    data = bytearray(png.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 20] = bytes(20)
    png.write_bytes(data)
    assert "in.png is damaged or cut short" in refused(capsys, "tone", png, target)
    tif = tmp_path / "in.tif"
    tifffile.imwrite(tif, (cat() * 255).astype(np.uint8), compression="jpeg", photometric="rgb")
    with tifffile.TiffFile(tif) as file:
        end = file.pages.first.dataoffsets[-1] + file.pages.first.databytecounts[-1]
    assert tif.stat().st_size == end  # the pixels come last
    tif.write_bytes(tif.read_bytes()[:-30])
    assert "in.tif is damaged or cut short (it ends too early)" in refused(capsys, "tone", tif, target)
    assert not target.exists()


@pytest.mark.usefixtures("tiled")
def test_transparency_must_be_finite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = np.concatenate([cat(), np.ones((*SIZE, 1))], axis=2)
    values[5, 7, 3] = np.nan
    source = tmp_path / "in.tif"
    tifffile.imwrite(source, values.astype(np.float32), photometric="rgb", extrasamples=["unassalpha"])
    assert main(["tone", str(source), str(tmp_path / "out.tif"), "--contrast", "1.2"]) == 2
    assert "NaN" in capsys.readouterr().err
    assert not (tmp_path / "out.tif").exists()


def test_strokes_that_cover_the_photograph_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = saved(tmp_path / "in.png", cat())
    Image.fromarray((cat() * 255).astype(np.uint8)).convert("RGBA").save(tmp_path / "strokes.png")
    assert "strokes.png has no transparency, so every pixel would count as a scribble" in refused(
        capsys, "recolor", source, tmp_path / "out.png", "--strokes", tmp_path / "strokes.png"
    )


@pytest.mark.parametrize("shape", [(1001, 501), (3, 200_000), (200_000, 1)])
def test_scribbles_in_the_last_row_are_shown(tmp_path: Path, shape: tuple[int, int]) -> None:
    picture = np.zeros((*shape, 3), np.uint8)
    picture[..., 0] = np.arange(shape[1]) % 200
    Image.fromarray(picture).save(tmp_path / "in.png")
    place = f"{shape[1] - 1},{shape[0] - 1},1,1"
    shown = tmp_path / "shown.png"
    assert (
        main(["mask", str(tmp_path / "in.png"), str(tmp_path / "out.png"), "--region", place, "--show", str(shown)])
        == 0
    )
    green = np.array([0.1, 0.8, 0.3])
    assert np.abs(loaded(shown)[-1, -1] - green).max() < 0.3


def test_denoise_recommends_only_more_strength(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rough = 0.5 + np.random.default_rng(0).normal(0, 0.3 / 255, (*SIZE, 3))
    source = saved(tmp_path / "in.tif", rough)
    for strength, recommended in ((1, True), (2, False), (0, False)):
        assert main(["denoise", str(source), str(tmp_path / "out.tif"), "--strength", str(strength)]) == 0
        printed = capsys.readouterr().out
        assert ("--strength 2 removes more" in printed) == recommended


def test_notes_of_a_folder_and_of_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("a.png", "b.png"):
        saved(folder / name, cat())
    idle = tmp_path / "idle.json"
    idle.write_text(json.dumps({"version": 1, "steps": []}))
    assert main(["batch", str(folder), str(tmp_path / "out"), "--preset", str(idle)]) == 0
    printed = capsys.readouterr()
    assert "holds no step that changes anything" in printed.out + printed.err
    assert main(["frames", str(folder), str(tmp_path / "frames"), "--alpha", "1,1,1,1"]) == 0
    assert "holds no step that changes anything" in capsys.readouterr().err
