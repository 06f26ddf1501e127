"""Table I and Fig. 20 of the paper, on reduced versions of the twelve pictures of docs.tables."""

import pytest

from docs import tables
from docs.tables import METHODS, PICTURES, figure_20, is_rising, table_1

PAPER, DEFAULTS = METHODS
LONG_SIDE = 100


@pytest.mark.slow
def test_eigenvectors_of_the_papers_method_hold_the_pictures() -> None:
    rows = {name: table_1(name, LONG_SIDE, METHODS[PAPER], (1.0, 1.5, 2.0, 3.0)) for name in PICTURES}
    assert sum(row[0].beta >= tables.SUFFICIENT for row in rows.values()) >= 9
    for name, row in rows.items():
        assert is_rising([captured.beta for captured in row]), name
        assert all(captured.finite for captured in row), name


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_defaults_hold_at_narrow_bandwidths_too(name: str) -> None:
    row = table_1(name, LONG_SIDE, METHODS[DEFAULTS])
    assert is_rising([captured.beta for captured in row])
    for captured in row:
        assert captured.finite
        assert captured.row_sum_error <= 1e-4
        assert captured.largest_eigenvalue <= 1.0001
        assert captured.beta <= 1.0001


@pytest.mark.slow
@pytest.mark.parametrize("method", list(METHODS))
def test_error_falls_with_the_number_of_eigenvectors(method: str) -> None:
    for name in PICTURES:
        missed = [captured.relative_rmse for captured in figure_20(name, LONG_SIDE, METHODS[method])]
        assert is_rising([-share for share in missed]), (name, missed)
        assert missed[-1] < missed[0]


def test_a_filter_that_is_none_is_told() -> None:
    assert not tables.CapturedEnergy(0.9, 1e-6, 1.0).failed
    for broken in (
        tables.CapturedEnergy(float("nan"), 0.0, 1.0),
        tables.CapturedEnergy(0.9, 0.5, 1.0),
        tables.CapturedEnergy(0.9, 0.0, 1e12),
    ):
        assert broken.failed
    assert not tables.CapturedEnergy(float("nan"), 0.0, 1.0).finite
