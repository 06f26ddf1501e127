"""Checks of arguments: numbers, responses, scales, and warnings at the line of the caller."""

import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NonlocalFilter,
    apply_function,
    diffusion_map,
    diffusion_mask,
    filter_regions,
    fit_filter,
    nonlocal_operator,
    polynomial_filter,
    propagate_strokes,
    segment_mask,
    spectral_filter,
)
from nlfilter_torch.core.checks import check_finite
from nlfilter_torch.photo import (
    Step,
    abstract,
    adjust_tone,
    colorize,
    defocus,
    denoise,
    enhance,
    filter_frames,
    recolor,
    sharpen,
)
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


NUMBERS: dict[str, tuple[str, Callable[[Any], object]]] = {
    "polynomial_filter": ("residual", lambda v: polynomial_filter(OPERATOR, IMAGE, ONES, residual=v)),
    "spectral_filter": ("residual", lambda v: spectral_filter(SPECTRUM, IMAGE, torch.sqrt, residual=v)),
    "filter_regions": ("residual", lambda v: filter_regions(OPERATOR, IMAGE, PAINTED, ONES[None], residual=v)),
    "fitted filter": ("residual", lambda v: FITTED(GREY, ONES, residual=v)),
    "enhance": ("residual", lambda v: enhance(IMAGE, ONES, residual=v, **OPTIONS)),
    "sharpen": ("amount", lambda v: sharpen(IMAGE, amount=v, **OPTIONS)),
    "contrast": ("contrast", lambda v: adjust_tone(IMAGE, contrast=v, **OPTIONS)),
    "clarity": ("clarity", lambda v: adjust_tone(IMAGE, clarity=v, **OPTIONS)),
    "diffusion_map": ("time", lambda v: diffusion_map(SPECTRUM, time=v)),
    "time of a mask": ("time", lambda v: diffusion_mask(SPECTRUM, PAINTED, time=v)),
    "width of a mask": ("width", lambda v: diffusion_mask(SPECTRUM, PAINTED, width=v)),
    "segment_mask": ("time", lambda v: segment_mask(SPECTRUM, PAINTED, time=v)),
    "time of colours": ("time", lambda v: colorize(GREY, IMAGE, PAINTED, method="kmeans", time=v)),
    "mask_bandwidth": ("mask_bandwidth", lambda v: enhance(IMAGE, ONES, PAINTED, mask_bandwidth=v, **OPTIONS)),
    "strength": ("strength", lambda v: propagate_strokes(SPECTRUM, IMAGE, PAINTED, strength=v)),
    "reach": ("reach", lambda v: recolor(IMAGE, IMAGE, PAINTED, reach=v, num_landmarks=20)),
    "smoothness": ("smoothness", lambda v: propagate_strokes(SPECTRUM, IMAGE, PAINTED, smoothness=v)),
    "power": ("power", lambda v: abstract(IMAGE, power=v, **OPTIONS)),
    "noise_level": ("noise_level", lambda v: denoise(IMAGE, noise_level=v, method="rule", num_landmarks=20)),
}


NO_NUMBERS: dict[str, Any] = {
    "NaN": NAN,
    "infinity": INFINITY,
    "string": "much",
    "bool": True,
    "list": [1.0, 2.0],
    "long integer": 10**400,
    "tensor with NaN": torch.tensor([0.5, NAN]),
    "another batch": torch.full((3,), 0.5),
    "another shape": torch.full((2, 1), 0.5),
    "empty tensor": torch.empty(0),
    "image": PAINTED,
    "complex tensor": torch.tensor(0.5j),
    "boolean tensor": torch.tensor(True),
}


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


EDITS: dict[str, Callable[[Tensor], object]] = {
    "recolor": lambda x: recolor(x, IMAGE, PAINTED, num_landmarks=20),
    "colorize": lambda x: colorize(x[:, :1], IMAGE, PAINTED, num_landmarks=20),
    "nonlocal_operator": lambda x: nonlocal_operator(x, num_landmarks=20),
    "small bandwidth": lambda x: nonlocal_operator(x, num_landmarks=20, photometric_bandwidth=0.1),
    "NonlocalFilter": lambda x: NonlocalFilter(num_landmarks=20)(x),
}
#: These see images in the range that they use.
OF_ANY_SCALE: dict[str, Callable[[Tensor], object]] = {
    "defocus": lambda x: defocus(x, PAINTED, num_landmarks=20),
    "abstract": lambda x: abstract(x, num_landmarks=20),
    "denoise": lambda x: denoise(x, num_landmarks=20),
    "sharpen": lambda x: sharpen(x, num_landmarks=20),
    "adjust_tone": lambda x: adjust_tone(x, num_landmarks=20),
    "enhance": lambda x: enhance(x, ONES, PAINTED, num_landmarks=20),
    "filter_frames": lambda x: filter_frames([], ONES, references=[x[:1]], num_landmarks=20),
}


@pytest.mark.parametrize("value", list(NO_NUMBERS))
@pytest.mark.parametrize("function", list(NUMBERS))
def test_numbers_are_finite_and_one_for_each_image(function: str, value: str) -> None:
    name, call = NUMBERS[function]
    sentence(lambda: call(NO_NUMBERS[value]), name)


@pytest.mark.parametrize("value", [0.5, torch.tensor(0.5), torch.tensor([0.5, 0.6]), torch.tensor(0.5).double()])
@pytest.mark.parametrize("function", list(NUMBERS))
def test_numbers_and_tensors_of_them_are_taken(function: str, value: float | Tensor) -> None:
    result = NUMBERS[function][1](value)
    assert isinstance(result, Tensor)
    assert result.isfinite().all()


