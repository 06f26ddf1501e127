"""Commands that edit a photograph by rows."""

import os
import resource
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import tifffile
import torch
import zarr
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.files.tiff import TiffRows
from nlfilter_torch.photo.picture import pictures, tiles
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.files import PROFILE, Array, cat
from tests.pairwise import each_value
from tests.ranks import forked

LITTLE = "0.03"  # gigabytes: less than the whole picture needs, more than small blocks of rows need


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce samples and blocks in proportion to small pictures."""
    monkeypatch.setattr("nlfilter_torch.photo.picture.sampling.PILOT", 8000)
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 6000)


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


@pytest.mark.usefixtures("tiled")
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("kind", "note"), [(tifffile.FILETYPE.REDUCEDIMAGE, False), (tifffile.FILETYPE.PAGE, True)], ids=["reduced", "page"]
)
def test_of_several_pages_the_first_is_edited(
    tmp_path: Path,
    kind: int,
    note: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A reduced version of the photograph is no further page."""
    picture = cat(40, 60, 3)
    with tifffile.TiffWriter(tmp_path / "in.tif") as file:
        file.write(picture, photometric="rgb")
        file.write(picture[::2, ::2], photometric="rgb", subfiletype=kind)
    assert detail(tmp_path / "in.tif", tmp_path / "out.tif") == 0
    said = capsys.readouterr().err
    assert (f"note: {tmp_path / 'in.tif'} has 2 pages, of which only the first is read" in said) == note
    assert said.count("note: ") == note
    assert tifffile.imread(tmp_path / "out.tif").shape == picture.shape


@pytest.mark.parametrize(
    ("suffix", "options"),
    each_value([".tif", ".png"], [(), ("--channels", "all", "--depth", "8"), ("--region", "40,60,20,20:0,1,1,1")]),
)
def test_detail_by_rows_is_detail(photo: Path, tmp_path: Path, suffix: str, options: tuple[str, ...]) -> None:
    source = photo.with_suffix(suffix)
    write_photograph(read_photograph(photo), source)
    whole, rows = tmp_path / f"whole{suffix}", tmp_path / f"rows{suffix}"
    assert detail(source, whole, *options) == 0
    assert detail(source, rows, *options, "--memory", LITTLE, "--full") == 0
    whole_result, rows_result = read_photograph(whole), read_photograph(rows)
    assert (whole_result.pixels - rows_result.pixels).abs().max() < (1.1 / 255 if "8" in options else 1e-4)
    assert whole_result.alpha is not None
    assert rows_result.alpha is not None
    assert torch.equal(whole_result.alpha, rows_result.alpha)
    assert (whole_result.depth, whole_result.icc) == (rows_result.depth, rows_result.icc)


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
    whole_result, rows_result = (read_photograph(tmp_path / name).pixels for name in ("mask.tif", "region.tif"))
    assert torch.equal(whole_result, rows_result)
    Image.fromarray(mask[1:]).save(tmp_path / "small.png")
    assert detail(photo, tmp_path / "out.tif", "--mask", tmp_path / "small.png", "--memory", LITTLE) == 2
    assert "small.png must be as large as the photograph, 300x200, but is 300x199" in capsys.readouterr().err


