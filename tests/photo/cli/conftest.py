"""A photograph for tests of commands."""

from pathlib import Path

import pytest
import skimage.data
import torch

from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph


@pytest.fixture(scope="module")
def cat() -> torch.Tensor:
    """(1, 3, 60, 90) in [0, 1]."""
    return torch.from_numpy(skimage.data.chelsea()[60:120, 100:190].copy()).permute(2, 0, 1)[None].float() / 255


@pytest.fixture
def photo(tmp_path: Path, cat: torch.Tensor) -> Path:
    """An 8-bit RGB file."""
    write_photograph(Photograph(cat), tmp_path / "in.png")
    return tmp_path / "in.png"
