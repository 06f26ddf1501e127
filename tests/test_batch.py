"""Editing a folder by several processes: each photograph once, broken ones reported, interrupted work resumed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import skimage.data
from PIL import Image

from nlfilter_torch.photo.cli import folders, interrupts, main, workers
from nlfilter_torch.photo.cli.folders import RECORD, Tally, edit_folder, pictures, prepare
from nlfilter_torch.photo.cli.workers import DEATHS
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.io.writing import open_beside

OPTIONS = ("--landmarks", "12", "--patch-size", "3", "--bandwidth", "20")
ROOT = Path(__file__).parents[1]
PATIENCE = 120  # seconds, on a machine that is busy with other things


def fill(folder: Path, count: int, broken: tuple[int, ...] = (), side: int = 48) -> None:
    """Crops of a photograph, some of them cut short."""
    folder.mkdir()
    cat, random = skimage.data.chelsea(), np.random.default_rng(0)
    for number in range(count):
        y, x = random.integers(0, 250), random.integers(0, 400)
        path = folder / f"{number:03}.png"
        Image.fromarray(cat[y : y + side, x : x + side]).save(path)
        if number in broken:
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "nlfilter_torch", "batch", *map(str, arguments), *OPTIONS]


def environment(**more: object) -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1"} | {name: str(value) for name, value in more.items()}


def finished(folder: Path) -> dict[str, tuple[int, int]]:
    """Return the names of the finished pictures, with the inode and time that writing them again would change."""
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.glob("[!.]*")}


@pytest.mark.slow
def test_two_hundred_killed_in_the_middle(tmp_path: Path) -> None:
    """Every good picture is edited exactly once, none is corrupt, and the five broken ones are reported."""
    source, target = tmp_path / "in", tmp_path / "out"
    broken = (3, 50, 51, 120, 199)
    names = [f"{number:03}.png" for number in broken]
    fill(source, 200, broken)
    arguments = command(source, target, "--workers", 2)
    first = subprocess.Popen(arguments, cwd=ROOT, env=environment(), start_new_session=True, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + PATIENCE
        while len(list(target.glob("[!.]*"))) < 60:
            assert first.poll() is None
            assert time.monotonic() < until
            time.sleep(0.002)
    finally:
        os.killpg(first.pid, signal.SIGKILL)
    assert first.wait() == -signal.SIGKILL
    before = finished(target)
    assert 60 <= len(before) < 195
    for name in before:
        assert np.asarray(Image.open(target / name)).shape == (48, 48, 3)  # the file is complete
    (target / ".007.png.0123abcd.part").write_bytes(b"half")

    second = subprocess.run(arguments, cwd=ROOT, env=environment(), capture_output=True, text=True, check=False)
    assert second.returncode == 1
    assert second.stdout.splitlines() == [
        f"{195 - len(before)} edited, {len(before)} there already, 5 failed, in {target}",
        f"failed: {', '.join(names)}",
    ]
    reasons = sorted(second.stderr.splitlines())
    assert len(reasons) == 5
    for name, reason in zip(names, reasons, strict=True):
        assert reason.startswith(f"nlfilter-torch: {source / name} is damaged or cut short")
    after = finished(target)
    assert len(after) == 195
    assert not set(names) & set(after)
    assert {name: after[name] for name in before} == before  # none was written again
    assert sorted(path.name for path in target.glob(".*")) == [RECORD]

    assert main(["detail", str(source / "008.png"), str(tmp_path / "one.png"), *OPTIONS]) == 0
    alone = np.asarray(Image.open(tmp_path / "one.png")).astype(int)
    for name in after:
        assert np.asarray(Image.open(target / name)).shape == (48, 48, 3)
    assert abs(np.asarray(Image.open(target / "008.png")) - alone).max() <= 1  # rounding depends on threads


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


@pytest.mark.parametrize("more", [(), ("--preset", "soft-skin"), ("--workers", 2)])
def test_a_cluster_that_does_not_answer(
    more: tuple[object, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    fill(tmp_path / "in", 1)
    monkeypatch.setattr(workers, "CONNECTING", 0.2)
    sentence = refused(capsys, tmp_path / "in", tmp_path / "out", "--cluster", "tcp://127.0.0.1:9", *more)
    wanted = "--cluster must be the address of a Dask scheduler"
    if "--workers" in more:
        wanted = "--workers must not be combined with --cluster"
    assert wanted in sentence


def copy_or_fail(source: str, target: str) -> None:
    """An edit whose process dies on some files and raises an unexpected error on others."""
    if Path(source).stem == "1":
        os.kill(os.getpid(), signal.SIGKILL)
    if Path(source).stem == "2":
        raise KeyError("what")
    Path(target).write_bytes(Path(source).read_bytes())


def die(source: str, target: str) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def tally_of(paths: list[Path], target: Path, edit: folders.Edit, workers: int = 1) -> tuple[Tally, list[str]]:
    tally, told = Tally(), list[str]()
    prepare(paths, target, {})
    edit_folder(paths, target, edit, workers=workers, threads=1, tell=told.append, begin=lambda name: None, tally=tally)
    return tally, told


def plain_files(folder: Path, count: int) -> list[Path]:
    folder.mkdir()
    for number in range(count):
        (folder / f"{number}.png").write_text("any")
    return pictures(folder)


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


def wait_for_ever(source: str, target: str) -> None:
    with open_beside(Path(target)):
        Path(source).with_suffix(".begun").touch()
        time.sleep(1000)


def run_for_ever(folder: str, target: str) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell inherit that it is ignored
    with interrupts.handled():  # as the command does; an interrupt during a callback would be lost
        tally_of(pictures(Path(folder)), Path(target), wait_for_ever)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_the_process_that_started_them(number: signal.Signals, tmp_path: Path) -> None:
    """After an interrupt, which a terminal sends to all of them, no half file is left."""
    plain_files(tmp_path / "in", 2)
    script = "import sys; from tests.test_batch import run_for_ever; run_for_ever(*sys.argv[1:])"
    arguments = [sys.executable, "-c", script, tmp_path / "in", tmp_path / "out"]
    process = subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, start_new_session=True)
    until = time.monotonic() + PATIENCE
    while not (tmp_path / "in" / "0.begun").exists():
        assert time.monotonic() < until
        time.sleep(0.01)
    children = psutil.Process(process.pid).children(recursive=True)
    assert children
    if number == signal.SIGKILL:
        process.kill()
    else:
        os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == -number
    _, alive = psutil.wait_procs(children, timeout=PATIENCE)
    for child in alive:
        child.kill()
    assert not alive
    if number == signal.SIGINT:
        assert errors.endswith(b"KeyboardInterrupt\n")
        assert [path.name for path in (tmp_path / "out").iterdir()] == [RECORD]


def test_files_of_other_types_are_mentioned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(tmp_path / "in", 1)
    for name in ("a.HEIC", "b.heic", "notes", "000.png.json", ".hidden.txt", "._000.png"):
        (tmp_path / "in" / name).touch()
    (tmp_path / "in" / "folder.dng").mkdir()
    monkeypatch.setattr("nlfilter_torch.photo.cli.folders.edit_folder", lambda *_, **__: None)
    assert main(["batch", str(tmp_path / "in"), str(tmp_path / "out")]) == 0
    assert [path.name for path in pictures(tmp_path / "in")] == ["000.png"]
    assert capsys.readouterr().err == (
        "nlfilter-torch: left out 2 .heic, 1 without a suffix; convert them to PNG, JPEG, TIFF, WebP or AVIF if they "
        "are photographs\n"
    )


def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fill(tmp_path / "in", 2)

    def interrupt(*_: object, tally: Tally, **__: object) -> None:
        tally.done, tally.left = 1, 1
        raise KeyboardInterrupt

    monkeypatch.setattr("nlfilter_torch.photo.cli.folders.edit_folder", interrupt)
    assert main(["batch", str(tmp_path / "in"), str(tmp_path / "out")]) == 130
    captured = capsys.readouterr()
    told = (
        "nlfilter-torch: run the same command again to edit the remaining photographs\n"
        "nlfilter-torch: interrupted; no file is half written\n"
    )
    assert captured.err == told
    assert captured.out == f"1 edited, 0 there already, 0 failed, 1 not begun, in {tmp_path / 'out'}\n"


def test_settings_and_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A preset and options reach the edit and the record; cores are shared among workers."""
    fill(tmp_path / "in", 9)
    seen = {}
    monkeypatch.setattr(
        "nlfilter_torch.photo.cli.folders.edit_folder", lambda *args, **kwargs: seen.update(kwargs, args=args)
    )
    monkeypatch.setattr("nlfilter_torch.photo.cli.batch._cores", lambda: 12)
    arguments = ["batch", str(tmp_path / "in"), str(tmp_path / "out"), "--preset", "smooth", "--seed", "5"]
    assert main([*arguments, "--workers", "2", "--memory", "8"]) == 0
    assert (seen["workers"], seen["threads"]) == (2, 6)
    settings = seen["args"][2].keywords
    assert settings.pop("memory") == 4.0  # of two workers
    smooth = PRESETS["smooth"].steps[0]
    assert settings["alpha"] == "0,0,0,1"
    assert (settings["bandwidth"], settings["seed"]) == (f"{smooth['bandwidth']:g}", 5)
    assert json.loads((tmp_path / "out" / RECORD).read_text()) == settings
    assert main(arguments) == 0
    assert (seen["workers"], seen["threads"]) == (9, 1)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["batch", *map(str, arguments)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    return lines[0]


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = tmp_path / "in", tmp_path / "out"
    fill(source, 2)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    assert "none is not a folder; give the one" in refused(capsys, tmp_path / "none", target)
    assert "holds no PNG, JPEG, TIFF, WebP or AVIF file" in refused(capsys, tmp_path / "empty", target)
    assert "must be another folder than that of the photographs" in refused(capsys, source, source)
    assert "is a file, not a folder" in refused(capsys, source, tmp_path / "file")
    assert "does not exist; make it first" in refused(capsys, source, tmp_path / "no" / "where")
    for options in (
        ("--alpha", 3),
        ("--bandwidth", 0),
        ("--residual", "nan"),
        ("--patch-size", 4),
        ("--workers", 0),
        ("--memory", 0),
    ):
        assert options[0].strip("-").replace("-", "_") in refused(capsys, source, target, *options).replace("-", "_")
    assert "--spatial-bandwidth must be a positive number of pixels" in refused(
        capsys, source, target, "--spatial-bandwidth", 0
    )
    (tmp_path / "tone.json").write_text(Recipe((Step("tone"),)).to_json())
    assert "--seed must not be given with a --preset of edits other than detail" in refused(
        capsys, source, target, "--preset", tmp_path / "tone.json", "--seed", 1
    )
    assert not target.exists()

    fill(target, 1)
    assert f"{target} already contains 000.png, which this command did not write" in refused(capsys, source, target)
    prepare(pictures(source), tmp_path / "begun", {"alpha": "1,2"})
    prepare(pictures(source), tmp_path / "begun", {"alpha": "1,2"})
    assert "contains results of other settings" in refused(capsys, source, tmp_path / "begun")


def test_a_folder_that_cannot_be_written_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path / "in", 1)
    (tmp_path / "out").mkdir()

    def full(path: Path, mode: str) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "open", full)
    assert "No space left on device" in refused(capsys, tmp_path / "in", tmp_path / "out")
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    assert "is read-only; choose another" in refused(capsys, tmp_path / "in", tmp_path / "out")
