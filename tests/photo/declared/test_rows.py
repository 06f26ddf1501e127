"""Rows as files store them: pixels that are hidden, and pixels without data."""

import numpy as np

from nlfilter_torch.photo.declared.rows import NodataRows, is_hidden, keep_apart, lacks_data


def test_what_lacks_data() -> None:
    colours = np.array([[[0, 0, 0], [0, 5, 0]]], np.uint8)
    assert lacks_data(colours, 0.0).tolist() == [[True, False]]
    assert lacks_data(colours.astype(np.float32), 0.0).tolist() == [[True, True]]
    assert not lacks_data(colours, -9999.0).any()
    assert not lacks_data(colours.astype(np.float32), -1.8e308).any()
    assert not lacks_data(colours, float("nan")).any()
    rows = NodataRows(colours, 0.0)
    assert rows.shape == (1, 2, 4)
    assert rows[0:1][..., 3].tolist() == [[0, 255]]


def test_values_of_pixels_with_data_are_moved_off_the_value_without() -> None:
    for dtype, moved in (("uint8", 1), ("float32", np.nextafter(np.float32(0), np.float32(1)))):
        values = np.zeros((1, 3, 1), dtype)
        hidden = is_hidden(np.array([[[1], [0], [2]]], np.uint8))
        keep_apart(values, hidden, 0.0)
        assert values[0, :, 0].tolist() == [moved, 0, moved]
