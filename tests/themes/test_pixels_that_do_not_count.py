"""Transparent pixels and those without data: what counts is edited as if they were not there, and they come back."""

from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import skimage.data
import tifffile
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.operator.hidden import fill_nearby
from nlfilter_torch.photo import Recipe, Step, apply_recipe, stream
from nlfilter_torch.photo.cli import editing, main
from nlfilter_torch.photo.declared.rows import lacks_data
from nlfilter_torch.photo.edits.noise import noise_of, profile_of
from nlfilter_torch.photo.picture.in_memory import InMemory, in_blocks
from nlfilter_torch.photo.picture.measuring import mean
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph
from nlfilter_torch.photo.picture.pixels import whole_image

Levels = NDArray[np.uint8]
SIZE = (96, 110)
NAMES = ("black", "white", "green", "noise")
EDITS = {
    "sharpen": ["--amount", "8"],
    "detail": ["--alpha", "3,3,4,1.05", "--landmarks", "60"],
    "tone": ["--contrast", "1.4", "--landmarks", "60"],
    "abstract": ["--landmarks", "60"],
    "denoise": [],
    "recolor": ["--region", "50,30,20,20:red"],
    "defocus": ["--region", "50,30,20,20"],
}


def opacity() -> Levels:
    """A disc with a soft edge."""
    rows, columns = np.ogrid[: SIZE[0], : SIZE[1]]
    distance = np.hypot(rows - 45, columns - 55)
    return np.rint((40 - distance).clip(0, 4) / 4 * 255).astype(np.uint8)


