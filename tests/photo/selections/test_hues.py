"""Corrections of masks by hue and saturation."""

import torch

from nlfilter_torch.photo.picture.colour import split_luminance
from nlfilter_torch.photo.selections.hues import (
    HueSamples,
    corrections,
    pieces_of,
    relative_chroma,
    shade,
    shaded_parts,
    trusted,
)

RED, WOOD, GREY = (0.6, 0.1, 0.1), (0.5, 0.3, 0.15), (0.4, 0.4, 0.4)


def colour(*channels: float) -> torch.Tensor:
    return torch.tensor(channels, dtype=torch.float64).view(1, 3, 1)


def filled(*channels: float, size: tuple[int, int] = (60, 80)) -> torch.Tensor:
    return colour(*channels).unsqueeze(3).expand(1, 3, *size)


def of_red() -> HueSamples:
    shaded = torch.linspace(0.5, 1.2, 40, dtype=torch.float64)
    return HueSamples.of(colour(*RED) * shaded, torch.ones(1, 1, 40, dtype=torch.float64))


def test_light_and_shade_of_a_colour_are_nearly_the_same() -> None:
    light, dark = relative_chroma(colour(*RED)), relative_chroma(0.3 * colour(*RED))
    assert (light - dark).abs().max() < 0.06 < (light - relative_chroma(colour(*WOOD))).abs().max()
    assert relative_chroma(colour(*GREY)).abs().max() < 1e-6


def test_likeness_is_of_hue_and_saturation() -> None:
    samples = of_red()
    assert samples.likeness(0.6 * filled(*RED)).min() == 1
    assert max(samples.likeness(filled(*other)).max() for other in (WOOD, GREY, RED[::-1])) < 0.15


def test_doubtful_areas_of_another_hue_do_not_count() -> None:
    alike = torch.ones(1, 1, 60, 80)
    alike[..., 40:] = 0.5
    mask = torch.full_like(alike, 0.4)
    factor = trusted(mask, alike)
    assert factor[..., :30].min() == 1
    assert factor[..., 50:].max() < 0.2
    assert trusted(torch.ones_like(mask), alike).min() == 1
    assert trusted(torch.ones_like(mask), 0 * alike).max() == 0


def test_a_highlight_belongs_to_the_paint_around_it() -> None:
    image = filled(*RED).clone()
    image[..., 30, 38:42] = 1.0
    mask = torch.ones(1, 1, 60, 80, dtype=torch.float64)
    assert corrections(image, mask, mask, of_red(), None)[:, 0].min() == 1


def test_a_side_in_shade_belongs_to_the_object_up_to_where_its_hue_ends() -> None:
    core, alike = torch.zeros(2, 1, 120, 140), torch.zeros(2, 1, 120, 140)
    core[..., 20:100, 20:80] = 1
    alike[..., 20:100, 20:110] = 1
    alike[1, ..., 110:130] = 0.6  # there, likeness fades
    within = shaded_parts(core, alike)
    assert within[0, :, 22:98, 82:108].min() == 1
    assert within[0, :, :, 114:].max() == within[1, :, 22:98, 90:].max() == 0


def test_shade_is_no_rim_and_not_far_larger_than_the_object() -> None:
    core, alike = torch.zeros(2, 1, 120, 140), torch.zeros(2, 1, 120, 140)
    core[..., 20:100, 20:80] = 1
    alike[0, :, 20:100, 20:83] = alike[1, :, 20:100, 20:130] = 1
    assert shaded_parts(core, alike)[:, :, 22:98, 82:].max() == 0


def test_dark_folds_in_an_object_are_looked_at() -> None:
    core = torch.ones(1, 1, 200, 240)
    core[..., 100:104], core[..., 150:170], core[..., :2] = 0, 0, 0
    within = shaded_parts(core, torch.zeros_like(core))
    assert within[..., 5:-5, 101:103].min() == 1
    assert within[..., 152:168].max() == within[..., :2].max() == 0


