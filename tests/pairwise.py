"""Grids of parameters in which every two values meet, in place of all combinations of all values."""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations, product
from typing import Any

Row = tuple[Any, ...]


def pairwise(*values: Iterable[Any], possible: Callable[..., bool] = lambda *_: True) -> list[Row]:
    """Return rows with one value of every axis, in which any two values of two axes stand together in some row.

    Most faults depend on one value or on two together, so these rows find nearly what all combinations find; with axes
    of six, five and four values they are about 30 in place of 120. Rows are chosen greedily: each is the combination
    that holds most of the pairs that are still missing. ``possible`` says of the values of a row whether they can
    stand together; pairs that no possible row holds are left out.
    """
    axes = [tuple(axis) for axis in values]
    rows = [row for row in product(*(range(len(axis)) for axis in axes)) if possible(*_values(axes, row))]
    missing = {row: _pairs(row) for row in rows}
    chosen = []
    while missing:
        row = max(missing, key=lambda candidate: len(missing[candidate]))  # the first of several
        chosen.append(row)
        held = missing.pop(row)
        missing = {other: rest for other, pairs in missing.items() if (rest := pairs - held)}
    return [_values(axes, row) for row in sorted(chosen)]


def each_value(*values: Iterable[Any]) -> list[Row]:
    """Return rows in which every value of every axis stands once at least: for axes that do not act on each other."""
    axes = [tuple(axis) for axis in values]
    return [tuple(axis[n % len(axis)] for axis in axes) for n in range(max(map(len, axes)))]


def _pairs(row: tuple[int, ...]) -> set[tuple[tuple[int, int], ...]]:
    return set(combinations(enumerate(row), 2))


def _values(axes: Sequence[Sequence[Any]], row: Sequence[int]) -> Row:
    return tuple(axis[index] for axis, index in zip(axes, row, strict=True))
