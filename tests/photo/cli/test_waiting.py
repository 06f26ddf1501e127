"""Threads of the program soon sleep while they wait for each other, unless the user decided how they wait."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nlfilter_torch.photo.cli.waiting import SPINS, VARIABLES, sleep_while_waiting
from tests.commands import small_photo


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
