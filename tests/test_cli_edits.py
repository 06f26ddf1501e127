"""The edits as commands: files, strokes, masks and rectangles, and input that is refused."""

from pathlib import Path

import pytest
import skimage.data
import torch
from PIL import Image

from nlfilter_torch import abstract, adjust_tone, colorize, defocus, denoise, enhance, recolor, sharpen
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.scribbles import Rectangle, selection
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import EDITS, MASK
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.io.rows import open_picture

HEIGHT, WIDTH = 48, 64
LANDMARKS = ("--landmarks", "40")
TECHNICAL = ["--bandwidth", "--spatial-bandwidth", "--patch-size", "--landmarks", "--sampling"]
TECHNICAL += ["--tolerance", "--reach", "--viewing-size", "--residual"]


@pytest.fixture(scope="module")
def pixels() -> torch.Tensor:
    """(1, 3, 48, 64) in [0, 1]: a piece of the cat."""
    return torch.from_numpy(skimage.data.chelsea()[80:128, 120:184].copy()).permute(2, 0, 1)[None].float() / 255


@pytest.fixture
def photo(tmp_path: Path, pixels: torch.Tensor) -> Path:
    write_photograph(Photograph(pixels), tmp_path / "in.png")
    return tmp_path / "in.png"


@pytest.fixture
def strokes(tmp_path: Path) -> Path:
    """Green strokes on a transparent layer of the photograph's size."""
    layer = Image.new("RGBA", (WIDTH, HEIGHT))
    layer.paste((20, 160, 40, 255), (10, 8, 18, 14))
    layer.save(tmp_path / "paint.png")
    return tmp_path / "paint.png"


def box(top: int, left: int, height: int, width: int) -> torch.Tensor:
    mask = torch.zeros(1, 1, HEIGHT, WIDTH)
    mask[..., top : top + height, left : left + width] = 1
    return mask


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def run(verb: str, source: Path, *arguments: object) -> torch.Tensor:
    out = source.parent / "out.png"
    assert main([verb, str(source), str(out), *map(str, arguments), *LANDMARKS]) == 0
    found = read_photograph(out).pixels
    out.unlink()
    return found


def is_written(found: torch.Tensor, wanted: torch.Tensor) -> bool:
    """Check that a file equals the expected image, to the rounding of eight bits."""
    return bool((found - wanted.clamp(0, 1)).abs().max() < 0.6 / 255)


GREEN = torch.tensor([20, 160, 40]).view(1, 3, 1, 1) / 255


def test_recolor(photo: Path, strokes: Path, pixels: torch.Tensor) -> None:
    mask = box(8, 10, 6, 8)
    wanted = recolor(pixels, GREEN * mask, mask, num_landmarks=40, generator=seeded())
    assert is_written(run("recolor", photo, "--strokes", strokes), wanted)
    assert is_written(run("recolor", photo, "--region", "10,8,8,6:rgb(20,160,40)"), wanted)
    assert is_written(run("recolor", photo, "--region", "10,8,8,6:red", "--region", "10,8,8,6:#14a028"), wanted)
    keep = box(30, 40, 8, 8)
    held = recolor(pixels, GREEN * mask, mask, keep=keep, reach=0.5, num_landmarks=40, generator=seeded())
    wide = recolor(pixels, GREEN * mask, mask, photometric_bandwidth=0.3, num_landmarks=40, generator=seeded())
    assert is_written(run("recolor", photo, "--strokes", strokes, "--tolerance", 30), wide)
    assert is_written(run("recolor", photo, "--strokes", strokes, "--keep", "40,30,8,8", "--reach", 0.5), held)