def test_what_is_like_a_scribble_to_keep_is_no_shade() -> None:
    image, share = filled(*GREY, size=(120, 140)).clone(), torch.zeros(1, 1, 120, 140, dtype=torch.float64)
    image[..., 40:80], image[..., 80:98] = filled(*RED)[..., :1, :1], 0.6 * filled(*RED)[..., :1, :1]
    share[..., 40:80] = 1
    kept = (0.6 * colour(*RED), torch.ones(1, 1, 1, dtype=torch.float64))
    assert corrections(image, share, share, of_red(), None)[:, 1, 5:-5, 85:95].min() == 1
    assert corrections(image, share, share, of_red(), kept)[:, 1, 5:-5, 85:95].max() == 0


def test_pieces_behind_an_arm_belong_to_the_object_and_others_do_not() -> None:
    masks, painted = torch.zeros(1, 2, 200, 240), torch.zeros(1, 2, 200, 240)
    masks[..., 20:180, 20:90] = 1
    masks[..., 20:100, 100:130] = 1  # a smaller piece behind an arm
    masks[..., 20:180, 150:230] = 1  # something else
    painted[..., 100, 40:60] = 1
    belongs = pieces_of(masks, painted)
    assert bool(belongs[..., 20:180, 20:90].all() & belongs[..., 20:100, 100:130].all())
    assert not belongs[..., 150:230].any()
    assert not pieces_of(masks, torch.zeros_like(painted)).any()


def test_shade_is_darker_of_a_similar_hue_and_no_less_saturated() -> None:
    luminance, chroma = (part.view(1, -1, 1, 1) for part in split_luminance(filled(*RED)[..., :1, :1]))

    def of(*channels: float) -> float:
        return float(shade(*split_luminance(filled(*channels)[..., :1, :1]), luminance, chroma))

    assert of(0.2, 0.03, 0.02) == 1
    assert of(0.15, 0.02, 0.05) > 0.5
    assert of(*RED) == of(0.1, 0.1, 0.1) == of(0.02, 0.05, 0.2) == of(0.15, 0.1, 0.02) == 0


def test_corrections_are_differentiable() -> None:
    generator = torch.Generator().manual_seed(0)
    image, mask, share, colours = (
        torch.rand(1, channels, 130, 121, generator=generator, dtype=torch.float64).requires_grad_()
        for channels in (3, 1, 1, 3)
    )

    def corrected(*inputs: torch.Tensor) -> torch.Tensor:
        scribbled = inputs[3][..., :9, :12].flatten(2)
        samples = HueSamples.of(scribbled, torch.ones_like(scribbled[:, :1]))
        return corrections(*inputs[:3], samples, (scribbled[..., :5], torch.ones_like(scribbled[:, :1, :5])))

    assert torch.autograd.gradcheck(corrected, (image, mask, share, colours), fast_mode=True)


def test_black_objects_and_objects_above_white_are_like_themselves() -> None:
    weights = torch.ones(1, 1, 40, dtype=torch.float64)
    assert HueSamples.of(colour(0, 0, 0).expand(1, 3, 40), weights).likeness(filled(0, 0, 0)).min() == 1
    bright = HueSamples.of(colour(3, 1.2, 1.2).expand(1, 3, 40), weights)
    assert bright.likeness(filled(3, 1.2, 1.2).clamp(0, 1)).min() == 1


def test_shade_of_huge_values_is_finite() -> None:
    chroma = torch.tensor((1e20, -1e20, 3e37)).view(1, 3, 1, 1).requires_grad_()
    luminance = torch.full((1, 1, 1, 1), 1e37).requires_grad_()
    shaded = shade(luminance, chroma, luminance, chroma)
    shaded.sum().backward()
    for tensor in (shaded, luminance.grad, chroma.grad):
        assert tensor is not None
        assert tensor.isfinite().all()
