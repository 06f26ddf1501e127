"""Files of a folder edited by workers: deaths of workers, errors, and what is left."""

import os
import signal
from pathlib import Path

import pytest

from nlfilter_torch.photo.cli import folders
from nlfilter_torch.photo.cli.folders import Tally, edit_folder, prepare
from nlfilter_torch.photo.cli.workers import DEATHS
from tests.folders import finished, plain_files, tally_of


@pytest.mark.client("Dask", "edits folders and zarr arrays: `--cluster`")
@pytest.mark.slow
def test_a_cluster_of_which_a_worker_is_killed(tmp_path: Path) -> None:
    """The file of a dead worker is given to another one; broken files are named, and those there are left alone."""
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    paths = plain_files(tmp_path / "in", 6)
    prepare(paths, tmp_path / "out", {})
    (tmp_path / "out" / "5.png").write_text("before")
    tally, told = Tally(), list[str]()
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        edit_folder(
            paths,
            tmp_path / "out",
            die_once_in_a_cluster,
            workers=1,
            threads=1,
            cluster=cluster.scheduler_address,
            tell=told.append,
            begin=lambda name: None,
            tally=tally,
        )
    assert (tally.done, tally.skipped, tally.left) == (4, 1, 0)
    assert told == ["2.png: KeyError: 'what'"]
    assert (tmp_path / "in" / "died").exists()
    assert (tmp_path / "out" / "5.png").read_text() == "before"
    assert sorted(finished(tmp_path / "out")) == ["0.png", "1.png", "3.png", "4.png", "5.png"]


def die_once_in_a_cluster(source: str, target: str) -> None:
    """An edit that kills its process over the first file that it is called for, and cannot do another."""
    mark = Path(source).with_name("died")
    if Path(source).stem == "1" and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if Path(source).stem == "2":
        raise KeyError("what")
    Path(target).write_bytes(Path(source).read_bytes())


def copy_or_fail(source: str, target: str) -> None:
    """An edit whose process dies on some files and raises an unexpected error on others."""
    if Path(source).stem == "1":
        os.kill(os.getpid(), signal.SIGKILL)
    if Path(source).stem == "2":
        raise KeyError("what")
    Path(target).write_bytes(Path(source).read_bytes())


def die(source: str, target: str) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_worker_that_dies_and_an_error_are_reported(tmp_path: Path) -> None:
    """The file of a worker that died with it is done."""
    paths = plain_files(tmp_path / "in", 5)
    tally, told = tally_of(paths, tmp_path / "out", copy_or_fail, workers=2)
    assert (tally.done, tally.skipped, tally.left) == (3, 0, 0)
    assert sorted(told) == [f"1.png: {folders.DIED}", "2.png: KeyError: 'what'"]
    assert sorted(finished(tmp_path / "out")) == ["0.png", "3.png", "4.png"]


@pytest.mark.slow
def test_workers_that_all_die_end_the_work(tmp_path: Path) -> None:
    paths = plain_files(tmp_path / "in", 9)
    tally, told = tally_of(paths, tmp_path / "out", die)
    assert (tally.done, len(tally.failures)) == (0, DEATHS)
    assert tally.left == 9 - DEATHS
    assert told[-1] == f"{DEATHS} workers died one after the other; no other file is begun"
