"""The network that corrects the model of an object: its weights, what it sees, and that results turn with pictures."""

import pytest
import torch

from nlfilter_torch.photo.selections import object_network
from nlfilter_torch.photo.selections.object_network import (
    EVIDENCE_PLANES,
    FEATURES,
    SHAPES,
    TRAINED_PIXELS,
    blurred,
    coarse_evidence,
    corrected,
    features,
    odds_of,
    trained,
)
from tests.problems import inverse, noise, oriented


def evidence(height: int = 12, width: int = 16, *, boxed: bool = False) -> torch.Tensor:
    """Random evidence (18, h, w) of an object in the middle, with a stroke inside and one outside."""
    planes = noise(1, sum(EVIDENCE_PLANES), height, width)[0]
    planes[12:17] = 0
    planes[12, 5:7, 6:9] = planes[14, 5:7, 6:8] = 1
    planes[13, 1, 1:5] = planes[15, 1, 1:4] = 1
    planes[16] = 1
    if boxed:
        planes[16, :, :3] = planes[16, :2] = 0
    return planes


def test_the_weights_are_small_and_finite() -> None:
    weights = trained()
    assert {name: tuple(weight.shape) for name, weight in weights.items()} == SHAPES
    assert sum(weight.numel() for weight in weights.values()) < 10_000
    assert all(bool(weight.isfinite().all()) for weight in weights.values())
    assert bool((weights["std"] > 0).all())


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("number", range(1, 8))
def test_results_turn_with_the_evidence(number: int, boxed: bool) -> None:
    planes = evidence(boxed=boxed)
    turned = corrected(oriented(planes[None], number)[0])
    torch.testing.assert_close(inverse(turned[None, None], number)[0, 0], corrected(planes), atol=1e-9, rtol=0)


def test_features_are_finite_without_strokes_or_object() -> None:
    planes = torch.zeros(sum(EVIDENCE_PLANES), 9, 11).double()
    planes.requires_grad_()
    found = features(coarse_evidence(planes))
    assert found.shape == (FEATURES, 9, 11)
    found.sum().backward()
    assert found.isfinite().all()
    assert planes.grad is not None
    assert planes.grad.isfinite().all()


def test_without_a_correction_the_model_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    planes = evidence()
    assert (corrected(planes) - odds_of(planes[-1])).abs().max() > 0.1
    none = {name: torch.zeros_like(weight) for name, weight in trained().items()}
    monkeypatch.setattr(object_network, "trained", lambda: none | {"std": torch.ones(FEATURES), "scale": torch.ones(1)})
    torch.testing.assert_close(corrected(planes), odds_of(planes[-1]))


def test_gradients_are_exact() -> None:
    planes = evidence(8, 9)
    planes[[0, 6, 9, 17]] = 0.3 + 0.4 * planes[[0, 6, 9, 17]]  # away from limits, where derivatives jump

    def of_some(changed: torch.Tensor) -> torch.Tensor:
        return corrected(torch.cat([changed[:1], planes[1:6], changed[1:2], planes[7:17], changed[2:], planes[18:]]))

    assert torch.autograd.gradcheck(of_some, planes[[0, 6, 17]].requires_grad_(), atol=1e-6, fast_mode=True)


def test_means_are_of_pixels_in_the_picture() -> None:
    planes = noise(1, 2, 7, 9)[0]
    sigma = 2.0 * (TRAINED_PIXELS / 63) ** 0.5  # 2 pixels of this picture
    rows, columns = torch.arange(7.0).double(), torch.arange(9.0).double()
    squared = (rows[:, None] - 3).square() + (columns - 1).square()
    weights = torch.exp(-squared / (2 * 2.0**2))
    wanted = (planes * weights).sum((1, 2)) / weights.sum()
    torch.testing.assert_close(blurred(planes, sigma)[:, 3, 1], wanted)


def test_means_in_blocks_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    planes = noise(3, 40, 150)
    whole = blurred(planes, 1.5)
    monkeypatch.setattr(object_network, "BLOCK", 16)
    torch.testing.assert_close(blurred(planes, 1.5), whole, rtol=0, atol=1e-7)