@pytest.mark.parametrize("function", list(NUMBERS))
def test_numbers_of_numpy_and_tensors_with_the_dimensions_of_images_are_taken(function: str) -> None:
    call = NUMBERS[function][1]
    half, both = call(0.5), call(torch.tensor([0.5, 0.6]))
    for value in (np.float16(0.5), np.float32(0.5), np.float64(0.5), torch.full((1, 1, 1, 1), 0.5)):
        torch.testing.assert_close(call(value), half)
    torch.testing.assert_close(call(torch.tensor([0.5, 0.6]).view(2, 1, 1, 1)), both)
    if function != "reach":
        torch.testing.assert_close(call(np.int64(1)), call(1))


def test_integers_of_numpy_are_taken() -> None:
    options = {"num_landmarks": np.int64(20), "patch_size": np.int32(3), "photometric_bandwidth": np.float32(0.25)}
    usual = {"num_landmarks": 20, "patch_size": 3, "photometric_bandwidth": 0.25}
    assert torch.equal(enhance(IMAGE, ONES, **options), enhance(IMAGE, ONES, **usual))
    assert torch.equal(nonlocal_operator(GREY, **options).factor, nonlocal_operator(GREY, **usual).factor)
    level = torch.tensor([0.1, 0.2])
    assert torch.equal(denoise(IMAGE, noise_level=level), denoise(IMAGE, noise_level=level.view(2, 1, 1, 1)))
    for wrong in (np.bool_(True), np.float32(2.5), np.array(20)):
        with pytest.raises(TypeError, match=r"num_landmarks must be an int, got .+; pass a positive integer"):
            nonlocal_operator(GREY, num_landmarks=wrong)
    with pytest.raises(ValueError, match="num_landmarks must be at least 1, got 0; "):
        nonlocal_operator(GREY, num_landmarks=np.int64(0))
    assert Step("detail", alpha=(np.float32(2), np.int64(1))).to_json() == Step("detail", alpha=(2.0, 1)).to_json()


@pytest.mark.parametrize("response", list(RESPONSES))
def test_responses_return_a_finite_gain_for_every_eigenvalue(response: str) -> None:
    result = RESPONSES[response]
    sentence(lambda: spectral_filter(SPECTRUM, IMAGE, result), "response")
    sentence(lambda: spectral_filter(SPECTRUM, IMAGE, result, residual=0.5), "response")
    sentence(lambda: spectral_filter(OPERATOR, IMAGE, result), "response")
    sentence(lambda: apply_function(OPERATOR, IMAGE, result), "response")
    sentence(lambda: SPECTRUM.gain(result), "response")
    sentence(lambda: SPECTRUM.synthesize(result, SPECTRUM.coefficients(IMAGE)), "response")


def test_a_constant_response_may_be_learned() -> None:
    spectrum = nonlocal_operator(GREY.clone().requires_grad_(), **OPTIONS).spectrum()
    gain = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    filtered = spectral_filter(spectrum, IMAGE, lambda s: gain * torch.ones_like(s))
    filtered.square().sum().backward()
    unit = spectral_filter(SPECTRUM, IMAGE, torch.ones_like)
    torch.testing.assert_close(filtered.detach(), 2 * unit)
    torch.testing.assert_close(gain.grad.float(), 4 * unit.square().sum(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("edit", list(EDITS))
def test_one_warning_for_an_image_in_0_to_255(edit: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        EDITS[edit](255 * IMAGE)
    about = [w for w in caught if "[0, 1]" in str(w.message)]
    assert len(about) == 1
    assert re.fullmatch(r"(image|grey|guide|references) must be .+, got values up to 25\d.*; .+", str(about[0].message))
    assert about[0].filename == __file__


@pytest.mark.parametrize("edit", list(OF_ANY_SCALE))
@pytest.mark.filterwarnings("error")
def test_no_warning_for_edits_of_any_scale(edit: str) -> None:
    OF_ANY_SCALE[edit](255 * IMAGE)


def test_no_warning_for_feature_maps_and_high_dynamic_range() -> None:
    nonlocal_operator(255 * noise(1, 8, 8, 9, dtype=torch.float32), num_landmarks=20)
    nonlocal_operator(255 * IMAGE, num_landmarks=20, photometric_bandwidth=20.0)
    nonlocal_operator(12 * IMAGE, num_landmarks=20)
    sharpen(12 * IMAGE, num_landmarks=20)


GUIDE = noise(2, 1, 8, 9)


def test_values_whose_sum_overflows_are_finite() -> None:
    image = torch.full((1, 1, 8, 9), 3e38)
    assert not image.sum().isfinite()
    check_finite(image, "image")


@pytest.mark.parametrize(("landmarks", "alarm"), [(100, 1.0), (20, 0.0)], ids=["too many landmarks", "no balance"])
def test_warnings_point_at_the_caller(landmarks: int, alarm: float, monkeypatch: pytest.MonkeyPatch) -> None:
    # Row sums of small images are too accurate for a warning, so here any deviation raises one.
    monkeypatch.setattr("nlfilter_torch.operator.sinkhorn.ALARM", {GUIDE.dtype: alarm})
    monkeypatch.setattr("nlfilter_torch.operator.sinkhorn.TOLERANCE", {GUIDE.dtype: 1e-17})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nonlocal_operator(GUIDE, num_landmarks=landmarks)
    assert [w.filename for w in caught] == [__file__]
