"""What commands print about scribbles, the pictures that ``--show`` writes, and notes on edits without effect."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.showing import hatched
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.selections.stray import stray_parts
from tests.problems import box, paint


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """A red disc on grass-green ground with some texture, 96x64."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    disc = ((x - 30).square() + (y - 32).square() < 18**2).float()
    noise = 0.03 * torch.randn(3, 64, 96, generator=torch.Generator().manual_seed(0))
    red, green = (torch.tensor(c).view(3, 1, 1) for c in ((0.8, 0.1, 0.1), (0.2, 0.6, 0.2)))
    write_photograph(Photograph((torch.lerp(green, red, disc) + noise).clamp(0, 1)[None]), tmp_path / "in.png")
    return tmp_path / "in.png"


def rgb(path: Path) -> np.ndarray:
    with Image.open(path) as opened:
        return np.asarray(opened.convert("RGB")).astype(int)


@pytest.mark.parametrize(
    "options",
    [["defocus", "--region", "20,20,20,20", "--background"], ["recolor", "--region", "20,20,20,20:blue", "--keep"]],
)
def test_background_is_not_shown_under_the_scribbles(options: list[str], photo: Path, tmp_path: Path) -> None:
    verb, *rest = options
    out, shown = tmp_path / "out.png", [tmp_path / "covered.png", tmp_path / "beside.png"]
    for background, path in zip(("35,24,10,5", "40,24,5,5"), shown, strict=True):
        assert main([verb, str(photo), str(out), *rest, background, "--show", str(path)]) == 0
    assert (rgb(shown[0]) == rgb(shown[1])).all()


@pytest.mark.parametrize("memory", [(), ("--memory", "0.01")])
def test_colours_notes_and_a_picture(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], memory: tuple[str, ...]
) -> None:
    out, shown = tmp_path / "out.png", tmp_path / "shown.png"
    region = ("--region", "24,28,10,8:blue")
    assert main(["recolor", str(photo), str(out), *region, "--keep", "80,4,8,8", "--show", str(shown), *memory]) == 0
    said = capsys.readouterr()
    assert "--region 24,28,10,8: 80 pixels, median colour #c" in said.out
    assert "--keep 80,4,8,8: 64 pixels" in said.out
    assert "note" not in said.err
    before, after = rgb(photo), rgb(shown)
    assert after.shape == before.shape
    assert after[32, 29, 2] > 150  # the scribble, in its colour
    dimmed = np.abs(after - before).sum(2)
    disc, ground = dimmed[20:24, 28:32].mean(), dimmed[50:60, 60:75].mean()
    assert disc < 15 < 100 < ground
    assert out.exists()


def test_a_scribble_over_unlike_things(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recolor", str(photo), str(tmp_path / "out.png"), "--region", "40,28,18,8:blue"]) == 0
    said = capsys.readouterr().err
    assert "note: --region 40,28,18,8 covers very different colours" in said
    assert "mark each part separately, with a smaller --region on each, and check them with --show FILE" in said


def test_many_scribbles_over_unlike_things_have_one_note(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    regions = [f"--region={x},28,18,8:blue" for x in (40, 24, 41)]
    assert main(["recolor", str(photo), str(tmp_path / "out.png"), *regions]) == 0
    said = capsys.readouterr().err
    assert said.count("note: --region 4") == said.count("very different colours") == 1
    assert "and 1 more of 3, cover very different colours: " in said


def test_stray_parts_are_hatched() -> None:
    thing = box(10, 10, 40, 40, (60, 90))
    image = paint(0.7, 0.15, 0.1, thing) + paint(0.2, 0.5, 0.25, 1 - thing)
    stray = stray_parts(InMemory(image), box(30, 20, 5, 37, (60, 90)))
    assert stray[..., 30:35, 50:57].all()
    assert stray.sum() <= 5 * 10  # and no more than three columns beside it
    dark = (hatched(image, stray) == 0).all(1)
    assert dark.sum() == pytest.approx(stray.sum() / 2, abs=2)
    assert not (dark & (stray[:, 0] == 0)).any()


@pytest.mark.parametrize(
    ("verb", "scribbles"),
    [
        ("detail", ("--region", "24,28,10,8", "--alpha", "3,2,1")),
        ("defocus", ("--region", "24,28,10,8")),
        ("mask", ("--region", "24,28,10,8", "--background", "80,4,8,8")),
    ],
)
def test_every_edit_shows_its_region(photo: Path, tmp_path: Path, verb: str, scribbles: tuple[str, ...]) -> None:
    shown = tmp_path / "shown.png"
    assert main([verb, str(photo), str(tmp_path / "out.png"), *scribbles, "--show", str(shown)]) == 0
    dimmed = np.abs(rgb(shown) - rgb(photo)).sum(2)
    assert dimmed[50:60, 60:75].mean() > 2 * dimmed[20:24, 28:32].mean() + 20


def test_colorize_shows_scribbles_alone(photo: Path, tmp_path: Path) -> None:
    shown = tmp_path / "shown.png"
    write_photograph(Photograph(read_photograph(photo).pixels.mean(1, keepdim=True)), tmp_path / "grey.png")
    scribbles = ("--region", "24,28,10,8:red", "--region", "80,4,8,8:#14a028")
    assert (
        main(["colorize", str(tmp_path / "grey.png"), str(tmp_path / "o.png"), *scribbles, "--show", str(shown)]) == 0
    )
    picture = rgb(shown)
    assert picture[32, 29, 0] > 200
    assert (picture[50, 60] == picture[50, 60, 0]).all()


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
    green = 255 * np.array([0.1, 0.8, 0.3])
    assert np.abs(rgb(shown)[-1, -1] - green).max() < 0.3 * 255


def test_nothing_to_show(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["detail", str(photo), str(tmp_path / "out.png"), "--show", str(tmp_path / "shown.png")]) == 2
    assert "--show needs scribbles" in capsys.readouterr().err
    assert not (tmp_path / "shown.png").exists()


def test_notes_of_a_folder_and_of_frames(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("a.png", "b.png"):
        shutil.copy(photo, folder / name)
    idle = tmp_path / "idle.json"
    idle.write_text(json.dumps({"version": 1, "steps": []}))
    assert main(["batch", str(folder), str(tmp_path / "out"), "--preset", str(idle)]) == 0
    printed = capsys.readouterr()
    assert "holds no step that changes anything" in printed.out + printed.err
    assert main(["frames", str(folder), str(tmp_path / "frames"), "--alpha", "1,1,1,1"]) == 0
    assert "holds no step that changes anything" in capsys.readouterr().err