def with_hidden(name: str) -> Levels:
    """A photograph (H, W, 4) with hidden pixels of a colour."""
    alpha = opacity()
    picture = np.dstack([skimage.data.chelsea()[60 : 60 + SIZE[0], 90 : 90 + SIZE[1]], alpha])
    colours: dict[str, Levels | tuple[int, int, int]] = {"black": (0, 0, 0), "white": (255,) * 3, "green": (0, 255, 0)}
    noise = np.random.default_rng(0).integers(0, 256, ((alpha == 0).sum(), 3), np.uint8)
    picture[alpha == 0, :3] = colours.get(name, noise)
    return picture


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("edit", EDITS)
def test_hidden_colours_change_no_visible_pixel(
    edit: str, tiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if tiled:
        monkeypatch.setattr(editing, "read_if_it_fits", lambda *_: None)
    results = []
    for name in NAMES:
        before, source, target = with_hidden(name), tmp_path / f"{name}.png", tmp_path / f"{name}-out.png"
        source.write_bytes(imagecodecs.png_encode(before))
        assert main([edit, str(source), str(target), *EDITS[edit]]) == 0
        after = imagecodecs.png_decode(target.read_bytes())
        hidden = before[..., 3] == 0
        assert np.array_equal(after[..., 3], before[..., 3])
        assert np.array_equal(after[hidden], before[hidden])
        results.append(after[~hidden])
    assert all(np.array_equal(result, results[0]) for result in results)
    assert edit == "denoise" or not np.array_equal(results[0][:, :3], before[~hidden][:, :3])


def test_masks_do_not_see_hidden_colours(tmp_path: Path) -> None:
    masks = []
    for name in NAMES:
        source, target = tmp_path / f"{name}.png", tmp_path / f"{name}-mask.png"
        source.write_bytes(imagecodecs.png_encode(with_hidden(name)))
        assert main(["mask", str(source), str(target), "--region", "50,30,20,20"]) == 0
        masks.append(imagecodecs.png_decode(target.read_bytes())[opacity() > 0])
    assert all(np.array_equal(mask, masks[0]) for mask in masks)


@pytest.mark.parametrize("tile_rows", [16, None])
def test_streams_do_not_see_hidden_colours(tile_rows: int | None) -> None:
    results = []
    for name in NAMES:
        before = with_hidden(name)
        after = np.empty_like(before)
        stream(Step("detail", alpha=(3.0, 1.0), landmarks=30), before, after, tile_rows=tile_rows)
        assert np.array_equal(after[opacity() == 0], before[opacity() == 0])
        results.append(after[opacity() > 0])
    assert all(np.array_equal(result, results[0]) for result in results)


def test_a_picture_without_visible_pixels_comes_back(tmp_path: Path) -> None:
    before = np.zeros((20, 30, 4), np.uint8)
    before[..., :3] = np.random.default_rng(0).integers(0, 256, (20, 30, 3))
    (tmp_path / "in.png").write_bytes(imagecodecs.png_encode(before))
    for edit in ("detail", "denoise", "sharpen"):
        assert main([edit, str(tmp_path / "in.png"), str(tmp_path / "out.png")]) == 0
        assert np.array_equal(imagecodecs.png_decode((tmp_path / "out.png").read_bytes()), before)
        after = np.empty_like(before)
        stream(Step(edit), before, after)
        assert np.array_equal(after, before)


def write_tiff(path: Path, picture: NDArray[np.generic], nodata: str) -> None:
    tags = [(42113, "s", 0, nodata, True)]
    photometric = "rgb" if picture.ndim == 3 else "minisblack"
    tifffile.imwrite(path, picture, extratags=tags, metadata=None, photometric=photometric)


def ground(dtype: str = "float32") -> NDArray[np.generic]:
    """A grey picture (96, 110) from 0 to 1 that never is 0."""
    picture = (skimage.data.chelsea()[60 : 60 + SIZE[0], 90 : 90 + SIZE[1], 1] + 1.0) / 256
    return picture.astype(dtype) if dtype[0] == "f" else np.rint(picture * 250).astype(dtype)


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize(
    ("nodata", "dtype"),
    [("-9999", "float32"), ("nan", "float32"), ("-1.7976931348623157e+308", "float64"), ("0", "uint8")],
)
def test_values_without_data_come_back(
    nodata: str, dtype: str, tiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if tiled:
        monkeypatch.setattr(editing, "read_if_it_fits", lambda *_: None)
    picture, source, target = ground(dtype), tmp_path / "in.tif", tmp_path / "out.tif"
    picture[:20] = np.asarray(float(nodata)).astype(dtype)
    write_tiff(source, picture, nodata)
    recipe = tmp_path / "two.json"
    recipe.write_text(
        '{"version": 1, "steps": [{"edit": "tone", "contrast": 1.4, "landmarks": 40}, {"edit": "sharpen"}]}'
    )
    for arguments in (
        ["detail", "--alpha", "3,1", "--landmarks", "40"],
        ["denoise"],
        ["apply", "--preset", str(recipe)],
    ):
        assert main([arguments[0], str(source), str(target), *arguments[1:]]) == 0
        with tifffile.TiffFile(target) as file:
            after, tag = file.asarray(), file.pages.first.tags[42113].value
        assert tag == nodata
        assert after[:20].tobytes() == picture[:20].tobytes()
        assert not lacks_data(after[20:, :, None], float(nodata)).any()
        assert np.abs(after[20:].astype(float) - picture[20:]).max() < (1 if dtype[0] == "f" else 255)


def test_no_pixel_with_data_gets_the_value_of_those_without(tmp_path: Path) -> None:
    picture = np.full((12, 12), 7, np.uint8)
    picture[:3] = 0
    write_tiff(tmp_path / "in.tif", picture, "0")
    photograph = read_photograph(tmp_path / "in.tif")
    assert photograph.hidden is not None
    assert float(photograph.pixels.min()) == pytest.approx(7 / 255)
    write_photograph(photograph.with_pixels(photograph.pixels * 0), tmp_path / "out.tif")
    after = tifffile.imread(tmp_path / "out.tif")
    assert (after[:3] == 0).all()
    assert (after[3:] == 1).all()


def test_nan_without_a_tag_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = ground()
    picture[:2] = np.nan
    tifffile.imwrite(tmp_path / "in.tif", picture)
    assert main(["tone", str(tmp_path / "in.tif"), str(tmp_path / "out.tif")]) != 0
    assert "NaN" in capsys.readouterr().err


STEPS = (
    Step("detail", alpha=(3.0, 3.0, 1.05), landmarks=40),
    Step("tone", contrast=1.4, landmarks=40),
    Step("sharpen", amount=8.0),
    Step("abstract", landmarks=40),
)


def planes_of(picture: NDArray[np.generic]) -> Tensor:
    return torch.from_numpy(picture.astype(np.float32) / 255).permute(2, 0, 1)[None]


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.edit)
def test_rows_without_data_are_as_good_as_absent(step: Step, tmp_path: Path) -> None:
    picture = skimage.data.chelsea()[60:180, 90:190]
    padded = np.concatenate([np.full((20, 100, 3), 255, np.uint8), picture])
    alone = apply_recipe(Recipe((step,)), planes_of(picture))
    weights = torch.ones(1, 1, 140, 100)
    weights[:, :, :20] = 0
    for filled in (255, 0):
        padded[:20] = filled
        picture_with_alpha = np.dstack([padded, (255 * weights[0, 0]).byte().numpy()])
        edited = np.empty(picture_with_alpha.shape, np.float32)
        stream(step, picture_with_alpha, edited, statistics="full", tile_rows=32)
        difference = np.abs(edited[20:, :, :3] - alone[0].permute(1, 2, 0).numpy())
        assert difference.max() < (0.03 if step.edit == "sharpen" else 2e-4)  # its noise is that of other windows
        assert difference.mean() < 3e-3


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.edit)
def test_tiles_agree_with_memory(step: Step, soft: bool, tmp_path: Path) -> None:
    picture = with_hidden("noise")
    if soft:
        picture[..., 3] = np.minimum(picture[..., 3], np.arange(SIZE[1], dtype=np.uint8) * 2)
    (tmp_path / "in.png").write_bytes(imagecodecs.png_encode(picture))
    photograph = read_photograph(tmp_path / "in.png")
    whole = apply_recipe(Recipe((step,)), photograph.pixels, weights=photograph.weights)
    edited = np.empty(picture.shape, np.float32)
    stream(step, picture, edited, statistics="full", tile_rows=24)
    difference = np.abs(edited[..., :3] - whole[0].permute(1, 2, 0).numpy())[picture[..., 3] > 0]
    assert difference.max() < 1e-3
    assert difference.mean() < 2e-5


