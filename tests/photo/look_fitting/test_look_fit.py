"""Samples of pixels, and least squares with bounds."""

import pytest
import torch

from nlfilter_torch.photo.look_fitting.look_fit import MOST, nonnegative, sample


def test_sums_of_samples_are_those_of_all_pixels() -> None:
    generator = torch.Generator().manual_seed(0)
    whole = torch.rand(300, 400, generator=generator) + 0.1
    whole[:, :50] = 0
    places = sample(whole)
    assert len(places) == MOST
    assert len(set(places.tolist())) > 0.9 * MOST
    assert bool((whole.flatten()[places] > 0).all())
    assert torch.equal(places, places.sort().values)
    assert float(whole.flatten()[places].mean()) == pytest.approx(float(whole[:, 50:].mean()), abs=2e-3)
    assert torch.equal(sample(whole[:50]), whole[:50].flatten().nonzero().squeeze(1))


def test_nonnegative_least_squares_meets_its_conditions() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        root = torch.rand(12, 8, generator=generator, dtype=torch.float64) - 0.3
        matrix, vector = root.mT @ root, torch.rand(8, generator=generator, dtype=torch.float64) - 0.5
        found = nonnegative(matrix, vector)
        slope = vector - matrix @ found
        assert float(found.min()) >= 0
        assert float(slope.max()) < 1e-8
        assert float((slope * found).abs().max()) < 1e-8
