"""Photographs of a folder, edited by ``nlfilter-torch batch``: deaths of workers, errors, and what is left."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

from nlfilter_torch.photo.cli import batch, main
from nlfilter_torch.photo.cli.batch import Edit, Tally, edit_folder
from nlfilter_torch.photo.cli.folders import RECORD, pictures, prepare
from nlfilter_torch.photo.cli.workers import Crew
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from tests.folders import fill, finished, plain_files, refused, tally_of

OPTIONS = ("--landmarks", "12", "--patch-size", "3", "--bandwidth", "20")
ROOT = Path(__file__).parents[3]
PATIENCE = 120  # seconds, on a machine that is busy with other things


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "nlfilter_torch", "batch", *map(str, arguments), *OPTIONS]


def environment(**more: object) -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1"} | {name: str(value) for name, value in more.items()}


@pytest.mark.slow
def test_a_hundred_killed_in_the_middle(tmp_path: Path) -> None:
    """Every good picture is edited exactly once, none is corrupt, and the five broken ones are reported."""
    source, target = tmp_path / "in", tmp_path / "out"
    broken = (3, 50, 51, 70, 99)
    names = [f"{number:03}.png" for number in broken]
    fill(source, 100, broken)
    arguments = command(source, target, "--workers", 2)
    first = subprocess.Popen(arguments, cwd=ROOT, env=environment(), start_new_session=True, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + PATIENCE
        while len(list(target.glob("[!.]*"))) < 30:
            assert first.poll() is None
            assert time.monotonic() < until
            time.sleep(0.002)
    finally:
        os.killpg(first.pid, signal.SIGKILL)
    assert first.wait() == -signal.SIGKILL
    before = finished(target)
    assert 30 <= len(before) < 95
    for name in before:
        assert np.asarray(Image.open(target / name)).shape == (48, 48, 3)  # the file is complete
    (target / ".007.png.0123abcd.part").write_bytes(b"half")

    second = subprocess.run(arguments, cwd=ROOT, env=environment(), capture_output=True, text=True, check=False)
    assert second.returncode == 1
    assert second.stdout.splitlines() == [
        f"{95 - len(before)} edited, {len(before)} there already, 5 failed, in {target}",
        f"failed: {', '.join(names)}",
    ]
    reasons = sorted(second.stderr.splitlines())
    assert len(reasons) == 5
    for name, reason in zip(names, reasons, strict=True):
        assert reason.startswith(f"nlfilter-torch: {source / name} is damaged or cut short")
    after = finished(target)
    assert len(after) == 95
    assert not set(names) & set(after)
    assert {name: after[name] for name in before} == before  # none was written again
    assert sorted(path.name for path in target.glob(".*")) == [RECORD]

    assert main(["detail", str(source / "008.png"), str(tmp_path / "one.png"), *OPTIONS]) == 0
    alone = np.asarray(Image.open(tmp_path / "one.png")).astype(int)
    for name in after:
        assert np.asarray(Image.open(target / name)).shape == (48, 48, 3)
    assert abs(np.asarray(Image.open(target / "008.png")) - alone).max() <= 1  # rounding depends on threads


def test_files_of_other_types_are_mentioned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(tmp_path / "in", 1)
    for name in ("a.HEIC", "b.heic", "notes", "000.png.json", ".hidden.txt", "._000.png"):
        (tmp_path / "in" / name).touch()
    (tmp_path / "in" / "folder.dng").mkdir()
    monkeypatch.setattr("nlfilter_torch.photo.cli.batch.edit_folder", lambda *_, **__: None)
    assert main(["batch", str(tmp_path / "in"), str(tmp_path / "out")]) == 0
    assert [path.name for path in pictures(tmp_path / "in")] == ["000.png"]
    assert capsys.readouterr().err == (
        "nlfilter-torch: left out 2 .heic, 1 without a suffix; convert them to PNG, JPEG, TIFF, WebP or AVIF if they "
        "are photographs\n"
        "nlfilter-torch: left out the subfolders folder.dng; run the command on each that holds photographs\n"
    )


def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fill(tmp_path / "in", 2)

    def interrupt(*_: object, tally: Tally, **__: object) -> None:
        tally.done, tally.left = 1, 1
        raise KeyboardInterrupt

    monkeypatch.setattr("nlfilter_torch.photo.cli.batch.edit_folder", interrupt)
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
        "nlfilter_torch.photo.cli.batch.edit_folder", lambda *args, **kwargs: seen.update(kwargs, args=args)
    )
    monkeypatch.setattr("nlfilter_torch.photo.cli.batch._cores", lambda: 12)
    arguments = ["batch", str(tmp_path / "in"), str(tmp_path / "out"), "--preset", "smooth", "--seed", "5"]
    assert main([*arguments, "--workers", "2", "--memory", "8"]) == 0
    assert seen["args"][3] == Crew(2, 6)
    edit, files = seen["args"][2].args
    assert files.memory == 4.0  # of two workers
    settings = edit.keywords
    smooth = PRESETS["smooth"].steps[0]
    assert settings["alpha"] == "0,0,0,1"
    assert (settings["bandwidth"], settings["seed"]) == (f"{smooth['bandwidth']:g}", 5)
    assert json.loads((tmp_path / "out" / RECORD).read_text()) == settings
    assert main(arguments) == 0
    assert seen["args"][3] == Crew(9, 1)


def edit_here(paths: list[Path], target: Path, edit: Edit, *_: object, **__: object) -> None:
    """Edit a folder without processes, which take seconds to start."""
    for path in paths:
        edit(str(path), str(target / path.name))


def test_the_quality_of_jpeg_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.cli.batch.edit_folder", edit_here)
    source, preset = tmp_path / "in", tmp_path / "look.json"
    fill(source, 1)
    Image.fromarray(skimage.data.chelsea()[:48, :48]).save(source / "001.jpg")
    preset.write_text(Recipe((Step("look", matrix=(0.9, 0, 0, 0, 0.9, 0, 0, 0, 0.9)),)).to_json())
    for name, options in (
        ("usual", ("--preset", preset)),
        ("small", ("--preset", preset, "--quality", 30)),
        ("detail", ("--quality", 30, *OPTIONS)),
        ("named", ("--preset", "Faded")),
    ):
        assert main(["batch", str(source), str(tmp_path / name), *map(str, options)]) == 0
    steps = {}
    for name in ("usual", "small", "detail"):
        with Image.open(tmp_path / name / "001.jpg") as picture:
            steps[name] = sum(picture.quantization[0])
    assert steps["small"] == steps["detail"] > 5 * steps["usual"]
    usual, small = ((tmp_path / name / "000.png").read_bytes() for name in ("usual", "small"))
    assert usual == small
    assert json.loads((tmp_path / "small" / RECORD).read_text())["quality"] == 30
    assert "contains results of other settings" in refused(capsys, source, tmp_path / "small", "--preset", preset)
    (source / "001.jpg").unlink()
    assert (
        f"--quality must be used with JPEG, WebP or AVIF files, got 30 for {source}, which has none; leave it out"
        in refused(capsys, source, tmp_path / "none", "--quality", 30)
    )
    assert "--quality" in refused(capsys, source, tmp_path / "none", "--quality", 101)


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
            Crew(1, cluster=cluster.scheduler_address),
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
    assert sorted(told) == [f"1.png: {batch.DIED}", "2.png: KeyError: 'what'"]
    assert sorted(finished(tmp_path / "out")) == ["0.png", "3.png", "4.png"]


@pytest.mark.slow
def test_workers_that_all_die_end_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "DEATHS", 2)  # each of which takes two processes that import torch
    paths = plain_files(tmp_path / "in", 9)
    tally, told = tally_of(paths, tmp_path / "out", die)
    assert (tally.done, len(tally.failures), tally.left) == (0, 2, 7)
    assert told[-1] == "2 workers died one after the other; no other file is begun"
