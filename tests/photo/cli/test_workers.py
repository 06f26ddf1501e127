"""Worker processes: clusters that do not answer, and the end of the process that started them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from nlfilter_torch.photo.cli import process, workers
from nlfilter_torch.photo.cli.folders import RECORD, pictures
from nlfilter_torch.photo.files.writing import open_beside
from tests.folders import fill, plain_files, refused, tally_of

ROOT = Path(__file__).parents[3]
PATIENCE = 120  # seconds, on a machine that is busy with other things


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


def wait_for_ever(source: str, target: str) -> None:
    with open_beside(Path(target)):
        Path(source).with_suffix(".begun").touch()
        time.sleep(1000)


def run_for_ever(folder: str, target: str) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell inherit that it is ignored
    with process.handled():  # as the command does
        tally_of(pictures(Path(folder)), Path(target), wait_for_ever)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_the_process_that_started_them(number: signal.Signals, tmp_path: Path) -> None:
    """After an interrupt, which a terminal sends to all of them, no half file is left."""
    plain_files(tmp_path / "in", 2)
    script = "import sys; from tests.photo.cli.test_workers import run_for_ever; run_for_ever(*sys.argv[1:])"
    arguments = [sys.executable, "-c", script, tmp_path / "in", tmp_path / "out"]
    started = subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, start_new_session=True)
    until = time.monotonic() + PATIENCE
    while not (tmp_path / "in" / "0.begun").exists():
        assert time.monotonic() < until
        time.sleep(0.01)
    children = psutil.Process(started.pid).children(recursive=True)
    assert children
    if number == signal.SIGKILL:
        started.kill()
    else:
        os.killpg(started.pid, number)
    _, errors = started.communicate(timeout=PATIENCE)
    assert started.returncode == -number
    _, alive = psutil.wait_procs(children, timeout=PATIENCE)
    for child in alive:
        child.kill()
    assert not alive
    if number == signal.SIGINT:
        assert errors.endswith(b"KeyboardInterrupt\n")
        assert [path.name for path in (tmp_path / "out").iterdir()] == [RECORD]
