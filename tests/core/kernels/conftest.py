import pytest
import torch

from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.kernels import library
from tests.native import LEVELS


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
