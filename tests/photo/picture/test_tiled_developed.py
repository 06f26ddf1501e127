"""Rows of a developed picture: those of the whole picture, by any requests, with little memory."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.picture.light import develop_image
from nlfilter_torch.photo.picture.tiled_developed import developed_rows
from nlfilter_torch.photo.picture.tiles import Passes
from tests.pairwise import each_value
from tests.recipes import from_rows, rows_of
from tests.tiles import Rows, cat

ALL = Development(exposure=0.3, warmth=0.2, tint=-0.1, straighten=4.0, crop=(0.1, 0.0, 1.0, 0.8))


@pytest.mark.parametrize(
    ("development", "dtype"),
    each_value(
        [
            Development(),
            ALL,
            ALL.geometry,
            Development(exposure=-1.0),
            Development(crop=ALL.crop),
            Development(rotate=90, contrast=0.5, crop=ALL.crop),
            Development(rotate=270, straighten=3.0, curve=(0.1, 1.0)),
            Development(exposure=0.2, saturation=0.5, vibrance=-0.3),
        ],
        ["float32", "float64"],
    ),
)
def test_rows_are_those_of_the_image(development: Development, dtype: str, tmp_path: Path) -> None:
    picture = cat(270, 290).astype(dtype)
    wanted = rows_of(develop_image(from_rows(picture), development))
    with developed_rows(development, Passes(dtype, folder=tmp_path), picture, "scan.tif") as rows:
        assert rows.shape == wanted.shape
        assert rows.dtype == dtype
        for part in (slice(0, 1), slice(31, 77), slice(0, rows.shape[0])):
            assert np.array_equal(rows[part], wanted[part])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [(90, 120), (700, 800)])
def test_areas_of_rows_are_those_of_the_image(size: tuple[int, int], tmp_path: Path) -> None:
    picture = cat(*size).astype("float32")
    development = Development(exposure=0.2, shadows=0.8, highlights=-0.6, temperature="auto")
    wanted = rows_of(develop_image(from_rows(picture), development))
    with developed_rows(development, Passes("float32", folder=tmp_path), picture, "scan.tif") as rows:
        assert np.abs(rows[0 : size[0]] - wanted).max() < 2e-4
        assert np.abs(rows[0 : size[0]] - picture).max() > 0.05


def test_a_few_rows_at_a_time(tmp_path: Path) -> None:
    picture = np.rint(255 * np.tile(cat(50, 60), (9, 1, 1))).astype(np.uint8)
    passes = Passes("float32", folder=tmp_path, memory=1 << 20)
    with developed_rows(
        Development(exposure=1.0, crop=(0.0, 0.5, 1.0, 1.0)), passes, Rows(picture, 40), "scan.tif"
    ) as rows:
        assert np.asarray(rows[10:20]).shape == (10, 60, 3)


class Elsewhere:
    """Processes of another machine."""

    on_this_machine = 0


def test_other_processes_take_rows_that_need_no_file(tmp_path: Path) -> None:
    passes = Passes("float32", folder=tmp_path, processes=Elsewhere())  # type: ignore[arg-type]
    picture = cat(20, 30)
    with developed_rows(Development(exposure=0.5, crop=(0.0, 0.0, 0.5, 1.0)), passes, picture, "scan.zarr") as rows:
        copy = pickle.loads(pickle.dumps(rows))
        assert np.array_equal(copy[0:20], rows[0:20])
    with (
        pytest.raises(ValueError, match="straighten must be 0 with --workers or --cluster, got 4; leave these out"),
        developed_rows(ALL, passes, picture, "scan.zarr"),
    ):
        pass
