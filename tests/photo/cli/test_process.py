"""How the process ends on signals, with no file half written, how its threads wait, and when circles are looked for."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.process import SPINS, THRESHOLDS, VARIABLES, sleep_while_waiting
from tests.commands import small_photo


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return small_photo(tmp_path)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signals_while_a_file_is_written(
    photo: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
    status: int,
) -> None:
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}

    def interrupted(*_: object) -> None:
        assert len(list(tmp_path.glob(".*.part"))) == 1
        os.kill(os.getpid(), number)

    monkeypatch.setattr("nlfilter_torch.photo.files.png.write_png", interrupted)
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        assert main(["detail", str(photo), str(tmp_path / "out.png"), "--alpha", "1,1"]) == status
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)
    assert [path.name for path in tmp_path.iterdir()] == ["in.png"]


def test_interrupted_work_says_so(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_photograph", interrupt)
    assert main(["tone", str(photo), str(tmp_path / "out.png")]) == 130
    assert capsys.readouterr().err.strip() == "nlfilter-torch: interrupted; no file is half written"


@pytest.fixture
def undecided(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # so that what the test sets is removed afterwards
        monkeypatch.delenv(name)


@pytest.mark.usefixtures("undecided")
def test_threads_sleep_unless_the_user_decided(monkeypatch: pytest.MonkeyPatch) -> None:
    sleep_while_waiting()
    assert (os.environ["OMP_WAIT_POLICY"], os.environ["GOMP_SPINCOUNT"]) == ("passive", str(SPINS))
    monkeypatch.delenv("GOMP_SPINCOUNT")
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    sleep_while_waiting()
    assert os.environ["OMP_WAIT_POLICY"] == "active"
    assert "GOMP_SPINCOUNT" not in os.environ


@pytest.mark.usefixtures("undecided")
@pytest.mark.parametrize("name", ["GOMP_SPINCOUNT", "KMP_BLOCKTIME"])
def test_users_may_decide_by_the_variables_of_compilers(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "300")
    sleep_while_waiting()
    assert "OMP_WAIT_POLICY" not in os.environ


@pytest.mark.usefixtures("undecided")
@pytest.mark.skipif(sys.platform != "linux", reason="another OpenMP prints other lines")
@pytest.mark.parametrize(
    ("policy", "wanted", "spins"), [(None, "PASSIVE", str(SPINS)), ("active", "ACTIVE", "30000000000")]
)
def test_openmp_of_torch_reads_it(policy: str | None, wanted: str, spins: str, tmp_path: Path) -> None:
    """What OpenMP prints when it is loaded, which is after the program has begun."""
    environment = os.environ | {"OMP_DISPLAY_ENV": "verbose"} | ({} if policy is None else {"OMP_WAIT_POLICY": policy})
    arguments = [sys.executable, "-m", "nlfilter_torch", "sharpen", small_photo(tmp_path), tmp_path / "out.png"]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True)
    assert f"OMP_WAIT_POLICY = '{wanted}'" in done.stderr
    assert f"GOMP_SPINCOUNT = '{spins}'" in done.stderr


PROGRAM = f"""
import atexit, gc
atexit.register(lambda: print(gc.get_freeze_count() > 1000, gc.get_threshold() == {THRESHOLDS}))  # called last
from nlfilter_torch.__main__ import main
main(["--version"])
main(["--version"])
"""


def test_the_program_leaves_objects_alone_at_its_end() -> None:
    result = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "True True"