def test_pixels_count_in_proportion() -> None:
    picture = planes_of(skimage.data.chelsea()[60:124, 90:154])
    weights = torch.ones(1, 1, 64, 64)
    weights[..., 32:] = 0.25
    source = InMemory(picture, weights=weights)
    expected = (picture * weights).mean((2, 3)) / weights.mean()
    torch.testing.assert_close(mean(source, whole_image)[..., 0, 0], expected)
    blocks = in_blocks(source, 16, 1)
    assert blocks.weights is not None
    torch.testing.assert_close(blocks.weights[0, 0, 0], torch.tensor([1.0, 1.0, 0.25, 0.25]))
    assert InMemory(picture, weights=torch.ones(1, 1, 64, 64)).weights is None
    assert InMemory(picture, weights=torch.zeros(1, 1, 64, 64)).weights is None
    slight = torch.ones(1, 1, 64, 64)
    slight[..., 32:] = 1e-4
    hidden = torch.where(slight < 1, 0.0, 1.0)
    results = [apply_recipe(Recipe((STEPS[1],)), picture, weights=plane) for plane in (slight, hidden)]
    assert float((results[0] - results[1])[..., :28].abs().mean()) < 0.005


def test_scribbles_on_hidden_pixels_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in.png").write_bytes(imagecodecs.png_encode(with_hidden("green")))
    assert main(["recolor", str(tmp_path / "in.png"), str(tmp_path / "out.png"), "--region", "0,0,5,5:red"]) != 0
    assert "not hidden" in capsys.readouterr().err


def test_noise_is_that_of_what_is_visible() -> None:
    draw = np.random.default_rng(0)
    flat = torch.from_numpy(0.5 + 12 / 255 * draw.standard_normal((1, 3, 160, 160))).float()
    weights = torch.zeros(1, 1, 160, 160)
    weights[..., 50:110, 40:120] = 1
    source = InMemory(fill_nearby(flat, weights > 0), weights=weights)
    assert float(noise_of(source).level) * 255 == pytest.approx(12, abs=1)
    assert float(profile_of(source).level) * 255 == pytest.approx(12, abs=2)
