"""Messages and pictures of scribbles on the command line: colours, notes, positions in per cent, and `--show`."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.scribbles import Rectangle
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph


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
    ("text", "wanted"),
    [
        ("25%,50%,10%,25%", "24,32,9,16"),
        ("24,50%,9,16", "24,32,9,16"),
        ("0%,0%,100%,100%", "0,0,96,64"),
        ("50%,50%", "47,31,2,2"),
        ("0,0", "0,0,2,2"),
        ("100%,100%", "94,62,2,2"),
        ("95,63", "94,62,2,2"),
    ],
)
def test_shares_and_points(text: str, wanted: str) -> None:
    assert str(Rectangle.parse(text, "--region", (64, 96))) == wanted


@pytest.mark.parametrize("text", ["50%", "1,2,3", "a%,2", "nan%,2,3,4", "50%,50%,60%,10%", "0,0,0%,5", "1.5,2,3,4"])
def test_shares_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match="--region must"):
        Rectangle.parse(text, "--region", (64, 96))


@pytest.mark.parametrize("text", ["97,20", "20,65", "-1,20", "101%,50%", "50%,-1%"])
def test_points_outside(text: str) -> None:
    with pytest.raises(ValueError, match="--region must be a point in the photograph, which is 96 pixels wide and 64 "):
        Rectangle.parse(text, "--region", (64, 96))


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


def test_a_share_does_what_pixels_do(photo: Path, tmp_path: Path) -> None:
    one, other = tmp_path / "one.png", tmp_path / "other.png"
    assert main(["recolor", str(photo), str(one), "--region", "25%,50%,9,16:blue"]) == 0
    assert main(["recolor", str(photo), str(other), "--region", "24,32,9,16:blue"]) == 0
    np.testing.assert_array_equal(rgb(one), rgb(other))


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
    found = rgb(shown)
    assert found[32, 29, 0] > 200
    assert (found[50, 60] == found[50, 60, 0]).all()


def test_nothing_to_show(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["detail", str(photo), str(tmp_path / "out.png"), "--show", str(tmp_path / "shown.png")]) == 2
    assert "--show needs scribbles" in capsys.readouterr().err
    assert not (tmp_path / "shown.png").exists()


@pytest.mark.parametrize(
    ("verb", "option"),
    [
        (["recolor", "--region", "24,32:blue"], "--show"),
        (["mask", "--region", "24,32"], "--show"),
        (["denoise"], "--map"),
    ],
)
def test_the_photograph_is_not_replaced(
    verb: list[str], option: str, photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, out = photo.read_bytes(), tmp_path / "out.png"
    for path, what in ((photo, "photograph"), (out, "output")):
        assert main([*verb, str(photo), str(out), option, str(path)]) == 2
        assert f"{option} must be another file than the {what}, got" in capsys.readouterr().err
    assert photo.read_bytes() == before
    assert not out.exists()
