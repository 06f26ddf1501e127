"""Colours beside the borders of a mask: mixtures in soft borders, and textures that are left alone."""

import torch

from nlfilter_torch.photo.selections.border_colours import Sides, colours_beside, refine_mask
from nlfilter_torch.photo.selections.matting import linear_mask
from tests.problems import noise

INSIDE, OUTSIDE = (torch.tensor(values).view(1, 3, 1, 1) for values in ((0.7, 0.2, 0.1), (0.1, 0.3, 0.8)))


def ramp(width: float) -> torch.Tensor:
    """A mask (1, 1, 40, 60) that falls from 1 to 0 over so many pixels around the middle."""
    return (0.5 - (torch.arange(60) - 29.5) / width).clamp(0, 1).expand(1, 1, 40, 60)


def test_pixels_of_a_soft_border_are_mixtures_of_the_colours_beside_it() -> None:
    alpha = ramp(4.0)
    image = torch.lerp(OUTSIDE, INSIDE, alpha)
    sides = colours_beside(image, alpha)
    middle = (..., slice(12, 28), slice(27, 33))
    torch.testing.assert_close(linear_mask(image, sides.mixture)[middle], alpha[middle], atol=0.12, rtol=0)
    assert sides.trust[middle].min() > 0.6
    across = (INSIDE - OUTSIDE).expand_as(image)
    torch.testing.assert_close(sides.across[..., 28:32], across[..., 28:32], atol=0.2, rtol=0)
    refined = refine_mask(image, ramp(7.0))  # of a mask whose border is too soft
    assert (refined - alpha)[middle].abs().mean() < 0.5 * (ramp(7.0) - alpha)[middle].abs().mean()


def test_similar_colours_and_certain_pixels_change_nothing() -> None:
    image, alpha = 0.5 + 0.001 * noise(1, 3, 40, 60, dtype=torch.float32), ramp(8.0)
    sides = colours_beside(image, alpha)
    assert sides.trust.max() < 0.01
    torch.testing.assert_close(sides.refine(image, alpha), alpha, atol=0.01, rtol=0)
    certain = ramp(1.0)
    assert torch.equal(colours_beside(image, certain).refine(image, certain), certain)


def test_planes_hold_all_of_the_sides() -> None:
    sides = colours_beside(torch.lerp(OUTSIDE, INSIDE, ramp(8.0)), ramp(8.0))
    again = Sides.of(sides.planes)
    assert sides.planes.shape == (1, 8, 40, 60)
    for name in ("mixture", "trust", "across"):
        assert torch.equal(getattr(again, name), getattr(sides, name))
