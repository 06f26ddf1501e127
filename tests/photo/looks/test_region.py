"""Looks of the pixels of all pairs, or of a region in them."""

import pytest
import torch

from nlfilter_torch.photo import Step, apply_look, apply_step, fit_look
from tests.looks import ALPHA, CAT, CUP, FEW, SEPIA, explained, in_bytes, rgb, single_look


@pytest.mark.parametrize("count", [1, 2])
def test_sliders_are_found_through_eight_bits(count: int) -> None:
    images = (rgb("chelsea", slice(0, 300, 2), slice(0, 450, 2)), rgb("coffee", slice(0, 300, 2), slice(0, 450, 2)))
    step = Step("detail", alpha=ALPHA, limits="none", threshold=0.0, landmarks=150)
    pairs = [(image, in_bytes(apply_step(step, image))) for image in images[:count]]
    look = single_look(fit_look(iter(pairs), step=Step("look", landmarks=150)))
    assert look.parts == ("alpha",)
    assert look.step.edit == "detail"
    assert look.step["alpha"] == pytest.approx(ALPHA, abs=1e-3)
    assert look.fitted > 0.99
    assert torch.allclose(look.apply(images[0]).clamp(0, 1), pairs[0][1], atol=1.01 / 255)


def test_regions_have_looks_of_their_own() -> None:
    masks = torch.zeros(1, 2, *CAT.shape[-2:])
    masks[:, 0, :, :50], masks[:, 1, :, 50:] = 1, 1
    bright, sepia = in_bytes(CAT**0.6), in_bytes(apply_look(CAT, matrix=SEPIA))
    looks = fit_look([(CAT, torch.where(masks[:, :1] > 0, bright, sepia), masks)], step=FEW)
    assert isinstance(looks, tuple)
    left, right = (look.apply(CAT) for look in looks)
    assert explained(CAT[..., :50], bright[..., :50], left[..., :50]) > 0.98
    assert explained(CAT[..., 50:], sepia[..., 50:], right[..., 50:]) > 0.98


def test_a_region_may_be_missing_in_some_pairs() -> None:
    sky = torch.zeros(1, 2, *CAT.shape[-2:])
    sky[:, 0, :40], sky[:, 1, 40:] = 1, 1
    ground = torch.stack([torch.zeros_like(sky[:, 0]), torch.ones_like(sky[:, 0])], dim=1)
    bright, sepia = in_bytes(CAT**0.6), in_bytes(apply_look(CAT, matrix=SEPIA))
    pairs = [
        (CUP, in_bytes(apply_look(CUP, matrix=SEPIA)), ground),
        (CAT, torch.where(sky[:, :1] > 0, bright, sepia), sky),
    ]
    looks = fit_look(pairs, step=FEW)
    assert isinstance(looks, tuple)
    upper, lower = (look.apply(CAT) for look in looks)
    assert explained(CAT[..., :40, :], bright[..., :40, :], upper[..., :40, :]) > 0.98
    assert explained(CAT[..., 40:, :], sepia[..., 40:, :], lower[..., 40:, :]) > 0.98
    with pytest.raises(
        ValueError, match="masks must hold a pixel that is not clipped in every region, got none in reg"
    ):
        fit_look([(*pairs[0][:2], ground)], step=FEW)
