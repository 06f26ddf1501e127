"""Stray ends and gaps of strokes: colours far from those of all the rest, along a stroke."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch.photo.selections.stray import Slices, distances_along, stray_runs

LENGTH, WIDTH = 60, 5
RED, GREEN, WHITE = (0.3, 0.5, 0.4), (0.25, -0.4, 0.3), (0.5, 0.0, 0.0)


def cells(bent: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a stroke, straight or with a corner."""
    plane = np.zeros((LENGTH, LENGTH), dtype=bool)
    plane[:WIDTH] = True
    plane[:, -WIDTH:] = bent | plane[:, -WIDTH:]
    return np.nonzero(plane)


def coloured(rows: np.ndarray, columns: np.ndarray, *parts: tuple[tuple[float, float, float], slice]) -> np.ndarray:
    """Colours of a stroke, red but for parts of its columns, with noise."""
    colours = np.tile(np.array(RED), (len(rows), 1))
    for colour, part in parts:
        colours[(columns >= part.start) & (columns < part.stop)] = colour
    return colours + np.random.default_rng(1).normal(0, 0.02, colours.shape)


def test_distances_follow_the_stroke() -> None:
    rows, columns = cells(bent=True)
    first, second = distances_along(rows, columns)
    assert first.max() == pytest.approx(2 * LENGTH - 2 * WIDTH, abs=2 * WIDTH)
    assert (first + second).min() >= first.max() - 1e-9  # no way is shorter than the shortest
    assert (first == 0).sum() == (second == 0).sum() == 1


@pytest.mark.parametrize("part", [slice(0, 12), slice(48, 60), slice(25, 37)])
def test_an_end_or_a_gap_of_another_colour_is_stray(part: slice) -> None:
    rows, columns = cells()
    stray = stray_runs(coloured(rows, columns, (GREEN, part)), rows, columns)
    inside = (columns >= part.start) & (columns < part.stop)
    assert stray[inside].all()
    assert not stray[(columns < part.start - 4) | (columns >= part.stop + 4)].any()


def test_both_ends_may_be_stray() -> None:
    rows, columns = cells()
    stray = stray_runs(coloured(rows, columns, (GREEN, slice(0, 9)), (WHITE, slice(51, 60))), rows, columns)
    assert stray[(columns < 9) | (columns >= 51)].all()
    assert not stray[(columns >= 14) & (columns < 46)].any()


@pytest.mark.parametrize(
    "parts",
    [
        (),
        ((GREEN, slice(30, 60)),),  # half of it
        ((GREEN, slice(0, 10)), (GREEN, slice(50, 60))),  # a colour that occurs elsewhere in the stroke
        tuple((WHITE, slice(start, start + 5)) for start in range(0, 60, 15)),  # a pattern
    ],
)
def test_what_is_meant_is_not(parts: tuple[tuple[tuple[float, float, float], slice], ...]) -> None:
    rows, columns = cells()
    assert not stray_runs(coloured(rows, columns, *parts), rows, columns).any()


def test_shading_is_not_stray() -> None:
    rows, columns = cells()
    shade = np.stack([0.5 * columns / LENGTH, np.zeros(len(rows)), np.zeros(len(rows))], axis=1)
    assert not stray_runs(shade, rows, columns).any()


@given(st.integers(1, 12), st.integers(1, 5), st.integers(0, 100))
def test_small_strokes_are_judged(length: int, width: int, seed: int) -> None:
    rows, columns = np.nonzero(np.ones((width, length), dtype=bool))
    colours = np.random.default_rng(seed).uniform(-1, 1, (len(rows), 3))
    assert stray_runs(colours, rows, columns).shape == rows.shape


def test_colours_do_not_depend_on_the_side_that_a_stroke_begins_on() -> None:
    rows, columns = cells()
    colours = coloured(rows, columns, (GREEN, slice(48, 60)))
    back = np.lexsort((LENGTH - 1 - columns, rows))
    there = stray_runs(colours, rows, columns)
    again = stray_runs(colours[back], rows[back], LENGTH - 1 - columns[back])
    assert (again == there[back]).mean() > 0.95


def test_slices_hold_all_cells() -> None:
    rows, columns = cells(bent=True)
    slices = Slices.of(distances_along(rows, columns)[0], coloured(rows, columns))
    assert set(slices.numbers) == set(range(len(slices.distances)))
    assert slices.shares[0] == 0
    assert slices.shares[-1] == pytest.approx(1)
