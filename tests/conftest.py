"""Settings and fixtures shared by every test."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from hypothesis import HealthCheck, settings

from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.kernels import library
from tests.native import LEVELS
from tests.torchvision import make_importable

if TYPE_CHECKING:
    from nlfilter_torch.photo.app.session import Session

# Fixed examples, so that results are reproducible; no deadline, as shared machines are slow at times.
settings.register_profile(
    "fixed",
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=20,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("fixed")


@pytest.fixture
def generator() -> torch.Generator:
    """A random generator other than the global one."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(params=LEVELS, ids=lambda level: instruction_sets.NAMES[level])
def level(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Instruction set of the kernels; tests that take it are skipped where there are none."""
    monkeypatch.setattr(library, "level", request.param)
    return int(request.param)


@pytest.fixture
def threads():
    """Sets the number of threads, which is restored after the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(params=[False, True], ids=["memory", "tiles"])
def tiled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether commands and the editor work as for large photographs."""
    if request.param:
        monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_if_it_fits", lambda *_: None)
        monkeypatch.setattr("nlfilter_torch.photo.app.session.WHOLE_MEMORY", 0)
    return bool(request.param)


@pytest.fixture
def session(tmp_path: Path) -> "Session":
    """A session of the editor with a small photograph open: cat.png, in the folder that the session saves to."""
    # Imported here, so that tests of the filter run without the packages that read files.
    from nlfilter_torch.photo.app.session import Session
    from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
    from tests.problems import cat

    write_photograph(Photograph(cat()), tmp_path / "cat.png")
    return Session(tmp_path, tmp_path / "cat.png")


@pytest.fixture
def deepinv() -> Iterator[None]:
    """Skip the test unless deepinv is installed."""
    if find_spec("deepinv") is None:
        pytest.skip("deepinv is not installed")
    operators = make_importable()
    yield
    del operators
