"""Random operators, pictures and calls keep the library's promises, and the faults that the checks detect.

The same few cases in every run; ``RANDOM_CASES=10000 pytest tests/themes/test_random_input.py`` draws as many new ones
for each test, on operators of up to 64x64 pixels and pictures of all sizes, and simplifies those that fail.
"""

import os
import random
import warnings
from dataclasses import replace

import numpy as np
import pytest
import skimage.data
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.color import rgb2gray
from skimage.transform import resize
from skimage.util import img_as_float64

import nlfilter_torch
from nlfilter_torch import NonlocalOperator, nonlocal_operator
from nlfilter_torch.core.checks import check_positive
from nlfilter_torch.core.warning import warn
from tests import random_operators as checks
from tests.problems import IMAGE_FUNCTIONS, noise
from tests.random_calls import FUNCTIONS, check_call, random_call
from tests.random_operators import (
    SAMPLINGS,
    Exact,
    Findings,
    check_case,
    check_operator,
    is_sentence,
    judged,
    random_case,
)

MANY = int(os.environ.get("RANDOM_CASES", "0"))
# All pictures of scikit-image that load without a download.
PICTURES = (
    "astronaut", "brick", "camera", "cell", "chelsea", "clock", "coffee", "coins", "colorwheel", "grass", "gravel",
    "horse", "hubble_deep_field", "immunohistochemistry", "logo", "microaneurysms", "moon", "page", "retina", "rocket",
    "shepp_logan_phantom", "stereo_motorcycle", "text",
)  # fmt: skip

# Hypothesis draws every choice, so that it can simplify a failing case.
sources = st.randoms(use_true_random=False)


def examples(few: int) -> settings:
    """As many fixed cases in the suite; random ones where the environment asks for many."""
    return settings(max_examples=MANY or few, derandomize=not MANY)


def assert_kept(what: object, findings: Findings) -> None:
    broken = [f"{figure.promise}: {figure.value:.4g} {figure.detail}" for figure in findings.broken]
    assert not broken, f"{what}\n" + "\n".join(broken)


@pytest.mark.slow
@given(rng=sources)
@examples(150)
def test_random_operators_keep_their_promises(rng: random.Random) -> None:
    case = random_case(rng, side=64 if MANY else 32)
    assert_kept(case, check_case(case))


@pytest.mark.slow
@given(rng=sources)
@examples(400)
def test_public_functions_with_random_arguments(rng: random.Random) -> None:
    call = random_call(rng)
    assert_kept(call, check_call(call))


@pytest.mark.slow
@given(
    name=st.sampled_from(PICTURES),
    side=st.sampled_from((64, 96, 160, 256) if MANY else (64,)),
    levels=st.sampled_from((1, 2, 4, 10, 25, 100)),
    landmarks=st.sampled_from(SAMPLINGS),
    count=st.sampled_from((5, 20, 50, 100, 200)),
)
@examples(8)
def test_pictures_keep_the_promises_of_their_operators(name, side, levels, landmarks, count) -> None:
    picture = getattr(skimage.data, name)()
    image = squeezed(picture[0] if isinstance(picture, tuple) else picture, side)
    findings, made = Findings(), None
    options = {"photometric_bandwidth": levels / 255, "landmarks": landmarks, "num_landmarks": count}
    with torch.no_grad(), judged(findings, legal=True, completed=True):
        made = nonlocal_operator(image, **options)
        check_operator(findings, made, image, None)
    assert_kept((name, side, options), findings)


def squeezed(picture: np.ndarray, side: int) -> torch.Tensor:
    """A picture in grey, (1, 1, side, side), whatever its proportions."""
    picture = img_as_float64(picture)
    picture = rgb2gray(picture[..., :3]) if picture.ndim == 3 else picture
    reduced = resize(picture, (side, side), anti_aliasing=True).clip(0, 1)
    return torch.from_numpy(np.ascontiguousarray(reduced))[None, None].float()


def operator(**changes: object) -> NonlocalOperator:
    made = nonlocal_operator(noise(2, 1, 9, 8, dtype=torch.float32), photometric_bandwidth=0.3, num_landmarks=8)
    return replace(made, **changes)


