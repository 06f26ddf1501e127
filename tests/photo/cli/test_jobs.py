"""Edits of single photographs by commands: the results of the functions, the same in tiles, and refusals."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import tifffile
import torch
from PIL import Image

from nlfilter_torch import standard_error
from nlfilter_torch.photo import abstract, adjust_tone, colorize, defocus, denoise, enhance, recolor, sharpen
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.jobs import ChangeMeter, EditJob, squared_difference, write_map
from nlfilter_torch.photo.cli.options import PhotographOptions
from nlfilter_torch.photo.cli.scribbles import ScribbleOptions
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.picture import sampling
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.problems import box, seeded

SIZE = HEIGHT, WIDTH = 48, 64
LANDMARKS = ("--landmarks", "40")
LITTLE = "0.014"  # gigabytes: less than the whole scan needs, more than small blocks of rows need
GREEN = torch.tensor([20, 160, 40]).view(1, 3, 1, 1) / 255


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


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of 16 bits, 180x150, beside strokes over it in two files, and a copy in grey."""
    monkeypatch.setattr(sampling, "PILOT", 8000)
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 6000)
    picture = skimage.data.chelsea()[20:170, 90:270].astype(np.uint16) * 257
    tifffile.imwrite(tmp_path / "in.tif", picture, photometric="rgb", tile=(64, 64), compression="zlib")
    tifffile.imwrite(tmp_path / "grey.tif", picture[..., 1], photometric="minisblack")
    layer = np.zeros((150, 180, 4), np.uint8)
    layer[60:70, 40:50], layer[110:120, 100:120] = (0, 0, 255, 255), (255, 0, 0, 255)
    Image.fromarray(layer).save(tmp_path / "paint.png")
    tifffile.imwrite(tmp_path / "paint.tif", layer, photometric="rgb", extrasamples=["unassalpha"], tile=(64, 64))
    tifffile.imwrite(tmp_path / "mask.tif", layer[..., 2], photometric="minisblack", tile=(64, 64))
    return tmp_path / "in.tif"


def patch(top: int, left: int, height: int, width: int) -> torch.Tensor:
    return box(top, left, height, width, SIZE)


def run(verb: str, source: Path, *arguments: object) -> torch.Tensor:
    out = source.parent / "out.png"
    assert main([verb, str(source), str(out), *map(str, arguments), *LANDMARKS]) == 0
    edited = read_photograph(out).pixels
    out.unlink()
    return edited


def by_command(verb: str, *arguments: object) -> int:
    return main([verb, *map(str, arguments), "--landmarks", "40"])


def is_written(edited: torch.Tensor, wanted: torch.Tensor) -> bool:
    """Check that a file equals the expected image, to the rounding of eight bits."""
    return bool((edited - wanted.clamp(0, 1)).abs().max() < 0.6 / 255)


def test_recolor(photo: Path, strokes: Path, pixels: torch.Tensor) -> None:
    mask = patch(8, 10, 6, 8)
    wanted = recolor(pixels, GREEN * mask, mask, num_landmarks=40, generator=seeded())
    assert is_written(run("recolor", photo, "--strokes", strokes), wanted)
    assert is_written(run("recolor", photo, "--region", "10,8,8,6:rgb(20,160,40)"), wanted)
    assert is_written(run("recolor", photo, "--region", "10,8,8,6:red", "--region", "10,8,8,6:#14a028"), wanted)
    keep = patch(30, 40, 8, 8)
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
    mask = patch(8, 10, 6, 8)
    for method in ("regression", "kmeans"):
        wanted = colorize(grey, GREEN * mask, mask, method=method, strength=0.7, num_landmarks=40, generator=seeded())
        arguments = ("--strokes", strokes, "--method", method, "--strength", 0.7)
        assert (
            run("colorize", tmp_path / "grey.png", *arguments) - wanted
        ).abs().max() < 1.5e-3  # the file has 16 bits
        assert "note" not in capsys.readouterr().err
        assert (run("colorize", photo, *arguments) - wanted).abs().max() < 1 / 255
        assert f"note: {photo} is in colour: colorize replaces its colours everywhere" in capsys.readouterr().err
    assert main(["colorize", str(tmp_path / "grey.png"), str(tmp_path / "c.png"), "--strokes", str(strokes)]) == 0
    written = read_photograph(tmp_path / "c.png")
    assert (written.depth, written.icc) == ("uint16", None)


