"""Functions of the spectrum and polynomials of an operator, for any source."""

from collections.abc import Callable

import pytest
import torch

from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.edits.synthesis import Polynomial, remainder, synthesize
from nlfilter_torch.photo.picture.in_memory import InMemory, InMemoryOperator
from nlfilter_torch.photo.picture.pixels import Strip, whole_image
from nlfilter_torch.photo.picture.source import Guide
from tests.problems import noise

IMAGE = noise(2, 3, 14, 17)
SOURCE = InMemory(IMAGE)
OPERATOR = nonlocal_operator(IMAGE, num_landmarks=25, photometric_bandwidth=0.6)
ROWS = Strip(IMAGE[:, :, 4:9], 4 * 17, 17)


def fitted_operator() -> InMemoryOperator:
    return SOURCE.operator(Guide(FilterOptions(num_landmarks=25, photometric_bandwidth=0.6)))


@pytest.mark.parametrize("response", [torch.ones_like, torch.square, torch.sqrt])
def test_functions_of_the_spectrum(response: Callable[[torch.Tensor], torch.Tensor]) -> None:
    operator = fitted_operator()
    planes = synthesize(operator, response, operator.coefficients(whole_image))
    spectrum = OPERATOR.spectrum()
    wanted = spectrum.synthesize(response, spectrum.coefficients(IMAGE))
    torch.testing.assert_close(planes(SOURCE), wanted, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(planes(ROWS), wanted[:, :, 4:9], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("residual", [None, 0.0, 1.0, 2.5])
def test_polynomials_are_the_filter_of_the_paper(residual: float | None) -> None:
    alpha = torch.tensor([3.0, 2.0, 0.5], dtype=torch.float64)
    polynomial = Polynomial.of(fitted_operator(), whole_image, 2, residual)
    wanted = polynomial_filter(OPERATOR, IMAGE, alpha, residual=residual)
    torch.testing.assert_close(polynomial(SOURCE, alpha), wanted, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(polynomial(ROWS, alpha), wanted[:, :, 4:9], rtol=1e-6, atol=1e-8)


def test_a_call_may_have_a_weight_of_its_own_for_the_residual() -> None:
    alpha = torch.tensor([3.0, 2.0, 0.5], dtype=torch.float64)
    polynomial = Polynomial.of(fitted_operator(), whole_image, 2, 1.0)
    wanted = polynomial_filter(OPERATOR, IMAGE, alpha, residual=0.25)
    torch.testing.assert_close(polynomial(SOURCE, alpha, 0.25), wanted, rtol=1e-6, atol=1e-8)


def test_the_remainder_of_the_diagonal() -> None:
    shares = fitted_operator().of_columns(remainder)(SOURCE)
    assert shares.shape == (2, 1, 14, 17)
    assert torch.equal(shares.flatten(1), OPERATOR.remainder)
    assert (shares >= 0).all()
