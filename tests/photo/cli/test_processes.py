"""Edits of zarr arrays whose tiles are computed and written by worker processes."""

import os
import signal
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import zarr
from torch import Tensor

from nlfilter_torch.photo.cli import main, processes
from nlfilter_torch.photo.cli.processes import ZarrProcesses, zarr_processes
from nlfilter_torch.photo.cli.workers import Crew
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.files.rows import open_picture, write_picture
from nlfilter_torch.photo.picture.pictures import Picture, Tile
from nlfilter_torch.photo.picture.tiles import Passes, Tiling
from tests.files import cat

FEW = ("--landmarks", "20")
FOCUS = Stroke(((0.3, 0.3), (0.5, 0.4)), 0.1, "in")
TWO = Recipe((Step("detail", alpha=(2.0, 1.0), landmarks=20), Step("defocus", (FOCUS,), landmarks=20)))
REGION = ("--region", "20,20,20,20")


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """An array of three bands of chunks; its last band and column of chunks are narrower."""
    zarr.create_array(store=tmp_path / "in.zarr", data=cat(80, 50, 3), chunks=(64, 64, 3))
    return tmp_path / "in.zarr"


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.files.tiff.TILE_SIZE", 32)
    monkeypatch.setattr(
        "nlfilter_torch.photo.picture.tiles.CHUNK_PIXELS", 7 * 50
    )  # such that chunks begin in the midst of one


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Have joblib do in this process what workers would do; lists the first rows of their parts."""
    begun = []

    @contextmanager
    def worker_pool(*_: object) -> Iterator[Crew]:
        with joblib.parallel_config("sequential"):
            yield Crew(2)

    def compute(path: Path, rows: range) -> Any:
        begun.append(rows.start)
        return work(path, rows)

    work = processes.compute
    monkeypatch.setattr(processes, "worker_pool", worker_pool)
    monkeypatch.setattr(processes, "compute", compute)
    return begun


@pytest.mark.parametrize(
    ("edit", "options"),
    [
        ("detail", ("--region", "20,20,20,20:3,2,1,1", *FEW)),
        ("denoise", ("--noise-level", "12", *FEW)),
        ("recolor", ("--region", "20,20,20,20:#4060c0", *FEW)),
        ("defocus", (*REGION, *FEW)),
        ("abstract", FEW),
        ("look", ("--saturation", "0.5,0.5,0.5,0.5,0.5", "--alpha", "2,1,1,1", *FEW)),
        ("sharpen", FEW),
        ("tone", FEW),
        ("colorize", ("--region", "20,20,20,20:#4060c0", *FEW)),
        ("mask", (*REGION, *FEW)),
        ("apply", ("--preset", "two.json")),
        ("apply", ("--preset", "one.json", "--mask", "left.zarr", "--preset", "one.json", "--mask", "right.zarr")),
    ],
)
def test_workers_compute_the_same_picture(
    edit: str,
    options: tuple[str, ...],
    picture: Path,
    in_this_process: list[int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Guides, sums and sources survive the way to another process."""
    monkeypatch.chdir(picture.parent)
    Path("one.json").write_text(Recipe(TWO.steps[:1]).to_json())
    Path("two.json").write_text(TWO.to_json())
    for name, columns in (("left", slice(0, 30)), ("right", slice(30, None))):
        mask = np.zeros((80, 50), np.uint8)
        mask[:, columns] = 255
        zarr.create_array(store=f"{name}.zarr", data=mask)
    told = []
    for target, more in (("threads.zarr", ()), ("workers.zarr", ("--workers", "2"))):
        assert main([edit, "in.zarr", target, *options, *more]) == 0
        told.append(capsys.readouterr().out)
    threads, workers = (zarr.open_array(path, mode="r") for path in ("threads.zarr", "workers.zarr"))
    assert np.abs(threads[:].astype(int) - workers[:]).max() <= 1
    assert (threads[:] != workers[:]).mean() < 0.01
    assert told[0] == told[1]
    assert set(in_this_process) >= {0, 32, 64}
    assert sorted(path.name for path in Path("workers.zarr").iterdir()) == ["c", "zarr.json"]
    assert not list(Path().glob(".*"))


@dataclass
class Negative:
    """An edit of tiles that kills its process once."""

    mark: Path

    def __call__(self, tile: Tile) -> Tensor:
        if tile.start >= 32 and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return 1 - tile.image


def write_negative(source: Path, processes: ZarrProcesses) -> None:
    """Have processes write the negative of a picture beside it."""
    with open_picture(source, 1 << 30) as stored:
        passes = Passes("uint8", folder=source.parent, processes=processes)
        tiling = Tiling(passes, Picture(stored.rows), Negative(source.with_name("died")), margin=0, rows=20)
        write_picture(source.with_name("out.zarr"), tiling, "uint8", stored, fill=tiling.fill)


def check_negative(source: Path) -> None:
    assert source.with_name("died").exists()
    picture, negative = (zarr.open_array(source.with_name(name), mode="r")[:] for name in ("in.zarr", "out.zarr"))
    assert np.array_equal(picture, 255 - negative)
    assert sorted(path.name for path in source.parent.iterdir()) == ["died", "in.zarr", "out.zarr"]


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(picture: Path) -> None:
    with zarr_processes(2, None) as workers:
        write_negative(picture, workers)
    check_negative(picture)


@pytest.mark.usefixtures("in_this_process")
def test_workers_that_all_die_leave_nothing(picture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are tried again after a death, but not for ever."""
    begun = []

    def die(path: Path, rows: range) -> Any:
        begun.append(rows.start)
        raise BrokenProcessPool

    monkeypatch.setattr(processes, "compute", die)
    with pytest.raises(ChildProcessError, match="the rows from 0 on died, one after the other; leave them more memory"):
        write_negative(picture, ZarrProcesses(Crew(2)))
    assert begun == [0, 0]  # with others, and alone
    assert [path.name for path in picture.parent.iterdir()] == ["in.zarr"]


@pytest.mark.client("Dask", "edits folders and zarr arrays: `--cluster`")
@pytest.mark.slow
def test_a_worker_of_a_cluster_that_dies_is_replaced(picture: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        zarr_processes(None, cluster.scheduler_address) as workers,
    ):
        assert workers.crew.number == 2
        write_negative(picture, workers)
    check_negative(picture)


def test_a_worker_without_the_folder_says_so(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"{tmp_path} must be seen by all workers under this name"):
        processes.compute(tmp_path / ".out.zarr.01234567.part", range(4))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("in.png", "out.png", "--workers", "2"), "--workers takes zarr arrays"),
        (("in.zarr", "out.tif", "--cluster", "tcp://127.0.0.1:9"), "--cluster takes zarr arrays"),
        (
            ("in.zarr", "out.zarr", "--cluster", "tcp://127.0.0.1:9"),
            "--cluster must be the address of a Dask scheduler",
        ),
        (("in.zarr", "out.zarr", "--cluster", "tcp://127.0.0.1:9", "--workers", "2"), "omit one of them"),
    ],
)
def test_refusals(
    options: tuple[str, ...],
    message: str,
    picture: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.chdir(picture.parent)
    monkeypatch.setattr("nlfilter_torch.photo.cli.workers.CONNECTING", 0.2)
    assert main(["detail", *options]) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert message in told
