"""Single precision on images and bandwidths that break other implementations: finite results, guarantees hold."""

import warnings

import pytest
import torch

from nlfilter_torch import detail_layers, nonlocal_operator, polynomial_filter
from tests.images import PHOTOGRAPHS, hard_images, reduced
from tests.pairwise import each_value, pairwise

BANDWIDTHS = (1, 3, 10, 30, 100, 1000)  # grey levels
IMAGES = hard_images()


def promises(image: torch.Tensor, bandwidth: float, landmarks: str) -> None:
    """Check all guarantees of an operator in float32."""
    count = min(100, image.shape[-2] * image.shape[-1])
    operator = nonlocal_operator(image, photometric_bandwidth=bandwidth / 255, num_landmarks=count, landmarks=landmarks)
    for tensor in (operator.factor, operator.diagonal, operator.scaling, operator.residual):
        assert tensor.isfinite().all()
    assert (operator.row_sums() - 1).abs().max() <= 1e-4

    spectrum = operator.spectrum()
    assert spectrum.eigenvalues.isfinite().all()
    assert spectrum.eigenvalues.min() >= 0
    assert spectrum.eigenvalues.max() <= 1.0001
    v = spectrum.eigenvectors.flatten(2).double()
    assert v.isfinite().all()
    assert (v @ v.mT - torch.eye(v.shape[1])).abs().max() <= 1e-3
    # Reported eigenvalues are clamped, those of the operator are not. With sampled landmarks they may exceed 1, because
    # of negative affinities (camera, one grey level: 1.06), which the diagnostics report.
    assert landmarks == "uniform" or operator.diagnostics().largest_eigenvalue[0] <= 1.0001

    assert (polynomial_filter(operator, image, torch.ones(4)) - image).abs().max() <= 1e-5
    parts = detail_layers(operator, image)
    assert parts.isfinite().all()
    assert (parts.sum(1) - image).abs().max() <= 1e-5
    assert polynomial_filter(operator, image, torch.tensor([3.0, 3.0, 4.0, 1.05]), residual=0.0).isfinite().all()


@pytest.mark.parametrize(
    ("landmarks", "bandwidth", "name"), pairwise(["kmeans", "uniform"], BANDWIDTHS, [*IMAGES, *PHOTOGRAPHS])
)
def test_every_image_and_bandwidth(name: str, bandwidth: int, landmarks: str) -> None:
    image = IMAGES[name] if name in IMAGES else reduced(name, 120)
    promises(torch.tensor(image, dtype=torch.float32)[None, None], bandwidth, landmarks)


@pytest.mark.slow
@pytest.mark.parametrize(("bandwidth", "name"), each_value([1, 10, 1000], PHOTOGRAPHS))
def test_whole_photographs(name: str, bandwidth: int) -> None:
    promises(torch.tensor(reduced(name, 320), dtype=torch.float32)[None, None], bandwidth, "kmeans")


@pytest.mark.parametrize("bandwidth", BANDWIDTHS)
@pytest.mark.parametrize("name", ["constant", "two colours", "bright pixel", "1x64"])
def test_the_plain_method_is_finite_even_where_it_fails(name: str, bandwidth: int) -> None:
    image = torch.tensor(IMAGES[name], dtype=torch.float32)[None, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns if its row sums are off
        operator = nonlocal_operator(
            image, photometric_bandwidth=bandwidth / 255, num_landmarks=20, landmarks="uniform", completion="none"
        )
    assert (operator @ image).isfinite().all()
    assert operator.spectrum().eigenvectors.isfinite().all()


def test_a_spatial_bandwidth_of_a_fraction_of_a_pixel() -> None:
    image = torch.tensor(IMAGES["uniform noise"], dtype=torch.float32)[None, None]
    operator = nonlocal_operator(image, photometric_bandwidth=0.1, spatial_bandwidth=0.01)
    assert (operator.row_sums() - 1).abs().max() <= 1e-4
    torch.testing.assert_close(operator @ image, image, atol=1e-4, rtol=0)  # every pixel is similar only to itself


def test_values_far_outside_of_0_to_1() -> None:
    image = torch.tensor(reduced("camera", 200), dtype=torch.float32)[None, None]
    # Uniform, because rounding may change a pixel's centroid in k-means: of 100 + y, float32 keeps y to 4e-6.
    plain = nonlocal_operator(image, photometric_bandwidth=0.1, landmarks="uniform") @ image
    with pytest.warns(UserWarning, match="guide must be in"):
        shifted = nonlocal_operator(image + 100, photometric_bandwidth=0.1, landmarks="uniform") @ image
    torch.testing.assert_close(shifted, plain, atol=2e-3, rtol=0)
