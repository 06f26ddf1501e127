"""Grids in which every two values meet."""

from itertools import combinations, product

import pytest

from tests.pairwise import each_value, pairwise

AXES = ("abcdef", range(5), [None, (1, 2), [3], "x"], [True, False])


@pytest.mark.parametrize("count", [2, 3, 4])
def test_every_pair_of_values_stands_in_a_row(count: int) -> None:
    axes = AXES[:count]
    rows = pairwise(*axes)
    for (i, one), (j, other) in combinations(enumerate(axes), 2):
        assert all(any(row[i] == a and row[j] == b for row in rows) for a, b in product(one, other))
    assert 30 <= len(rows) <= 33  # no fewer hold the pairs of the two longest axes


def test_impossible_rows_are_left_out() -> None:
    rows = pairwise(range(4), range(4), "ab", possible=lambda a, b, _: a * b < 6)
    assert {row[:2] for row in rows} == {(a, b) for a in range(4) for b in range(4) if a * b < 6}
    assert {(row[0], row[2]) for row in rows} == set(product(range(4), "ab"))


def test_a_single_value_stands_in_every_row() -> None:
    assert pairwise("abc", "x") == [("a", "x"), ("b", "x"), ("c", "x")]


def test_each_value_stands_in_a_row() -> None:
    assert each_value("abc", [1, 2]) == [("a", 1), ("b", 2), ("c", 1)]