def test_defocus(photo: Path, pixels: torch.Tensor, tmp_path: Path) -> None:
    region = patch(10, 20, 12, 16)
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
    background = patch(30, 40, 8, 8)
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
    regions = torch.cat([patch(8, 10, 6, 8), patch(30, 40, 8, 8)], dim=1)
    wanted = enhance(pixels, torch.stack([sliders, own]), regions, reach=0.75, num_landmarks=40)
    arguments = ("--alpha", "4,3,1", "--region", "10,8,8,6", "--region", "40,30,8,8:0,0.5,1", "--reach", 0.75)
    assert is_written(run("detail", photo, *arguments), wanted)
    write_photograph(Photograph(regions[:, :1]), tmp_path / "mask.png")
    whole = run("detail", photo, "--alpha", "4,3,1")
    part = run("detail", photo, "--alpha", "4,3,1", "--mask", tmp_path / "mask.png")
    assert is_written(part, enhance(pixels, sliders, regions[:, :1], num_landmarks=40))
    assert not torch.equal(part, whole)


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


@pytest.mark.filterwarnings("always::UserWarning")
def test_the_scale_of_floats_is_noted(
    pixels: torch.Tensor, tmp_path: Path, tiled: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "in.tif"
    write_photograph(Photograph(255 * pixels, "float32"), source)
    assert main(["recolor", str(source), str(tmp_path / "out.tif"), "--region", "1,2,5,4:red"]) == 0
    noted = capsys.readouterr().err
    assert noted.count("must be in or near [0, 1]") == 1
    assert "divide by the value of white" in noted
    assert main(["tone", str(source), str(tmp_path / "out.tif"), "--contrast", "1.2"]) == 0
    assert "must be in or near [0, 1]" not in capsys.readouterr().err  # it is seen in the range that it uses


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
        ("denoise", "in.tif", ("--method", "rule", "--colour", "0.4", "--noise-level", "6")),
        ("denoise", "grey.tif", ("--method", "rule", "--noise-level", "5")),
        ("abstract", "in.tif", ("--edges", "1", "--tones", "8")),
        ("abstract", "grey.tif", ()),
        ("defocus", "in.tif", ("--region", "80,60,20,20", "--region", "100,90,9,9")),
        ("defocus", "in.tif", ("--mask", "mask.tif", "--aperture", "gaussian")),
        ("defocus", "in.tif", ("--region", "80,60,20,20", "--background", "5,5,20,20")),
    ],
)
def test_by_rows_as_whole(scan: Path, verb: str, source: str, options: tuple[str, ...]) -> None:
    folder = scan.parent
    options = tuple(str(folder / word) if word.startswith(("paint", "mask")) else word for word in options)
    for name, more in (("whole.tif", ()), ("rows.tif", ("--memory", LITTLE, "--full"))):
        assert by_command(verb, folder / source, folder / name, *options, *more) == 0
    with tifffile.TiffFile(folder / "rows.tif") as file:
        assert file.pages.first.is_tiled  # what is written by rows is
    whole, by_rows = (read_photograph(folder / name) for name in ("whole.tif", "rows.tif"))
    assert whole.depth == by_rows.depth
    assert (whole.pixels - read_photograph(folder / source).pixels).abs().max() > 0.01
    # Masks divide by small weights at single pixels, where rounding counts: one value of defocus differs by 1.4e-4.
    limit = {"recolor": 1e-3, "defocus": 2e-4}.get(verb, 1e-4)
    assert (whole.pixels - by_rows.pixels).abs().max() < (1.1 / 255 if "8" in options else limit)


def test_what_cannot_be_done_by_rows_leaves_nothing(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = scan.parent
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
        assert by_command(verb, folder / source, folder / "out.tif", *options, "--memory", LITTLE) == 2
        assert sentence in capsys.readouterr().err
    assert by_command("recolor", scan, folder / "out.tif", "--region", "1,2,5,4:red", "--memory", "0") == 2
    assert "--memory must be a positive number" in capsys.readouterr().err
    assert set(folder.iterdir()) == files


def job(step: Step, *, region: list[str] | None = None) -> EditJob:
    return EditJob("in.png", "out.png", PhotographOptions(), False, step, ScribbleOptions(region))


def test_what_is_known_before_the_photograph_is_read() -> None:
    detail = Step("detail", alpha=(2.0, 1.0))
    plain, regional = (job(detail, region=region).bytes_per_pixel for region in (None, ["1,2,3,4"]))
    assert plain == detail.bytes_per_pixel()
    assert regional == detail.bytes_per_pixel(masked=True) > plain
    defocused = Step("defocus")
    assert job(defocused, region=["1,2,3,4"]).bytes_per_pixel == defocused.bytes_per_pixel()
    assert job(Step("colorize")).coloured
    assert not job(detail).coloured


def test_the_same_pixels_in_memory_and_from_a_file(photo: Path, pixels: torch.Tensor) -> None:
    edit = EditJob(str(photo), "", PhotographOptions(), False, Step("tone", contrast=1.3), ScribbleOptions())
    wanted = adjust_tone(pixels, contrast=1.3, generator=seeded())
    assert (edit.edited(read_photograph(photo)) - wanted).abs().max() < 1e-5


def test_the_noise_of_a_faint_picture_is_told_as_a_share_of_its_range(
    pixels: torch.Tensor, tmp_path: Path, tiled: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    noisy = pixels + 0.1 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0))
    for name, scale, unit in (
        ("in.png", 0.01, r"0\.\d+ grey levels"),
        ("in.tif", 60000.0, r"\d+ \(in values of the file\)"),
    ):
        source, target = tmp_path / name, tmp_path / f"out-{name}"
        write_photograph(Photograph(scale * noisy, "uint16" if scale < 1 else "float32"), source)
        assert main(["denoise", str(source), str(target), "--noise-level", "0.2"]) == 0
        told = capsys.readouterr().out
        share = r"[\d.e-]+ % of the range in use"
        assert re.search(rf"given noise of .+, {share}.*; ", told)
        assert main(["denoise", str(source), str(target)]) == 0
        told = capsys.readouterr().out
        assert re.search(rf"estimated noise of {unit}, {share}|no pixel changed", told), told


