"""Commands of edits, by rows as in memory."""

from pathlib import Path

import numpy as np
import pytest
import skimage.data
import tifffile
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.io.photographs import read_photograph
from nlfilter_torch.photo.tiled import sampling

LITTLE = "0.014"  # gigabytes: less than the whole picture needs, more than small blocks of rows need


@pytest.fixture
def photo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of 16 bits, 180x150, beside strokes over it in two files, and a copy in grey."""
    monkeypatch.setattr(sampling, "PILOT", 8000)
    monkeypatch.setattr("nlfilter_torch.photo.tiled.pictures.STATISTICS_PIXELS", 6000)
    picture = skimage.data.chelsea()[20:170, 90:270].astype(np.uint16) * 257
    tifffile.imwrite(tmp_path / "in.tif", picture, photometric="rgb", tile=(64, 64), compression="zlib")
    tifffile.imwrite(tmp_path / "grey.tif", picture[..., 1], photometric="minisblack")
    layer = np.zeros((150, 180, 4), np.uint8)
    layer[60:70, 40:50], layer[110:120, 100:120] = (0, 0, 255, 255), (255, 0, 0, 255)
    Image.fromarray(layer).save(tmp_path / "paint.png")
    tifffile.imwrite(tmp_path / "paint.tif", layer, photometric="rgb", extrasamples=["unassalpha"], tile=(64, 64))
    tifffile.imwrite(tmp_path / "mask.tif", layer[..., 2], photometric="minisblack", tile=(64, 64))
    return tmp_path / "in.tif"


def run(verb: str, *arguments: object) -> int:
    return main([verb, *map(str, arguments), "--landmarks", "40"])


@pytest.mark.parametrize(
    ("verb", "source", "options"),
    [
        ("recolor", "in.tif", ("--strokes", "paint.tif", "--keep", "5,5,20,20", "--reach", "0.6")),
        ("recolor", "in.tif", ("--strokes", "paint.png", "--region", "100,20,9,9:#14a028", "--depth", "8")),
        ("colorize", "grey.tif", ("--strokes", "paint.tif", "--strength", "0.8")),
        ("colorize", "in.tif", ("--region", "40,60,10,10:blue", "--region", "100,110,20,10:red", "--seed", "3")),
        ("sharpen", "in.tif", ()),
        ("sharpen", "grey.tif", ("--guide-blur", "0")),
        ("tone", "in.tif", ("--clarity", "1.5")),
        ("denoise", "in.tif", ("--method", "rule", "--patch-size", "3", "--noise-level", "6")),
        ("denoise", "grey.tif", ("--method", "rule", "--noise-level", "5")),
        ("abstract", "in.tif", ("--edges", "1", "--tones", "8")),
        ("abstract", "grey.tif", ()),
        ("defocus", "in.tif", ("--region", "80,60,20,20", "--region", "100,90,9,9")),
        ("defocus", "in.tif", ("--mask", "mask.tif", "--aperture", "gaussian")),
        ("defocus", "in.tif", ("--region", "80,60,20,20", "--background", "5,5,20,20")),
    ],
)
def test_by_rows_as_whole(photo: Path, verb: str, source: str, options: tuple[str, ...]) -> None:
    folder = photo.parent
    options = tuple(str(folder / word) if word.startswith(("paint", "mask")) else word for word in options)
    for name, more in (("whole.tif", ()), ("rows.tif", ("--memory", LITTLE, "--full"))):
        assert run(verb, folder / source, folder / name, *options, *more) == 0
    with tifffile.TiffFile(folder / "rows.tif") as file:
        assert file.pages.first.is_tiled  # what is written by rows is
    whole, by_rows = (read_photograph(folder / name) for name in ("whole.tif", "rows.tif"))
    assert whole.depth == by_rows.depth
    assert (whole.pixels - read_photograph(folder / source).pixels).abs().max() > 0.01
    assert (whole.pixels - by_rows.pixels).abs().max() < (
        1.1 / 255 if "8" in options else 1e-3 if verb == "recolor" else 1e-4
    )


def test_what_cannot_be_done_by_rows_leaves_nothing(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = photo.parent
    layer = Image.open(folder / "paint.png")
    layer.crop((0, 0, 180, 149)).save(folder / "small.png")
    layer.convert("RGB").save(folder / "opaque.png")
    Image.new("RGBA", layer.size).save(folder / "clear.png")
    files = set(folder.iterdir())
    for verb, source, options, sentence in (
        ("colorize", "in.tif", ("--strokes", folder / "paint.png", "--method", "kmeans"), "method must be regression"),
        ("recolor", "grey.tif", ("--strokes", folder / "paint.png"), "recolor needs a colour photograph, got a grey"),
        ("recolor", "in.tif", (), "give --strokes FILE or --region"),
        ("recolor", "in.tif", ("--strokes", folder / "small.png"), "small.png must be as large as the photograph"),
        ("recolor", "in.tif", ("--strokes", folder / "opaque.png"), "opaque.png has no transparency"),
        ("colorize", "in.tif", ("--strokes", folder / "clear.png"), "clear.png is transparent everywhere"),
        ("recolor", "in.tif", ("--region", "1,2,5,4:red", "--keep", "9,9,9,9:red"), "--keep must be X,Y,W,H only"),
        ("colorize", "in.tif", ("--region", "1,2,5,4"), "--region must end in a colour"),
    ):
        assert run(verb, folder / source, folder / "out.tif", *options, "--memory", LITTLE) == 2
        assert sentence in capsys.readouterr().err
    assert run("recolor", photo, folder / "out.tif", "--region", "1,2,5,4:red", "--memory", "0") == 2
    assert "--memory must be a positive number" in capsys.readouterr().err
    assert set(folder.iterdir()) == files
