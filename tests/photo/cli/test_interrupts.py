"""Signals while modules are imported and while a file is written: the exit status, and no files left."""

import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.machinery import SourceFileLoader
from pathlib import Path

import pytest

from nlfilter_torch.photo.cli import interrupts, main
from nlfilter_torch.photo.picture.photographs import read_photograph
from tests.commands import small_photo


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return small_photo(tmp_path)


@pytest.mark.parametrize(
    ("number", "status", "told"),
    [(signal.SIGINT, 130, "nlfilter-torch: interrupted; no file is half written\n"), (signal.SIGTERM, 143, "")],
)
def test_signals_while_modules_are_imported(
    photo: Path, tmp_path: Path, number: signal.Signals, status: int, told: str
) -> None:
    """Also if the imported module converts every exception into another one."""
    (tmp_path / "torch.py").write_text(
        f"import os, time\ntry:\n    os.kill(os.getpid(), {int(number)})\n    time.sleep(60)\n"
        "except BaseException as error:\n    raise ImportError('no torch') from error\n"
    )
    program = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # background jobs of a shell ignore it
        "from nlfilter_torch.photo.cli import main\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    command = [sys.executable, "-c", program, "detail", str(photo), str(tmp_path / "out.png")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, timeout=50)
    assert (finished.returncode, finished.stderr) == (status, told)


@pytest.mark.parametrize("importing", [False, True])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signals_while_a_file_is_written(
    photo: Path,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
    status: int,
    importing: bool,
) -> None:
    """Also while a module is imported that catches every exception."""
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    folder = tmp_path_factory.mktemp("modules")
    (folder / "catches_everything.py").write_text(
        f"import os\ntry:\n    os.kill(os.getpid(), {int(number)})\nexcept BaseException:\n    pass\n"
    )
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "catches_everything", raising=False)

    def interrupted(*_: object) -> None:
        assert len(list(tmp_path.glob(".*.part"))) == 1
        if importing:
            importlib.import_module("catches_everything")
            time.sleep(60)
            raise AssertionError("the signal was lost")
        os.kill(os.getpid(), number)

    monkeypatch.setattr("nlfilter_torch.photo.picture.photographs.encode", interrupted)
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
def interruptible() -> Iterator[None]:
    """Ctrl-C interrupts, as it does not in background jobs of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_that_python_loses_comes_again(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Busy:
        def __del__(self) -> None:
            raise KeyboardInterrupt  # as if Ctrl-C were pressed at this moment

    def work(*_: object, **__: object) -> None:
        Busy()
        for _ in range(1000):
            time.sleep(0.01)

    monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_photograph", work)
    assert main(["tone", str(photo), str(tmp_path / "out.png")]) == 130
    assert capsys.readouterr().err.strip() == "nlfilter-torch: interrupted; no file is half written"


def test_other_errors_of_destructors_are_told_as_ever(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Faulty:
        def __del__(self) -> None:
            raise RuntimeError("of its own")

    told: list[BaseException | None] = []
    monkeypatch.setattr("sys.unraisablehook", lambda lost: told.append(lost.exc_value))
    monkeypatch.setattr(
        "nlfilter_torch.photo.cli.editing.read_photograph", lambda *_, **__: Faulty() and read_photograph(photo)
    )
    assert main(["tone", str(photo), str(tmp_path / "out.png")]) == 0
    assert [str(error) for error in told] == ["of its own"]


def test_a_program_that_is_run_by_an_import_is_interrupted_as_ever(photo: Path, tmp_path: Path) -> None:
    """Only modules that the command line imports itself count as being imported."""
    (tmp_path / "runs_it.py").write_text(
        "import os, signal\n"
        "from nlfilter_torch.photo.cli import editing, main\n"
        "def interrupt(*_, **__):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "editing.read_photograph = interrupt\n"
        f"status = main(['tone', {str(photo)!r}, {str(tmp_path / 'out.png')!r}])\n"
    )
    program = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\n"
        "import runs_it\n"
        "print('returned', runs_it.status)\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=50)
    assert (finished.returncode, finished.stdout) == (0, "returned 130\n")
    assert finished.stderr == "nlfilter-torch: interrupted; no file is half written\n"


def test_modules_are_loaded_as_before_afterwards() -> None:
    before = SourceFileLoader.exec_module
    with interrupts.handled():
        assert SourceFileLoader.exec_module is not before
        with interrupts.handled():  # the program may run itself
            pass
        assert SourceFileLoader.exec_module is not before
    assert SourceFileLoader.exec_module is before
