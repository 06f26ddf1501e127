"""Recipes of any edits that are applied to one photograph, in memory and in tiles."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.jobs import RecipeJob
from nlfilter_torch.photo.cli.options import PhotographOptions
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.picture.photographs import read_photograph
from tests.problems import colour
from tests.recipes import COLORIZE

SIZE = (64, 96)
SEPIA = (0.393, 0.769, 0.189, 0.349, 0.686, 0.168, 0.272, 0.534, 0.131)
GREYS = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # a matrix that leaves colours as they are


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
    edited, before = loaded(target), loaded(source)
    assert edited.max() > 0.9 * before.max() > 2
    assert edited.min() >= before.min()


def test_what_is_known_before_the_photograph_is_read() -> None:
    detail, tone = Recipe((Step("detail", alpha=(2.0, 1.0)),)), Recipe((Step("tone", contrast=1.5),))
    single, both = (
        RecipeJob("", "", PhotographOptions(), False, recipes, masks)
        for recipes, masks in (([detail], []), ([detail, tone], [Path(), Path()]))
    )
    assert single.bytes_per_pixel == detail.bytes_per_pixel
    assert both.bytes_per_pixel > max(detail.bytes_per_pixel, tone.bytes_per_pixel)
    assert not both.coloured
    assert RecipeJob("", "", PhotographOptions(), False, [tone, Recipe((COLORIZE,))]).coloured


def test_masks_have_the_size_of_the_photograph(tmp_path: Path, tiled: bool, capsys: pytest.CaptureFixture[str]) -> None:
    source, mask = saved(tmp_path / "in.png", cat()), saved(tmp_path / "mask.png", np.ones((SIZE[0], SIZE[1] - 1)))
    edit = recipe(tmp_path / "edit.json", Step("tone", contrast=1.5))
    arguments = ("apply", str(source), str(tmp_path / "out.png"), "--preset", str(edit), "--mask", str(mask))
    assert main(list(arguments)) == 2
    assert f"{mask} must have the size of {source}, 96x64, got 95x64; resize it" in capsys.readouterr().err
    assert not (tmp_path / "out.png").exists()


def test_notes_of_all_recipes_are_printed_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, white = saved(tmp_path / "in.png", cat().mean(2)), saved(tmp_path / "mask.png", np.ones(SIZE))
    sepia = Recipe((Step("look", matrix=SEPIA),))
    job = RecipeJob(str(source), str(tmp_path / "out.png"), PhotographOptions(), False, [sepia, sepia], [white, white])
    job.edited(read_photograph(source))
    assert capsys.readouterr().err.count("is grey and stays grey") == 1
