"""Pixels of a photograph before and after an edit, all or a sample."""

import pytest
import torch

from nlfilter_torch.photo import fit_look
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.look_fitting.look_pixels import EditedPhotograph
from tests.looks import ALPHA, CAT, FEW, explained, in_bytes, single_look


def test_layers_of_a_sample_are_nearly_those_of_all_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.look_fitting.look_sums.MOST", 2000)
    monkeypatch.setattr("nlfilter_torch.photo.look_fitting.look_pixels.MOST", 2000)
    photograph = EditedPhotograph(CAT[0], (CAT[0] ** 0.7), None, FEW, 3, None)
    regions = photograph.regions_of_sample()
    assert regions is not None
    (sample,) = regions
    assert sample.weighed["alpha"].shape == (4, 2000)
    assert float(sample.weights[0].sum()) == pytest.approx(float(photograph.free[0].sum()), rel=0.02)
    exact = photograph.layers[:, sample.places]
    assert torch.allclose(sample.weighed["alpha"].sum(0), exact.sum(0), atol=1e-5)
    assert bool(((sample.weighed["alpha"] - exact).square().mean(1) < 0.04 * exact.square().mean(1)).all())
    masks = torch.ones(1, *CAT.shape[-2:])
    assert EditedPhotograph(CAT[0], CAT[0] ** 0.7, masks, FEW, 3, None).regions_of_sample() is None


def test_a_sampled_pair_and_a_whole_one_have_the_same_look() -> None:
    large = torch.nn.functional.interpolate(CAT, (320, 400), mode="bicubic").clamp(0, 1)  # 128,000 pixels
    step = Step("detail", alpha=ALPHA, limits="none", threshold=0.0, landmarks=40, viewing_size=0.0)
    sliders = single_look(fit_look([(large, in_bytes(apply_step(step, large)))], step=FEW.changed(viewing_size=0.0)))
    assert sliders.step["alpha"] == pytest.approx(ALPHA, abs=1e-3)
    curve = single_look(fit_look([(large, in_bytes(large**0.7))], step=FEW))
    assert explained(large, large**0.7, curve.apply(large)) > 0.99
