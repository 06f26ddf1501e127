"""Pixels kept for the lattice, and lattices of looks."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.photo import fit_look
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.looks.edited_pixels import EditedPhotograph
from nlfilter_torch.photo.looks.look_filter import COLOUR_PARTS
from nlfilter_torch.photo.looks.look_sums import PartLayout
from nlfilter_torch.photo.looks.region import (
    THINNED,
    ThinnedPixels,
    coloured,
    is_of_colours,
)
from tests.looks import CAT, CUP, FEW, SUIT, explained, in_bytes, single_look


def by_hue(image: Tensor) -> Tensor:
    """An edit that no curve or matrix says: colours become lighter or darker by their hue."""
    red, green, blue = image.split(1, dim=1)
    across, along = red - green, (red + green) / 2 - blue
    return in_bytes(image**0.8 + 0.6 * torch.hypot(across, along) * torch.sin(3 * torch.atan2(across, along)))


def test_edits_by_hue_need_a_lattice_and_carry_over() -> None:
    pairs = [(image, by_hue(image)) for image in (CAT, CUP, SUIT)]
    names = ("curves", "matrix", "saturation")
    plain = single_look(fit_look(pairs[:2], parts=names, step=FEW))
    look = single_look(fit_look(pairs[:2], parts=(*names, "lattice"), step=FEW))
    assert look.parts[-1] == "lattice"
    for pair in pairs:
        without, share = (1 - explained(*pair, each_look.apply(pair[0])) for each_look in (plain, look))
        assert share < 0.6 * without
    assert look.explained[look.parts] == (look.fitted, look.left_out)
    assert look.tensors["lattice"].shape[0] == 3
    again = Recipe.from_json(look.to_json(), "it").steps[0]
    assert again == look.step


def test_pairs_without_common_colours_have_a_lattice_if_parts_of_all_agree() -> None:
    before = [
        in_bytes(image * (0.7 + 0.3 * torch.eye(3)[i]).view(1, 3, 1, 1)) for i, image in enumerate((CAT, CUP, SUIT))
    ]
    look = single_look(fit_look([(image, by_hue(image)) for image in before], step=FEW))
    assert look.parts[-1] == "lattice"
    assert look.left_out < 0.9  # of colours that no other pair has


def test_parts_that_are_functions_of_the_colour() -> None:
    assert is_of_colours(("tone", "matrix"))
    assert not is_of_colours(("curves", "bands"))


def test_half_a_picture_carries_over_to_the_other() -> None:
    edited = by_hue(CUP)
    look = single_look(fit_look([(CUP[..., :50], edited[..., :50])], step=FEW))
    assert explained(CUP[..., 50:], edited[..., 50:], look.apply(CUP[..., 50:])) > 0.97


def test_smooth_skies_stay_smooth_and_greys_rise() -> None:
    look = single_look(fit_look([(CUP, by_hue(CUP))], step=FEW))
    ramp = torch.linspace(0.02, 0.98, 400)
    sky = torch.stack([0.3 + 0.3 * ramp, 0.5 + 0.3 * ramp, 0.7 + 0.3 * ramp]).view(1, 3, 1, -1)
    rises = look.apply(sky)[0, :, 0].diff() / sky[0, :, 0].diff()
    assert float(rises.min()) > 0.1  # no plateau that would show as a band
    assert float(rises.diff().abs().max()) < 1
    greys = look.apply(ramp.expand(1, 3, 1, -1))[0, :, 0]
    assert float(greys.diff().min()) >= -1e-6


def test_greys_never_get_darker_even_if_those_of_the_edit_do() -> None:
    strange = in_bytes(CUP**0.8 + 0.3 * torch.sin(12 * CUP.mean(1, keepdim=True)))
    look = single_look(fit_look([(CUP, strange)], parts=("curves", "lattice"), step=FEW))
    greys = look.apply(torch.linspace(0, 1, 300).expand(1, 3, 1, -1))[0, :, 0]
    assert look.parts[-1] == "lattice"
    assert float(greys.diff().min()) >= -1e-5


def test_never_more_pixels_than_enough_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = ThinnedPixels()
    assert THINNED >= 1 << 16
    monkeypatch.setattr("nlfilter_torch.photo.looks.region.THINNED", 15_000)
    for number, image in enumerate((CAT, CUP, SUIT, CAT, CUP)):
        photograph = EditedPhotograph(image[0], image[0] ** 0.7, None, FEW, 3, None)
        (pixels,) = photograph.regions()
        kept.add(pixels._replace(fold=torch.full_like(pixels.fold, number)))
        total = float(kept.all().shown.sum())
        assert total == pytest.approx(8000 * (number + 1), rel=0.01)
        assert len(kept.all().shown) <= 15_000
    assert kept.step == 4
    assert kept.all().fold.unique().tolist() == [0, 1, 2, 3, 4]


def test_colours_under_a_look_are_those_of_its_columns() -> None:
    photograph = EditedPhotograph(CUP[0], by_hue(CUP)[0], None, FEW, 3, None)
    layout = PartLayout(17, 5, 4)
    pixels, more = photograph.regions()[0].every(4), photograph.colours(5000)[0]
    assert (len(pixels.shown), len(more.shown)) == (2000, 5000)
    assert float(pixels.shown.sum()) == pytest.approx(float(more.shown.sum()), rel=0.01)
    coefficients = torch.randn(3, layout.columns, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    coefficients[:, layout.place("saturation")] = coefficients[:1, layout.place("saturation")]  # for all channels
    others = [layout.place(name) for name in layout.lengths if name not in COLOUR_PARTS]
    for place in others:
        coefficients[:, place] = 0
    change = torch.einsum("cf,cfp->cp", coefficients, pixels.columns(layout))
    shown = coloured(pixels.before.double(), coefficients, layout)
    torch.testing.assert_close(shown, pixels.before + change)


@pytest.mark.parametrize("colour", [(0.5, 0.5, 0.5), (0.2, 0.6, 0.4)])
def test_pairs_of_one_colour_or_two(colour: tuple[float, float, float]) -> None:
    before = torch.tensor(colour).view(1, 3, 1, 1).expand(1, 3, 20, 20).clone()
    after = before * 0.8
    look = single_look(fit_look([(before, after)], step=Step("look", landmarks=20)))
    assert bool(look.apply(before).isfinite().all())
    before[..., :10] = 0.9
    after = before * 0.8
    look = single_look(fit_look([(before, after)], step=Step("look", landmarks=20)))
    assert explained(before, after, look.apply(before)) > 0.9


def test_a_photograph_of_which_most_is_clipped_is_white_again() -> None:
    after = in_bytes(by_hue(CUP) * 1.6)
    look = single_look(fit_look([(CUP, after)], step=FEW))
    white = (after == 1).all(1, keepdim=True).expand_as(after)
    assert float(white.float().mean()) > 0.02
    assert float((apply_step(look.step, CUP).clamp(0, 1) - after)[white].abs().mean()) < 0.01
