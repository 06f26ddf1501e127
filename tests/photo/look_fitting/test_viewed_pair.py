"""A photograph before and after an edit, at the viewing size."""

import torch

from nlfilter_torch.photo.look_fitting.viewed_pair import ViewedPair
from tests.looks import CAT


def test_errors_and_groups_are_those_of_the_sample() -> None:
    pair = ViewedPair(CAT[0], CAT[0].square(), 1.5, 0)
    assert torch.equal(pair.places, torch.arange(8000))
    assert torch.equal(pair.errors(pair.after), torch.zeros(24000, dtype=torch.float64))
    assert torch.equal(pair.errors(pair.before), pair.change())
    assert pair.groups(alone=True).unique().tolist() == [0, 1, 2]
    assert ViewedPair(CAT[0], CAT[0].square(), 1.5, 4).groups(alone=False).unique().tolist() == [4]
    assert ViewedPair(CAT[0], CAT[0].square(), 0.002, 0).image.shape == (1, 3, 40, 50)


def test_frames_have_no_weight() -> None:
    after = CAT[0].clone()
    after[:, :10] = 1.0
    pair = ViewedPair(CAT[0], after, 1.5, 0)
    assert pair.weights.view(80, 100)[:10].sum() == 0
    assert bool((pair.weights.view(80, 100)[10:] == 1).all())


def test_only_changes_of_brightness_by_surroundings_can_be_steps() -> None:
    grey = CAT.mean(1, keepdim=True)
    shift = 0.1 * (grey - grey.mean((2, 3), keepdim=True)).roll((3, 3), (2, 3))
    assert ViewedPair(CAT[0], (CAT + shift)[0], 1.5, 0).is_of_brightness()
    for after in (CAT**0.8, CAT * torch.tensor([1.1, 1.0, 0.9]).view(1, 3, 1, 1), CAT):
        assert not ViewedPair(CAT[0], after[0].clamp(0, 1), 1.5, 0).is_of_brightness()
