"""Two edits, one after the other."""

import torch

from nlfilter_torch.photo import Recipe, apply_recipe
from nlfilter_torch.photo.look_fitting.own_chains import Chain, is_exact
from nlfilter_torch.photo.look_fitting.own_edits import OwnDetail, OwnEdit, OwnSharpen, OwnTone
from nlfilter_torch.photo.look_fitting.viewed_pair import ViewedPair
from nlfilter_torch.photo.picture.in_memory import InMemory
from tests.looks import CAT, in_bytes

FEW = (("landmarks", 40),)
TONE, DETAIL = OwnTone(filter=FEW), OwnDetail(filter=FEW, order=2)


def chain(first: OwnEdit, second: OwnEdit, values: tuple[float, ...]) -> Chain:
    count = len(first.start)
    after = apply_recipe(Recipe((first.step(values[:count]), second.step(values[count:]))), CAT)
    pair = ViewedPair(CAT[0], in_bytes(after)[0], 1.5, 0)
    return Chain(first, second, [pair], [first.ingredients(CAT, first.operator(InMemory(CAT)))])


def test_the_right_values_leave_what_rounding_to_8_bits_does() -> None:
    values = (1.3, 1.0, 1.8, 1.4, 1.0, 5.0)
    both = chain(TONE, DETAIL, values)
    state = both.better(both.begin(torch.tensor((1.29, 1.05, *values[2:]), dtype=torch.float64)))
    best = both.snapped(state)
    assert is_exact(best)
    assert torch.allclose(best.values, torch.tensor(values, dtype=torch.float64), atol=0.03)
    assert not is_exact(state) or state is best


def test_a_start_is_near_the_values() -> None:
    values = (1.3, 1.0, 3.0)
    both = chain(TONE, OwnSharpen(), values)
    pair = both.pairs[0]
    seen = [[edit.ingredients(CAT, edit.operator(InMemory(CAT))).at(pair.places)] for edit in (both.first, both.second)]
    start = both.start(seen[0], seen[1], 2)
    assert torch.allclose(start.values, torch.tensor(values, dtype=torch.float64), atol=0.4)
    assert start.loss < 0.3 * float(pair.change().square().sum()) / 2
