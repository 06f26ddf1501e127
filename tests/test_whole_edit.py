"""Recipes on pictures read by rows: the result in memory, and errors that name their cause."""

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from nlfilter_torch.nn.denoiser.noise import estimate_noise
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.applying import apply_recipe
from nlfilter_torch.photo.edits.noise import noise_of
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.painting import cover, mask_of, paint
from nlfilter_torch.photo.selections.pyramid import pyramid_levels
from nlfilter_torch.photo.tiled import recipe as whole_edit
from nlfilter_torch.photo.tiled import stream_detail
from nlfilter_torch.photo.tiled.pictures import Picture
from nlfilter_torch.photo.tiled.source import Tiled
from nlfilter_torch.photo.tiled.tiles import Passes
from tests.problems import cat, difference
from tests.test_streaming import cat as photograph

LINE = ((0.25, 0.25), (0.5, 0.3))
IN, OUT = Stroke(LINE, 0.06, "in"), Stroke(((0.8, 0.8),), 0.1, "out")
BLUE, KEEP = Stroke(LINE, 0.06, "#2040e0"), Stroke(((0.8, 0.8),), 0.1, "keep")
FAR = Stroke(((1.8, 1.8),), 0.05, "out")  # covers no pixel
ALPHA, INSIDE = (0.5, 1.0, 1.0, 1.0), (3.0, 3.0, 2.0, 1.0)
DETAIL = Step("detail", (IN, OUT), alpha=ALPHA, inside=INSIDE, reach=0.5, landmarks=40)
RECOLOR = Step("recolor", (BLUE, KEEP), reach=0.5, tolerance=20.0)
COLORIZE = Step("colorize", (BLUE,), strength=0.5)


def rows_of(image: torch.Tensor) -> NDArray[Any]:
    return np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())


def from_rows(rows: NDArray[Any]) -> torch.Tensor:
    return torch.from_numpy(rows).permute(2, 0, 1)[None].clamp(0, 1)


def by_rows(recipe: Recipe, source: NDArray[Any], folder: Path, **options: Any) -> NDArray[Any]:
    passes = Passes("float32", "full", folder=folder, **options)
    return np.concatenate([rows for _, rows in whole_edit.edit_rows(passes, source, recipe.steps, "scan.tif")])


def test_denoising_by_a_sample_is_within_a_grey_level() -> None:
    noise = np.random.default_rng(0).normal(0, 0.06, (200, 260, 3))
    picture = (photograph(200, 260) + noise).clip(0, 1).astype(np.float32)
    step, options = Recipe((Step("denoise", landmarks=60),)), {"sample": 4096}
    rows = [rows for _, rows in whole_edit.edit_rows(Passes("float32", **options), picture, step.steps, "scan.tif")]
    assert difference(from_rows(np.concatenate(rows)), apply_recipe(step, from_rows(picture))) < 1  # grey level


@pytest.mark.parametrize("rows", [slice(0, 1), slice(3, 11), slice(7, 48), slice(0, 48)])
def test_strokes_cover_the_same_by_rows(rows: slice) -> None:
    strokes, size = (BLUE, replace(BLUE, points=((-0.1, 0.9), (1.2, 0.1)), paint="#ff0000")), (48, 64)
    assert torch.equal(cover(BLUE, size, rows), cover(BLUE, size)[rows])
    assert torch.equal(mask_of(strokes, size, rows), mask_of(strokes, size)[..., rows, :])
    for some, whole in zip(paint(strokes, size, rows), paint(strokes, size), strict=True):
        assert torch.equal(some, whole[..., rows, :])


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe(),
        Recipe((Step("detail", alpha=(3.0, 1.0)),)),
        Recipe((DETAIL,)),
        Recipe((DETAIL.changed(strokes=(IN, FAR)),)),
        Recipe((COLORIZE,)),
        Recipe((RECOLOR,)),
        Recipe((RECOLOR.changed(strokes=(BLUE, replace(FAR, paint="keep"))),)),
        Recipe((Step("denoise", landmarks=60),)),
        Recipe((Step("denoise", noise_level=8.0, landmarks=60),)),
        Recipe((Step("sharpen", landmarks=60),)),
        Recipe((Step("tone", contrast=1.3, clarity=1.5, landmarks=60),)),
        Recipe((Step("abstract", landmarks=60),)),
        Recipe((Step("abstract", landmarks=60, edges=0.7, tones=6),)),
        Recipe((Step("defocus", (IN,), landmarks=60, radius=3.0),)),
        Recipe((DETAIL, COLORIZE, RECOLOR)),
        Recipe((RECOLOR, Step("detail", alpha=(1.5, 1.0)))),
    ],
)
def test_an_edit_by_rows_is_the_one_in_memory(recipe: Recipe, tmp_path: Path) -> None:
    image = cat(5)
    edited = by_rows(recipe, rows_of(image), tmp_path, tile_rows=17)
    # Differences of 1e-5 before recolouring may change its landmarks, so its input is that of the steps by rows.
    before, last = recipe.steps[:-1], recipe.steps[-1:]
    given = from_rows(by_rows(Recipe(before), rows_of(image), tmp_path, tile_rows=17)) if before else image
    wanted = rows_of(apply_recipe(Recipe(last), given))
    # In memory the balancing stops at 1e-5.
    assert np.abs(edited - wanted).max() < (1e-4 if RECOLOR in last else 2e-5)
    assert not list(tmp_path.iterdir())