def test_zarr_in_and_out(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = cat(200, 300)
    zarr.create_array(store=tmp_path / "in.zarr", data=picture, chunks=(64, 64, 3))
    write_photograph(Photograph(torch.from_numpy(picture).permute(2, 0, 1)[None] / 255), tmp_path / "in.png")
    for _ in range(2):  # the second output replaces the first
        assert detail(tmp_path / "in.zarr", tmp_path / "out.zarr", "--full") == 0
    assert detail(tmp_path / "in.png", tmp_path / "out.png") == 0
    wanted = read_photograph(tmp_path / "out.png").pixels[0].permute(1, 2, 0).numpy() * 255
    assert np.abs(zarr.open_array(tmp_path / "out.zarr", mode="r")[:] - wanted).max() < 1.01
    assert not list(tmp_path.glob(".*"))

    (tmp_path / "folder.zarr").mkdir()
    for source, target, message in (
        ("in.zarr", "folder.zarr", "is a folder, not a zarr array that can be replaced"),
        ("folder.zarr", "new.zarr", "is not a zarr array"),
        ("none.zarr", "new.zarr", "is not a zarr array"),
        ("in.zarr", "no/new.zarr", "does not exist; make it first"),
        ("in.zarr", "new.gif", "must end in .png, .jpg, .webp, .avif or .tif"),
    ):
        assert detail(tmp_path / source, tmp_path / target) == 2
        assert message in capsys.readouterr().err
    zarr.create_array(store=tmp_path / "line.zarr", data=np.zeros(5))
    assert detail(tmp_path / "line.zarr", tmp_path / "new.zarr") == 2
    assert "line.zarr must have the shape (H, W) or (H, W, S), got (5,)" in capsys.readouterr().err
    zarr.create_array(store=tmp_path / "deep.zarr", data=np.zeros((5, 5), np.uint32))
    for depth in ((), ("--depth", "8")):
        assert detail(tmp_path / "deep.zarr", tmp_path / "new.zarr", *depth) == 2
        assert "deep.zarr stores its channels as uint32, which is not supported" in capsys.readouterr().err


def test_zarr_is_needed_for_zarr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert detail(tmp_path / "in.zarr", tmp_path / "out.zarr") == 2
    assert "install nlfilter-torch[zarr]" in capsys.readouterr().err


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the error sentence of a `detail` that fails, and check that it leaves nothing in the output folder."""
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


def test_damage_in_the_middle_is_named(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with tifffile.TiffFile(photo) as file:
        offset = file.pages.first.dataoffsets[-1]
    content = bytearray(photo.read_bytes())
    content[offset : offset + 50] = bytes(50)
    photo.write_bytes(content)
    sentence = refused(capsys, photo, tmp_path / "out.tif", "--memory", LITTLE)
    assert "in.tif is damaged or cut short" in sentence


@pytest.fixture
def file_limit() -> Any:
    """A limit on the size of files in bytes, in place of a full disk."""
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


@pytest.mark.parametrize("target", ["out.tif", "out.png", "out.zarr"])
def test_a_full_disk_is_named(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], file_limit: Any, target: str
) -> None:
    with file_limit(20_000):
        sentence = refused(capsys, photo, tmp_path / target, "--memory", LITTLE, "--threshold", "0")  # no temporaries
    assert f"{target} cannot be written: File too large; free some space there or write elsewhere" in sentence


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
    sentence = refused(capsys, photo, tmp_path / "out.webp", "--memory", "0.001", "--depth", "8")
    assert "out.webp needs 2 MB of memory to be encoded, but only 1 MB may be used; write a TIFF file" in sentence
    eight = replace(read_photograph(photo), depth="uint8")
    write_photograph(eight, photo.with_suffix(".webp"))
    sentence = refused(capsys, photo.with_suffix(".webp"), tmp_path / "out.tif", "--memory", "0.0001")
    assert "in.webp has 300x200 pixels and needs about" in sentence
    for wrong in ("0", "-1", "nan", "inf"):
        assert "--memory must be a " in refused(capsys, photo, tmp_path / "o.tif", "--memory", wrong)


def edit_slowly(*arguments: str) -> None:
    """The command, which sleeps in its last pass, when it writes."""
    original = tiles.Tiling._edited

    def edited(tiling: tiles.Tiling, tile: Any) -> Any:
        time.sleep(2 * tiling.transparent)
        return original(tiling, tile)

    # Background jobs of a shell, and so their children, ignore this signal; these tests may be such a job.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    tiles.Tiling._edited = edited  # type: ignore[method-assign]
    tiles.TILE_PIXELS = 6000
    tiles.sampling.PILOT = pictures.STATISTICS_PIXELS = 8000
    sys.exit(main(list(arguments)))


@pytest.mark.parametrize(
    ("target", "number"),
    [
        ("out.tif", signal.SIGKILL),
        ("out.tif", signal.SIGINT),
        ("out.tif", signal.SIGTERM),
        ("out.zarr", signal.SIGKILL),
        ("out.zarr", signal.SIGTERM),
    ],
)
def test_interrupted_work_leaves_nothing_that_looks_finished(
    photo: Path, tmp_path: Path, number: signal.Signals, target: str
) -> None:
    arguments = ["detail", str(photo), str(tmp_path / target), "--landmarks", "40", "--memory", LITTLE]
    process = forked(edit_slowly, arguments)
    try:
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob(f".{target}.*.part")):
            assert process.is_alive()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert process.pid is not None
        os.kill(process.pid, number)
        process.join(60)
        assert process.exitcode not in (None, 0)
    finally:
        process.kill()
        process.join()
    assert not (tmp_path / target).exists()
    left = list(tmp_path.glob(".*"))
    assert bool(left) == (number == signal.SIGKILL)  # only a killed process leaves a hidden part
    if left:
        assert detail(photo, tmp_path / target, "--memory", LITTLE) == 0
        assert not list(tmp_path.glob(".*"))  # which the next run removes
