"""Sizes of tiles, and the target that they are written to."""

import numpy as np
import pytest
import torch

from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from tests.pairwise import each_value
from tests.streams import stream_detail
from tests.tiles import ALPHA, cat, streamed


def test_memory_gives_the_size_of_tiles() -> None:
    picture = Picture(np.zeros((20_000, 200, 3), np.uint8))

    def rows_within(memory: int, masked: bool = False) -> int:
        tiled = Tiled(picture, Passes("uint8", sample=1 << 16, memory=memory))
        return tiled.room.rows(75 if masked else 25, num_landmarks=5)

    rows = [rows_within(memory) for memory in (5 * 10**7, 2 * 10**8, 10**10)]
    assert 200 * 85 * 4 * rows[0] < 5 * 10**7 < 200 * 85 * 4 * 4 * rows[0]
    assert rows[0] < rows[1] == rows[2]  # longer tiles are no faster
    assert rows_within(13 * 10**7, masked=True) < rows[1]
    with pytest.raises(
        MemoryError, match=r"source needs at least \d+ MB of memory, but only 10 MB may be used; allow more"
    ):
        rows_within(10**7)
    with pytest.raises(MemoryError, match="source needs at least 7 MB of memory, but only 0 MB may be used"):
        streamed(cat(60, 80), memory=1000)


@pytest.mark.parametrize(("kind", "channels"), each_value(["uint8", "uint16", "float32"], [1, 2, 3, 4]))
def test_ones_give_the_picture_back_with_its_transparency(kind: str, channels: int) -> None:
    draw = np.random.default_rng(0).random((30, 20, channels))
    picture = (draw if kind == "float32" else draw * np.iinfo(kind).max).astype(kind)
    edited = streamed(picture, torch.ones(3), num_landmarks=20)
    np.testing.assert_allclose(edited, picture, rtol=0, atol=2e-6 if kind == "float32" else 0)
    if channels == 1:
        np.testing.assert_allclose(streamed(picture[..., 0], torch.ones(3), num_landmarks=20), edited[..., 0])


def test_depth_is_that_of_the_target() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (30, 20, 4), np.uint8)
    deep = streamed(picture, torch.ones(2), kind="uint16", num_landmarks=20)
    np.testing.assert_array_equal(deep, picture.astype(np.uint16) * 257)
    floats = streamed(deep, torch.ones(2), kind="float32", num_landmarks=20)
    np.testing.assert_allclose(floats, picture / 255.0, atol=2e-6)


def test_target_must_fit() -> None:
    picture = cat(20, 30)
    with pytest.raises(ValueError, match="target must have the shape of the source"):
        stream_detail(picture, np.empty((20, 30), np.float32), ALPHA)
    with pytest.raises(ValueError, match="dtype of the target must be one of"):
        stream_detail(picture, np.empty((20, 30, 3), np.int64), ALPHA)
