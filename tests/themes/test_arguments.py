"""Numbers, responses and scales that functions and edits must refuse, or warn about, in one sentence."""

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch

from nlfilter_torch import (
    NonlocalFilter,
    diffusion_map,
    diffusion_mask,
    estimate_bandwidth,
    fit_alpha,
    fit_filter,
    nonlocal_operator,
    polynomial_filter,
    polynomial_response,
)
from nlfilter_torch.photo import abstract, adjust_tone, defocus, enhance, filter_frames, sharpen
from tests.problems import noise

IMAGE = noise(2, 3, 8, 9, dtype=torch.float32)
GREY = IMAGE[:, :1]
PAINTED = torch.zeros(2, 1, 8, 9).index_fill(3, torch.tensor([2]), 1.0)
OPTIONS: dict[str, Any] = {"num_landmarks": 20, "photometric_bandwidth": 0.3}
OPERATOR = nonlocal_operator(GREY, **OPTIONS)
SPECTRUM = OPERATOR.spectrum()
FITTED = fit_filter(nonlocal_operator(GREY[:1], **OPTIONS), GREY[:1])
ONES = torch.ones(4)
NAN, INFINITY = float("nan"), float("inf")


def sentence(call: Callable[[], object], name: str) -> None:
    """Check that ``name`` is refused in one sentence."""
    with pytest.raises((TypeError, ValueError)) as caught:
        call()
    assert re.fullmatch(rf"{name} must .+, got .+; .+", str(caught.value)), caught.value


# --- numbers, one for all images or one for each


# --- plain numbers and integers

PLAIN: dict[str, Callable[[Any], object]] = {
    "guide_blur": lambda v: sharpen(IMAGE, guide_blur=v, **OPTIONS),
    "radius": lambda v: defocus(IMAGE, PAINTED, radius=v),
    "edges": lambda v: abstract(IMAGE, edges=v, **OPTIONS),
    "edge_width": lambda v: abstract(IMAGE, edge_width=v, **OPTIONS),
    "tones": lambda v: abstract(IMAGE, tones=v, **OPTIONS),
    "ridge": lambda v: fit_alpha(OPERATOR, IMAGE, IMAGE, ridge=v),
    "rounding": lambda v: fit_alpha(OPERATOR, IMAGE, IMAGE, rounding=v),
    "order": lambda v: adjust_tone(IMAGE, order=v, **OPTIONS),
    "tolerance": lambda v: nonlocal_operator(GREY, tolerance=v, **OPTIONS),
}


@pytest.mark.parametrize("value", [NAN, INFINITY, -1.0, "2", [2], True, 10**400, torch.tensor([1.0, 2.0])])
@pytest.mark.parametrize("name", list(PLAIN))
def test_plain_numbers(name: str, value: Any) -> None:
    sentence(lambda: PLAIN[name](value), name)


def test_other_arguments_of_a_wrong_type() -> None:
    sentence(lambda: polynomial_filter(None, IMAGE, ONES), "operator")
    sentence(lambda: diffusion_map(OPERATOR, time=1.0), "spectrum")
    sentence(lambda: polynomial_response(None, ONES), "eigenvalues")
    sentence(lambda: polynomial_response(torch.rand(2, 5), torch.rand(3, 4)), "alpha")
    sentence(lambda: nonlocal_operator(GREY, generator=3), "generator")
    sentence(lambda: fit_alpha(OPERATOR, IMAGE, IMAGE, loss="l1"), "loss")
    sentence(lambda: fit_alpha(OPERATOR, IMAGE, IMAGE, loss=lambda a, b: None), "loss")
    sentence(lambda: fit_alpha(OPERATOR, IMAGE, IMAGE, loss=lambda a, b: b.sum()), "loss")
    sentence(lambda: fit_alpha(OPERATOR, IMAGE, IMAGE, shared=None), "shared")
    sentence(lambda: filter_frames(None, ONES, references=[GREY[:1]]), "frames")
    sentence(lambda: filter_frames([], ONES, references=None), "references")
    sentence(lambda: FITTED.layers(GREY, origin="top"), "origin")
    sentence(lambda: FITTED.layers(GREY, halo=(0, -1)), "halo")
    sentence(lambda: FITTED.layers(GREY, halo=(4, 4)), "halo")
    sentence(lambda: enhance(IMAGE, ONES, IMAGE[0]), "regions")
    sentence(lambda: NonlocalFilter().forward(None), "image")
    sentence(lambda: NonlocalFilter().sliders.combine(IMAGE[0]), "layers")
    sentence(lambda: NonlocalFilter(residual=0.5).sliders.combine(IMAGE), "residual")
    sentence(lambda: SPECTRUM.synthesize(torch.sqrt, torch.ones(2, 3, 19)), "coefficients")
    sentence(lambda: OPERATOR.powers(IMAGE, 10**12), "order")


def test_a_mask_of_no_width_is_one_on_its_region_alone() -> None:
    flat = torch.zeros(1, 1, 8, 9).index_fill(3, torch.tensor([2]), 1.0)
    mask = diffusion_mask(nonlocal_operator(flat, **OPTIONS).spectrum(), flat, width=1e-40)
    assert mask.isfinite().all()


# --- responses


# --- incompatible values and bandwidths


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["photometric_bandwidth", "spatial_bandwidth"])
def test_bandwidths_under_which_features_overflow(name: str, dtype: torch.dtype) -> None:
    tiny = 1e-40 if dtype == torch.float32 else 1e-300
    with pytest.raises(ValueError, match=rf"^{name} must be at least ([^ ]+) for .+, got .+; raise it$") as caught:
        nonlocal_operator(GREY.to(dtype), **OPTIONS | {name: tiny})
    least = float(str(caught.value).split("at least ")[1].split()[0])
    operator = nonlocal_operator(GREY.to(dtype), **OPTIONS | {name: least})
    assert operator.factor.isfinite().all()
    assert (operator.row_sums() - 1).abs().max() < 1e-4


def test_the_same_of_a_batch_names_the_image_that_fails() -> None:
    bandwidths = torch.tensor([0.2, 1e-30])
    with pytest.raises(ValueError, match=r"^photometric_bandwidth must be at least .+, got 1e-30; raise it$"):
        nonlocal_operator(GREY, num_landmarks=20, photometric_bandwidth=bandwidths)


@pytest.mark.parametrize("scale", [1e20, 1e37, -1e20])
def test_automatic_bandwidth_of_huge_values(scale: float) -> None:
    guide = noise(1, 5, 12, 13, dtype=torch.float32)
    expected = estimate_bandwidth(guide)
    torch.testing.assert_close(estimate_bandwidth(guide * scale) / abs(scale), expected)
    operator = nonlocal_operator(guide * scale, num_landmarks=20)
    assert (operator.row_sums() - 1).abs().max() < 1e-4


def test_gradients_between_the_largest_values_do_not_overflow() -> None:
    stripes = torch.tensor([-3e38, -3e38, 3e38, 3e38]).expand(1, 1, 4, 4)
    assert estimate_bandwidth(stripes).isfinite().all()


# --- images in [0, 255]
