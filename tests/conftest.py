"""Settings shared by every test."""

import pytest
import torch
from hypothesis import HealthCheck, settings

# Fixed examples: a test that passed does not fail tomorrow. No deadline: shared machines are slow at times.
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
    """A source of randomness that is not the global one."""
    return torch.Generator().manual_seed(0)
