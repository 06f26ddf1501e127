"""Scribbles, masks and rectangles on a photograph, from the options of a command."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.scribbles import MarkedPhotograph, ScribbleOptions, parse_region
from nlfilter_torch.photo.declared.declaration import Edit, Scribble
from nlfilter_torch.photo.declared.parameters import EDITS, MASK
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Region
from nlfilter_torch.photo.files.rows import StoredPicture, open_picture
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.painting import cover, plane_rows
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.commands import refusal
from tests.problems import box, colour

SIZE = HEIGHT, WIDTH = 60, 90  # of the photograph
PHOTOGRAPH = Rows("photograph", SIZE, 3, lambda rows: torch.zeros(1, 3, HEIGHT, WIDTH)[..., rows, :])


def rgb(path: Path) -> np.ndarray:
    with Image.open(path) as opened:
        return np.asarray(opened.convert("RGB")).astype(int)


def placed(text: str, size: tuple[int, int], option: str = "--region") -> str:
    """The region of a text, in pixels."""
    return parse_region(text, option, size, "in")[0].text(size)


def marked(edit: Edit, options: ScribbleOptions, alpha: tuple[float, ...] = ()) -> MarkedPhotograph:
    """A photograph of :data:`SIZE` with options that name no picture."""
    return options.on(edit, PHOTOGRAPH, unread, alpha)


def test_rectangles() -> None:
    region, note = parse_region("0,0,64,48", "--region", (48, 64), "in")
    assert cover(region, (48, 64)).all()
    assert note is None
    assert parse_region("63,47,1,1:", "--region", (48, 64), "in")[1] == ""


def test_ellipses_and_polygons() -> None:
    ellipse, note = parse_region("ellipse:10%,20,40,30:red", "--region", (64, 96), "in")
    assert (ellipse.text((64, 96)), note) == ("ellipse:9,20,40,30", "red")
    inside = cover(ellipse, (64, 96))
    assert inside[20:50, 9:49].sum() == inside.sum()
    assert abs(int(inside.sum()) - torch.pi * 20 * 15) < 10
    triangle, _ = parse_region("10,10,50,10,10,50%", "--region", (64, 96), "in")
    assert triangle.text((64, 96)) == "10,10,50,10,10,32"
    assert abs(int(cover(triangle, (64, 96)).sum()) - 40 * 22 / 2) < 20


@pytest.mark.parametrize("text", ["ellipse:1,2", "ellipse:1,2,3,4,5,6", "1,2,3,4,5", "ellipse", "circle:1,2,3,4"])
def test_wrong_shapes(text: str) -> None:
    with pytest.raises(ValueError, match="--region must be four whole numbers"):
        parse_region(text, "--region", (64, 96), "in")


def test_percentages_are_exact() -> None:
    for percent in range(100):
        text = f"{percent}%,{percent}%,{100 - percent}%,{100 - percent}%"
        region, _ = parse_region(text, "--region", (100, 300), "in")
        assert torch.equal(cover(region, (100, 300)), box(percent, 3 * percent, 100, 300, (100, 300))[0, 0] > 0)


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
        assert placed(text, (64, 96)) == wanted


WRONG_SHARES = ["50%", "1,2,3", "a%,2", "nan%,2,3,4", "50%,50%,60%,10%", "0,0,0%,5", "1.5,2,3,4"]


def test_wrong_shares() -> None:
    for text in WRONG_SHARES:
        with pytest.raises(ValueError, match="--region must"):
            placed(text, (64, 96))


POINTS_OUTSIDE = ["97,20", "20,65", "-1,20", "101%,50%", "50%,-1%"]


def test_points_outside() -> None:
    for text in POINTS_OUTSIDE:
        with pytest.raises(
            ValueError, match="--region must be a point in the photograph, which is 96 pixels wide and 64 "
        ):
            placed(text, (64, 96))


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
        drawn = ScribbleOptions(mask=tmp_path / "layer.png").on(MASK, PHOTOGRAPH, lambda _: stored).tensors()
        assert torch.equal(drawn.masks["scribbles"], box(8, 10, 6, 8, SIZE))


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
    ("defocus", [], "give --region X,Y,W,H, --box X,Y,W,H or --mask FILE"),
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
        "--remove must come with --region, --box, --add or --mask, got none of them; mark",
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
        Scribble("scribbles", "Object", needed=True, advice="give --region X,Y,W,H, the part to desaturate"),
        Scribble("keep", "Keep", role="background", option="--keep", option_help="Pixels to keep."),
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
    both = marked(DESATURATE, options)
    drawn = both.tensors()
    assert (drawn.colours, drawn.sliders) == (None, None)
    assert [option for option, _ in both.drawn_regions()] == ["--region", "--region", "--keep"]
    assert torch.equal(drawn.masks["scribbles"], box(3, 2, 5, 4, SIZE) + box(3, 10, 5, 4, SIZE))
    assert torch.equal(drawn.masks["keep"], box(30, 20, 5, 4, SIZE))
    rows = plane_rows(both.rows().masks["keep"], slice(28, 32))
    assert torch.equal(torch.from_numpy(rows)[..., 0], drawn.masks["keep"][0, 0, 28:32])


def test_an_object_may_be_needed() -> None:
    with pytest.raises(ValueError, match="give --region X,Y,W,H, the part to desaturate"):
        marked(DESATURATE, ScribbleOptions(rectangles={"--keep": ["1,2,3,4"]}))
    assert not marked(EDITS["detail"], ScribbleOptions(), (2.0, 1.0)).tensors().masks


def test_what_is_outside_must_not_be_hidden_by_the_object() -> None:
    hidden = marked(DESATURATE, ScribbleOptions(["2,3,9,9"], rectangles={"--keep": ["3,4,2,2"]}))
    with pytest.raises(ValueError, match="--keep must hold a painted pixel outside the scribbles on the object"):
        hidden.tensors()


def test_regions_have_sliders() -> None:
    options = ScribbleOptions(["2,3,4,5", "10,3,4,5:0,1,2"])
    drawn = marked(EDITS["detail"], options, (3.0, 2.0, 1.0)).tensors()
    assert drawn.sliders is not None
    assert drawn.sliders.tolist() == [[3, 2, 1], [0, 1, 2]]
    (regions,) = drawn.masks.values()
    assert torch.equal(regions, torch.cat([box(3, 2, 5, 4, SIZE), box(3, 10, 5, 4, SIZE)], dim=1))


def test_masks_are_painted_by_rectangles() -> None:
    rectangles = {"--add": ["2,3,4,5", "10,3,4,5:0,1,2"], "--remove": ["2,3,1,1"]}
    options = ScribbleOptions(["20,3,4,5:0,1,2"], rectangles=rectangles)
    drawn = marked(EDITS["detail"], options, (3.0, 2.0, 1.0)).tensors()
    assert drawn.sliders is not None
    assert drawn.sliders.tolist() == [[0, 1, 2], [3, 2, 1]]
    masks, removed = drawn.masks, box(3, 2, 1, 1, SIZE)
    added = torch.cat([box(3, 10, 5, 4, SIZE), box(3, 2, 5, 4, SIZE) - removed], dim=1)
    assert torch.equal(masks["added"], added)
    assert torch.equal(masks["removed"], removed)
    assert torch.equal(masks["regions"][:, 1:], torch.zeros(1, 1, *SIZE))
    coloured = marked(EDITS["recolor"], ScribbleOptions(rectangles={"--add": ["2,3,4,5:red"]})).tensors()
    assert coloured.colours is None
    red = box(3, 2, 5, 4, SIZE)
    assert torch.equal(coloured.masks["added"], torch.cat([red, 0 * red, 0 * red, red], dim=1))
    with pytest.raises(ValueError, match="--add must end in a colour"):
        marked(EDITS["recolor"], ScribbleOptions(rectangles={"--add": ["2,3,4,5"]}))


@pytest.mark.parametrize(
    ("verb", "text", "sentence"),
    [
        ("mask", "10,20", "--box must be a rectangle X,Y,W,H around the object, got '10,20'; give four numbers"),
        ("mask", "ellipse:1,1,9,9", "--box must be a rectangle X,Y,W,H around the object, got 'ellipse:1,1,9,9'; give"),
        ("defocus", "10,20,200,9", "--box must lie within the photograph, which is 90 pixels wide and 60 high, got"),
        ("defocus", "10,20,0,9", "--box must be at least 1 pixel wide and high, got 0x9"),
        ("defocus", "10,20,9,9:red", "--box must be X,Y,W,H only, got '10,20,9,9:red'; drop the colon"),
        ("recolor", "10,20,9,9", "strokes of recolor must be in a colour, or its box must say one, got neither"),
        ("recolor", "10,20,9,9:reddish", "--box must end in a colour, such as red"),
        ("detail", "10,20,9,9:1,2", "--box must have as many sliders as --alpha, 4, got 2"),
    ],
)
def test_wrong_boxes(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str, text: str, sentence: str
) -> None:
    out = tmp_path / "out.png"
    assert sentence in refusal(capsys, verb, photo, out, "--box", text)
    assert not out.exists()


@pytest.mark.usefixtures("tiled")
def test_a_box_alone_marks_an_object(photo: Path, tmp_path: Path) -> None:
    before = rgb(photo)
    for verb, more in (("defocus", ""), ("recolor", ":blue"), ("detail", ":3,3,3,1")):
        assert main([verb, str(photo), str(tmp_path / "out.png"), "--box", f"20,10,50,40{more}"]) == 0
        changed = (rgb(tmp_path / "out.png") != before).any(2)
        assert changed.any()
        if verb != "defocus":
            changed[10:50, 20:70] = False
            assert not changed.any()


def test_colours_and_their_mask() -> None:
    both = marked(EDITS["colorize"], ScribbleOptions(["2,3,4,5:#0000ff", "4,3,4,5:red"]))
    drawn = both.tensors()
    assert drawn.colours is not None
    red, blue = box(3, 4, 5, 4, SIZE), box(3, 2, 5, 2, SIZE)  # the later rectangle covers the earlier one
    assert torch.equal(drawn.colours, torch.cat([red, torch.zeros_like(red), blue, red + blue], dim=1))


def test_rectangles_of_the_same_sliders_are_one_region() -> None:
    texts = ["2,3,4,5", "20,3,4,5:1,2,3", "2,13,4,5:3,2,1", "40,3,4,5:1,2,3"]
    drawn = marked(EDITS["detail"], ScribbleOptions(texts), (3.0, 2.0, 1.0)).tensors()
    assert drawn.sliders is not None
    assert drawn.sliders.tolist() == [[3, 2, 1], [1, 2, 3]]
    regions = drawn.masks["regions"]
    assert torch.equal(regions[0, 0], (box(3, 2, 5, 4, SIZE) + box(13, 2, 5, 4, SIZE))[0, 0])
    assert torch.equal(regions[0, 1], (box(3, 20, 5, 4, SIZE) + box(3, 40, 5, 4, SIZE))[0, 0])


#: Marks of an edit of a file, and the same as options in a photograph of :data:`SIZE`.
SAVED = (
    Region.upright((30 / 90, 20 / 60, 10 / 90, 12 / 60), "rectangle", "in"),
    Region.upright((50 / 90, 20 / 60, 10 / 90, 12 / 60), "ellipse", "in"),
    Region(((5 / 90, 5 / 60), (20 / 90, 5 / 60), (5 / 90, 20 / 60)), "polygon", "out"),
    Region.upright((9 / 90, 12 / 60, 70 / 90, 40 / 60), "rectangle", "box"),
)
TYPED = ("30,20,10,12", "ellipse:50,20,10,12", "5,5,20,5,5,20", "9,12,70,40")


@pytest.mark.parametrize(
    ("verb", "background", "further"),
    [
        ("defocus", "--background", ()),
        ("mask", "--background", ()),
        ("recolor", "--keep", ("--colour", "blue")),
        ("detail", "--background", ("--alpha", "3,2,1")),
    ],
)
@pytest.mark.usefixtures("tiled")
def test_strokes_saved_for_one_edit_are_those_of_every_command(
    photo: Path, tmp_path: Path, verb: str, background: str, further: tuple[str, ...]
) -> None:
    saved, one, other = (tmp_path / name for name in ("edit.json", "one.png", "other.png"))
    saved.write_text(Recipe((Step("tone"), Step("defocus", SAVED))).to_json())
    assert main([verb, str(photo), str(one), "--strokes", str(saved), *further]) == 0
    typed = ["--region", TYPED[0], "--region", TYPED[1], background, TYPED[2], "--box", TYPED[3]]
    assert main([verb, str(photo), str(other), *typed, *further]) == 0
    np.testing.assert_array_equal(rgb(one), rgb(other))


def test_a_step_of_a_file_does_what_its_command_does(photo: Path, tmp_path: Path) -> None:
    saved, one, other = (tmp_path / name for name in ("edit.json", "one.png", "other.png"))
    mask = np.zeros(SIZE, np.uint8)
    mask[30:40, 40:60] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    step = Step("defocus", (*SAVED, Region.of_file("mask.png", "mask", "in")))  # beside the file
    saved.write_text(Recipe((step,)).to_json())
    assert main(["apply", str(photo), str(one), "--preset", str(saved)]) == 0
    assert main(["defocus", str(photo), str(other), "--strokes", str(saved)]) == 0
    np.testing.assert_array_equal(rgb(one), rgb(other))
    by_mask = [
        "--mask",
        str(tmp_path / "mask.png"),
        "--region",
        TYPED[0],
        "--region",
        TYPED[1],
        "--background",
        TYPED[2],
        "--box",
        TYPED[3],
    ]
    assert main(["defocus", str(photo), str(other), *by_mask]) == 0
    np.testing.assert_array_equal(rgb(one), rgb(other))


def test_pictures_of_scribbles_are_marks_of_every_command(photo: Path, tmp_path: Path) -> None:
    layer, mask, one, other = (tmp_path / name for name in ("layer.png", "mask.png", "one.png", "other.png"))
    pixels = np.zeros((*SIZE, 4), np.uint8)
    pixels[20:32, 30:40] = 0, 0, 255, 255
    Image.fromarray(pixels).save(layer)
    Image.fromarray(pixels[..., 3]).save(mask)
    for verb in ("mask", "defocus", "detail"):
        assert main([verb, str(photo), str(one), "--strokes", str(layer)]) == 0
        assert main([verb, str(photo), str(other), "--mask", str(mask)]) == 0
        np.testing.assert_array_equal(rgb(one), rgb(other))
    for verb in ("recolor", "colorize"):
        assert main([verb, str(photo), str(one), "--strokes", str(layer)]) == 0
        assert main([verb, str(photo), str(other), "--mask", str(mask), "--colour", "blue"]) == 0
        np.testing.assert_array_equal(rgb(one), rgb(other))


def test_files_of_strokes_that_do_not_suit_are_refused(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, out = tmp_path / "edit.json", tmp_path / "out.png"
    saved.write_text(Recipe((Step("defocus", SAVED),)).to_json())
    for verb, options, sentence in (
        ("recolor", (), "must come with --colour, such as --colour red, got none; add it"),
        ("recolor", ("--colour", "reddish"), "--colour must end in a colour, such as red"),
        ("colorize", ("--colour", "red"), "must be one of a colour such as #c04020, box, got 'out'"),
    ):
        assert sentence in refusal(capsys, verb, photo, out, "--strokes", saved, *options)
    saved.write_text(Recipe((Step("tone"),)).to_json())
    assert "must hold one step with strokes, or one of mask, got 0; keep one" in refusal(
        capsys, "mask", photo, out, "--strokes", saved
    )
    Image.new("L", (WIDTH, HEIGHT), 255).save(tmp_path / "mask.png")
    assert "--mask must come with --colour" in refusal(capsys, "recolor", photo, out, "--mask", tmp_path / "mask.png")
    assert not out.exists()


def test_gradients_in_pixels_and_percent() -> None:
    linear = parse_region("-9,0,50%,120:red", "--linear", SIZE, "add", "linear")
    assert linear == (Region(((-0.1, 0.0), (0.5, 2.0)), "linear", "add"), "red")
    radial, _ = parse_region("9,6,50%,50%,30%", "--radial", SIZE, "add", "radial")
    assert radial.entries() == {"paint": "add", "radial": [0.1, 0.1, 0.5, 0.5], "softness": 0.3}
    drawn = marked(EDITS["defocus"], ScribbleOptions(rectangles={"--radial": ["0,0,90,60"], "--linear": ["0,0,0,6"]}))
    assert [mark.entries()["paint"] for mark in drawn.marks] == ["add", "add"]
    for option, shape in (("--linear", "linear"), ("--radial", "radial")):
        for text in ("1,2,3", "0,0,0,0", "0,0,1,x", "0,0,1,300%", ""):
            with pytest.raises(ValueError, match=f"{option} must be X,Y,.*, in pixels or percent, got '{text}'"):
                parse_region(text, option, SIZE, "add", shape)
