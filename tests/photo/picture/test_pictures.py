"""Sources of rows: what is read of them, and errors that name them."""

import io

import numpy as np
import pytest

from nlfilter_torch.photo.files.writing import FileRows
from tests.streams import stream_detail
from tests.tiles import ALPHA, FEW, PLAIN, Rows, Shrinking, cat, streamed


def test_source_is_read_a_few_rows_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 600)
    picture = cat(90, 60)
    source, edited = Rows(picture, most=10 + 4), np.empty_like(picture)
    options = PLAIN | {"num_landmarks": 30}
    stream_detail(source, edited, ALPHA, tile_rows=10, sample=2000, memory=FEW, **options)
    assert source.read <= 3 * 90 * 14 // 10  # the pilot, the sample and the result, each with its halo
    np.testing.assert_array_equal(edited, streamed(picture, tile_rows=10, sample=2000, num_landmarks=30, memory=FEW))


def test_source_that_changes_its_size_is_named() -> None:
    source = Shrinking(cat(40, 30), most=100)
    with pytest.raises(ValueError, match="source must keep its size while it is read, 40 rows of 30"):
        stream_detail(source, np.empty_like(source.picture), ALPHA, num_landmarks=20, tile_rows=10)


def test_rows_of_a_file_are_those_that_were_written() -> None:
    rows = np.arange(60, dtype=np.uint16).reshape(5, 4, 3)
    stored = FileRows(io.BytesIO(rows.tobytes()), rows.shape, rows.dtype)
    assert np.array_equal(stored[2:4], rows[2:4])
    assert np.array_equal(stored[:], rows)
    assert stored[5:9].shape == (0, 4, 3)
