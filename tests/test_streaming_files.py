"""Files that are read and written by rows: every layout of TIFF, zarr, and what happens when something breaks."""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import skimage.data
import tifffile
import torch
import zarr
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from nlfilter_torch import tiff
from nlfilter_torch.cli import main
from nlfilter_torch.exif import upright
from nlfilter_torch.files import Photograph, read_photograph, write_photograph
from nlfilter_torch.streaming import files as streaming_files
from nlfilter_torch.streaming.files import StoredPicture, open_picture, write_picture
from nlfilter_torch.streaming.tiff_rows import TiffRows

Array = NDArray[Any]
PLENTY = 1 << 30
PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
LITTLE = "0.03"  # gigabytes: less than the picture takes whole, more than it takes by rows in small blocks


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples and blocks in proportion to small pictures."""
    monkeypatch.setattr("nlfilter_torch.streaming.sampling.PILOT", 8000)
    monkeypatch.setattr("nlfilter_torch.streaming.rows.STATISTICS_PIXELS", 6000)


def cat(height: int = 200, width: int = 150, channels: int = 3) -> Array:
    """(height, width, channels) of 8 bits; the fourth channel is a ramp."""
    picture = skimage.data.chelsea()[20 : 20 + height, 90 : 90 + width]
    ramp = np.broadcast_to(np.arange(width, dtype=np.uint8)[:, None], (height, width, 1))
    return np.ascontiguousarray(np.concatenate([picture, ramp], axis=2)[..., :channels])


def rows_of(path: Path, step: int = 37) -> Array:
    with open_picture(path, PLENTY) as picture:
        height = picture.shape[0]
        parts = [picture.rows[slice(top, min(top + step, height))] for top in range(0, height, step)]
        return np.concatenate(parts)


@pytest.mark.parametrize(
    "layout",
    [
        {},
        {"compression": "zlib", "predictor": True, "rowsperstrip": 7},
        {"compression": "lzw", "tile": (32, 48)},
        {"tile": (64, 64)},
        {"rowsperstrip": 16},
        {"planarconfig": "separate"},
        {"planarconfig": "separate", "tile": (32, 32), "compression": "zlib"},
        {"bigtiff": True, "byteorder": ">", "compression": "zlib", "tile": (128, 128)},
        {"byteorder": ">"},
        {"compression": "jpeg", "tile": (64, 64)},
    ],
)
def test_rows_of_every_layout_of_tiff(tmp_path: Path, layout: dict[str, Any]) -> None:
    picture = cat() if layout.get("compression") == "jpeg" else cat().astype(np.uint16) * 250
    tifffile.imwrite(
        tmp_path / "in.tif",
        np.moveaxis(picture, 2, 0) if "planarconfig" in layout else picture,
        photometric="rgb",
        **layout,
    )
    whole = read_photograph(tmp_path / "in.tif").pixels[0].permute(1, 2, 0).numpy()
    white = 255 if picture.dtype == np.uint8 else 65535
    np.testing.assert_array_equal(rows_of(tmp_path / "in.tif"), np.rint(whole * white).astype(picture.dtype))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_rows_are_upright(tmp_path: Path, orientation: int) -> None:
    picture = cat(90, 60)
    tags = [(274, "H", 1, orientation, True)]
    tifffile.imwrite(tmp_path / "in.tif", picture, photometric="rgb", extratags=tags, rowsperstrip=10)
    np.testing.assert_array_equal(rows_of(tmp_path / "in.tif"), upright(picture, orientation))


def test_grey_floats_white_at_zero_and_multiplied_alpha(tmp_path: Path) -> None:
    grey = cat(channels=1)[..., 0]
    tifffile.imwrite(tmp_path / "float.tif", grey / np.float32(255), photometric="minisblack")
    np.testing.assert_allclose(rows_of(tmp_path / "float.tif")[..., 0] * 255, grey, rtol=1e-6)
    tifffile.imwrite(tmp_path / "white.tif", grey, photometric="miniswhite", tile=(32, 32))
    np.testing.assert_array_equal(rows_of(tmp_path / "white.tif")[..., 0], 255 - grey)
    tifffile.imwrite(tmp_path / "alpha.tif", cat(channels=4), photometric="rgb", extrasamples=["assocalpha"])
    whole = read_photograph(tmp_path / "alpha.tif")
    assert whole.alpha is not None
    wanted = torch.cat([whole.pixels, whole.alpha], 1)[0].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(rows_of(tmp_path / "alpha.tif"), np.rint(wanted * 255))


def test_tiles_that_a_sparse_file_leaves_out_are_black(tmp_path: Path) -> None:
    tile = cat(64, 64)
    tiles = iter([tile, None, None, tile])
    tifffile.imwrite(tmp_path / "in.tif", tiles, shape=(128, 128, 3), dtype=np.uint8, tile=(64, 64), photometric="rgb")
    rows = rows_of(tmp_path / "in.tif")
    np.testing.assert_array_equal(rows[:64, :64], tile)
    np.testing.assert_array_equal(rows[64:, 64:], tile)
    assert not rows[:64, 64:].any()
    assert not rows[64:, :64].any()


def test_a_part_of_a_tiff_is_read_without_the_rest(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", cat(), photometric="rgb", tile=(32, 32), compression="zlib")
    with TiffRows(tmp_path / "in.tif") as rows:
        rows[slice(70, 80)]
        assert list(rows.bands) == [2]
        rows[slice(60, 130)]
        assert list(rows.bands) == [3, 4]
        assert rows.held == 3 * 32 * 150 * 3


def test_a_tiff_in_one_piece_needs_memory_for_it(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", cat(), photometric="rgb", rowsperstrip=200, compression="zlib")
    with pytest.raises(MemoryError, match=r"can only be read in pieces of 0 MB, .* save it in tiles"):
        open_picture(tmp_path / "in.tif", 100_000).__enter__()


@pytest.mark.parametrize("suffix", [".tif", ".zarr", ".png"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_writing_rows_keeps_everything(tmp_path: Path, suffix: str, channels: int) -> None:
    picture = cat(270, 350, 4)[..., [0] if channels == 1 else [0, 3] if channels == 2 else slice(channels)]
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    like = StoredPicture(picture, channels in (2, 4), 0, PROFILE, exif.tobytes(), {"stain": "H&E"})
    parts = ((slice(top, min(top + 41, 270)), picture[top : top + 41]) for top in range(0, 270, 41))
    path = tmp_path / f"out{suffix}"
    write_picture(path, parts, "uint8", like)
    np.testing.assert_array_equal(rows_of(path).reshape(picture.shape), picture)
    with open_picture(path, PLENTY) as written:
        assert written.shape == picture.shape
        assert written.alpha == (channels in (2, 4))
        if suffix == ".zarr":
            assert written.attributes == {"stain": "H&E"}
        else:
            assert written.icc == PROFILE
            assert written.exif is not None
            assert b"Maker" in written.exif
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_large_file_becomes_a_bigtiff(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff, "CLASSIC", 1000)
    picture = cat()
    write_picture(tmp_path / "out.tif", iter([(slice(0, 200), picture)]), "uint8", StoredPicture(picture, False, 0))
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.is_bigtiff
        assert file.pages.first.is_tiled
    np.testing.assert_array_equal(rows_of(tmp_path / "out.tif"), picture)


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """An RGBA file of 16 bits with a profile, 300x200."""
    picture = cat(200, 300, 4).astype(np.float32) / 255
    planes = torch.from_numpy(picture).permute(2, 0, 1)[None]
    photograph = Photograph(planes[:, :3], "uint16", planes[:, 3:], PROFILE)
    write_photograph(photograph, tmp_path / "in.tif")
    return tmp_path / "in.tif"


def detail(*arguments: object) -> int:
    return main(["detail", *map(str, arguments), "--landmarks", "40"])


@pytest.mark.parametrize("suffix", [".tif", ".png"])
@pytest.mark.parametrize("options", [(), ("--channels", "all", "--depth", "8"), ("--region", "40,60,20,20:0,1,1,1")])
def test_detail_by_rows_is_detail(photo: Path, tmp_path: Path, suffix: str, options: tuple[str, ...]) -> None:
    source = photo.with_suffix(suffix)
    write_photograph(read_photograph(photo), source)
    whole, rows = tmp_path / f"whole{suffix}", tmp_path / f"rows{suffix}"
    assert detail(source, whole, *options) == 0
    assert detail(source, rows, *options, "--memory", LITTLE, "--full") == 0
    one, other = read_photograph(whole), read_photograph(rows)
    assert (one.pixels - other.pixels).abs().max() < (1.1 / 255 if "8" in options else 1e-4)
    assert one.alpha is not None
    assert other.alpha is not None
    assert torch.equal(one.alpha, other.alpha)
    assert (one.depth, one.icc) == (other.depth, other.icc)


def test_detail_by_rows_happens_by_itself(photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = psutil.virtual_memory()._replace(available=int(25e6))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    assert detail(photo, tmp_path / "out.tif") == 0
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.pages.first.is_tiled


def test_a_mask_of_the_picture_is_read_by_rows(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mask = np.zeros((200, 300), np.uint8)
    mask[60:80, 40:60] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    options = ("--alpha", "0,1,1,1", "--memory", LITTLE)
    assert detail(photo, tmp_path / "mask.tif", "--mask", tmp_path / "mask.png", *options) == 0
    assert detail(photo, tmp_path / "region.tif", "--region", "40,60,20,20", *options) == 0
    one, other = (read_photograph(tmp_path / name).pixels for name in ("mask.tif", "region.tif"))
    assert torch.equal(one, other)
    Image.fromarray(mask[1:]).save(tmp_path / "small.png")
    assert detail(photo, tmp_path / "out.tif", "--mask", tmp_path / "small.png", "--memory", LITTLE) == 2
    assert "small.png must be as large as the photograph, 300x200, but is 300x199" in capsys.readouterr().err


def test_zarr_in_and_out(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = cat(200, 300)
    zarr.create_array(store=tmp_path / "in.zarr", data=picture, chunks=(64, 64, 3))
    write_photograph(Photograph(torch.from_numpy(picture).permute(2, 0, 1)[None] / 255), tmp_path / "in.png")
    for _ in range(2):  # the second time it takes the place of the first
        assert detail(tmp_path / "in.zarr", tmp_path / "out.zarr", "--full") == 0
    assert detail(tmp_path / "in.png", tmp_path / "out.png") == 0
    wanted = read_photograph(tmp_path / "out.png").pixels[0].permute(1, 2, 0).numpy() * 255
    assert np.abs(zarr.open_array(tmp_path / "out.zarr", mode="r")[:] - wanted).max() < 1.01
    assert not list(tmp_path.glob(".*"))

    (tmp_path / "folder.zarr").mkdir()
    for source, target, message in (
        ("in.zarr", "folder.zarr", "is a folder, but no array of zarr that could be replaced"),
        ("folder.zarr", "new.zarr", "is no array of zarr"),
        ("none.zarr", "new.zarr", "is no array of zarr"),
        ("in.zarr", "no/new.zarr", "does not exist; make it first"),
        ("in.zarr", "new.gif", "must end in .png, .jpg, .webp or .tif"),
    ):
        assert detail(tmp_path / source, tmp_path / target) == 2
        assert message in capsys.readouterr().err
    zarr.create_array(store=tmp_path / "line.zarr", data=np.zeros(5))
    assert detail(tmp_path / "line.zarr", tmp_path / "new.zarr") == 2
    assert "line.zarr must have the shape (H, W) or (H, W, S), got (5,)" in capsys.readouterr().err


def test_zarr_is_needed_for_zarr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert detail(tmp_path / "in.zarr", tmp_path / "out.zarr") == 2
    assert "install nlfilter-torch[zarr]" in capsys.readouterr().err


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The sentence of a `detail` that fails, which must leave no trace in the folder of its output."""
    folder = Path(str(arguments[1])).parent
    before = set(folder.iterdir())
    assert detail(*arguments) == 2
    assert set(folder.iterdir()) == before
    return capsys.readouterr().err


