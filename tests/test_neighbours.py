"""Weights between neighbouring pixels."""

import pytest
import torch

from nlfilter_torch.photo.selections.neighbours import SIDES, neighbour_weights


def test_weights_of_neighbours_are_those_of_pairs() -> None:
    guide = torch.rand(1, 2, 4, 5, generator=torch.Generator().manual_seed(3))
    weights = neighbour_weights(guide, lambda squared: torch.exp(-4 * squared))
    assert weights.shape == (1, 4, 4, 5)
    for number, (here, there) in enumerate(SIDES):
        wanted = torch.exp(-4 * (guide[..., *here] - guide[..., *there]).square().sum(1))
        torch.testing.assert_close(weights[:, number, *here], wanted)
        assert float(weights[:, number].sum()) == pytest.approx(float(wanted.sum()))