def test_a_mask_by_a_pyramid_is_the_same_by_rows(tmp_path: Path) -> None:
    image = cat()[..., :97, :149]  # large enough to be halved once, and no multiple of two
    assert pyramid_levels(97) == 1
    recipe = Recipe((Step("defocus", (IN,), landmarks=60, radius=3.0),))
    edited = by_rows(recipe, rows_of(image), tmp_path, tile_rows=17)
    assert np.abs(edited - rows_of(apply_recipe(recipe, image))).max() < 2e-5


def test_tiles_and_their_margins_fit_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image, recipe = cat(), Recipe((Step("abstract", landmarks=20, edges=1.0),))
    monkeypatch.setattr("nlfilter_torch.photo.tiled.source.FINISH_FLOATS", 4000)  # 2.4 MB a row
    few = by_rows(recipe, rows_of(image), tmp_path, memory=60_000_000)  # and so two tiles or more
    assert np.abs(few - by_rows(recipe, rows_of(image), tmp_path)).max() < 1e-5
    monkeypatch.setattr("nlfilter_torch.photo.tiled.source.FINISH_FLOATS", 20_000)
    with pytest.raises(MemoryError, match=r"scan.tif needs at least \d+ MB of memory, but only 60 MB may be used"):
        by_rows(recipe, rows_of(image), tmp_path, memory=60_000_000)


def test_noise_is_estimated_by_rows_as_in_memory() -> None:
    image = cat()
    tiled = Tiled(Picture(rows_of(image)), Passes("float32"))
    assert torch.equal(noise_of(tiled).level, estimate_noise(image))


def test_grey_becomes_colour_and_transparency_stays(tmp_path: Path) -> None:
    grey = cat()[:, :1]
    source = np.concatenate([rows_of(grey), np.linspace(0, 1, 15000, dtype=np.float32).reshape(100, 150, 1)], axis=2)
    detail, colorize = Step("detail", alpha=(2.0, 1.0), landmarks=30), Step("colorize", (BLUE,))
    edited = by_rows(Recipe((detail, colorize)), source, tmp_path)
    # Differences of 1e-5 before colorizing may change its landmarks, so its input is that of the first step by rows.
    given = from_rows(by_rows(Recipe((detail,)), rows_of(grey), tmp_path))
    assert np.abs(edited[..., :3] - rows_of(apply_recipe(Recipe((colorize,)), given))).max() < 2e-5
    np.testing.assert_allclose(edited[..., 3], source[..., 1], atol=1e-7)


def test_the_command_line_goes_by_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.tiled.sampling.PILOT", 4000)
    monkeypatch.setattr("nlfilter_torch.photo.tiled.pictures.STATISTICS_PIXELS", 6000)
    photo, preset = tmp_path / "in.tif", tmp_path / "edit.json"
    write_photograph(Photograph(cat().repeat(1, 1, 2, 2), "uint16"), photo)  # more than tiles need
    preset.write_text(Recipe((DETAIL, RECOLOR)).to_json())
    names = [tmp_path / "whole.tif", tmp_path / "rows.tif"]
    for name, options in zip(names, ([], ["--memory", "0.044", "--full"]), strict=True):
        assert main(["apply", str(photo), str(name), "--preset", str(preset), *options]) == 0
    whole, rows = (read_photograph(name).pixels for name in names)
    # Rounding in the first step may change the k-means of the second: noise of 1e-7 changes single pixels by 3 levels.
    assert 0 < difference(whole, rows) < 8
    assert 255 * (whole - rows).square().mean().sqrt() < 0.5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["edit.json", "in.tif", "rows.tif", "whole.tif"]


def test_no_room_between_two_steps_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        """A file on a full disk."""

        def __enter__(self) -> "Full":
            return self

        def __exit__(self, *_: object) -> None: ...

        def write(self, _: bytes) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("nlfilter_torch.photo.tiled.tiles.TemporaryFile", lambda **_: Full())
    sentence = "No space left on device, for a temporary file of 1 MB"
    with pytest.raises(OSError, match=sentence) as raised:
        by_rows(Recipe((Step("detail", alpha=(2.0, 1.0), landmarks=30), RECOLOR)), rows_of(cat()), tmp_path)
    assert raised.value.filename == str(tmp_path)
    assert raised.value.errno == errno.ENOSPC


def test_negative_regions_come_with_regions_of_their_number() -> None:
    source = rows_of(cat())
    edited, two, three = np.empty_like(source), np.ones((100, 150, 2), np.float32), np.ones((100, 150, 3), np.float32)
    with pytest.raises(ValueError, match="negative must be given together with regions, got no regions"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), negative=two)
    with pytest.raises(ValueError, match="negative must have 1 channel or one for each of the 2 regions, got 3"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), two, negative=three)
    with pytest.raises(ValueError, match="negative must have the height and width of source, 100x150, got 99x150"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), two, negative=two[1:])
    with pytest.raises(ValueError, match="negative must hold a painted pixel, got none"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), two, negative=0 * two)