@pytest.mark.parametrize("how", ["cut", "grown"])
def test_a_file_that_changes_while_it_is_read_is_named(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    read, calls = TiffRows._decode, []

    def change(self: TiffRows, first: int, last: int) -> Array:
        calls.append(first)
        if len(calls) == 3:
            with photo.open("r+b") as stream:
                stream.truncate(3000 if how == "cut" else 3 * photo.stat().st_size)
        self.bands.clear()
        return read(self, first, last)

    monkeypatch.setattr(TiffRows, "_decode", change)
    size = photo.stat().st_size
    sentence = refused(capsys, photo, tmp_path / "out.tif", "--memory", LITTLE)
    assert f"in.tif changed while it was read, from {size} to " in sentence


def test_a_zarr_array_that_changes_its_shape_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    array = zarr.create_array(store=tmp_path / "in.zarr", data=cat(), chunks=(64, 64, 3))
    with open_picture(tmp_path / "in.zarr", PLENTY) as picture:
        picture.rows[slice(0, 10)]
        array.resize((100, 150, 3))
        with pytest.raises(ValueError, match=r"in\.zarr changed while it was read, from the shape \(200, 150, 3\)"):
            picture.rows[slice(10, 20)]


def test_damage_in_the_middle_is_named(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with tifffile.TiffFile(photo) as file:
        offset = file.pages.first.dataoffsets[-1]
    content = bytearray(photo.read_bytes())
    content[offset : offset + 50] = bytes(50)
    photo.write_bytes(content)
    sentence = refused(capsys, photo, tmp_path / "out.tif", "--memory", LITTLE)
    assert "in.tif is damaged or cut short" in sentence


@pytest.mark.parametrize("target", ["out.tif", "out.png", "out.zarr"])
def test_a_full_disk_is_named(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], file_limit: Any, target: str
) -> None:
    with file_limit(20_000):
        sentence = refused(capsys, photo, tmp_path / target, "--memory", LITTLE)
    assert f"{target} cannot be written: File too large; make room there or write elsewhere" in sentence


@pytest.fixture
def file_limit() -> Any:
    """A limit in bytes to the size of files, which a full disk has, too."""
    from contextlib import contextmanager

    @contextmanager
    def limit(size: int) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limit


def test_a_folder_that_cannot_be_written_is_named(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    for target in ("out.tif", "out.zarr"):
        sentence = refused(capsys, photo, tmp_path / target, "--memory", LITTLE)
        assert "is read-only; choose another" in sentence


def test_what_is_too_large_to_be_put_together_is_named(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "needs " in refused(capsys, photo, tmp_path / "out.tif", "--memory", "0.001")
    sentence = refused(capsys, photo, tmp_path / "out.png", "--memory", "0.003")
    assert "out.png takes 4 MB to be put together, but 3 MB may be used; write a TIFF file, or allow more" in sentence
    write_photograph(read_photograph(photo), photo.with_suffix(".png"))
    sentence = refused(capsys, photo.with_suffix(".png"), tmp_path / "out.tif", "--memory", "0.0001")
    assert "in.png has 300x200 pixels and needs about" in sentence
    for wrong in ("0", "-1", "nan", "inf"):
        assert "--memory must be a positive number" in refused(capsys, photo, tmp_path / "o.tif", "--memory", wrong)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("target", ["out.tif", "out.zarr"])
def test_interrupted_work_leaves_nothing_that_looks_finished(
    photo: Path, tmp_path: Path, number: signal.Signals, target: str
) -> None:
    program = (
        "import sys, time\n"
        "from nlfilter_torch.streaming import detail, rows, tiles\n"
        "def slow(original):\n"
        "    def edit(*arguments):\n"
        "        time.sleep(0.05)\n"
        "        return original(*arguments)\n"
        "    return edit\n"
        "detail._edit, tiles.TILE_PIXELS = slow(detail._edit), 300\n"
        "tiles.sampling.PILOT = rows.STATISTICS_PIXELS = 8000\n"
        "from nlfilter_torch.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    arguments = ["detail", str(photo), str(tmp_path / target), "--landmarks", "40", "--memory", LITTLE]
    process = subprocess.Popen([sys.executable, "-c", program, *arguments], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob(f".{target}.*.part")):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.send_signal(number)
        assert process.wait(60) != 0
    finally:
        process.kill()
        process.wait()
    assert not (tmp_path / target).exists()
    left = list(tmp_path.glob(".*"))
    assert bool(left) == (number == signal.SIGKILL)  # only what could not tidy up leaves a hidden part


def test_report_of_progress_is_drawn_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    from rich.console import Console

    from nlfilter_torch.cli import progress

    shown = Console(force_terminal=True, width=80, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
    monkeypatch.setattr(progress, "Console", lambda stderr: shown)
    with progress.stages() as report:
        report("Looking", 1, 4)
        report("Filtering", 3, 4)
    text = shown.export_text()
    shown.file.close()
    assert "Filtering" in text
    assert "75%" in text


def test_free_memory_leaves_some(monkeypatch: pytest.MonkeyPatch) -> None:
    free = psutil.virtual_memory()._replace(available=1000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    assert streaming_files.free_memory() == 800
