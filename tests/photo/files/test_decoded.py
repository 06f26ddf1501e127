"""Errors of decoders become one sentence, and rows are regrouped."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from nlfilter_torch.photo.files.decoded import bands, decoding, quiet
from nlfilter_torch.photo.files.metadata import UnhandledImage


def test_errors_of_decoders_are_damage() -> None:
    with (
        pytest.raises(ValueError, match=r"^a\.png is damaged or cut short \(bad\); copy it again"),
        decoding(Path("a.png")),
    ):
        raise OSError("bad")
    with pytest.raises(ValueError, match="EOFError"), decoding(Path("a.png")):
        raise EOFError
    for kept in (UnhandledImage("of another kind"), MemoryError("too large")):
        with pytest.raises(type(kept), match=str(kept)), decoding(Path("a.png")):
            raise kept


def test_rows_are_regrouped() -> None:
    rows = np.arange(23).reshape(23, 1, 1)
    pieces = list(bands((rows[top : top + 5] for top in range(0, 23, 5)), 4))
    assert [len(piece) for piece in pieces] == [4, 4, 4, 4, 4, 3]
    np.testing.assert_array_equal(np.concatenate(pieces), rows)
    assert list(bands([], 4)) == []


def test_warnings_of_pillow_are_suppressed() -> None:
    with quiet():
        warnings.warn("damaged EXIF", stacklevel=1)