def test_colorize(
    photo: Path, strokes: Path, pixels: torch.Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Grey files become colour files; a photograph in colour is converted to grey first."""
    grey = (pixels * torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)).sum(1, keepdim=True)
    write_photograph(Photograph(grey, "uint16", icc=b"a profile for grey"), tmp_path / "grey.png")
    mask = box(8, 10, 6, 8)
    for method in ("regression", "kmeans"):
        wanted = colorize(grey, GREEN * mask, mask, method=method, strength=0.7, num_landmarks=40, generator=seeded())
        arguments = ("--strokes", strokes, "--method", method, "--strength", 0.7)
        assert (run("colorize", tmp_path / "grey.png", *arguments) - wanted).abs().max() < 1e-3
        assert "note" not in capsys.readouterr().err
        assert (run("colorize", photo, *arguments) - wanted).abs().max() < 1 / 255
        assert f"note: {photo} is in colour: colorize replaces its colours everywhere" in capsys.readouterr().err
    assert main(["colorize", str(tmp_path / "grey.png"), str(tmp_path / "c.png"), "--strokes", str(strokes)]) == 0
    found = read_photograph(tmp_path / "c.png")
    assert (found.depth, found.icc) == ("uint16", None)


def test_defocus(photo: Path, pixels: torch.Tensor, tmp_path: Path) -> None:
    region = box(10, 20, 12, 16)
    for aperture in ("disc", "gaussian"):
        wanted = defocus(pixels, region, radius=3.0, aperture=aperture, num_landmarks=40, generator=seeded())
        assert is_written(
            run("defocus", photo, "--region", "20,10,16,12", "--radius", 6.25, "--aperture", aperture), wanted
        )
    write_photograph(Photograph(region), tmp_path / "mask.png")
    assert is_written(
        run("defocus", photo, "--mask", tmp_path / "mask.png"),
        defocus(pixels, region, num_landmarks=40, generator=seeded()),
    )
    background = box(30, 40, 8, 8)
    assert is_written(
        run("defocus", photo, "--region", "20,10,16,12", "--background", "40,30,8,8"),
        defocus(pixels, region, background=background, num_landmarks=40, generator=seeded()),
    )


def test_abstract(photo: Path, pixels: torch.Tensor) -> None:
    wanted = abstract(
        pixels, power=0.2, edges=0.5, edge_width=0.96, tones=6, photometric_bandwidth=40 / 255, num_landmarks=40
    )
    arguments = ("--power", 0.2, "--edges", 0.5, "--edge-width", 2, "--tones", 6, "--bandwidth", 40)
    assert is_written(run("abstract", photo, *arguments), wanted)
    assert is_written(run("abstract", photo, "--power", 0), pixels)


def test_denoise(photo: Path, pixels: torch.Tensor) -> None:
    wanted = denoise(pixels, noise_level=12 / 255, spatial_bandwidth=20.0, num_landmarks=40, generator=seeded())
    assert is_written(run("denoise", photo, "--noise-level", 12, "--spatial-bandwidth", 20), wanted)
    assert is_written(run("denoise", photo), denoise(pixels, num_landmarks=40, generator=seeded()))


def test_sharpen(photo: Path, pixels: torch.Tensor) -> None:
    wanted = sharpen(pixels, amount=6.0, guide_blur=0.8, patch_size=3, num_landmarks=40, generator=seeded())
    assert is_written(run("sharpen", photo, "--amount", 6, "--guide-blur", 0.8, "--patch-size", 3), wanted)


def test_tone(photo: Path, pixels: torch.Tensor) -> None:
    wanted = adjust_tone(pixels, contrast=1.3, clarity=2.0, num_landmarks=40, generator=seeded())
    assert is_written(run("tone", photo, "--contrast", 1.3, "--clarity", 2), wanted)


def test_detail_of_regions(photo: Path, pixels: torch.Tensor, tmp_path: Path) -> None:
    sliders, own = torch.tensor([4.0, 3.0, 1.0]), torch.tensor([0.0, 0.5, 1.0])
    regions = torch.cat([box(8, 10, 6, 8), box(30, 40, 8, 8)], dim=1)
    wanted = enhance(pixels, torch.stack([sliders, own]), regions, reach=0.75, num_landmarks=40)
    arguments = ("--alpha", "4,3,1", "--region", "10,8,8,6", "--region", "40,30,8,8:0,0.5,1", "--reach", 0.75)
    assert is_written(run("detail", photo, *arguments), wanted)
    write_photograph(Photograph(regions[:, :1]), tmp_path / "mask.png")
    whole = run("detail", photo, "--alpha", "4,3,1")
    part = run("detail", photo, "--alpha", "4,3,1", "--mask", tmp_path / "mask.png")
    assert is_written(part, enhance(pixels, sliders, regions[:, :1], num_landmarks=40))
    assert not torch.equal(part, whole)


def test_depth_and_transparency_are_kept(tmp_path: Path, pixels: torch.Tensor) -> None:
    alpha = pixels[:, :1].flip(-1)
    write_photograph(Photograph(pixels, "uint16", alpha), tmp_path / "deep.png")
    assert main(["tone", str(tmp_path / "deep.png"), str(tmp_path / "out.png"), *LANDMARKS]) == 0
    stored, found = read_photograph(tmp_path / "deep.png"), read_photograph(tmp_path / "out.png")
    assert found.depth == "uint16"
    assert torch.equal(found.alpha, stored.alpha)
    assert main(["tone", str(tmp_path / "deep.png"), str(tmp_path / "out.tif"), "--depth", "float", *LANDMARKS]) == 0
    assert read_photograph(tmp_path / "out.tif").depth == "float32"


@pytest.mark.parametrize("edit", [*EDITS.values(), MASK], ids=lambda edit: edit.name)
def test_photographic_options_come_first_in_the_help(edit: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    """Settings of the filter, and those of files and memory, are in sections of their own."""
    assert main([edit.name, "--help"]) == 0
    shown = capsys.readouterr().out
    names = (None, "Filter", "Files and memory")
    starts = [shown.index(f"─ {name or 'Options'} ─") for name in names]
    assert starts == sorted(starts)
    sections = {name: shown[a:b] for name, a, b in zip(names, starts, [*starts[1:], len(shown)], strict=True)}
    for parameter in edit:
        option = f"--{parameter.name.replace('_', '-')}"
        assert (option in sections[parameter.panel]) == parameter.is_option
        assert (parameter.panel == "Filter") == (option in TECHNICAL)
    assert "--seed" in sections["Filter"]
    assert all(option in sections["Files and memory"] for option in ("--depth", "--memory", "--full"))


def test_help_of_the_mask_says_what_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mask", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "a grey picture of the photograph's size, white in the selected area" in shown
    assert ".tif (16 bits), .png, .jpg, .webp, .avif (8 bits) or .pfm (floats)" in shown


@pytest.mark.parametrize("verb", ["recolor", "colorize", "defocus", "abstract", "denoise", "sharpen", "tone"])
def test_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    assert f"Usage: nlfilter-torch {verb}" in capsys.readouterr().out


def test_rectangles() -> None:
    assert Rectangle.parse("0,0,64,48", "--region", (48, 64)) == Rectangle(slice(0, 48), slice(0, 64), None)
    assert Rectangle.parse("63,47,1,1:", "--region", (48, 64)).note == ""


def test_percentages_are_exact() -> None:
    for percent in range(100):
        found = Rectangle.parse(f"{percent}%,{percent}%,{100 - percent}%,{100 - percent}%", "--region", (100, 300))
        assert (found.rows, found.columns) == (slice(percent, 100), slice(3 * percent, 300))


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize("arguments", [("look",), ("tone", "--contrast", 1), ("detail", "--alpha", "1,1")])
def test_an_edit_that_changes_nothing_says_so(
    photo: Path, tmp_path: Path, arguments: tuple[object, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *options = map(str, arguments)
    assert main([verb, str(photo), str(tmp_path / "out.png"), *options]) == 0
    note = f"nlfilter-torch: note: {verb} changes nothing with these options: the photograph is written as it is\n"
    assert note in capsys.readouterr().err
    assert main(["detail", str(photo), str(tmp_path / "out.png"), "--alpha", "1,1", "--region", "2,2,5,5:2,1"]) == 0
    assert "changes nothing" not in capsys.readouterr().err


def test_what_is_transparent_in_a_mask_is_not_selected(tmp_path: Path) -> None:
    planes = torch.ones(1, 3, HEIGHT, WIDTH)
    write_photograph(Photograph(planes, "uint8", box(8, 10, 6, 8)), tmp_path / "layer.png")
    with open_picture(tmp_path / "layer.png", 10**9) as stored:
        found = selection((HEIGHT, WIDTH), tmp_path / "layer.png", None, "--region", lambda _: stored)
        assert found is not None
        assert torch.equal(found.at_once(), box(8, 10, 6, 8))


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert len(captured.err.splitlines()) == 1
    return captured.err.strip().removeprefix("nlfilter-torch: ")


@pytest.mark.parametrize(
    ("verb", "options", "sentence"),
    [
        ("recolor", [], "give --strokes FILE or --region X,Y,W,H:COLOUR"),
        ("colorize", [], "give --strokes FILE or --region X,Y,W,H:COLOUR"),
        ("defocus", [], "give --region X,Y,W,H or --mask FILE"),
        (
            "recolor",
            ["--region", "1,2,3"],
            "--region must be four whole numbers X,Y,W,H, such as 40,60,20,20, got '1,2,3'",
        ),
        ("recolor", ["--region", "1,2,3,x:red"], "--region must be four whole numbers"),
        ("recolor", ["--region", "1,2,3,4"], "--region must end in a colour, such as 1,2,3,4:red, got '1,2,3,4'"),
        ("recolor", ["--region", "1,2,3,4:reddish"], "--region must end in a colour, such as red, #c04020 or rgb("),
        ("recolor", ["--region", "1,2,3,4:#0000ff80"], "--region must end in an opaque colour, got '#0000ff80'"),
        ("recolor", ["--region", "1,2,0,4:red"], "--region must be at least 1 pixel wide and high, got 0x4"),
        (
            "recolor",
            ["--region", "60,2,5,4:red"],
            "--region must lie within the photograph, which is 64 pixels wide and 48",
        ),
        ("recolor", ["--region", "-1,2,5,4:red"], "--region must lie within the photograph"),
        ("recolor", ["--region", "1,2,5,4:red", "--keep", "99,9,9,9"], "--keep must lie within the photograph"),
        ("recolor", ["--region", "1,2,5,4:red", "--keep", "9,9,9,9:red"], "--keep must be X,Y,W,H only, got"),
        ("recolor", ["--region", "1,2,5,4:red", "--reach", "1"], "Invalid value for '--reach'"),
        ("defocus", ["--region", "1,2,5,4:red"], "--region must be X,Y,W,H only, got"),
        ("defocus", ["--region", "1,2,5,4", "--radius", "0"], "Invalid value for '--radius': "),
        ("detail", ["--region", "1,2,5,4:1,2"], "--region must have as many sliders as --alpha, 4, got 2"),
        ("detail", ["--region", "1,2,5,4:1,x,1,1"], "--region must be numbers separated by commas"),
        ("detail", ["--region", "1,2,5,4", "--reach", "1"], "Invalid value for '--reach': "),
        ("abstract", ["--tones", "1"], "Invalid value for '--tones'"),
        ("abstract", ["--edge-width", "0"], "Invalid value for '--edge-width': "),
        ("denoise", ["--noise-level", "-1"], "Invalid value for '--noise-level'"),
        ("tone", ["--bandwidth", "0"], "--bandwidth must be a positive number of grey levels"),
        ("denoise", ["--bandwidth", "0"], "Invalid value for '--bandwidth': "),
    ],
)
def test_wrong_options(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str, options: list[str], sentence: str
) -> None:
    assert refused(capsys, verb, photo, tmp_path / "out.png", *options).startswith(sentence)
    assert [file.name for file in tmp_path.iterdir()] == ["in.png"]


@pytest.mark.parametrize("tiles", [[], ["--memory", "0.001"]])
@pytest.mark.parametrize(
    ("verb", "options"),
    [
        ("recolor", ["--region", "1,2,5,4:red", "--keep", "2,3,2,2"]),
        ("defocus", ["--region", "1,2,5,4", "--background", "1,2,5,4"]),
    ],
)
def test_contradictory_rectangles(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str, options: list[str], tiles: list[str]
) -> None:
    assert main([verb, str(photo), str(tmp_path / "out.png"), *options, *tiles]) == 2
    name = options[-2].removeprefix("--")
    assert f"{name} must hold a painted pixel outside the scribbles on the object" in capsys.readouterr().err
    assert not (tmp_path / "out.png").exists()


def test_wrong_pictures(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.png"
    Image.new("RGBA", (WIDTH, HEIGHT)).save(tmp_path / "clear.png")
    Image.new("RGBA", (30, 20), (255, 0, 0, 255)).save(tmp_path / "small.png")
    Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / "black.png")
    Image.new("L", (WIDTH, HEIGHT), 90).save(tmp_path / "grey.png")
    (tmp_path / "text.png").write_text("no picture")

    def sentence(verb: str, source: str, *options: object) -> str:
        return refused(capsys, verb, tmp_path / source, out, *options)

    assert "small.png must be as large as the photograph, 64x48, but is 30x20; resize it" in sentence(
        "recolor", "in.png", "--strokes", tmp_path / "small.png"
    )
    assert "small.png must be as large as the photograph" in sentence(
        "defocus", "in.png", "--mask", tmp_path / "small.png"
    )
    assert "clear.png is transparent everywhere; draw at least one scribble" in sentence(
        "colorize", "in.png", "--strokes", tmp_path / "clear.png"
    )
    assert "in.png has no transparency, so every pixel would count as a scribble" in sentence(
        "colorize", "in.png", "--strokes", photo
    )
    assert "black.png is darker than middle grey everywhere; paint the selected area white" in sentence(
        "defocus", "in.png", "--mask", tmp_path / "black.png"
    )
    assert "text.png is not a PNG" in sentence("recolor", "in.png", "--strokes", tmp_path / "text.png")
    assert "none.png does not exist" in sentence("recolor", "in.png", "--strokes", tmp_path / "none.png")
    assert "recolor needs a colour photograph, got a grey one; use colorize" in sentence(
        "recolor", "grey.png", "--region", "1,1,5,5:red"
    )
    assert not out.exists()


@pytest.mark.usefixtures("tiled")
def test_an_empty_picture_of_scribbles_is_refused_beside_rectangles(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, clear, black = (tmp_path / name for name in ("out.png", "clear.png", "black.png"))
    Image.new("RGBA", (WIDTH, HEIGHT)).save(clear)
    Image.new("L", (WIDTH, HEIGHT)).save(black)
    for verb, *options in (
        ("defocus", "--mask", black, "--region", "5,5,9,9"),
        ("detail", "--mask", black, "--region", "5,5,9,9"),
        ("mask", "--mask", black, "--region", "5,5,9,9"),
        ("recolor", "--strokes", clear, "--region", "5,5,9,9:red"),
    ):
        said = refused(capsys, str(verb), photo, out, *options)
        assert (
            f"{options[1]} is {'darker than middle grey' if options[1] == black else 'transparent'} everywhere" in said
        )
