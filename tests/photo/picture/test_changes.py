"""Changes of detail: less of it in flat areas."""

from collections.abc import Callable

import pytest
import torch

from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo import enhance
from nlfilter_torch.photo.picture.changes import (
    DetailChange,
    limit_by_activity,
    remainder,
    split_sliders,
    sum_of,
    synthesize,
)
from nlfilter_torch.photo.picture.in_memory import InMemory, InMemoryOperator
from nlfilter_torch.photo.picture.pixels import Strip, whole_image
from nlfilter_torch.photo.picture.source import Guide
from tests.brightness import ALPHA
from tests.problems import noise


def test_calm_areas_are_strengthened_less_and_smoothed_alike() -> None:
    changes = torch.tensor([0.4, 0.1]).view(1, 2, 1, 1).expand(1, 2, 1, 3)
    variance = torch.tensor([0.0, 1e-4, 1.0]).view(1, 1, 1, 3)
    limited = limit_by_activity(changes, variance, 0.01).flatten()
    torch.testing.assert_close(limited, torch.tensor([0.1, 0.3, 0.5]), atol=1e-4, rtol=0)
    assert torch.equal(limit_by_activity(changes, variance, 0.0), torch.full((1, 1, 1, 3), 0.5))
    added, rest = split_sliders(torch.tensor([0.5, -0.5, 2.0, 0.3]))
    assert added.tolist() == [0.5, 0.0, 2.0, 0.0]
    assert (added + rest).tolist() == pytest.approx([0.5, -0.5, 2.0, 0.3])
    grain = 0.5 + 2 / 255 * torch.randn(1, 1, 60, 60, generator=torch.Generator().manual_seed(0))
    grain[..., 58:, :30], grain[..., 58:, 30:] = 0.0, 1.0  # so that it uses its range
    edited = [enhance(grain, ALPHA, threshold=t, num_landmarks=60) for t in (0.0, 5 / 255, 50 / 255)]
    stds = [image[..., :50, :].std() for image in edited]
    assert stds[0] > 1.2 * stds[1]
    assert stds[1] > stds[2]
    assert stds[2] < 1.05 * grain[..., :50, :].std()
    smooth = [enhance(grain, torch.tensor([0.0, 0.0, 1.0]), threshold=t, num_landmarks=60) for t in (0.0, 0.1)]
    assert torch.equal(smooth[0], smooth[1])


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
def test_changes_of_detail_are_those_of_the_filter_of_the_paper(residual: float | None) -> None:
    sliders = torch.tensor([3.0, -0.5, 0.5], dtype=torch.float64)
    change = DetailChange.of(fitted_operator(), whole_image, sliders, residual)
    wanted = polynomial_filter(OPERATOR, IMAGE, sliders, residual=residual)
    torch.testing.assert_close(change.whole(SOURCE), wanted, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(change.whole(ROWS), wanted[:, :, 4:9], rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(sum_of(change(ROWS)), wanted[:, :, 4:9], rtol=1e-6, atol=1e-8)


def test_added_detail_leaves_the_residual_to_the_rest() -> None:
    sliders = torch.tensor([3.0, -0.5, 0.5], dtype=torch.float64)
    added, rest = DetailChange.of(fitted_operator(), whole_image, sliders, 0.25)(SOURCE).chunk(2, dim=1)
    raised = torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64)
    for part, own, residual in ((added, raised, 0.0), (rest, sliders - raised, 0.25)):
        wanted = polynomial_filter(OPERATOR, IMAGE, own, residual=residual)
        torch.testing.assert_close(part, wanted, rtol=1e-6, atol=1e-8)


def test_the_remainder_of_the_diagonal() -> None:
    shares = fitted_operator().of_columns(remainder)(SOURCE)
    assert shares.shape == (2, 1, 14, 17)
    assert torch.equal(shares.flatten(1), OPERATOR.remainder)
    assert (shares >= 0).all()
