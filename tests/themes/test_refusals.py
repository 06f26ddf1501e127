"""What public functions and modules refuse: one table of the function, the wrong argument and the sentence."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch import (
    DiffusionMask,
    NonlocalAffinity,
    NonlocalBlock,
    NonlocalDenoiser,
    NonlocalFilter,
    NonlocalOperator,
    PolynomialSliders,
    Refine,
    SegmentMask,
    apply_function,
    captured_energy,
    compose_alpha,
    detail_layers,
    diffusion_map,
    diffusion_mask,
    estimate_bandwidth,
    estimate_noise,
    filter_regions,
    fit_alpha,
    fit_filter,
    noise_profile,
    nonlocal_operator,
    operator_from_features,
    pad_images,
    polynomial_filter,
    polynomial_response,
    propagate_strokes,
    refine,
    segment_mask,
    spectral_filter,
    standard_error,
)
from nlfilter_torch.photo import (
    abstract,
    adjust_light,
    adjust_tone,
    apply_look,
    colorize,
    cutout,
    defocus,
    denoise,
    enhance,
    filter_frames,
    heal,
    recolor,
    region_mask,
    sharpen,
)
from tests.problems import box, noise, paint
from tests.refusals import Refusal, check_refusals, refusals

NAN, INFINITY = float("nan"), float("inf")

# Two small images, their operator and spectrum.
GUIDE, IMAGE = noise(2, 1, 8, 9, dtype=torch.float32), noise(2, 3, 8, 9, dtype=torch.float32)
PAINTED = torch.zeros(2, 1, 8, 9).index_fill(3, torch.tensor([2]), 1.0)
EMPTY, ONES = 0 * PAINTED, torch.ones(4)
OPTIONS: dict[str, Any] = {"num_landmarks": 20, "photometric_bandwidth": 0.3}
OPERATOR = nonlocal_operator(GUIDE, **OPTIONS)
SPECTRUM = OPERATOR.spectrum()
FITTED = fit_filter(nonlocal_operator(GUIDE[:1], **OPTIONS), GUIDE[:1])
ASSIGNMENT = OPERATOR.assignment
VOLUME = noise(1, 1, 4, 5, 6)
OF_VOLUME = nonlocal_operator(VOLUME, patch_size=3, photometric_bandwidth=0.4, num_landmarks=30)

# Two photographs for edits, and a spot painted on them.
GREY, RGB = (0.2 + 0.6 * noise(2, channels, 20, 22, dtype=torch.float32) for channels in (1, 3))
SPOT, ELSEWHERE = box(4, 4, size=(20, 22)), box(14, 14, size=(20, 22))
STROKES = {"strokes": paint(1, 0, 0, SPOT), "stroke_mask": SPOT}

# Parts of sentences.
INT, NUMBER = "must be an int, got", "must be a number or a tensor, got"
POSITIVE = "must be positive and finite, got"
TWO_SLIDERS = "alpha must have at least two entries, got 1"


def exactly(text: str) -> str:
    """The pattern of a sentence that begins with a text."""
    return "^" + re.escape(text)


# --- numbers, one for all images or one for each

NUMBERS: dict[str, tuple[str, Callable[[Any], object]]] = {
    "polynomial_filter": ("residual", lambda v: polynomial_filter(OPERATOR, IMAGE, ONES, residual=v)),
    "spectral_filter": ("residual", lambda v: spectral_filter(SPECTRUM, IMAGE, torch.sqrt, residual=v)),
    "filter_regions": ("residual", lambda v: filter_regions(OPERATOR, IMAGE, PAINTED, ONES[None], residual=v)),
    "fitted filter": ("residual", lambda v: FITTED(GUIDE, ONES, residual=v)),
    "enhance": ("residual", lambda v: enhance(IMAGE, ONES, residual=v, **OPTIONS)),
    "sharpen": ("amount", lambda v: sharpen(IMAGE, amount=v, **OPTIONS)),
    "contrast of adjust_tone": ("contrast", lambda v: adjust_tone(IMAGE, contrast=v, **OPTIONS)),
    "clarity of adjust_tone": ("clarity", lambda v: adjust_tone(IMAGE, clarity=v, **OPTIONS)),
    "diffusion_map": ("time", lambda v: diffusion_map(SPECTRUM, time=v)),
    "time of diffusion_mask": ("time", lambda v: diffusion_mask(SPECTRUM, PAINTED, time=v)),
    "width of diffusion_mask": ("width", lambda v: diffusion_mask(SPECTRUM, PAINTED, width=v)),
    "segment_mask": ("time", lambda v: segment_mask(SPECTRUM, PAINTED, time=v)),
    "time of colorize": ("time", lambda v: colorize(GUIDE, IMAGE, PAINTED, method="kmeans", time=v)),
    "mask_bandwidth of enhance": (
        "mask_bandwidth",
        lambda v: enhance(IMAGE, ONES, PAINTED, mask_bandwidth=v, **OPTIONS),
    ),
    "strength of propagate_strokes": ("strength", lambda v: propagate_strokes(SPECTRUM, IMAGE, PAINTED, strength=v)),
    "recolor": ("reach", lambda v: recolor(IMAGE, IMAGE, PAINTED, reach=v, num_landmarks=20)),
    "smoothness of propagate_strokes": (
        "smoothness",
        lambda v: propagate_strokes(SPECTRUM, IMAGE, PAINTED, smoothness=v),
    ),
    "abstract": ("power", lambda v: abstract(IMAGE, power=v, **OPTIONS)),
    "denoise": ("noise_level", lambda v: denoise(IMAGE, noise_level=v, method="rule", num_landmarks=20)),
}
NO_NUMBERS: tuple[Any, ...] = (
    NAN,
    INFINITY,
    "much",
    True,
    [1.0, 2.0],
    10**400,
    torch.tensor([0.5, NAN]),
    torch.full((3,), 0.5),  # another batch
    torch.full((2, 1), 0.5),
    torch.empty(0),
    PAINTED,
    torch.tensor(0.5j),
    torch.tensor(True),
)
PLAIN_NUMBERS: dict[str, Callable[[Any], object]] = {
    "guide_blur": lambda v: sharpen(IMAGE, guide_blur=v, **OPTIONS),
    "radius": lambda v: defocus(IMAGE, PAINTED, radius=v),
    "edges": lambda v: abstract(IMAGE, edges=v, **OPTIONS),
    "edge_width": lambda v: abstract(IMAGE, edge_width=v, **OPTIONS),
    "tones": lambda v: abstract(IMAGE, tones=v, **OPTIONS),
    "ridge": lambda v: fit_alpha(OPERATOR, IMAGE, IMAGE, ridge=v),
    "rounding": lambda v: fit_alpha(OPERATOR, IMAGE, IMAGE, rounding=v),
    "order": lambda v: adjust_tone(IMAGE, order=v, **OPTIONS),
    "tolerance": lambda v: nonlocal_operator(GUIDE, tolerance=v, **OPTIONS),
}
NO_PLAIN_NUMBERS: tuple[Any, ...] = (NAN, INFINITY, -1.0, "2", [2], True, 10**400, torch.tensor([1.0, 2.0]))


def sentence(call: Callable[[], object], name: str) -> None:
    """Check that ``name`` is refused in one sentence."""
    with pytest.raises((TypeError, ValueError)) as caught:
        call()
    assert re.fullmatch(rf"{name} must .+, got .+; .+", str(caught.value)), caught.value


@pytest.mark.parametrize("function", NUMBERS)
def test_numbers_are_finite_and_one_for_each_image(function: str) -> None:
    name, call = NUMBERS[function]
    for value in NO_NUMBERS:
        sentence(lambda value=value: call(value), name)  # type: ignore[misc]


@pytest.mark.parametrize("name", PLAIN_NUMBERS)
def test_plain_numbers(name: str) -> None:
    for value in NO_PLAIN_NUMBERS:
        sentence(lambda value=value: PLAIN_NUMBERS[name](value), name)  # type: ignore[misc]


@pytest.mark.parametrize("function", NUMBERS)
def test_numbers_and_tensors_of_them_are_taken(function: str) -> None:
    call = NUMBERS[function][1]
    half, both = call(0.5), call(torch.tensor([0.5, 0.6]))
    for result in (half, both):
        assert isinstance(result, torch.Tensor)
        assert result.isfinite().all()
    tensors = torch.tensor(0.5), torch.tensor(0.5).double(), torch.full((1, 1, 1, 1), 0.5)
    for value in (np.float16(0.5), np.float32(0.5), np.float64(0.5), *tensors):
        torch.testing.assert_close(call(value), half)
    torch.testing.assert_close(call(torch.tensor([0.5, 0.6]).view(2, 1, 1, 1)), both)
    if function != "recolor":  # reach is below 1
        torch.testing.assert_close(call(np.int64(1)), call(1))


# --- images

FLOATS = "must have a floating-point dtype with values in [0, 1], got"
BAD_IMAGES: list[tuple[Any, type[Exception], str]] = [
    (np.zeros((2, 1, 8, 9)), TypeError, "must be a torch.Tensor, got ndarray"),
    ([[0.0]], TypeError, "must be a torch.Tensor, got list"),
    (EMPTY.to(torch.uint8), TypeError, f"{FLOATS} torch.uint8; divide"),
    (EMPTY.bool(), TypeError, f"{FLOATS} torch.bool"),
    (EMPTY.to(torch.complex64), TypeError, f"{FLOATS} torch.complex64"),
    (EMPTY[0], ValueError, "must have shape (B, C, H, W)"),
    (EMPTY[None, None], ValueError, "must have shape (B, C, H, W)"),
    (EMPTY[:, :, :0], ValueError, "must hold at least one pixel, got shape (2, 1, 0, 9)"),
    (EMPTY[:, :0], ValueError, "must hold at least one pixel, got shape (2, 0, 8, 9)"),
    (EMPTY + NAN, ValueError, "must be finite, got 144 NaN or infinite value(s)"),
    (INFINITY * PAINTED.where(PAINTED > 0, 1), ValueError, "must be finite, got 144 NaN or infinite"),
    (EMPTY.index_fill(3, torch.tensor([4]), NAN), ValueError, "must be finite, got 16 NaN or infinite"),
]
TAKE_AN_IMAGE: dict[str, tuple[str, Callable[[Any], object]]] = {
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


@pytest.mark.parametrize("function", TAKE_AN_IMAGE)
def test_images(function: str) -> None:
    name, call = TAKE_AN_IMAGE[function]
    rows = [({"x": value}, exactly(f"{name} {must}"), error) for value, error, must in BAD_IMAGES]
    if function not in ("nonlocal_operator", "estimate_bandwidth"):  # which take none; others get two against none
        rows.append(({"x": EMPTY[:0]}, f"^{name} must h", ValueError))
    if name != "guide":
        size = f"^{name} must have the height and width of the "
        rows += [
            ({"x": noise(2, 1, 9, 8)}, size, ValueError),
            ({"x": noise(3, 1, 8, 9)}, f"^{name} must h", ValueError),
        ]
    if name not in ("guide", "mask"):
        rows.append(({"x": noise(2, 1, 8, 9).to("meta")}, f"^{name} must be on the device of the ", ValueError))
    check_refusals(refusals(lambda x: call(x), {}, *rows))


# --- responses

RESPONSES: dict[str, Any] = {
    "no function": 0.5,
    "None": lambda s: None,
    "number": lambda s: 1.0,
    "scalar": lambda s: s.sum(),
    "row": lambda s: s[:1],
    "too few": lambda s: s[:, :3],
    "too many": lambda s: s.expand(3, *s.shape),
    "NaN": lambda s: s * NAN,
    "infinity": lambda s: s / 0.0,
    "complex": lambda s: s * 1j,
}


@pytest.mark.parametrize("response", RESPONSES)
def test_responses_return_a_finite_gain_for_every_eigenvalue(response: str) -> None:
    result = RESPONSES[response]
    sentence(lambda: spectral_filter(SPECTRUM, IMAGE, result), "response")
    sentence(lambda: spectral_filter(SPECTRUM, IMAGE, result, residual=0.5), "response")
    sentence(lambda: spectral_filter(OPERATOR, IMAGE, result), "response")
    sentence(lambda: apply_function(OPERATOR, IMAGE, result), "response")
    sentence(lambda: SPECTRUM.gain(result), "response")
    sentence(lambda: SPECTRUM.synthesize(result, SPECTRUM.coefficients(IMAGE)), "response")


# --- all other arguments

ODD = "must be odd and at least 1, got"
TWO_NUMBERS = "must be a number, or two for vertical and horizontal distances, got"
SQUARE = "must have shape (p, p) with odd p, or (p, p, p) for volumes, got"
BAD_OPTIONS: list[tuple[str, Any, type[Exception], str]] = [
    ("patch_size", 4, ValueError, f"{ODD} 4; try 5"),
    ("patch_size", 0, ValueError, f"{ODD} 0; try 1"),
    ("patch_size", -3, ValueError, f"{ODD} -3; try 3"),
    ("patch_size", 5.0, TypeError, f"{INT} float"),
    ("patch_size", True, TypeError, f"{INT} bool"),
    ("photometric_bandwidth", 0.0, ValueError, f"{POSITIVE} 0.0"),
    ("photometric_bandwidth", -1, ValueError, f"{POSITIVE} -1"),
    ("photometric_bandwidth", NAN, ValueError, f"{POSITIVE} nan"),
    ("photometric_bandwidth", INFINITY, ValueError, f"{POSITIVE} inf"),
    ("photometric_bandwidth", "wide", ValueError, "must be "),
    ("photometric_bandwidth", None, TypeError, f"{NUMBER} NoneType"),
    ("photometric_bandwidth", True, TypeError, f"{NUMBER} bool"),
    ("photometric_bandwidth", torch.tensor([0.5, -0.5]), ValueError, f"{POSITIVE} [0.5, -0.5]"),
    ("photometric_bandwidth", torch.ones(3), ValueError, "must be a number or have shape () or (2,), got (3,)"),
    ("spatial_bandwidth", 0, ValueError, f"{POSITIVE} 0"),
    ("spatial_bandwidth", "auto", TypeError, f"{NUMBER} str"),
    ("spatial_bandwidth", (4.0, 0.0), ValueError, f"{POSITIVE} 0.0"),
    ("spatial_bandwidth", (4.0, 5.0, 6.0), ValueError, f"{TWO_NUMBERS} 3 in a tuple; pass two numbers"),
    ("spatial_bandwidth", [4.0], ValueError, f"{TWO_NUMBERS} 1 in a list; pass two numbers"),
    ("spatial_bandwidth", torch.ones(2, 1), ValueError, "must be a number or have shape () or (2,), got (2, 1)"),
    ("num_landmarks", 0, ValueError, "must be at least 1, got 0"),
    ("num_landmarks", np.int64(0), ValueError, "must be at least 1, got 0"),
    ("num_landmarks", 20.0, TypeError, f"{INT} float"),
    ("num_landmarks", True, TypeError, f"{INT} bool"),
    ("num_landmarks", np.bool_(True), TypeError, INT),
    ("num_landmarks", np.float32(2.5), TypeError, INT),
    ("num_landmarks", np.array(20), TypeError, INT),
    ("landmarks", "k-means", ValueError, "must be one of 'kmeans', 'uniform', 'random', got 'k-means'"),
    ("completion", None, ValueError, "must be one of 'diagonal', 'none', got None"),
    ("guide_channels", "rgb", ValueError, "must be one of 'luminance', 'all', got 'rgb'"),
    ("tolerance", 0.0, ValueError, f"{POSITIVE} 0.0"),
    ("generator", 3, TypeError, "must "),
    ("patch_weights", [[1.0]], TypeError, "must be a torch.Tensor, got list; convert it"),
    ("patch_weights", torch.ones(3, 5), ValueError, f"{SQUARE} (3, 5)"),
    ("patch_weights", torch.ones(4, 4), ValueError, f"{SQUARE} (4, 4)"),
    ("patch_weights", torch.ones(9), ValueError, f"{SQUARE} (9,)"),
    ("patch_weights", -torch.ones(3, 3), ValueError, "must be non-negative with a positive sum, got"),
    ("patch_weights", torch.zeros(3, 3), ValueError, "must be non-negative with a positive sum, got"),
    ("patch_weights", torch.ones(3, 3) * NAN, ValueError, "must be finite, got 9 NaN"),
]
HELD = nonlocal_operator(noise(2, 1, 6, 6), photometric_bandwidth=0.1, num_landmarks=10)
COUNTED: list[tuple[dict[str, Any], str] | tuple[dict[str, Any], str, type[Exception]]] = [
    ({"weights": EMPTY}, r"^weights must be positive at some pixel of every image, .*\[0, 1\]"),
    ({"weights": PAINTED[:, 0]}, r"^weights must have shape \(2, 1, 8, 9\).*got \(2, 8, 9\)"),
    ({"weights": PAINTED.mT}, "^weights must have shape"),
    ({"weights": EMPTY - 1}, r"^weights must be 0, or from 1e-06 to 1e\+06, got -1 to -1"),
    ({"weights": EMPTY + NAN}, "^weights must be 0, or from"),
    ({"weights": PAINTED > 0}, "^weights must have a floating-point dtype", TypeError),
    ({"weights": [1.0]}, "^weights must be a torch.Tensor, got list", TypeError),
]
POINTS: dict[str, Any] = {"features": noise(1, 3, 12), "size": (3, 4), "num_landmarks": 4}
LOGITS, MASK = noise(2, 4, 8, 9), noise(2, 1, 8, 9)
CAT = NonlocalOperator.cat
PAIR = nonlocal_operator(noise(3, 1, 10, 12, dtype=torch.float32), num_landmarks=8)
THREE = noise(3, 1, 10, 12, dtype=torch.float32)


def joined(guide: torch.Tensor, **options: Any) -> Callable[[], object]:
    """A call that joins an operator with one of other options."""
    return lambda: CAT([PAIR, nonlocal_operator(guide, **{"num_landmarks": 8, **options})])


OPERATORS: dict[str, list[Refusal]] = {
    "nonlocal_operator": [
        *refusals(
            nonlocal_operator,
            {"guide": GUIDE, "num_landmarks": 20},
            *(({option: value}, exactly(f"{option} {must}"), error) for option, value, error, must in BAD_OPTIONS),
            *COUNTED,
        ),
        *refusals(
            nonlocal_operator,
            {"guide": VOLUME},
            (
                {"spatial_bandwidth": (2.0, 3.0)},
                "^spatial_bandwidth must be a number, or three for depth, vertical and horizontal distances, got 2",
            ),
            (
                {"patch_weights": torch.ones(3, 3)},
                r"^patch_weights must have the 3 axes of the guide, got \(3, 3\); pass \(p, p, p\)",
            ),
            ({"guide": VOLUME.flatten(2)}, r"^guide must have shape \(B, C, H, W\) or \(B, C, D, H,"),
        ),
    ],
    "landmarks of nonlocal_operator": refusals(
        nonlocal_operator,
        {"guide": noise(2, 1, 6, 6), "photometric_bandwidth": 0.1, "landmarks": HELD},
        ({"landmarks": HELD.landmarks[:, 1:]}, r"^landmarks must have shape \(B, 25, M\)"),
        ({"landmarks": HELD, "patch_size": 3, "guide": noise(2, 1, 6, 5)}, r"^landmarks must have shape \(B, 9,"),
        ({"landmarks": HELD.landmarks, "patch_size": 3}, r"^landmarks must have shape \(B, 9,"),
        ({"landmarks": HELD.landmarks[0]}, r"^landmarks must have shape \(B, D, N\)"),
        ({"landmarks": HELD.landmarks[..., :0]}, r"^landmarks must have shape \(B, D, N\)"),
        ({"landmarks": HELD.landmarks.long()}, "^landmarks must have a floating-point", TypeError),
        ({"landmarks": HELD.landmarks * NAN}, "^landmarks must be finite"),
        ({"landmarks": HELD.landmarks.tolist()}, "^landmarks must be one of .* got list"),
        ({"landmarks": HELD.assignment, "guide": noise(1, 1, 6, 6)}, "^landmarks must be an assignment of 36 points"),
        ({"landmarks": HELD.assignment, "guide": noise(2, 1, 6, 5)}, "^landmarks must be an assignment of 30"),
        ({"landmarks": HELD.landmarks.to("meta")}, "^landmarks must be on the device"),
    ),
    "estimate_bandwidth": refusals(
        estimate_bandwidth,
        {"guide": GUIDE},
        ({"guide_channels": "rgb"}, "^guide_channels must be one of 'lum"),
        *COUNTED,
    ),
    "operator_from_features": refusals(
        operator_from_features,
        POINTS,
        ({"features": [1.0]}, "^features must be a torch.Tensor", TypeError),
        ({"features": noise(3, 12)}, r"^features must have shape \(B, D, N\)"),
        ({"features": noise(1, 3, 12).round().int()}, "^features must have a floating-point dtype", TypeError),
        ({"features": noise(1, 3, 12) * NAN}, "^features must be finite"),
        ({"size": 12}, r"^size must be integers, such as \(H, W\), .*, got 12; pass \(12,\)", TypeError),
        ({"size": ()}, r"^size must be integers, such as .*, got \(\); pass \(12,\)", TypeError),
        ({"size": (3, 2, 2.0)}, r"^size must be integers, .*, got \(3, 2, 2.0\)", TypeError),
        ({"size": (3, 2, 3)}, "^size must have one pixel for each of the 12 points, got 3x2x3"),
        ({"size": (3, 5)}, "^size must have one pixel for each of the 12 points, got 3x5"),
        ({"size": (-3, -4)}, "^size must have one pixel for each"),
        ({"weights": torch.ones(11)}, r"^weights must have shape \(12,\) or \(1, 12\), got \(11,\)"),
        ({"weights": torch.zeros(12)}, r"^weights must be positive at some pixel .*\[0\]"),
        ({"weights": torch.full((12,), 1e7)}, r"^weights must be 0, or from 1e-06 to 1e\+06"),
        ({"weights": torch.ones(12, dtype=torch.complex64)}, "^weights must have a floating-point dtype", TypeError),
        ({"weights": 4.0}, "^weights must be a torch.Tensor", TypeError),
        ({"landmarks": 5}, "num_landmarks"),
    ),
    "spectrum": refusals(
        OPERATOR.spectrum,
        {},
        ({"rank": 0}, "^rank must be at least 1, got 0"),
        ({"rank": 5.0}, "^rank must be an int", TypeError),
    ),
    "powers": [Refusal(lambda: OPERATOR.powers(IMAGE, 10**12), "^order must ")],
    "indices of operators": [
        *(
            Refusal(lambda index=index: PAIR[index], r"^index must be .* or of 3 bools, got .*; pass 0", TypeError)
            for index in ("0", 1.0, None, True, torch.tensor([True]), torch.ones(1, 1).long(), torch.ones(3))
        ),
        *(
            Refusal(lambda index=index: PAIR[index], "^index must be from -3 to 2, got (3|-4); see len", IndexError)
            for index in (3, -4, [0, 3], torch.tensor([-4]))
        ),
        Refusal(lambda: PAIR[:0][0], "absent, as there are no images", IndexError),
    ],
    "NonlocalOperator.cat": [
        *(
            Refusal(lambda batches=batches: CAT(batches), "batches must be a", TypeError)  # type: ignore[misc]
            for batches in ([], PAIR, "operators", [PAIR, None], [PAIR, PAIR.spectrum()], None)
        ),
        Refusal(joined(THREE, num_landmarks=9), "the same number of landmarks to be joined, got 8 and 9"),
        Refusal(joined(THREE[..., 1:]), "the same number of pixels to be joined, got 120 and 110"),
        Refusal(joined(THREE.mT), "the same size to be joined, got 10 and 12"),
        Refusal(
            lambda: CAT([PAIR, PAIR.to(torch.float64)]), "the same dtype to be joined, got torch.float32 and torch"
        ),
        Refusal(lambda: CAT([PAIR, PAIR.to("meta")]), "the same device to be joined, got cpu and meta"),
        Refusal(joined(THREE, patch_size=3), r"the same landmarks to be joined, got \(3, 25, 8\) and \(3, 9, 8\)"),
        Refusal(
            joined(THREE, patch_weights=torch.ones(5, 5)), "the same patch_weights to be joined, got different val"
        ),
        Refusal(joined(THREE, guide_channels="all"), "the same guide_channels to be joined, got 'luminance' and 'all'"),
    ],
    "pad_images": refusals(
        pad_images,
        {},
        ({"images": []}, "^images must be a list of one or more tensors", TypeError),
        ({"images": torch.ones(2, 3, 4, 4)}, "^images must be a list of one or more tensors, got Tensor", TypeError),
        ({"images": [torch.ones(3, 4, 4), None]}, "^images must be a torch.Tensor, got NoneType", TypeError),
        ({"images": [torch.ones(3, 4, 4).byte()]}, "^images must have a floating-point dtype", TypeError),
        ({"images": [torch.ones(3, 4, 4), torch.ones(1, 4, 4)]}, r"same channels.*got \(3, 4, 4\), \(1, 4, 4\)"),
        ({"images": [torch.full((3, 4, 4), NAN)]}, "^images must be finite, got 48 NaN"),
        ({"images": [torch.ones(4, 4)]}, r"^images must have shape \(C, H, W\)"),
        ({"images": [torch.ones(3, 4, 4), torch.ones(3, 4, 4).double()]}, "dtype"),
    ),
    "to_dense": [
        Refusal(
            nonlocal_operator(noise(1, 1, 129, 128), num_landmarks=5, photometric_bandwidth=0.5).to_dense,
            "must have at most 16384 pixels for a dense matrix, got 16512; use a smaller image",
        )
    ],
    "volumes": [
        Refusal(
            lambda: OF_VOLUME @ VOLUME[0], r"^image must have shape \(B, C, D, H, W\), got \(1, 4, 5, 6\); add the m"
        ),
        Refusal(
            lambda: OF_VOLUME @ VOLUME[..., 0],
            r"^image must have shape \(B, C, D, H, W\), got \(1, 1, 4, 5\); add the m",
        ),
        Refusal(
            lambda: OF_VOLUME @ VOLUME.unsqueeze(0),
            r"^image must have shape \(B, C, D, H, W\), got .*; index or flatten",
        ),
        Refusal(
            lambda: OF_VOLUME @ VOLUME[..., :5], "^image must have the size of the operator, 4x5x6, got 4x5x5; resize"
        ),
        Refusal(
            lambda: OF_VOLUME @ VOLUME.flatten(2)[..., 1:],
            r"^image must have shape \(B, C, D, H, W\), got \(1, 1, 119\)",
        ),
    ],
}

FILTERS: dict[str, list[Refusal]] = {
    "polynomial_filter": [
        *refusals(
            polynomial_filter,
            {"operator": OPERATOR, "image": IMAGE, "alpha": ONES},
            ({"operator": None}, "^operator ", TypeError),
            ({"alpha": [1.0, 1.0]}, "^alpha must be a torch.Tensor, got list; convert", TypeError),
            ({"alpha": torch.tensor([1, 1])}, "^alpha must have a floating-point dtype, got torch.int64", TypeError),
            ({"alpha": torch.ones(1)}, f"^{TWO_SLIDERS}"),
            ({"alpha": torch.ones(2, 1)}, f"^{TWO_SLIDERS}"),
            ({"alpha": torch.ones(2, 1, 8, 9)}, f"^{TWO_SLIDERS}"),
            ({"alpha": ONES[0]}, exactly("alpha must have shape (k+1,) or (B, k+1) or (B, k+1, H, W), got ()")),
            (
                {"alpha": torch.ones(2, 4, 9)},
                exactly("alpha must have shape (k+1,) or (B, k+1) or (B, k+1, H, W), got (2, 4, 9)"),
            ),
            ({"alpha": torch.tensor([1.0, NAN])}, "^alpha must be finite, got 1 NaN"),
            ({"alpha": torch.ones(3, 4)}, "^alpha must have the batch size of the layers, 2, got 3"),
            ({"alpha": torch.ones(2, 4, 9, 8)}, "^alpha must have the height and width of the image, 8x9, got 9x8"),
        ),
        *refusals(
            polynomial_filter,
            {"operator": OF_VOLUME, "image": VOLUME},
            (
                {"alpha": torch.ones(1, 2, 5, 6)},
                r"^alpha must have shape \(k\+1,\) or \(B, k\+1\) or \(B, k\+1, D, H, W\), got \(1, 2, 5, 6\)",
            ),
        ),
    ],
    "polynomial_response": refusals(
        polynomial_response,
        {"eigenvalues": torch.ones(3), "alpha": ONES},
        ({"alpha": torch.ones(1)}, f"^{TWO_SLIDERS}"),
        ({"alpha": torch.ones(2, 4, 8, 9)}, exactly("alpha must have shape (k+1,) or (B, k+1), got (2, 4, 8, 9)")),
        ({"eigenvalues": None}, "^eigenvalues must", TypeError),
        ({"eigenvalues": torch.rand(2, 5), "alpha": torch.rand(3, 4)}, "^alpha must"),
        (
            {"eigenvalues": torch.ones(3, 3, 5), "alpha": torch.ones(3, 4)},
            exactly("eigenvalues must have shape (B, R) for sliders of shape (B, k+1), got (3, 3, 5)"),
        ),
    ),
    "compose_alpha": refusals(
        compose_alpha,
        {"masks": torch.ones(2, 1, 4, 4), "alpha": torch.ones(3, 1, 4)},
        ({}, "^alpha must have the batch of masks, 2, or 1, got 3"),
    ),
    "detail_layers": refusals(
        detail_layers,
        {"operator": OPERATOR, "image": IMAGE},
        ({"order": 0}, "^order must be at least 1, got 0"),
        ({"order": 2.0}, "^order must be an int, got float", TypeError),
    ),
    "filter_regions": refusals(
        filter_regions,
        {"operator": OF_VOLUME, "image": VOLUME, "masks": VOLUME, "alpha": torch.ones(1, 2)},
        ({"masks": VOLUME.flatten(2)}, r"^masks must have shape \(B, C, D, H, W\), got \(1, 1, 120\)"),
    ),
    "synthesize": [
        Refusal(
            lambda: SPECTRUM.synthesize(torch.sqrt, torch.ones(2, 3, 19)),
            "^coefficients must",
        )
    ],
    "diffusion_map": [
        Refusal(lambda: diffusion_map(SPECTRUM, time=0.0), f"^time {POSITIVE} 0.0"),
        Refusal(lambda: diffusion_map(OPERATOR, time=1.0), "^spectrum must", TypeError),  # type: ignore[arg-type]
    ],
    "diffusion_mask": [
        *refusals(
            diffusion_mask,
            {"spectrum": SPECTRUM, "region": PAINTED},
            ({"time": -1.0}, f"^time {POSITIVE} -1.0"),
            ({"width": 0.0}, f"^width {POSITIVE} 0.0"),
            ({"width": "4"}, f"^width {NUMBER} str", TypeError),
            ({"region": -PAINTED}, "^region must be non-negative, got -1"),
            ({"region": EMPTY}, "^region must hold a pixel of positive weight in every mask, got an"),
            (
                {"negative": PAINTED.expand(-1, 3, -1, -1)},
                r"^negative must have 1 channel or as many as region \(1\), got 3",
            ),
        ),
        Refusal(
            lambda: diffusion_mask(OF_VOLUME.spectrum(), VOLUME[..., 0]), r"^region must have shape \(B, C, D, H, W\)"
        ),
    ],
    "segment_mask": refusals(
        segment_mask,
        {"spectrum": SPECTRUM, "regions": PAINTED},
        ({"time": NAN}, f"^time {POSITIVE} nan"),
        (
            {"regions": torch.cat([PAINTED, EMPTY], dim=1)},
            "^regions must hold a pixel of positive weight in every mask, got an empty one",
        ),
    ),
    "propagate_strokes": refusals(
        propagate_strokes,
        {"spectrum": SPECTRUM, "strokes": noise(1, 1, 8, 9), "stroke_mask": PAINTED[:1]},
        ({"stroke_mask": EMPTY[:1]}, "^stroke_mask must hold a painted pixel in every image, got none"),
        ({"stroke_mask": EMPTY[:1] + 2}, r"^stroke_mask must be in \[0, 1\], got values from 2 to 2"),
        ({"stroke_mask": torch.ones(1, 2, 8, 9)}, r"^stroke_mask must have 1 channel\(s\), got 2"),
        ({"stroke_mask": torch.ones(1, 1, 8, 10)}, "^stroke_mask must have the height and width of the spectrum, 8x9"),
        ({"strokes": torch.ones(1, 1, 4, 5)}, "^strokes must have the height and width .* 8x9, got 4x5"),
        ({"strokes": torch.ones(3, 1, 8, 9), "stroke_mask": PAINTED}, "batch size"),
        ({"strength": 1.5}, r"^strength must be in \[0, 1\], got 1.5"),
        ({"strength": -0.1}, r"^strength must be in \[0, 1\], got -0.1"),
        ({"reach": 1.0}, r"^reach must be in \[0, 1\), got 1.0"),
        ({"smoothness": 0.0}, "^smoothness must be positive and finite, got 0"),
    ),
    "refine": refusals(
        refine,
        {"logits": LOGITS, "guide": IMAGE},
        ({"logits": LOGITS[0]}, "^logits must have shape"),
        ({"logits": LOGITS * NAN}, "^logits must be finite"),
        ({"logits": LOGITS[..., :4]}, "^logits must have the height and width of the guide, 8x9, got 8x4"),
        ({"logits": LOGITS.repeat(2, 1, 1, 1)}, "^logits must have batch size 1 or that"),
        ({"guide": IMAGE * INFINITY}, "^guide must be finite"),
        ({"kind": "labels"}, "^kind must be one of 'logits', 'probabilities', 'mask', 'trimap', got 'labels'"),
        ({"kind": "mask"}, "^logits must have 1 channel"),
        ({"logits": MASK, "kind": "probabilities"}, "^logits must have at least 2 channels as probabilities"),
        ({"logits": 3 + LOGITS, "kind": "probabilities"}, r"^logits must be in \[0, 1\], got values from 3"),
        ({"logits": 0.5 + 0 * MASK, "kind": "trimap"}, "^logits must have a pixel that is 0 or 1 in every"),
        ({"confidence": 0 * MASK}, "^confidence must have a pixel that is trusted in every image, got none in"),
        ({"confidence": MASK - 1}, r"^confidence must be in \[0, 1\], got values from -"),
        ({"confidence": MASK[..., :4]}, "^confidence must have the height and width of the logits, 8x9"),
        ({"steps": 0}, "^steps must be at least 1, got 0"),
        ({"strength": -1.0}, "^strength must be at least 0 and finite, got -1.0"),
        ({"margin": 0.0}, "^margin must be positive and finite, got 0.0"),
        ({"caution": "much"}, "^caution must be one of 'auto', got 'much'; pass it, a number or None"),
        ({"compatibility": torch.eye(3)}, r"^compatibility must have shape \(4, 4\), got \(3, 3\); pass a row"),
        ({"compatibility": torch.eye(4) * NAN}, "^compatibility must be finite"),
        ({"spatial_bandwidth": "wide"}, "^spatial_bandwidth must be one of 'auto', got 'wide'"),
        (
            {"guide": OPERATOR, "spatial_bandwidth": 3.0},
            "^spatial_bandwidth must be left out if guide is an operator, got 3.0; pass it to nonlocal_operator",
        ),
    ),
    "fit_alpha": refusals(
        fit_alpha,
        {"operator": OPERATOR, "image": GUIDE, "target": GUIDE},
        ({"target": torch.rand(1, 1, 8, 8)}, "^target must have the height and width of the image, 8x9, got 8x8"),
        ({"target": torch.rand(1, 3, 8, 9)}, r"^target must have 1 channel\(s\), got 3"),
        ({"target": torch.rand(3, 1, 8, 9)}, "^target must have batch size 1 or 2, got 3"),
        ({"target": PAINTED.byte()}, "^target must have a floating-point dtype", TypeError),
        ({"image": torch.rand(2, 1, 9, 8)}, "^image must have the height and width of the operator"),
        ({"mask": EMPTY}, "^mask must hold a pixel of positive weight"),
        ({"mask": EMPTY - 1}, "^mask must be non-negative, got -1"),
        ({"mask": torch.ones(1, 2, 8, 9)}, r"^mask must have 1 channel\(s\), got 2"),
        ({"mask": torch.ones(1, 1, 4, 9)}, "^mask must have the height and width of the image"),
        ({"order": 0}, "^order must be at least 1, got 0"),
        ({"ridge": -1.0}, "^ridge must be at least 0 and finite, got -1"),
        ({"ridge": "much"}, "^ridge must be a number, got str", TypeError),
        ({"rounding": NAN}, "^rounding must be at least 0 and finite, got nan"),
        ({"loss": "l1"}, "^loss must", TypeError),
        ({"loss": lambda a, b: None}, "^loss must", TypeError),
        ({"loss": lambda a, b: b.sum()}, "^loss must"),
        ({"shared": None}, "^shared must", TypeError),
    ),
    "fitted filters": [
        Refusal(lambda: FITTED.layers(GUIDE, origin="top"), "^origin must", TypeError),  # type: ignore[arg-type]
        Refusal(lambda: FITTED.layers(GUIDE, halo=(0, -1)), "^halo must"),
        Refusal(lambda: FITTED.layers(GUIDE, halo=(4, 4)), "^halo must"),
    ],
}

LEARN = "^learn must hold only names from"
MODULES: dict[str, list[Refusal]] = {
    "NonlocalFilter": refusals(
        NonlocalFilter,
        {},
        ({"learn": ("alpha", "gamma")}, f"{LEARN} 'alpha', .*, got 'gamma'"),
        ({"learn": "bandwidth"}, "got 'bandwidth'"),
        ({"learn": 3}, "^learn must be a list of names, got 3", TypeError),
        ({"photometric_bandwidth": 0.0}, "^photometric_bandwidth must be positive"),
        (
            {"photometric_bandwidth": -1.0, "learn": "photometric_bandwidth"},
            "^photometric_bandwidth must be positive and finite, got -1",
        ),
        ({"photometric_bandwidth": "car"}, "^photometric_bandwidth must be one of 'auto'"),
        (
            {"learn": "photometric_bandwidth"},
            "^photometric_bandwidth must be a number if it is learned, got 'auto'; pass",
        ),
        ({"landmarks": 48}, "^landmarks must be one of .*, got 48; .* num_landmarks"),
        ({"num_landmarks": "48"}, "^num_landmarks must be an int, got str", TypeError),
        ({"patch_size": 4}, "^patch_size must be odd"),
        ({"patch_size": 4, "learn": "patch_weights"}, "^patch_size must be odd"),
        ({"patch_size": 100001}, "^patch_size must be at most 101, got 100001"),
        ({"completion": "all"}, "^completion must be one of"),
        ({"guide_channels": "rgb"}, "^guide_channels must be one of"),
        ({"tolerance": 0.0}, "^tolerance must be positive"),
        ({"tolerance": torch.tensor(1e-5)}, "^tolerance must be a number, got Tensor", TypeError),
        ({"generator": 1}, "^generator must be a Generator, got int", TypeError),
        ({"group": "all"}, "^group must be a process group", TypeError),
        ({"patch_weights": torch.ones(2, 2)}, "^patch_weights must have shape"),
        ({"residual": NAN}, "^residual must be finite, got nan"),
        ({"residual": "all"}, "^residual must be a number or a tensor, got str", TypeError),
        ({"alpha": "1, 1"}, "^alpha must be numbers or rows of numbers of equal length, got '1, 1'", TypeError),
        ({"alpha": (1.0,)}, "^alpha must have at least two entries"),
        ({"alpha": (1.0, NAN)}, "^alpha must be finite"),
        ({"spatial_bandwidth": -3.0}, "^spatial_bandwidth must be positive"),
        ({"learn": "spatial_bandwidth"}, "^spatial_bandwidth must be a number of pixels"),
        ({"hold": "pixels"}, "^hold must be one of 'assignment', 'features', got 'pixels'"),
        ({"landmarks": HELD.landmarks}, "^photometric_bandwidth must be a number if landmarks"),
        (
            {"landmarks": HELD.landmarks, "hold": "assignment"},
            "^hold must be 'features' if landmarks are features",
        ),
        (
            {"landmarks": HELD.assignment, "hold": "features"},
            "^hold must be 'assignment' if landmarks are an assignment",
        ),
    ),
    "calls of NonlocalFilter": [
        Refusal(lambda: NonlocalFilter().forward(None), "^image must", TypeError),  # type: ignore[arg-type]
        Refusal(lambda: NonlocalFilter().sliders.combine(IMAGE[0]), "^layers must"),
        Refusal(lambda: NonlocalFilter(residual=0.5).sliders.combine(IMAGE), "^residual must"),
        Refusal(
            lambda: NonlocalFilter(hold="features")(IMAGE), "^landmarks must be chosen before the first call .* renew"
        ),
        Refusal(lambda: NonlocalFilter(hold="features").renew(), "^guide must be images .* got None"),
        Refusal(lambda: NonlocalFilter().renew(IMAGE), "^hold must be 'assignment' or 'features' to renew"),
        Refusal(
            lambda: NonlocalFilter(landmarks=OPERATOR, patch_size=3)(IMAGE[:1]), "^landmarks must be an assignment of"
        ),
    ],
    "NonlocalAffinity": refusals(
        NonlocalAffinity,
        {},
        ({"learn": ("alpha",)}, f"{LEARN} 'photometric_bandwidth'"),
        ({"landmarks": 48}, "^landmarks must be one of .*, got 48; .* num_landmarks"),
    ),
    "PolynomialSliders": refusals(PolynomialSliders, {}, ({"learn": ("time",)}, f"{LEARN} 'alpha', 'residual'")),
    "DiffusionMask": refusals(
        DiffusionMask,
        {},
        ({"learn": ("alpha",)}, f"{LEARN} 'time', 'width'"),
        ({"time": "long"}, "^time must be a number or a tensor, got str", TypeError),
        ({"time": -1.0, "learn": "time"}, "^time must be positive"),
        ({"width": 0.0}, "^width must be positive"),
    ),
    "SegmentMask": refusals(SegmentMask, {}, ({"time": -1.0}, "^time must be positive")),
    "Refine": refusals(
        Refine,
        {},
        ({"learn": ("steps",)}, f"{LEARN} 'strength', 'margin'"),
        ({"learn": ("spatial_bandwidth",)}, "^spatial_bandwidth must be a number, got str", TypeError),
        ({"learn": ("margin",), "margin": None}, "^margin must be a number, got NoneType", TypeError),
        ({"learn": ("compatibility",)}, "^classes must be the number of classes to learn compatibility"),
        ({"learn": ("compatibility",), "classes": 1}, "^classes must be at least 2, got 1"),
        ({"kind": "image"}, "^kind must be one of"),
        ({"strength": 0.0}, "^strength must be positive"),
        ({"caution": -1.0}, "^caution must be positive"),
        ({"steps": 0}, "^steps must be at least 1"),
        ({"photometric_bandwidth": "wide"}, "^photometric_bandwidth must be one of 'auto', got 'wide'"),
        ({"spatial_bandwidth": "wide"}, "^spatial_bandwidth must be one of 'auto', got 'wide'"),
        ({"spatial_bandwidth": -1.0}, "^spatial_bandwidth must be positive"),
    ),
    "NonlocalBlock": refusals(
        NonlocalBlock,
        {"channels": 4},
        ({"channels": 0}, "^channels must be at least 1"),
        ({"inner_channels": 2.0}, "^inner_channels must be an int", TypeError),
        ({"embedding_channels": 0}, "^embedding_channels must be at least 1"),
        ({"num_landmarks": 0}, "^num_landmarks must be at least 1"),
        ({"landmarks": "grid"}, "^landmarks must be"),
        ({"norm": "layer"}, "^norm must be one of 'batch', 'none'"),
        ({"temperature": 0.0}, "^temperature must be positive"),
        ({"spatial_bandwidth": -1.0}, "^spatial_bandwidth must be positive"),
        ({"learn": "alpha"}, f"{LEARN} 'temperature'"),
        ({"learn": "spatial_bandwidth"}, "^spatial_bandwidth must be a number of pix"),
    ),
    "calls of NonlocalBlock": refusals(
        lambda x, **options: NonlocalBlock(4, **options)(x),
        {},
        ({"x": None}, "^x must be a torch.Tensor, got NoneType", TypeError),
        ({"x": torch.rand(1, 3, 5, 5)}, r"^x must have 4 channel\(s\), got 3"),
        ({"x": torch.rand(4, 5)}, r"^x must have shape \(B, C, N\), .* got \(4, 5\)"),
        ({"x": torch.rand(1, 4, 0, 5)}, "^x must have shape .* with at least one pixel"),
        ({"x": torch.rand(1, 4, 5).double()}, "^x must have the dtype of the block", TypeError),
        ({"x": torch.rand(1, 4, 5) / 0}, "^x must be finite, got 20 NaN"),
        ({"x": torch.rand(1, 4, 5), "spatial_bandwidth": 3.0}, "^x must have places"),
    ),
    "NonlocalDenoiser": refusals(
        lambda image, noise: NonlocalDenoiser.trained()(image, noise),
        {"image": torch.zeros(1, 3, 8, 8), "noise": 0.1},
        ({"image": torch.zeros(8, 8)}, "^noisy must have shape"),
        ({"image": torch.full((1, 1, 8, 8), NAN)}, "^noisy must be finite"),
        ({"noise": -0.1}, "^noise must be at least 0"),
        ({"noise": torch.full((1, 1, 8, 8), NAN)}, "^noise must be finite"),
        ({"noise": torch.full((1, 1, 8, 8), -1.0)}, "^noise must be at least 0"),
        ({"noise": torch.zeros(1, 1, 8, 9)}, "^noise must have the height and width"),
        ({"noise": torch.zeros(1, 2, 8, 8)}, "^noise must have 1 channel or as many as the image"),
        ({"noise": torch.zeros(3)}, "^noise must be a number or have shape"),
        ({"noise": "much"}, "^noise must be a number", TypeError),
    ),
}

LEAVES = "^box must lie within the picture, which is 22 pixels wide and 20 high, got"
NARROW, NO_NUMBERS_OF_BOX = "^box must be at least 1 pixel wide and high, got", "^box must be four numbers .*, got"
NO_BOXES: dict[Any, tuple[str, type[Exception]]] = {
    (1, 2, 3): (rf"{NO_NUMBERS_OF_BOX} \(1, 2, 3\); reshape it", ValueError),
    (0, 0, 100, 20): (rf"{LEAVES} \(0, 0, 100, 20\); move or shrink", ValueError),
    (-1, 0, 10, 20): (rf"{LEAVES} \(-1, 0, 10, 20\); move or shrink", ValueError),
    (10, 0, 5, 20): (rf"{NARROW} \(10, 0, 5, 20\); give left, top, right and bottom", ValueError),
    (5, 5, 5, 5): (rf"{NARROW} \(5, 5, 5, 5\); give left, top, right and bottom", ValueError),
    (NAN, 0, 5, 5): ("^box must be finite, got 1 NaN or infinite value", ValueError),
    (0, 0, INFINITY, 5): ("^box must be finite, got 1 NaN or infinite value", ValueError),
    "left": (f"{NO_NUMBERS_OF_BOX} 'left'; give left, top", TypeError),
    7: (f"{NO_NUMBERS_OF_BOX} 7; give left, top", TypeError),
    torch.ones(3, 4): (rf"{NO_NUMBERS_OF_BOX} \(3, 4\); reshape", ValueError),
    torch.ones(5, 1, 4): (rf"{NO_NUMBERS_OF_BOX} \(5, 1, 4\); reshape", ValueError),
    torch.ones(1, 3, 4): ("^box must be one for all regions or one for each of the 1 regions, got 3; add", ValueError),
    torch.ones(1, 1, 4).bool(): ("^box must hold numbers of pixels, got torch.bool; convert", TypeError),
    (10, 10, 22, 20): ("^box must hold most of the .* on its object in every image, got some that lie m", ValueError),
}
WITH_BOX: dict[str, Callable[[Any], object]] = {
    "region_mask": lambda v: region_mask(RGB, SPOT, box=v, num_landmarks=20),
    "defocus": lambda v: defocus(RGB, SPOT, box=v, num_landmarks=20),
    "recolor": lambda v: recolor(RGB, **STROKES, box=v, num_landmarks=20),
    "enhance": lambda v: enhance(RGB, ONES, SPOT, box=v, num_landmarks=20),
}


@pytest.mark.parametrize("function", WITH_BOX)
def test_refused_boxes(function: str) -> None:
    call = WITH_BOX[function]
    check_refusals(Refusal(partial(call, value), *said) for value, said in NO_BOXES.items())


EDITS: dict[str, list[Refusal]] = {
    "enhance": [
        *refusals(
            enhance,
            {"image": RGB, "alpha": ONES},
            ({"alpha": [1.0, 1.0]}, "^alpha must be a torch.Tensor, got list; convert it", TypeError),
            ({"regions": [1]}, "^regions must be a torch.Tensor, got list", TypeError),
            ({"regions": SPOT[0]}, "^regions must"),
            ({"image": EMPTY[:0]}, r"^image must hold at least one pixel, got shape \(0, 1, 8, 9\)"),
        ),
        *refusals(
            enhance,
            {"image": RGB, "alpha": ONES, "regions": SPOT},
            (
                {"outside": torch.ones(2)},
                r"^outside must have shape \(4,\), got \(2,\); give as many sliders as alpha h",
            ),
            ({"outside": [1.0, 1.0, 1.0, 1.0]}, "^outside must be a torch.Tensor, got list; give as many", TypeError),
            (
                {"outside": ONES.int()},
                "^outside must have a floating-point dtype, got torch.int32; write 1.0",
                TypeError,
            ),
            ({"outside": ONES * NAN}, "^outside must be"),
        ),
    ],
    "recolor": refusals(
        recolor,
        {"image": RGB, **STROKES},
        ({"image": GREY}, r"^image must have 3 channel\(s\), got 1"),
        ({"stroke_mask": 0 * SPOT}, "^stroke_mask must hold a painted pixel in every image"),
        ({"stroke_mask": 2 * SPOT}, r"^stroke_mask must be in \[0, 1\]"),
        ({"strokes": torch.ones(1, 3, 9, 9)}, "^strokes must have the height and width of the image"),
        ({"keep": torch.ones(1, 1, 9, 9)}, "^keep must have the height and width of the image"),
        ({"keep": 3 * SPOT}, r"^keep must be in \[0, 1\], got values from 0 to 3"),
        ({"reach": 1.0}, r"^reach must be in \[0, 1\)"),
    ),
    "colorize": refusals(
        colorize,
        {"grey": GREY, **STROKES},
        ({"grey": RGB}, r"^grey must have 1 channel\(s\), got 3; select or convert the channels"),
        ({"stroke_mask": 0 * SPOT}, "^stroke_mask must hold a painted pixel"),
        ({"method": "levin"}, "^method must be one of 'regression', 'kmeans', got 'levin'"),
        ({"strength": 2.0}, r"^strength must be in \[0, 1\]"),
        ({"strokes": torch.ones(3, 3, 20, 22)}, "^strokes must have batch size 1 or 2, got 3"),
        ({"strength": None}, "^strength must be a number or a tensor, got NoneType", TypeError),
        ({"photometric_bandwidth": "auto"}, "^photometric_bandwidth must be a number or a", TypeError),
        ({"num_landmarks": "a"}, "^num_landmarks must be an int, got str", TypeError),
    ),
    "adjust_light": refusals(
        adjust_light,
        {"image": RGB, "region": SPOT, "exposure": 1.0},
        ({"region": 0 * SPOT}, "^region must hold a painted pixel"),
        ({"background": torch.ones(1, 1, 9, 9)}, "^background must have the height and width of the image"),
        ({"exposure": 6.0}, r"^exposure must be in \[-5, 5\], got 6"),
        ({"saturation": NAN}, r"^saturation must be in \[-1, 1\]"),
        ({"temperature": 100.0}, "^temperature must be a number from 2000 to 15000"),
        ({"curve": (0.0, 2.0)}, "^curve must be a list"),
        ({"image": RGB[:, :2]}, "^image must have 1 or 3 channels, got 2"),
    ),
    "heal": refusals(
        heal,
        {"image": RGB, "spots": SPOT},
        ({"spots": 0 * SPOT}, "^spots must hold a painted pixel"),
        ({"spots": SPOT[..., :9]}, "^spots must have the height and width of the image"),
        ({"spots": 3 * SPOT}, r"^spots must be in \[0, 1\], got values from 0 to 3"),
        ({"reach": 0.0}, "^reach must be positive"),
    ),
    "defocus": refusals(
        defocus,
        {"image": RGB, "focus_region": SPOT},
        ({"focus_region": 0 * SPOT}, "^focus_region must hold a painted pixel"),
        ({"focus_region": SPOT[..., :9]}, "^focus_region must have the height and width of the image"),
        ({"background": torch.ones(1, 1, 9, 9)}, "^background must have the height and width of the image"),
        ({"background": 3 * SPOT}, r"^background must be in \[0, 1\], got values from 0 to 3"),
        ({"radius": 0.0}, "^radius must be positive"),
        ({"radius": 1e4}, "^radius must be at most half the short side of the"),
        ({"aperture": "square"}, "^aperture must be one of 'disc', 'gaussian'"),
        ({"image": RGB[:, :2]}, "^image must have 1 or 3 channels, got 2"),
    ),
    "abstract": refusals(
        abstract,
        {"image": RGB},
        ({"power": -1.0}, r"^power must be in \[0, 10\], got -1"),
        ({"edges": 2.0}, r"^edges must be in \[0, 1\], got 2"),
        ({"edge_width": 0.0}, "^edge_width must be positive"),
        ({"edge_width": 1e4}, "^edge_width must be at most half the short side of the"),
        ({"tones": 1}, "^tones must be at least 2, got 1"),
        ({"image": RGB[:, :2], "tones": 4}, "^image must have 1 or 3 channels for edges and tones, got 2"),
        ({"num_landmarks": "a"}, "^num_landmarks must be an int, got str", TypeError),
    ),
    "denoise": refusals(
        denoise,
        {"image": RGB},
        ({"image": VOLUME}, r"^image must have shape \(B, C, H, W\), got .*; index or flatten"),
        ({"noise_level": -0.1}, "^noise_level must be at least 0 and finite"),
        (
            {"noise_level": torch.zeros_like(RGB), "method": "rule"},
            r"^noise_level must be a number or have shape \(B,\) for method rule, got a map",
        ),
        ({"grain": 1.5}, r"^grain must be in \[0, 1\], got 1\.5"),
        ({"grain": torch.tensor([-0.1])}, r"^grain must be in \[0, 1\], got \[-0\.1"),
        ({"grain": "fine"}, "^grain must be a number", TypeError),
        ({"method": "luck"}, "^method must be one of 'network', 'rule', got 'luck'"),
        ({"num_landmarks": "a"}, "^num_landmarks must be an int, got str", TypeError),
    ),
    "sharpen": refusals(
        sharpen,
        {"image": RGB},
        ({"guide_blur": -1.0}, "^guide_blur must be at least 0 and finite, got -1"),
        ({"guide_blur": INFINITY}, "^guide_blur must be at least 0 and finite, got inf"),
    ),
    "adjust_tone": refusals(adjust_tone, {"image": RGB}, ({"order": 0}, "^order must be at least 1, got 0")),
    "apply_look": refusals(
        apply_look,
        {"image": RGB},
        ({"matrix": (1.0, 0.0)}, "^matrix must be 9 numbers"),
        ({"red": (0.0, 1.0)}, "^red, green and blue must be equally many"),
        ({"bands": (1.0, 1.0)}, "^bands must have the shape"),
        ({"texture": (1.0,)}, "^texture must have the shape"),
        ({"alpha": (1.0,)}, "^alpha must have the shape"),
        ({"local": (1.0,)}, "^local must have the shape"),
        ({"stretch": (1.0,)}, "^stretch must have the shape"),
        ({"lattice": torch.zeros(3, 4, 4, 5)}, r"^lattice must have the shape \(3, n, n, n\)"),
        ({"lattice": torch.zeros(3, 1, 1, 1)}, r"^lattice must have the shape \(3, n, n, n\)"),
        ({"lattice": (0.0, 1.0)}, "or be as many numbers, got 2; add or drop some"),
        ({"lattice": torch.full((3, 2, 2, 2), NAN)}, "^lattice must be finite"),
    ),
    "region_mask": refusals(
        region_mask,
        {"image": RGB[:1], "scribbles": SPOT},
        ({"scribbles": None}, "^scribbles must be a torch.Tensor, got NoneType; paint some, or pass box or", TypeError),
        ({"scribbles": 0 * SPOT}, "^scribbles must hold a painted pixel"),
        ({"scribbles": 2 * SPOT}, r"^scribbles must be in \[0, 1\]"),
        ({"scribbles": torch.ones(1, 1, 9, 9)}, "^scribbles must have the height and width of the image"),
        ({"background": 0 * SPOT}, "^background must hold a painted pixel"),
        ({"background": SPOT}, "^background must hold a painted pixel outside the scribbles"),
        (
            {"background": ELSEWHERE.repeat(1, 3, 1, 1)},
            "^background must have 1 channel or one for each of the 1 regions",
        ),
        ({"reach": 1.0}, "^reach must be"),
        ({"photometric_bandwidth": -1.0}, "^photometric_bandwidth must be positive"),
        ({"image": RGB[:1, :2]}, "^image must have 1 or 3 channels"),
        ({"added": ELSEWHERE.repeat(1, 2, 1, 1)}, "^added must have a channel for each of the 1 regions, got 2"),
        ({"removed": ELSEWHERE.repeat(1, 2, 1, 1)}, "^removed must have 1 channel or one for each of the 1 regions"),
        ({"added": 2 * ELSEWHERE}, r"^added must be in \[0, 1\], got values from 0 to 2"),
        ({"removed": ELSEWHERE[..., :9]}, "^removed must have the height and width of the image"),
    ),
    "cutout": refusals(
        cutout,
        {"image": RGB, "mask": SPOT},
        ({"image": RGB[:, :2]}, "^image must have 1 or 3 channels, got 2; select 1 or 3"),
        ({"mask": None}, "^mask must be a torch.Tensor, got NoneType", TypeError),
        ({"mask": SPOT[..., :9]}, "^mask must have the height and width of the image"),
        ({"mask": SPOT.repeat(1, 2, 1, 1)}, r"^mask must have 1 channel\(s\), got 2"),
        ({"mask": 2 * SPOT}, r"^mask must be in \[0, 1\], got values from 0 to 2"),
        ({"mask": SPOT * NAN}, "^mask must be finite"),
    ),
    "filter_frames": refusals(
        filter_frames,
        {"frames": [], "alpha": ONES, "references": [GUIDE[:1]]},
        ({"frames": None}, "^frames must", TypeError),
        ({"references": None}, "^references must", TypeError),
        ({"references": []}, "^references must hold at least one frame, got none"),
        (
            {"references": [GREY[:1], GREY[1:]], "spatial_bandwidth": 5.0},
            "^references must hold a single frame if",
        ),
        ({"references": [GREY[:1], GREY[:1, ..., 1:]]}, "^references must have the height and width of the first"),
        ({"references": [GREY]}, "^references must have batch size 1, got 2"),
    ),
    "estimate_noise": refusals(
        estimate_noise, {"image": VOLUME}, ({}, r"^image must have shape \(B, C, H, W\), got .*; index or flatten")
    ),
    "standard_error": refusals(
        standard_error,
        {"function": torch.neg, "image": GUIDE, "noise": 0.1},
        ({"function": 3}, "^function must be a function of an image, got int; pass a denoiser", TypeError),
        ({"function": torch.sum}, "^the result of function must have shape"),
        ({"noise": -0.1}, "^noise must"),
        ({"noise": torch.ones(2, 1, 4, 9)}, "^noise must have the height and width of the image"),
        ({"image": GUIDE * NAN}, "^image must be finite"),
    ),
    "noise_profile": refusals(
        noise_profile, {"image": VOLUME}, ({}, r"^image must have shape \(B, C, H, W\), got .*; index or flatten")
    ),
    "enhance of a volume": refusals(
        enhance, {"image": VOLUME, "alpha": 2.0}, ({}, r"^image must have shape \(B, C, H, W\), got .*; index or flat")
    ),
}
EVERY = {name: rows for table in (OPERATORS, FILTERS, MODULES, EDITS) for name, rows in table.items()}


@pytest.mark.parametrize("function", EVERY)
def test_refusals(function: str) -> None:
    check_refusals(EVERY[function])


def test_nothing_is_changed_by_an_error() -> None:
    state, image = torch.get_rng_state(), IMAGE.clone()
    check_refusals(
        [
            Refusal(lambda: polynomial_filter(OPERATOR, image, torch.ones(1)), "^alpha"),
            Refusal(lambda: nonlocal_operator(GUIDE, patch_size=2), "^patch_size"),
        ]
    )
    assert torch.equal(image, IMAGE)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.is_grad_enabled()
    assert not torch.is_autocast_enabled("cpu")
