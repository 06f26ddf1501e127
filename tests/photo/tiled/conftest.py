"""Samples and blocks in proportion to small pictures."""

import pytest

from nlfilter_torch.photo.tiled import sampling


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce samples and blocks in proportion to a small picture."""
    monkeypatch.setattr(sampling, "PILOT", 2000)
    monkeypatch.setattr(sampling, "CHUNK", 300)
    monkeypatch.setattr("nlfilter_torch.photo.tiled.pictures.STATISTICS_PIXELS", 2500)