def broken_promises(made: NonlocalOperator) -> set[str]:
    findings = Findings()
    check_operator(findings, made, noise(2, 1, 9, 8, dtype=torch.float32), None)
    return {figure.promise for figure in findings.broken}


def test_checks_notice_a_false_residual() -> None:
    scaling = operator().scaling.clone()
    scaling[1, 7] *= 1.01
    assert {checks.RESIDUAL, checks.ROW_SUMS} <= broken_promises(operator(scaling=scaling))


def test_checks_notice_a_row_sum_that_no_warning_tells_of() -> None:
    made = operator()
    made = replace(made, scaling=made.scaling * 1.001, residual=made.residual + 2e-3)
    promises = broken_promises(made)
    assert checks.ROW_SUMS in promises
    assert checks.RESIDUAL not in promises


def test_checks_notice_an_eigenvalue_above_one() -> None:
    assert checks.EIGENVALUES in broken_promises(operator(scaling=operator().scaling * 1.001))


def test_checks_notice_an_eigenvalue_below_zero() -> None:
    remainder = operator().remainder.clone()
    remainder[0] -= 1.0
    assert checks.EIGENVALUES in broken_promises(operator(remainder=remainder))


@pytest.mark.parametrize("name", ["factor", "diagonal", "scaling", "remainder", "residual"])
def test_checks_notice_what_is_not_finite(name: str) -> None:
    changed = getattr(operator(), name).clone()
    changed.view(-1)[0] = torch.nan
    assert broken_promises(operator(**{name: changed})) == {checks.FINITE}


@pytest.mark.parametrize("scale", [0.3, 1.0, 1e6])
def test_the_largest_eigenvalue_is_found_without_a_dense_matrix(monkeypatch, scale: float) -> None:
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(3, 6, 40, generator=generator, dtype=torch.float64) * scale
    diagonal = torch.rand(3, 40, generator=generator, dtype=torch.float64)
    factor[2] = 0  # the largest eigenvalue is then the largest entry of the diagonal
    exact = Exact(factor, diagonal)
    _, dense = exact.eigenvalue_range()
    monkeypatch.setattr("tests.random_operators.DENSE", 0)
    least, most = exact.eigenvalue_range()
    torch.testing.assert_close(most, dense, atol=0, rtol=1e-7)
    torch.testing.assert_close(least, diagonal.amin(1))


def failure(function, *arguments: object) -> Exception:
    try:
        function(*arguments)
    except Exception as error:
        return error
    pytest.fail("no error was raised")


def test_a_sentence_names_requirement_and_remedy_and_comes_from_the_package() -> None:
    assert is_sentence(failure(check_positive, -1.0, "time"))
    assert not is_sentence(failure(torch.ones(2).reshape, 3))
    assert not is_sentence(failure(int, "x must be a number, got it not; write one"))


def test_legal_arguments_may_not_be_refused() -> None:
    for legal in (True, False):
        findings = Findings()
        with judged(findings, legal=legal):
            check_positive(-1.0, "time")
        assert {figure.promise for figure in findings.broken} == ({checks.REFUSED} if legal else set())


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("row sums are off by 1; raise num_landmarks", True),
        ("row sums are off by 1; use completion='diagonal'", False),  # already in use
        ("row sums are off by 1", False),
    ],
)
def test_a_warning_needs_a_remedy_that_is_not_in_force(text: str, kept: bool) -> None:
    findings = Findings()
    with judged(findings, legal=True, completed=True):
        warn(text)
    assert findings.warned == [text]
    assert (not findings.broken) == kept
    findings = Findings()
    with judged(findings, legal=True):
        warnings.warn(text, DeprecationWarning, stacklevel=1)
    assert findings.broken


def test_every_public_function_is_called() -> None:
    # Returned by functions, not called by users.
    results = {
        "Certificate",
        "Contraction",
        "Diagnostics",
        "FittedFilter",
        "FunctionProduct",
        "LayerFit",
        "NoiseProfile",
        "NonlocalOperator",
        "Restoration",
        "Spectrum",
    }
    assert {*nlfilter_torch.__all__, *IMAGE_FUNCTIONS} - results <= FUNCTIONS.keys()
