"""Weights between neighbouring pixels."""

import math

import pytest
import torch

from nlfilter_torch.photo.selections.neighbours import SIDES, neighbour_weights


def test_weights_of_neighbours_are_those_of_pairs() -> None:
    guide = torch.rand(1, 2, 4, 5, generator=torch.Generator().manual_seed(3))
    weights = neighbour_weights(guide, lambda squared: torch.exp(-4 * squared))
    assert weights.shape == (1, 4, 4, 5)
    for number, (down, right) in enumerate(((0, 1), (1, 0), (1, 1), (1, -1))):
        for row in range(4):
            for column in range(5):
                wanted = 0.0
                if row + down < 4 and 0 <= column + right < 5:
                    difference = guide[0, :, row, column] - guide[0, :, row + down, column + right]
                    wanted = math.exp(-4 * float(difference.square().sum()))
                assert float(weights[0, number, row, column]) == pytest.approx(wanted)


def test_sides_are_the_pixels_with_a_neighbour_and_their_neighbours() -> None:
    numbers = torch.arange(20).view(4, 5)
    steps = [numbers[there] - numbers[here] for here, there in SIDES]
    assert [sorted(set(step.flatten().tolist())) for step in steps] == [[1], [5], [6], [4]]
    assert [step.numel() for step in steps] == [16, 15, 12, 12]
