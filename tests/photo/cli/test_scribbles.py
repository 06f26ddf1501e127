"""Scribbles, masks and rectangles on a photograph, from the options of a command."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.scribbles import Rectangle, ScribbleOptions, at_once, of_edit, overlays, selection
from nlfilter_torch.photo.declared.declaration import Edit, Scribble
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.files.rows import StoredPicture, open_picture
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.commands import refusal
from tests.problems import box, colour

SIZE = HEIGHT, WIDTH = 60, 90  # of the photograph


def rgb(path: Path) -> np.ndarray:
    with Image.open(path) as opened:
        return np.asarray(opened.convert("RGB")).astype(int)


def test_rectangles() -> None:
    assert Rectangle.parse("0,0,64,48", "--region", (48, 64)) == Rectangle(slice(0, 48), slice(0, 64), None)
    assert Rectangle.parse("63,47,1,1:", "--region", (48, 64)).note == ""


def test_percentages_are_exact() -> None:
    for percent in range(100):
        rectangle = Rectangle.parse(f"{percent}%,{percent}%,{100 - percent}%,{100 - percent}%", "--region", (100, 300))
        assert (rectangle.rows, rectangle.columns) == (slice(percent, 100), slice(3 * percent, 300))


SHARES = [
    ("25%,50%,10%,25%", "24,32,9,16"),
    ("24,50%,9,16", "24,32,9,16"),
    ("0%,0%,100%,100%", "0,0,96,64"),
    ("50%,50%", "47,31,2,2"),
    ("0,0", "0,0,2,2"),
    ("100%,100%", "94,62,2,2"),
    ("95,63", "94,62,2,2"),
]


def test_shares_and_points() -> None:
    for text, wanted in SHARES:
        assert str(Rectangle.parse(text, "--region", (64, 96))) == wanted


WRONG_SHARES = ["50%", "1,2,3", "a%,2", "nan%,2,3,4", "50%,50%,60%,10%", "0,0,0%,5", "1.5,2,3,4"]


def test_wrong_shares() -> None:
    for text in WRONG_SHARES:
        with pytest.raises(ValueError, match="--region must"):
            Rectangle.parse(text, "--region", (64, 96))


POINTS_OUTSIDE = ["97,20", "20,65", "-1,20", "101%,50%", "50%,-1%"]


def test_points_outside() -> None:
    for text in POINTS_OUTSIDE:
        with pytest.raises(
            ValueError, match="--region must be a point in the photograph, which is 96 pixels wide and 64 "
        ):
            Rectangle.parse(text, "--region", (64, 96))


def test_a_share_does_what_pixels_do(photo: Path, tmp_path: Path) -> None:
    percent, pixels = tmp_path / "one.png", tmp_path / "other.png"
    assert main(["recolor", str(photo), str(percent), "--region", "20%,50%,9,16:blue"]) == 0
    assert main(["recolor", str(photo), str(pixels), "--region", "18,30,9,16:blue"]) == 0
    np.testing.assert_array_equal(rgb(percent), rgb(pixels))


def test_faint_parts_of_a_mask_are_not_selected(tmp_path: Path, tiled: bool) -> None:
    photo, target = tmp_path / "in.png", tmp_path / "out.png"
    write_photograph(Photograph(colour("chelsea", 64, 96)), photo)
    mask = np.full((64, 96), 0.02)  # not exactly black
    mask[20:40, 30:60] = 1
    faint, hard = tmp_path / "faint.png", tmp_path / "hard.png"
    for path, plane in ((faint, mask), (hard, mask.round())):
        Image.fromarray((plane * 255).round().astype(np.uint8)).save(path)
    assert main(["defocus", str(photo), str(target), "--mask", str(hard)]) == 0
    wanted = rgb(target)
    assert np.abs(wanted - rgb(photo)).mean() > 0.002 * 255
    assert main(["defocus", str(photo), str(target), "--mask", str(faint)]) == 0
    np.testing.assert_array_equal(rgb(target), wanted)


def test_what_is_transparent_in_a_mask_is_not_selected(tmp_path: Path) -> None:
    planes = torch.ones(1, 3, HEIGHT, WIDTH)
    write_photograph(Photograph(planes, "uint8", box(8, 10, 6, 8, SIZE)), tmp_path / "layer.png")
    with open_picture(tmp_path / "layer.png", 10**9) as stored:
        region = selection((HEIGHT, WIDTH), tmp_path / "layer.png", None, "--region", lambda _: stored)
        assert region is not None
        assert torch.equal(region.at_once(), box(8, 10, 6, 8, SIZE))


def test_strokes_that_cover_the_photograph_are_refused(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Image.open(photo) as opened:
        opened.convert("RGBA").save(tmp_path / "strokes.png")
    assert "strokes.png has no transparency, so every pixel would count as a scribble" in refusal(
        capsys, "recolor", photo, tmp_path / "out.png", "--strokes", tmp_path / "strokes.png"
    )


WRONG_RECTANGLES = [
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
        ["--region", "88,2,5,4:red"],
        "--region must lie within the photograph, which is 90 pixels wide and 60",
    ),
    ("recolor", ["--region", "-1,2,5,4:red"], "--region must lie within the photograph"),
    ("recolor", ["--region", "1,2,5,4:red", "--keep", "99,9,9,9"], "--keep must lie within the photograph"),
    ("recolor", ["--region", "1,2,5,4:red", "--keep", "9,9,9,9:red"], "--keep must be X,Y,W,H only, got"),
    ("defocus", ["--region", "1,2,5,4:red"], "--region must be X,Y,W,H only, got"),
    ("detail", ["--region", "1,2,5,4:1,2"], "--region must have as many sliders as --alpha, 4, got 2"),
    (
        "detail",
        ["--remove", "1,2,5,4"],
        "--remove must come with --region, --add or --mask, got none of them; mark",
    ),
    ("detail", ["--region", "1,2,5,4:1,x,1,1"], "--region must be numbers separated by commas"),
]


def test_wrong_rectangles(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for verb, options, sentence in WRONG_RECTANGLES:
        assert refusal(capsys, verb, photo, tmp_path / "out.png", *options).startswith(sentence)
        assert [file.name for file in tmp_path.iterdir()] == ["in.png"]


def test_wrong_pictures(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.png"
    Image.new("RGBA", (WIDTH, HEIGHT)).save(tmp_path / "clear.png")
    Image.new("RGBA", (30, 20), (255, 0, 0, 255)).save(tmp_path / "small.png")
    Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / "black.png")
    Image.new("L", (WIDTH, HEIGHT), 90).save(tmp_path / "grey.png")
    (tmp_path / "text.png").write_text("no picture")

    def sentence(verb: str, source: str, *options: object) -> str:
        return refusal(capsys, verb, tmp_path / source, out, *options)

    assert "small.png must be as large as the photograph, 90x60, but is 30x20; resize it" in sentence(
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
        said = refusal(capsys, str(verb), photo, out, *options)
        assert (
            f"{options[1]} is {'darker than middle grey' if options[1] == black else 'transparent'} everywhere" in said
        )


#: An edit of no command, which takes two kinds of scribbles.
DESATURATE = Edit(
    "desaturate",
    "",
    (),
    scribbles=(
        Scribble("scribbles", "in", "Object", needed=True, advice="give --region X,Y,W,H, the part to desaturate"),
        Scribble("keep", "keep", "Keep", role="background", option="--keep", option_help="Pixels to keep."),
    ),
)


def unread(path: Path) -> StoredPicture:
    raise AssertionError(f"{path} is not among the options")


def test_what_options_mark() -> None:
    edit = EDITS["recolor"]
    assert not ScribbleOptions(rectangles={"--keep": ["1,2,3,4"], "--remove": ["1,2,3,4"]}).marks_objects(edit)
    assert not ScribbleOptions(region=[]).marks_objects(edit)
    for options in (
        ScribbleOptions(region=["1,2,3,4"]),
        ScribbleOptions(strokes=Path("a.png")),
        ScribbleOptions(mask=Path("a.png")),
        ScribbleOptions(rectangles={"--add": ["1,2,3,4:red"]}),
    ):
        assert options.marks_objects(edit)
    assert ScribbleOptions(region=["1,2,3,4:red"]).called == "--region"
    assert ScribbleOptions(strokes=Path("a.png")).called == "a.png"


def test_two_kinds_of_scribbles() -> None:
    options = ScribbleOptions(["2,3,4,5", "10,3,4,5"], rectangles={"--keep": ["20,30,4,5"]})
    drawn = of_edit(DESATURATE, None, SIZE, options, unread)
    assert (drawn.colours, drawn.sliders) == (None, None)
    assert [option for _, option, _ in overlays(DESATURATE, drawn)] == ["--region", "--keep"]
    tensors = at_once(DESATURATE, drawn).masks
    assert torch.equal(tensors["scribbles"], box(3, 2, 5, 4, SIZE) + box(3, 10, 5, 4, SIZE))
    assert torch.equal(tensors["keep"], box(30, 20, 5, 4, SIZE))
    assert torch.equal(drawn.masks["keep"].planes(slice(28, 32)), tensors["keep"][..., 28:32, :])


def test_an_object_may_be_needed() -> None:
    with pytest.raises(ValueError, match="give --region X,Y,W,H, the part to desaturate"):
        of_edit(DESATURATE, None, SIZE, ScribbleOptions(rectangles={"--keep": ["1,2,3,4"]}), unread)
    assert not of_edit(EDITS["detail"], (2.0, 1.0), SIZE, ScribbleOptions(), unread).masks


def test_regions_have_sliders() -> None:
    options = ScribbleOptions(["2,3,4,5", "10,3,4,5:0,1,2"])
    drawn = of_edit(EDITS["detail"], (3.0, 2.0, 1.0), SIZE, options, unread)
    assert drawn.sliders is not None
    assert drawn.sliders.tolist() == [[3, 2, 1], [0, 1, 2]]
    (regions,) = at_once(EDITS["detail"], drawn).masks.values()
    assert torch.equal(regions, torch.cat([box(3, 2, 5, 4, SIZE), box(3, 10, 5, 4, SIZE)], dim=1))


def test_masks_are_painted_by_rectangles() -> None:
    rectangles = {"--add": ["2,3,4,5", "10,3,4,5:0,1,2"], "--remove": ["2,3,1,1"]}
    drawn = of_edit(
        EDITS["detail"], (3.0, 2.0, 1.0), SIZE, ScribbleOptions(["20,3,4,5:0,1,2"], rectangles=rectangles), unread
    )
    assert drawn.sliders is not None
    assert drawn.sliders.tolist() == [[0, 1, 2], [3, 2, 1]]
    masks = at_once(EDITS["detail"], drawn).masks
    assert torch.equal(masks["added"], torch.cat([box(3, 10, 5, 4, SIZE), box(3, 2, 5, 4, SIZE)], dim=1))
    assert torch.equal(masks["removed"], box(3, 2, 1, 1, SIZE))
    assert torch.equal(masks["regions"][:, 1:], torch.zeros(1, 1, *SIZE))
    coloured = at_once(
        EDITS["recolor"],
        of_edit(EDITS["recolor"], None, SIZE, ScribbleOptions(rectangles={"--add": ["2,3,4,5:red"]}), unread),
    )
    assert coloured.colours is None
    red = box(3, 2, 5, 4, SIZE)
    assert torch.equal(coloured.masks["added"], torch.cat([red, 0 * red, 0 * red, red], dim=1))
    with pytest.raises(ValueError, match="--add must end in a colour"):
        of_edit(EDITS["recolor"], None, SIZE, ScribbleOptions(rectangles={"--add": ["2,3,4,5"]}), unread)


def test_colours_and_their_mask() -> None:
    drawn = of_edit(EDITS["colorize"], None, SIZE, ScribbleOptions(["2,3,4,5:#0000ff", "4,3,4,5:red"]), unread)
    assert [option for _, option, _ in overlays(EDITS["colorize"], drawn)] == ["--region"]
    tensors = at_once(EDITS["colorize"], drawn)
    assert tensors.colours is not None
    red, blue = box(3, 4, 5, 4, SIZE), box(3, 2, 5, 2, SIZE)  # the later rectangle covers the earlier one
    assert torch.equal(tensors.colours, torch.cat([red, torch.zeros_like(red), blue], dim=1))
    (mask,) = tensors.masks.values()
    assert torch.equal(mask, red + blue)


def test_rectangles_of_the_same_sliders_are_one_region() -> None:
    texts = ["2,3,4,5", "20,3,4,5:1,2,3", "2,13,4,5:3,2,1", "40,3,4,5:1,2,3"]
    drawn = at_once(EDITS["detail"], of_edit(EDITS["detail"], (3.0, 2.0, 1.0), SIZE, ScribbleOptions(texts), unread))
    assert drawn.sliders is not None
    assert drawn.sliders.tolist() == [[3, 2, 1], [1, 2, 3]]
    regions = drawn.masks["regions"]
    assert torch.equal(regions[0, 0], (box(3, 2, 5, 4, SIZE) + box(13, 2, 5, 4, SIZE))[0, 0])
    assert torch.equal(regions[0, 1], (box(3, 20, 5, 4, SIZE) + box(3, 40, 5, 4, SIZE))[0, 0])
