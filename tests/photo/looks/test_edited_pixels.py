"""Pixels of a photograph before and after an edit, all or a sample."""

import pytest
import torch

from nlfilter_torch.photo import fit_look
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.looks.edited_pixels import EditedPhotograph, images_of, means_of_shades
from nlfilter_torch.photo.looks.look_sums import sample as sample_of
from tests.looks import ALPHA, CAT, CUP, FEW, explained, in_bytes, single_look


def test_layers_of_a_sample_are_nearly_those_of_all_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.looks.look_sums.SAMPLED_PIXELS", 2000)
    monkeypatch.setattr("nlfilter_torch.photo.looks.edited_pixels.SAMPLED_PIXELS", 2000)
    photograph = EditedPhotograph(CAT[0], (CAT[0] ** 0.7), None, FEW, 3, None)
    regions = photograph.regions_of_sample()
    assert regions is not None
    (sample,) = regions
    assert sample.surroundings[0, -4:].shape == (4, 2000)
    assert float(sample.weights[0].sum()) == pytest.approx(float(photograph.free[0].sum()), rel=0.02)
    exact = photograph.layers[:, sample_of(torch.ones(CAT.shape[-2:]))]
    assert torch.allclose(sample.surroundings[0, -4:].sum(0), exact.sum(0), atol=1e-5)
    assert bool(((sample.surroundings[0, -4:] - exact).square().mean(1) < 0.04 * exact.square().mean(1)).all())
    masks = torch.ones(1, *CAT.shape[-2:])
    assert EditedPhotograph(CAT[0], CAT[0] ** 0.7, masks, FEW, 3, None).regions_of_sample() is None


def test_a_sampled_pair_and_a_whole_one_have_the_same_look() -> None:
    large = torch.nn.functional.interpolate(CAT, (320, 400), mode="bicubic").clamp(0, 1)  # 128,000 pixels
    step = Step("detail", alpha=ALPHA, limits="none", threshold=0.0, landmarks=40, viewing_size=0.0)
    sliders = single_look(fit_look([(large, in_bytes(apply_step(step, large)))], step=FEW.changed(viewing_size=0.0)))
    assert sliders.step["alpha"] == pytest.approx(ALPHA, abs=1e-3)
    curve = single_look(fit_look([(large, in_bytes(large**0.7))], step=FEW))
    assert explained(large, large**0.7, curve.apply(large)) > 0.99


def test_batches_and_grey_photographs_are_images_in_colour() -> None:
    batch = torch.cat([CAT, CAT.flip(3)]).mean(1, keepdim=True)
    masks = torch.ones_like(batch).expand(-1, 2, -1, -1)
    images = list(images_of([(batch, batch**0.5, masks), (CAT, CAT**0.5)]))
    assert [tuple(before.shape) for before, _, _ in images] == [tuple(CAT.shape[1:])] * 3
    assert [None if masks is None else len(masks) for _, _, masks in images] == [2, 2, None]
    assert torch.equal(images[1][1], batch[1].expand(3, -1, -1) ** 0.5)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([], "pairs must hold a pair"),
        ([(CAT, CAT)], "each is the same before and after"),
        ([(CAT, torch.zeros_like(CAT))], "not clipped to black or white"),
        ([(CAT, CUP.flip(2, 3))], "must be an edit of before of pair 1"),
        ([(CAT, CAT[..., :50])], "after of pair 1"),
        ([CAT], "pairs must hold tuples"),
        ([(CAT, CAT**0.5, torch.zeros_like(CAT))], "masks must hold a pixel"),
        ([(CAT, CAT.to("meta"))], "after of pair 1 must be on the device of the before of pair 1, cpu, got meta; move"),
        ([(CAT, CAT**0.5), (CAT.to("meta"), CAT.to("meta"))], "before of pair 2 must be on the device of the first"),
        ([(CAT, CAT**0.5, CAT[:, :1].to("meta"))], "masks must be on the device of the before of pair 1, cpu, got"),
    ],
)
def test_bad_pairs_are_refused_in_a_sentence(pairs: list[object], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as error:
        fit_look(pairs, step=FEW)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


def test_means_are_those_of_pixels_of_the_same_shade() -> None:
    grey = torch.tensor([0.2, 0.8, 0.2, 1.3, 1.0], dtype=torch.float64)
    values = torch.tensor([1.0, 5.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    assert means_of_shades(grey, values).tolist() == [1.5, 5.0, 1.5, 3.5, 3.5]