def write(path: Path, noise: float, *, alpha: bool = False) -> Path:
    ramp = torch.linspace(0.2, 0.8, 96).expand(1, 3, 64, 96)
    pixels = ramp + noise / 255 * torch.randn(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    write_photograph(
        Photograph(pixels.clamp(0, 1), "uint16", torch.full_like(pixels[:, :1], 0.5) if alpha else None), path
    )
    return path


def grey_levels(path: Path) -> np.ndarray:
    levels: np.ndarray = tifffile.imread(path).astype(float) / 257
    return levels


@pytest.mark.parametrize("alpha", [False, True])
def test_estimated_noise_and_the_change_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], tiled: bool, alpha: bool
) -> None:
    photo, out = write(tmp_path / "in.tif", 10.0, alpha=alpha), tmp_path / "out.tif"
    assert main(["denoise", str(photo), str(out), "--landmarks", "40", *(["--full"] if tiled else [])]) == 0
    said = re.fullmatch(
        r"denoise: estimated noise of ([\d.]+) grey levels; (\d+) % of the finest grain kept \(--grain\); "
        r"pixels changed by ([\d.]+) grey levels \(RMS\)\n",
        capsys.readouterr().out,
    )
    assert said is not None
    assert float(said[1]) == pytest.approx(10, abs=0.6)
    assert int(said[2]) == round(80 / float(said[1]))
    before, after = grey_levels(photo)[..., :3], grey_levels(out)[..., :3]
    change = np.sqrt(np.square(after - before).mean())
    assert change > 2
    assert float(said[3]) == pytest.approx(change, abs=0.02)


def test_nothing_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str], tiled: bool) -> None:
    photo, out = write(tmp_path / "in.tif", 0.0), tmp_path / "out.tif"
    assert main(["denoise", str(photo), str(out), "--landmarks", "40"]) == 0
    assert "estimated noise of 0.00 grey levels, less than 0.1; no pixel changed: " in capsys.readouterr().out
    np.testing.assert_array_equal(grey_levels(photo), grey_levels(out))


def test_a_chosen_level_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = write(tmp_path / "in.tif", 2.0)
    arguments = ["denoise", str(photo), str(tmp_path / "out.tif"), "--landmarks", "40", "--noise-level"]
    assert main([*arguments, "3"]) == 0
    assert "given noise of 3.00 grey levels; pixels changed by" in capsys.readouterr().out
    assert main([*arguments, "0.2"]) == 0
    assert "which is barely visible\n" in capsys.readouterr().out


def test_little_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = write(tmp_path / "in.tif", 0.3)
    assert main(["denoise", str(photo), str(tmp_path / "out.png"), "--landmarks", "40"]) == 0
    assert "which is barely visible, as is the noise\n" in capsys.readouterr().out  # a clean one has none to remove
    with Image.open(tmp_path / "out.png") as opened:
        assert opened.size == (96, 64)


