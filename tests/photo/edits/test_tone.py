"""Contrast and local contrast: what they change, and what they leave unchanged."""

from typing import Any

import pytest
import torch

from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.photo import adjust_tone, enhance
from nlfilter_torch.photo.picture.colour import split_luminance
from tests.problems import colour, luminance

#: The filter of the paper, without limits.
PLAIN: dict[str, Any] = {
    "limits": "none",
    "photometric_bandwidth": "auto",
    "spatial_bandwidth": "none",
    "num_landmarks": 100,
}


def test_tone_holds_mean_and_colours() -> None:
    image = colour("coffee", 40, 60)
    strong = adjust_tone(image, contrast=1.4, clarity=3.0, **PLAIN)
    torch.testing.assert_close(strong.mean((2, 3)), image.mean((2, 3)), atol=1e-5, rtol=0)
    torch.testing.assert_close(split_luminance(strong)[1], split_luminance(image)[1], atol=1e-5, rtol=0)
    assert luminance(strong).std() > 1.2 * luminance(image).std()
    assert torch.equal(adjust_tone(image), image)
    grey = luminance(image)
    operator = nonlocal_operator(grey)
    mean = grey.mean()
    expected = mean + polynomial_filter(operator, grey - mean, torch.tensor([1.0, 1.0, 3.0, 1.4]))
    torch.testing.assert_close(adjust_tone(grey, contrast=1.4, clarity=3.0, **PLAIN), expected)


@pytest.mark.parametrize("name", ["astronaut", "coffee"])
def test_saturated_highlights_keep_their_chroma(name: str) -> None:
    """Also if chroma gained elsewhere could make up for the loss."""
    image = colour(name, 64, 96)
    before = split_luminance(image)[1].norm(dim=1)
    edits = ((adjust_tone(image, contrast=1.4), 0.03), (enhance(image, torch.tensor([3.0, 3.0, 3.0, 1.0])), 0.015))
    for edited, limit in edits:
        after = split_luminance(edited)[1].norm(dim=1)
        assert (before - after).clamp(min=0).mean() < limit * before.mean()
        assert after.mean() == pytest.approx(float(before.mean()), rel=0.01)
