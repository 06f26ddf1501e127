"""Fitting looks to pairs, and what they explain on other photographs."""

import gc
import json
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import scipy.ndimage
import skimage.color
import skimage.data
import skimage.exposure
import torch
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo import fit_look
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from tests.looks import CAT, CUP, FEW, SEPIA, SUIT, explained, in_bytes, rgb, single_look


def equalized(image: Tensor) -> Tensor:
    values = skimage.exposure.equalize_adapthist(image[0].permute(1, 2, 0).numpy(), clip_limit=0.1)
    return in_bytes(torch.from_numpy(values).permute(2, 0, 1)[None].float())


def detailed(image: Tensor) -> Tensor:
    """Detail that a guided filter of 9 x 9 pixels takes away from luminance, three times as strong."""
    light = reduce_channels(image, "luminance")[0, 0].numpy()
    mean, square = (scipy.ndimage.uniform_filter(values, 9) for values in (light, light**2))
    slope = (square - mean**2) / (square - mean**2 + 0.1**2)
    smooth = scipy.ndimage.uniform_filter(slope, 9) * light + scipy.ndimage.uniform_filter(mean - slope * mean, 9)
    return in_bytes(image + 2 * torch.from_numpy(light - smooth))


@pytest.mark.parametrize(
    ("edit", "parts", "least", "most"),
    [
        (equalized, ("curves", "bands", "local"), 0.8, 0.5),
        (detailed, ("curves", "bands", "texture"), 0.9, 0.75),
    ],
)
def test_parts_that_depend_on_the_picture_explain_another_photograph(
    edit: Callable[[Tensor], Tensor], parts: tuple[str, ...], least: float, most: float
) -> None:
    pairs = [(image, edit(image)) for image in (CAT, CUP, SUIT)]
    shares = []
    for chosen in (parts, parts[:2]):
        look = single_look(fit_look(pairs[:2], parts=chosen, step=FEW))
        shares.append(explained(*pairs[2], look.apply(SUIT)))
    assert shares[0] > least > most > shares[1], shares


@pytest.mark.parametrize(
    "edit",
    [
        lambda x: x**0.6,
        lambda x: 1 / (1 + torch.exp(8 * (0.5 - x))),
        lambda x: torch.einsum("cd,bdhw->bchw", torch.tensor(SEPIA).view(3, 3), x),
        lambda x: x * torch.tensor([1.15, 1.0, 0.85]).view(1, 3, 1, 1),
        lambda x: x.mean((2, 3), keepdim=True).mean() + 1.3 * (x - x.mean((2, 3), keepdim=True).mean()),
    ],
    ids=["gamma", "sigmoid", "sepia", "warmth", "contrast"],
)
def test_edits_of_others_are_explained_on_other_photographs(edit: object) -> None:
    assert callable(edit)
    pairs = [(image, in_bytes(edit(image))) for image in (CAT, CUP, SUIT)]
    look = single_look(fit_look(pairs[:2], step=FEW))
    assert all(explained(*pair, look.apply(pair[0])) > 0.95 for pair in pairs)


def test_saturation_in_hsv_is_explained_on_other_photographs() -> None:
    def saturated(image: Tensor) -> Tensor:
        hsv = skimage.color.rgb2hsv(image[0].permute(1, 2, 0).numpy())
        hsv[..., 1] = (1.4 * hsv[..., 1]).clip(0, 1)
        return in_bytes(torch.from_numpy(skimage.color.hsv2rgb(hsv)).permute(2, 0, 1)[None].float())

    every = slice(0, 512, 5)  # small pictures with colours of all kinds
    pairs = [
        (image, saturated(image)) for image in (rgb(name, every, every) for name in ("astronaut", "coffee", "chelsea"))
    ]
    look = single_look(fit_look(pairs[:2], step=FEW))
    assert look.parts[0] == "saturation"
    assert all(explained(*pair, look.apply(pair[0])) > 0.99 for pair in pairs)


def test_one_pair_does_not_bend_curves_where_it_has_no_values() -> None:
    dark = in_bytes(0.1 + 0.25 * CAT)
    look = single_look(fit_look([(dark, in_bytes(dark + 0.8 * dark * (0.5 - dark)))], parts=("curves",), step=FEW))
    curves = look.tensors["curves"]
    assert look.fitted > 0.9
    assert float((curves[:, 12:] - torch.linspace(0, 1, 17)[12:]).abs().max()) < 0.08


def test_pairs_are_read_once_and_not_kept() -> None:
    alive: list[bool] = []
    yielded: list[weakref.ref[Tensor]] = []

    def pairs() -> Iterator[tuple[Tensor, Tensor]]:
        for number in range(6):
            image = CAT.roll(number, 2)
            yielded.append(weakref.ref(image))
            yield image, in_bytes(image**0.7)
            del image
            gc.collect()
            alive.extend(reference() is not None for reference in yielded[:-1])

    look = single_look(fit_look(pairs(), step=FEW))
    assert len(yielded) == 6
    assert len(alive) == 15
    assert not any(alive)
    assert look.left_out > 0.95


@pytest.mark.parametrize(("colour", "width"), [(1.0, 5), (0.0, 8), (0.9, 8)])
def test_a_frame_around_the_edited_picture_is_left_out(colour: float, width: int) -> None:
    inside = (..., slice(width, -width), slice(width, -width))
    after = torch.full_like(CAT, colour)
    after[inside] = in_bytes(CAT**0.6)[inside]
    look = single_look(fit_look([(CAT, after)], step=FEW))
    assert look.fitted > 0.98
    assert explained(CAT[inside], after[inside], look.apply(CAT)[inside]) > 0.98


def test_a_watermark_lowers_what_is_explained_and_little_else() -> None:
    after = in_bytes(CAT**0.6)
    after[..., 60:75, 60:95] = 0.9
    look = single_look(fit_look([(CAT, after)], step=FEW))
    assert 0 < look.fitted < 0.95
    assert explained(CAT[..., :55, :], after[..., :55, :], look.apply(CAT)[..., :55, :]) > 0.8


def test_more_parameters_than_pixels_are_told_by_what_is_left_out() -> None:
    noise = torch.rand(1, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    look = single_look(fit_look([(CAT[..., :5, :5], noise)], step=Step("look", landmarks=20)))
    assert look.left_out < 0.5
    assert all(abs(value) < 1e3 for value in look.tensors["alpha"].tolist())


def test_files_keep_looks(tmp_path: Path) -> None:
    look = single_look(fit_look([(CAT, in_bytes(CAT**0.6))], step=FEW))
    text = look.to_json()
    assert json.loads(text)["steps"][0]["edit"] == "look"
    assert Recipe.from_json(text, "it").steps == (look.step,)
    with pytest.raises(ValueError, match="matrix of look, step 1 in it must be a list of 9 numbers"):
        Recipe.from_json('{"version": 1, "steps": [{"edit": "look", "matrix": [1, 2]}]}', "it")


def test_a_pair_of_which_a_single_pixel_is_not_clipped() -> None:
    before, after = torch.ones(2, 1, 3, 20, 20).unbind()
    before[..., 1, 2], after[..., 1, 2] = 0.5, 0.6
    assert fit_look([(before, after)]).apply(before).isfinite().all()
