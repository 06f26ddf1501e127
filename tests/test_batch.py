"""Editing a folder by several processes: each photograph once, broken ones reported, interrupted work resumed."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import skimage.data
import torch.distributed as dist
from PIL import Image

from nlfilter_torch.cli import folders, main
from nlfilter_torch.cli.folders import DEATHS, RECORD, Tally, edit_folder, pictures, prepare
from nlfilter_torch.core.ranks import Ranks, connected_ranks
from nlfilter_torch.edits.presets import PRESETS

OPTIONS = ("--landmarks", "12", "--patch-size", "3", "--bandwidth", "20")
ROOT = Path(__file__).parents[1]
PATIENCE = 120  # seconds, on a machine that is busy with other things
needs_gloo = pytest.mark.skipif(
    not dist.is_available() or not dist.is_gloo_available(), reason="this torch has no gloo"
)


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


@pytest.mark.slow
@needs_gloo
def test_ranks_share_the_folder(tmp_path: Path) -> None:
    """The same command under torchrun edits no picture twice, and a broken picture does not stop the other rank."""
    source, target = tmp_path / "in", tmp_path / "out"
    fill(source, 12, broken=(0,))
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    run = subprocess.run(
        [*launch, *command(source, target, "--workers", 1)[1:]],
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE,
    )
    assert run.returncode == 1
    assert run.stdout.splitlines() == [f"11 edited, 0 there already, 1 failed, in {target}", "failed: 000.png"]
    assert len(finished(target)) == 11


def test_shares_are_a_partition() -> None:
    items = list(range(17))
    for size in (1, 2, 3, 20):
        shares = [Ranks(rank, size).share(items) for rank in range(size)]
        assert sorted(item for share in shares for item in share) == items
        assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert Ranks(1, 3).all_gather("own") == ["own"]


def meet_and_die(rank: str, word: str) -> None:
    """One of two ranks; the second one dies before the end."""
    with connected_ranks() as ranks:
        if rank == "1":
            os._exit(9)
        try:
            ranks.all_gather(word)
        except OSError as error:
            sys.stdout.write(str(error))


@pytest.mark.slow
@needs_gloo
def test_a_rank_that_dies_is_named() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    script = "import sys; from tests.test_batch import meet_and_die; meet_and_die(*sys.argv[1:])"
    ranks = [
        subprocess.Popen(
            [sys.executable, "-c", script, str(rank), "word"],
            cwd=ROOT,
            env=environment(RANK=rank, WORLD_SIZE=2, MASTER_ADDR="127.0.0.1", MASTER_PORT=port),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        for rank in range(2)
    ]
    said = [process.communicate(timeout=PATIENCE)[0] for process in ranks]
    assert said[0] == "rank 1 of 2 died or did not answer; start the same command again to do the rest"


@pytest.mark.parametrize(("rank", "size"), [("2", "2"), ("x", "2"), ("0", "0"), ("-1", "2")])
def test_wrong_ranks(monkeypatch: pytest.MonkeyPatch, rank: str, size: str) -> None:
    monkeypatch.setenv("RANK", rank)
    monkeypatch.setenv("WORLD_SIZE", size)
    with pytest.raises(ValueError, match="unset them, or start with torchrun"), connected_ranks():
        pass


def test_ranks_without_a_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rank variables of a scheduler are enough to share the work; each rank reports its own files."""
    monkeypatch.delenv("MASTER_ADDR", raising=False)
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with connected_ranks() as ranks:
        assert ranks == Ranks(1, 2)


def copy_or_fail(source: str, target: str) -> None:
    """An edit whose process dies on some files and raises an unexpected error on others."""
    if Path(source).stem in ("1", "4"):
        os.kill(os.getpid(), signal.SIGKILL)
    if Path(source).stem == "2":
        raise KeyError("what")
    Path(target).write_bytes(Path(source).read_bytes())


def die(source: str, target: str) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def tally_of(paths: list[Path], target: Path, edit: folders.Edit) -> tuple[Tally, list[str]]:
    tally, told = Tally(), list[str]()
    prepare(paths, target, {})
    edit_folder(paths, target, edit, workers=1, threads=1, tell=told.append, begin=lambda name: None, tally=tally)
    return tally, told


def plain_files(folder: Path, count: int) -> list[Path]:
    folder.mkdir()
    for number in range(count):
        (folder / f"{number}.png").write_text("any")
    return pictures(folder)


