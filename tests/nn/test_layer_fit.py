"""Fits of a layer from starts that lie far apart end with the same output."""

import math

import pytest
import torch
from kornia.filters import bilateral_blur
from torch import Tensor, nn

from nlfilter_torch import NonlocalFilter, fit_alpha, fit_layer, nonlocal_operator, polynomial_filter
from tests.problems import noise, picture

IMAGE = picture("camera", 24, 24, torch.float32)
EDITED = IMAGE + 1.5 * (IMAGE - bilateral_blur(IMAGE, (9, 9), 0.1, (3.0, 3.0)))
LEARNED = ("alpha", "photometric_bandwidth", "spatial_bandwidth")


def layer(photometric: float, learn: tuple[str, ...] = LEARNED) -> NonlocalFilter:
    return NonlocalFilter(
        photometric_bandwidth=photometric,
        spatial_bandwidth=5.0,
        num_landmarks=30,
        learn=learn,  # type: ignore[arg-type]
    )


def distance(found: Tensor) -> float:
    return float((found - EDITED).detach().square().mean().sqrt())


def test_starts_a_factor_of_100_apart_end_near_the_best_of_a_grid() -> None:
    best = math.inf
    for photometric in torch.logspace(-1.8, -0.5, 5).tolist():
        for spatial in torch.logspace(0.2, 1.4, 4).tolist():
            operator = nonlocal_operator(
                IMAGE, photometric_bandwidth=photometric, spatial_bandwidth=spatial, num_landmarks=30
            )
            alpha = fit_alpha(operator, IMAGE, EDITED, rounding=0.0)[0]
            best = min(best, distance(polynomial_filter(operator, IMAGE, alpha)))
    for start in (0.01, 1.0):
        fitted = layer(start)
        found = fit_layer(fitted, IMAGE, EDITED, evaluations=60)
        assert found.evaluations <= 60
        assert found.error < 1.2 * best
        assert distance(fitted(IMAGE)) == pytest.approx(found.error, rel=1e-4)
        assert fitted.affinity.held is None
        assert found.alpha == tuple(fitted.alpha.tolist())
        assert found.photometric_bandwidth == pytest.approx(fitted.affinity.log_photometric_bandwidth.exp().item())
        assert found.starts[0] >= found.error


def test_a_layer_that_learns_sliders_alone_gets_those_of_fit_alpha() -> None:
    fitted = layer(0.1, learn=("alpha",))
    found = fit_layer(fitted, IMAGE, EDITED)
    operator = nonlocal_operator(IMAGE, photometric_bandwidth=0.1, spatial_bandwidth=5.0, num_landmarks=30)
    torch.testing.assert_close(fitted.alpha.detach(), fit_alpha(operator, IMAGE, EDITED, rounding=0.0)[0])
    assert found.evaluations == 1
    assert found.starts == ()


def test_a_guide_is_fitted_with_the_bandwidths() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        guide = nn.Conv2d(1, 3, 3, padding=1)
    before = guide.weight.detach().clone()
    fitted = layer(0.1)
    found = fit_layer(fitted, IMAGE, EDITED, guide=guide, evaluations=110)
    assert not torch.equal(guide.weight, before)
    assert distance(fitted(IMAGE, guide=guide(IMAGE))) == pytest.approx(found.error, rel=1e-4)


def test_what_is_refused() -> None:
    with pytest.raises(TypeError, match="layer must be"):
        fit_layer(IMAGE, IMAGE, EDITED)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="layer must have one row of sliders"):
        fit_layer(NonlocalFilter(((1.0, 1.0), (1.0, 2.0))), IMAGE, EDITED)
    with pytest.raises(ValueError, match="layer must have one row of sliders and a residual of None"):
        fit_layer(NonlocalFilter(residual=1.0), IMAGE, EDITED)
    with pytest.raises(ValueError, match="evaluations must be"):
        fit_layer(layer(0.1), IMAGE, EDITED, evaluations=10)
    with pytest.raises(ValueError, match="target must have"):
        fit_layer(layer(0.1), IMAGE, noise(1, 1, 8, 8, dtype=torch.float32))