def test_denoise_recommends_only_more_strength(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = torch.randn(1, 3, 64, 96, generator=torch.Generator().manual_seed(0)) * 0.52 / 255
    rough = torch.linspace(0.1, 0.9, 96) + noise
    source = tmp_path / "in.tif"
    write_photograph(Photograph(rough, "float32"), source)
    for strength, recommended in ((1, True), (2, False), (0, False)):
        assert main(["denoise", str(source), str(tmp_path / "out.tif"), "--strength", str(strength)]) == 0
        printed = capsys.readouterr().out
        assert ("--strength 2 removes more" in printed) == recommended


@pytest.mark.parametrize(
    ("arguments", "note"),
    [
        (["--brightness", "0"], "in.png is grey: with brightness 0 all of its noise is left"),
        (["--colour", "0.5"], "in.png is grey: colour changes nothing"),
        (["--brightness", "0.5"], None),
    ],
)
def test_a_grey_photograph_has_no_coloured_noise(
    arguments: list[str], note: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "in.png"
    grey = torch.linspace(0.1, 0.9, 96) + torch.randn(1, 1, 64, 96, generator=torch.Generator().manual_seed(0)) / 50
    write_photograph(Photograph(grey.clamp(0, 1)), source)
    assert main(["denoise", str(source), str(tmp_path / "out.png"), *arguments]) == 0
    printed = capsys.readouterr()
    assert "removes more" not in printed.out
    assert printed.err == ("" if note is None else f"nlfilter-torch: note: {tmp_path}/{note}\n")


def test_the_change_is_a_root_mean_square_in_grey_levels() -> None:
    meter = ChangeMeter()
    assert meter.change == 0
    before = np.zeros((4, 5, 3), np.uint8)
    meter.add(squared_difference(before, before + np.uint8(3)))
    assert meter.change == pytest.approx(3)
    meter.add(squared_difference(before, before + np.uint8(4)))  # as many values
    assert meter.change == pytest.approx(12.5**0.5)
    meter.add(squared_difference(before[:0], before[:0]))
    assert meter.change == pytest.approx(12.5**0.5)


def test_differences_are_compared_in_the_depth_of_each_file() -> None:
    rows = np.random.default_rng(0).integers(0, 256, (6, 7, 3)).astype(np.uint8)
    for same in (rows.astype(np.uint16) * 257, rows / np.float32(255)):
        squares, count = squared_difference(rows, same)
        assert squares < 1e-10
        assert count == 6 * 7 * 3


def test_transparency_is_not_compared() -> None:
    before, after = np.zeros((4, 5, 4), np.uint8), np.zeros((4, 5, 4), np.uint8)
    after[..., 3] = 255
    assert squared_difference(before, after) == (0, 0)
    before[1:, :, 3] = 1
    assert squared_difference(before, after) == (0, 45)
    assert squared_difference(before[..., 2:], after[..., 2:]) == (0, 15)  # grey


def neighbours(image: torch.Tensor) -> torch.Tensor:
    """A map that depends on two pixels around each."""
    return torch.nn.functional.avg_pool2d(image.mean(1, keepdim=True), 5, 1, 2, count_include_pad=False)


def test_a_map_has_no_seams(tmp_path: Path) -> None:
    image = torch.rand(1, 3, 600, 20, generator=torch.Generator().manual_seed(0))
    read: list[int] = []

    def rows(part: slice) -> torch.Tensor:
        read.append(part.stop - part.start)
        return image[..., part, :]

    write_map(neighbours, Rows("in.tif", (600, 20), 3, rows), tmp_path / "map.png")
    stored = read_photograph(tmp_path / "map.png")
    assert stored.depth == "uint16"
    assert (stored.pixels - neighbours(image)).abs().max() < 1e-5
    assert max(read) < 600 <= sum(read)


def test_errors_of_denoised_pixels_in_units_of_the_picture(photo: Path, pixels: torch.Tensor, tmp_path: Path) -> None:
    out, errors = tmp_path / "out.png", tmp_path / "errors.tif"
    arguments = ["--noise-level", "8", "--brightness", "0.7"]
    assert main(["denoise", str(photo), str(out), "--error-map", str(errors), *arguments]) == 0
    stored = read_photograph(errors)
    assert stored.depth == "float32"
    edit = partial(denoise, noise_level=8 / 255, brightness=0.7)
    torch.testing.assert_close(stored.pixels, standard_error(edit, pixels, 8 / 255), rtol=1e-3, atol=1e-6)
    # A picture that uses another range is seen in that range, and its errors are in its own units.
    wide, large = tmp_path / "wide.tif", tmp_path / "large.tif"
    write_photograph(Photograph(100 * pixels, "float32"), wide)
    for path, target in ((photo, errors), (wide, large)):
        assert main(["denoise", str(path), str(tmp_path / "out.tif"), "--error-map", str(target)]) == 0
    ratio = float(read_photograph(large).pixels.mean() / read_photograph(errors).pixels.mean())
    assert 50 < ratio < 200


def test_errors_are_of_pixels_in_memory(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, errors = tmp_path / "out.tif", tmp_path / "errors.tif"
    for options, sentence in (
        (["--memory", "0.001"], f"--error-map must be used with a photograph that fits in memory, got {photo}, which"),
        (["--pages"], "--pages must be used with a TIFF file as OUT and without --show, --map and --error-map, got"),
        (["--map", str(errors)], "--error-map must be another file than the map"),
    ):
        assert main(["denoise", str(photo), str(out), "--error-map", str(errors), *options]) == 2
        assert sentence in " ".join(capsys.readouterr().err.split())
        assert not out.exists()
        assert not errors.exists()