@pytest.mark.slow
def test_a_worker_that_dies_and_an_error_are_reported(tmp_path: Path) -> None:
    paths = plain_files(tmp_path / "in", 6)
    tally, told = tally_of(paths, tmp_path / "out", copy_or_fail)
    assert (tally.done, tally.skipped, tally.left) == (3, 0, 0)
    assert list(tally.failures) == ["1.png", "2.png", "4.png"]
    assert told[0].startswith("1.png: the process that worked on it died")
    assert told[1] == "2.png: KeyError: 'what'"
    assert sorted(finished(tmp_path / "out")) == ["0.png", "3.png", "5.png"]


@pytest.mark.slow
def test_workers_that_all_die_end_the_work(tmp_path: Path) -> None:
    paths = plain_files(tmp_path / "in", 9)
    tally, told = tally_of(paths, tmp_path / "out", die)
    assert (tally.done, len(tally.failures)) == (0, DEATHS)
    assert tally.left == 9 - DEATHS
    assert told[-1] == f"{DEATHS} workers died one after the other; no other file is begun"


def wait_for_ever(source: str, target: str) -> None:
    Path(target).touch()
    time.sleep(1000)


def run_for_ever(folder: str, target: str) -> None:
    tally_of(pictures(Path(folder)), Path(target), wait_for_ever)


@pytest.mark.slow
def test_workers_end_with_the_process_that_hired_them(tmp_path: Path) -> None:
    plain_files(tmp_path / "in", 2)
    script = "import sys; from tests.test_batch import run_for_ever; run_for_ever(*sys.argv[1:])"
    process = subprocess.Popen([sys.executable, "-c", script, tmp_path / "in", tmp_path / "out"], cwd=ROOT)
    until = time.monotonic() + PATIENCE
    while not (tmp_path / "out" / "0.png").exists():
        assert time.monotonic() < until
        time.sleep(0.01)
    children = psutil.Process(process.pid).children(recursive=True)
    assert children
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=PATIENCE)
    for child in alive:
        child.kill()
    assert not alive


def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fill(tmp_path / "in", 2)

    def interrupt(*_: object, tally: Tally, **__: object) -> None:
        tally.done, tally.left = 1, 1
        raise KeyboardInterrupt

    monkeypatch.setattr("nlfilter_torch.cli.folders.edit_folder", interrupt)
    assert main(["batch", str(tmp_path / "in"), str(tmp_path / "out")]) == 130
    captured = capsys.readouterr()
    told = "nlfilter-torch: the same command does the rest\nnlfilter-torch: interrupted; no file is half written\n"
    assert captured.err == told
    assert captured.out == f"1 edited, 0 there already, 0 failed, 1 not begun, in {tmp_path / 'out'}\n"


def test_settings_and_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A preset and options reach the edit and the record file; cores are divided among workers and local ranks."""
    fill(tmp_path / "in", 9)
    seen = {}
    monkeypatch.setattr(
        "nlfilter_torch.cli.folders.edit_folder", lambda *args, **kwargs: seen.update(kwargs, args=args)
    )
    monkeypatch.setattr("nlfilter_torch.cli.batch._cores", lambda: 12)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    arguments = ["batch", str(tmp_path / "in"), str(tmp_path / "out"), "--preset", "smooth", "--seed", "5"]
    assert main([*arguments, "--workers", "2", "--memory", "8"]) == 0
    assert (seen["workers"], seen["threads"]) == (2, 3)
    settings = seen["args"][2].keywords
    assert settings.pop("memory") == 2.0  # of two ranks with two workers each
    smooth = PRESETS["smooth"]
    assert settings["alpha"] == "0,0,0,1"
    assert (settings["bandwidth"], settings["seed"]) == (f"{smooth.bandwidth:g}", 5)
    assert json.loads((tmp_path / "out" / RECORD).read_text()) == settings
    assert main(arguments) == 0
    assert (seen["workers"], seen["threads"]) == (6, 1)


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
    assert "none is no folder; name the one" in refused(capsys, tmp_path / "none", target)
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
    assert not target.exists()

    fill(target, 1)
    assert f"{target} holds a file 000.png from somewhere else" in refused(capsys, source, target)
    prepare(pictures(source), tmp_path / "begun", {"alpha": "1,2"})
    prepare(pictures(source), tmp_path / "begun", {"alpha": "1,2"})
    assert "was begun with other settings" in refused(capsys, source, tmp_path / "begun")


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
