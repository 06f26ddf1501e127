"""Masks of objects: files of every kind, in memory and in tiles, and what the command prints about them."""

import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from nlfilter_torch.photo import Recipe, Region, Step, cutout, read_photograph, region_mask
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.mask_job import MaskJob
from nlfilter_torch.photo.cli.options import FileDepth
from nlfilter_torch.photo.cli.scribbles import ScribbleOptions
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.files.formats import write_pfm
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from nlfilter_torch.photo.picture.source import seeded
from tests.problems import box, colour

SIZE = (64, 80)
REGION, GROUND = "30,30,12,8", "4,4,10,8"


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    path = tmp_path / "in.tif"
    pixels = (colour("coffee", *SIZE)[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    tifffile.imwrite(path, pixels, photometric="rgb")
    return path


def expected(path: Path) -> np.ndarray:
    image = tifffile.imread(path).astype(np.float32) / 255
    front, back = box(30, 30, 8, 12, size=SIZE), box(4, 4, 8, 10, size=SIZE)
    options = {p.keyword: p.argument_of(p.default, SIZE) for p in MASK}
    planes = torch.from_numpy(image).permute(2, 0, 1)[None]
    return region_mask(planes, front, back, **options, generator=seeded())[0, 0].numpy()


def run(source: Path, target: Path, *more: str) -> int:
    return main(["mask", str(source), str(target), "--region", REGION, "--background", GROUND, *more])


def floats(path: Path) -> np.ndarray:
    """The plane in a PFM file."""
    head, size, scale, values = path.read_bytes().split(b"\n", 3)
    assert (head, size, scale) == (b"Pf", b"80 64", b"-1.0")
    return np.frombuffer(values, "<f4").reshape(SIZE)[::-1]


@pytest.mark.parametrize("memory", [[], ["--memory", "0.05"]], ids=["in memory", "in tiles"])
def test_it_prints_how_much_is_selected(
    photograph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], memory: list[str]
) -> None:
    assert run(photograph, tmp_path / "out.pfm", *memory) == 0
    printed = capsys.readouterr()
    told = re.search(r"selected: (\d+) % of the picture", printed.out)
    assert told is not None
    assert int(told[1]) == pytest.approx(100 * floats(tmp_path / "out.pfm").mean(), abs=1)
    assert "nearly all" not in printed.err
    even = tmp_path / "even.tif"
    tifffile.imwrite(even, np.full((*SIZE, 3), 120, np.uint8), photometric="rgb")
    assert main(["mask", str(even), str(tmp_path / "all.png"), "--region", REGION, *memory]) == 0
    printed = capsys.readouterr()
    assert "selected: 100 % of the picture" in printed.out
    assert "nearly all of the picture's borders are selected" in printed.err


def test_a_mask_may_be_painted_by_rectangles(photograph: Path, tmp_path: Path) -> None:
    painted = ["--add", "4,40,20,10", "--remove", "10,44,2,2"]
    for memory in ([], ["--memory", "0.05"]):
        assert run(photograph, tmp_path / "out.pfm", *painted, *memory) == 0
        wanted = expected(photograph)
        wanted[40:50, 4:24] = 1
        wanted[44:46, 10:12] = 0
        np.testing.assert_allclose(floats(tmp_path / "out.pfm"), wanted, atol=1e-4)
    assert main(["mask", str(photograph), str(tmp_path / "out.pfm"), *painted]) == 0
    assert floats(tmp_path / "out.pfm").sum() == 196


def test_files_of_every_kind(photograph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = expected(photograph)
    assert run(photograph, tmp_path / "out.png") == 0
    assert f"--background {GROUND}: 80 pixels" in capsys.readouterr().out
    with Image.open(tmp_path / "out.png") as opened:
        assert opened.mode == "L"
        np.testing.assert_allclose(np.asarray(opened) / 255, wanted, atol=1 / 255)
    assert run(photograph, tmp_path / "out.tif") == 0
    sixteen = tifffile.imread(tmp_path / "out.tif")
    assert sixteen.dtype == np.uint16
    np.testing.assert_allclose(sixteen / 65535, wanted, atol=1e-4)
    assert run(photograph, tmp_path / "out.pfm") == 0
    np.testing.assert_allclose(floats(tmp_path / "out.pfm"), wanted, atol=1e-5)


def test_an_object_is_cut_out(photograph: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = torch.from_numpy(tifffile.imread(photograph).astype(np.float32) / 255).permute(2, 0, 1)[None]
    wanted = cutout(image, torch.from_numpy(expected(photograph))[None, None])[0].permute(1, 2, 0).numpy()
    for name in ("cut.png", "cut.tif"):
        assert run(photograph, tmp_path / "out.png", "--cutout", str(tmp_path / name)) == 0
    with Image.open(tmp_path / "cut.png") as opened:
        assert opened.mode == "RGBA"
        np.testing.assert_allclose(np.asarray(opened) / 255, wanted, atol=0.5 / 255 + 1e-4)
    assert read_photograph(tmp_path / "cut.tif").alpha is not None
    sixteen = tmp_path / "sixteen.tif"
    tifffile.imwrite(sixteen, tifffile.imread(photograph).astype(np.uint16) * 257, photometric="rgb")
    monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_if_it_fits", lambda *_: None)
    assert run(sixteen, tmp_path / "out.pfm", "--cutout", str(tmp_path / "cut.png")) == 0
    cut = read_photograph(tmp_path / "cut.png")
    assert (cut.depth, cut.alpha is None) == ("uint16", False)
    shown = wanted[..., 3] > 0.05
    np.testing.assert_allclose(cut.pixels[0].permute(1, 2, 0).numpy()[shown], wanted[..., :3][shown], atol=0.02)


@pytest.mark.usefixtures("tiled")
def test_cut_outs_that_cannot_be_written(photograph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, sentence in (
        ("cut.jpg", "cannot hold this picture: JPEG has no alpha channel; write a PNG"),
        ("out.png", "--cutout must be another file than the output, got"),
        ("cut.pfm", "must end in .png, .jpg, .webp, .avif or .tif, got '.pfm'"),
    ):
        assert run(photograph, tmp_path / "out.png", "--cutout", str(tmp_path / name)) == 2
        assert sentence in capsys.readouterr().err
        assert sorted(file.name for file in tmp_path.iterdir()) == [photograph.name]


@pytest.mark.parametrize("verb", ["mask", "defocus", "detail"])
def test_masks_of_other_programs_are_read_from_files_of_every_kind(photograph: Path, tmp_path: Path, verb: str) -> None:
    plane = np.zeros(SIZE, np.float32)
    plane[20:50, 20:60] = 1
    write_pfm(tmp_path / "mask.pfm", plane)
    Image.fromarray((plane * 255).astype(np.uint8)).save(tmp_path / "mask8.png")
    write_photograph(Photograph(torch.from_numpy(plane)[None, None], "uint16"), tmp_path / "mask16.png")
    tifffile.imwrite(tmp_path / "mask.tif", (plane * 65535).astype(np.uint16))
    results = []
    for name in ("mask.pfm", "mask8.png", "mask16.png", "mask.tif"):
        assert main([verb, str(photograph), str(tmp_path / "out.png"), "--mask", str(tmp_path / name)]) == 0
        with Image.open(tmp_path / "out.png") as opened:
            results.append(np.asarray(opened))
        if name == "mask.pfm":
            edit = Step(verb, (Region.of_file(str(tmp_path / name), "mask", "in"),)) if verb == "defocus" else None
    assert all(np.array_equal(result, results[0]) for result in results)
    if edit is not None:
        (tmp_path / "edit.json").write_text(Recipe((edit,)).to_json())
        assert main(["apply", str(photograph), str(tmp_path / "out.png"), "--preset", str(tmp_path / "edit.json")]) == 0
        with Image.open(tmp_path / "out.png") as opened:
            np.testing.assert_array_equal(np.asarray(opened), results[0])


def test_a_rough_mask_becomes_a_soft_one(photograph: Path, tmp_path: Path) -> None:
    rough = np.zeros(SIZE, np.uint8)
    rough[20:50, 20:60] = 255
    Image.fromarray(rough).save(tmp_path / "rough.png")
    assert main(["mask", str(photograph), str(tmp_path / "out.png"), "--mask", str(tmp_path / "rough.png")]) == 0
    with Image.open(tmp_path / "out.png") as opened:
        assert np.asarray(opened)[20:50, 20:60].min() > 240


def test_tiles(photograph: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_if_it_fits", lambda *_: None)
    assert run(photograph, tmp_path / "out.tif") == 0
    mask = tifffile.imread(tmp_path / "out.tif")
    assert mask.shape == SIZE
    np.testing.assert_allclose(mask / 65535, expected(photograph), atol=0.02)
    assert run(photograph, tmp_path / "out.pfm") == 0
    np.testing.assert_allclose(floats(tmp_path / "out.pfm"), mask / 65535, atol=1e-4)


@pytest.mark.usefixtures("tiled")
def test_depths_of_floats(photograph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for depth in ("8", "16"):
        assert run(photograph, tmp_path / "out.pfm", "--depth", depth) == 2
        told = capsys.readouterr().err
        assert f"--depth must be float for a .pfm file, got {depth}; leave it out, or write a .tif or .png file" in told
        assert not (tmp_path / "out.pfm").exists()
    assert run(photograph, tmp_path / "out.pfm", "--depth", "float") == 0


@pytest.mark.parametrize(
    ("name", "depth", "kind"),
    [
        ("a.png", None, "uint8"),
        ("a.tif", None, "uint16"),
        ("a.TIFF", None, "uint16"),
        ("a.tif", "8", "uint8"),
        ("a.png", "16", "uint16"),
        ("a.tif", "float", "float32"),
    ],
)
def test_depth_of_a_file(name: str, depth: FileDepth | None, kind: str) -> None:
    job = MaskJob({}, "in.png", Path(name), ScribbleOptions(), None, 0, None, False, depth)
    assert job.kind == kind
    assert not job.floats
    job.check_depth()
