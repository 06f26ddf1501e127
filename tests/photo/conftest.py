"""A small photograph for tests of edits and commands, and tiles in proportion to it."""

import pytest
import skimage.data
import torch

from nlfilter_torch.photo.picture import sampling


@pytest.fixture(scope="module")
def pixels() -> torch.Tensor:
    """(1, 3, 48, 64) in [0, 1]: a piece of the cat."""
    return torch.from_numpy(skimage.data.chelsea()[80:128, 120:184].copy()).permute(2, 0, 1)[None].float() / 255


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce samples and blocks in proportion to a small picture."""
    monkeypatch.setattr(sampling, "PILOT", 2000)
    monkeypatch.setattr(sampling, "CHUNK", 300)
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 2500)
