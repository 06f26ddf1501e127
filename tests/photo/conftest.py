"""A small photograph for tests of edits and commands."""

import pytest
import skimage.data
import torch


@pytest.fixture(scope="module")
def pixels() -> torch.Tensor:
    """(1, 3, 48, 64) in [0, 1]: a piece of the cat."""
    return torch.from_numpy(skimage.data.chelsea()[80:128, 120:184].copy()).permute(2, 0, 1)[None].float() / 255
