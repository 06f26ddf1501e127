"""Drawn patterns repeat, differ between generators, and fall into two families without a common kind."""

import pytest
import torch
from torch import Tensor

from benchmarks.training.patterns import APART, TRAINED, pattern


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def best_match(picture: Tensor) -> float:
    """Error of the best other place of a patch from the middle, over the variance of the picture."""
    side, half = 9, picture.shape[-1] // 2
    patches = picture[None].unfold(2, side, 1).unfold(3, side, 1)[0].permute(1, 2, 0, 3, 4).flatten(2)
    middle = patches[half - side // 2, half - side // 2]
    errors = (patches - middle).square().mean(-1)
    reach = side // 2
    errors[half - side // 2 - reach : half - side // 2 + reach + 1, half - side - reach : half + reach + 1] = 1
    return float(errors.min() / picture.var(dim=(1, 2)).mean().clamp(min=1e-4))


@pytest.mark.parametrize("kind", [*TRAINED, *APART])
def test_each_kind_draws_a_picture_that_repeats(kind: str) -> None:
    matches = []
    for seed in range(5):
        picture = pattern(64, generator(seed), kind=kind)
        assert picture.shape == (3, 64, 64)
        assert picture.min() >= 0
        assert picture.max() <= 1
        assert picture.std(dim=(1, 2)).max() > 0.01
        matches.append(best_match(picture))
    assert sorted(matches)[2] < (0.8 if kind in ("text", "digits") else 0.3)


def test_equal_generators_draw_equal_pictures_and_leave_the_global_one() -> None:
    state = torch.random.get_rng_state()
    first, again, other = (pattern(32, generator(seed)) for seed in (1, 1, 2))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_the_families_have_no_kind_in_common() -> None:
    assert not set(TRAINED) & set(APART)
    drawn = {
        held_out: torch.stack([pattern(16, generator(seed), held_out=held_out) for seed in range(6)])
        for held_out in (False, True)
    }
    assert not torch.equal(drawn[False], drawn[True])
