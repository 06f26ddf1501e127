"""Bad input to the filter: an error is one sentence with the argument, what it must be, what it was, and the remedy."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch import (
    NonlocalFilter,
    captured_energy,
    compose_alpha,
    detail_layers,
    diffusion_mask,
    estimate_bandwidth,
    nonlocal_operator,
    polynomial_filter,
    polynomial_response,
    propagate_strokes,
    refine,
    segment_mask,
    spectral_filter,
)
from nlfilter_torch.photo import enhance
from tests.problems import noise

GUIDE = noise(2, 1, 8, 9)
OPERATOR = nonlocal_operator(GUIDE, num_landmarks=20)
SPECTRUM = OPERATOR.spectrum()
IMAGE = noise(2, 3, 8, 9)
EMPTY = torch.zeros(2, 1, 8, 9)
PAINTED = EMPTY.index_fill(3, torch.tensor([2]), 1.0)
NAN, INFINITY = float("nan"), float("inf")


def raises(call: Callable[[], object], error: type[Exception], message: str) -> None:
    """Check for ``<argument> must <requirement>, got <value>; <remedy>`` on one line that begins with ``message``."""
    with pytest.raises(error) as caught:
        call()
    result = str(caught.value)
    assert result.startswith(message), result
    assert re.fullmatch(r"\w+ must .+, got .+; .+", result), result
    assert not re.search(r"\n|[^.]\.$", result), result


# --- images

FLOATS = "must have a floating-point dtype with values in [0, 1], got"
BAD_IMAGES: dict[str, tuple[Any, type[Exception], str]] = {
    "array": (np.zeros((2, 1, 8, 9)), TypeError, "must be a torch.Tensor, got ndarray"),
    "list": ([[0.0]], TypeError, "must be a torch.Tensor, got list"),
    "integers": (EMPTY.to(torch.uint8), TypeError, f"{FLOATS} torch.uint8; divide"),
    "bools": (EMPTY.bool(), TypeError, f"{FLOATS} torch.bool"),
    "complex": (EMPTY.to(torch.complex64), TypeError, f"{FLOATS} torch.complex64"),
    "rank 3": (EMPTY[0], ValueError, "must have shape (B, C, H, W)"),
    "rank 6": (EMPTY[None, None], ValueError, "must have shape (B, C, H, W)"),
    "no row": (EMPTY[:, :, :0], ValueError, "must hold at least one pixel, got shape (2, 1, 0, 9)"),
    "no channel": (EMPTY[:, :0], ValueError, "must hold at least one pixel, got shape (2, 0, 8, 9)"),
    "NaN": (EMPTY + NAN, ValueError, "must be finite, got 144 NaN or infinite value(s)"),
    "infinity": (INFINITY * PAINTED.where(PAINTED > 0, 1), ValueError, "must be finite, got 144 NaN or infinite"),
    "one NaN": (EMPTY.index_fill(3, torch.tensor([4]), NAN), ValueError, "must be finite, got 16 NaN or infinite"),
}

TAKE_AN_IMAGE: dict[str, tuple[str, Callable[[torch.Tensor], object]]] = {
    "nonlocal_operator": ("guide", nonlocal_operator),
    "estimate_bandwidth": ("guide", estimate_bandwidth),
    "NonlocalFilter": ("guide", lambda x: NonlocalFilter(num_landmarks=20)(IMAGE, guide=x)),
    "matmul": ("image", lambda x: OPERATOR @ x),
    "detail_layers": ("image", lambda x: detail_layers(OPERATOR, x)),
    "polynomial_filter": ("image", lambda x: polynomial_filter(OPERATOR, x, torch.ones(4))),
    "spectral_filter": ("image", lambda x: spectral_filter(SPECTRUM, x, torch.sqrt)),
    "spectral_filter of the operator": ("image", lambda x: spectral_filter(OPERATOR, x, torch.sqrt)),
    "coefficients": ("image", SPECTRUM.coefficients),
    "propagate_strokes": ("strokes", lambda x: propagate_strokes(SPECTRUM, x, PAINTED)),
    "captured_energy": ("image", lambda x: captured_energy(SPECTRUM, x)),
    "diffusion_mask": ("region", lambda x: diffusion_mask(SPECTRUM, x)),
    "segment_mask": ("regions", lambda x: segment_mask(SPECTRUM, x)),
    "refine": ("logits", lambda x: refine(x, OPERATOR)),
    "mask of a layer": ("mask", lambda x: NonlocalFilter(num_landmarks=20)(IMAGE, mask=x)),
}


@pytest.mark.parametrize("bad", list(BAD_IMAGES))
@pytest.mark.parametrize("function", list(TAKE_AN_IMAGE))
def test_bad_images(function: str, bad: str) -> None:
    name, call = TAKE_AN_IMAGE[function]
    value, error, message = BAD_IMAGES[bad]
    raises(lambda: call(value), error, f"{name} {message}")


def test_empty_batches_are_refused_where_they_make_no_sense() -> None:
    fits = ("nonlocal_operator", "estimate_bandwidth")  # all others: two images against an empty batch
    for function, (name, call) in TAKE_AN_IMAGE.items():
        if function not in fits:
            name = "image" if function == "NonlocalFilter" else name
            raises(lambda call=call: call(EMPTY[:0]), ValueError, f"{name} must h")  # type: ignore[misc]
    raises(
        lambda: enhance(EMPTY[:0], torch.ones(4)),
        ValueError,
        "image must hold at least one pixel, got shape (0, 1, 8, 9)",
    )


@pytest.mark.parametrize(
    "function", [name for name, (argument, _) in TAKE_AN_IMAGE.items() if argument not in ("guide", "mask")]
)
def test_images_on_another_device(function: str) -> None:
    name, call = TAKE_AN_IMAGE[function]
    raises(lambda: call(noise(2, 1, 8, 9).to("meta")), ValueError, f"{name} must be on the device of the ")


@pytest.mark.parametrize("function", [name for name, (argument, _) in TAKE_AN_IMAGE.items() if argument != "guide"])
def test_images_of_another_size_or_batch(function: str) -> None:
    name, call = TAKE_AN_IMAGE[function]
    raises(lambda: call(noise(2, 1, 9, 8)), ValueError, f"{name} must have the height and width of the ")
    raises(lambda: call(noise(3, 1, 8, 9)), ValueError, f"{name} must have ")


# --- options of the operator


@pytest.mark.parametrize(
    ("rank", "error", "message"), [(0, ValueError, "at least 1, got 0"), (5.0, TypeError, "an int")]
)
def test_bad_rank(rank: Any, error: type[Exception], message: str) -> None:
    raises(lambda: OPERATOR.spectrum(rank), error, f"rank must be {message}")


def test_dense_matrix_of_a_large_image_is_refused() -> None:
    operator = nonlocal_operator(noise(1, 1, 129, 128), num_landmarks=5, photometric_bandwidth=0.5)
    with pytest.raises(
        ValueError, match=r"must have at most 16384 pixels for a dense matrix, got 16512; use a smaller image"
    ):
        operator.to_dense()


# --- sliders and layers


# --- masks


# --- state after an error or a warning


def test_nothing_is_changed_by_an_error() -> None:
    state, image = torch.get_rng_state(), IMAGE.clone()
    raises(lambda: polynomial_filter(OPERATOR, image, torch.ones(1)), ValueError, "alpha")
    raises(lambda: nonlocal_operator(GUIDE, patch_size=2), ValueError, "patch_size")
    assert torch.equal(image, IMAGE)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.is_grad_enabled()
    assert not torch.is_autocast_enabled("cpu")


def test_shapes_of_sliders_and_eigenvalues_that_do_not_fit() -> None:
    message = "eigenvalues must have shape (B, R) for sliders of shape (B, k+1), got (3, 3, 5)"
    raises(lambda: polynomial_response(torch.ones(3, 3, 5), torch.ones(3, 4)), ValueError, message)
    message = "alpha must have the batch of masks, 2, or 1, got 3"
    raises(lambda: compose_alpha(torch.ones(2, 1, 4, 4), torch.ones(3, 1, 4)), ValueError, message)


@pytest.mark.parametrize(
    ("outside", "error", "message"),
    [
        (torch.ones(2), ValueError, "outside must have shape (4,), got (2,); give as many sliders as alpha has"),
        ([1.0, 1.0, 1.0, 1.0], TypeError, "outside must be a torch.Tensor, got list; give as many"),
        (torch.ones(4).int(), TypeError, "outside must have a floating-point dtype, got torch.int32; write 1.0"),
        (torch.full((4,), torch.nan), ValueError, "outside must be"),
    ],
)
def test_bad_sliders_outside_of_regions(outside: Any, error: type[Exception], message: str) -> None:
    regions = torch.ones(1, 1, 8, 9)
    raises(lambda: enhance(torch.rand(1, 3, 8, 9), torch.ones(4), regions, outside=outside), error, message)
