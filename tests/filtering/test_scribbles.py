"""Propagated strokes: against a dense computation of the same estimate, invariants, gradients and bad input."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch import Spectrum, nonlocal_operator, operator_from_features, propagate_strokes
from nlfilter_torch.filtering.scribbles import DAB, NOISE
from tests.images import two_colours
from tests.pairwise import each_value
from tests.problems import build, guides, noise, options, picture, seeded


def spots(*places: tuple[int, int], height: int = 20, width: int = 24) -> torch.Tensor:
    """A mask (1, 1, height, width) of 2x2 strokes."""
    mask = torch.zeros(1, 1, height, width, dtype=torch.float64)
    for row, column in places:
        mask[..., row : row + 2, column : column + 2] = 1
    return mask


@pytest.fixture(scope="module")
def spectrum() -> Spectrum:
    return build(picture("coffee", 20, 24), num_landmarks=60, photometric_bandwidth=0.2).spectrum()


PLACES = ((2, 3), (8, 15), (16, 5))


def kriging(
    spectrum: Spectrum, strokes: np.ndarray, weights: np.ndarray, strength: float, reach: float, smoothness: float
) -> np.ndarray:
    """The estimate in its textbook form, with the dense matrix of covariances between pixels."""
    factor, scaling = spectrum.factor[0].numpy(), spectrum.scaling[0].numpy()
    rows = factor * scaling
    basis, singular, _ = np.linalg.svd(rows.T, full_matrices=False)  # orthonormal over pixels
    basis = basis[:, singular > 1e-6 * singular[0]]
    w = basis.T @ rows.T @ rows @ basis
    remainder = spectrum_remainder(spectrum)
    w = w + basis.T @ (remainder[:, None] * basis)
    walks = np.linalg.solve(np.eye(len(w)) - reach * w, w)  # W + s W^2 + ...
    covariance = basis @ walks @ basis.T / np.outer(scaling, scaling)
    painted = weights > 0
    inner = covariance[np.ix_(painted, painted)]
    own = 1 - np.square(factor[:, painted]).sum(0)  # of the kernel's unit diagonal
    variance = ((np.diag(inner) + own) * weights[painted]).sum() / weights[painted].sum()
    spot = DAB * factor.shape[1]  # less than a pixel here
    noisy = inner + np.diag(smoothness * (spot * NOISE * variance + own) / weights[painted])
    ones = np.ones(painted.sum())
    solved, of_ones = np.linalg.solve(noisy, strokes[painted]), np.linalg.solve(noisy, ones)
    mean = (ones @ solved) / (ones @ of_ones)
    across = covariance[:, painted]
    return across @ solved + strength * mean * (1 - across @ of_ones)


def spectrum_remainder(spectrum: Spectrum) -> np.ndarray:
    """The diagonal part r of W, by which the row sums of the factor's part are below 1."""
    rows = (spectrum.factor[0] * spectrum.scaling[0]).numpy()
    return 1 - rows.T @ rows.sum(1)


@pytest.mark.parametrize(("strength", "reach", "smoothness"), [(1.0, 0.9, 1.0), (0.3, 0.0, 5.0), (0.0, 0.99, 0.1)])
def test_it_is_the_best_linear_estimate(spectrum: Spectrum, strength: float, reach: float, smoothness: float) -> None:
    strokes, mask = noise(1, 3, 20, 24), spots(*PLACES) * (0.5 + noise(1, 1, 20, 24, seed=1) / 2)
    result = propagate_strokes(spectrum, strokes, mask, strength=strength, reach=reach, smoothness=smoothness)
    for channel in range(3):
        expected = kriging(
            spectrum, strokes[0, channel].flatten().numpy(), mask.flatten().numpy(), strength, reach, smoothness
        )
        np.testing.assert_allclose(result[0, channel].flatten(), expected, atol=2e-5)


@pytest.mark.parametrize(("dtype", "bandwidth"), each_value([torch.float32, torch.float64], [0.001, 0.02, 0.05, 0.1]))
def test_pixels_that_the_landmarks_miss_do_not_run_away(bandwidth: float, dtype: torch.dtype) -> None:
    """Their affinities of a few millionths would have to be amplified to reach the painted values."""
    image, mask = noise(1, 1, 32, 32, dtype=dtype), spots((8, 8), (20, 20), height=32, width=32).to(dtype)
    strokes = torch.zeros_like(mask)
    strokes[..., 20:22, 20:22] = 1
    spectrum = nonlocal_operator(image, photometric_bandwidth=bandwidth).spectrum()
    result = propagate_strokes(spectrum, strokes, mask)
    assert result.min() > -0.5
    assert result.max() < 1.5
    constant = torch.full_like(mask, 0.7)
    torch.testing.assert_close(propagate_strokes(spectrum, constant, mask), constant, atol=1e-5, rtol=0)


@given(guides(), options, st.data())
def test_a_constant_stays_constant(guide: torch.Tensor, options: dict, data: st.DataObject) -> None:
    batch, _, height, width = guide.shape
    mask = (noise(batch, 1, height, width, seed=data.draw(st.integers(0, 9))) > 0.7).double()
    mask[..., 0, 0] = 1
    spectrum = build(guide, **options).spectrum()
    for value in (0.0, 1.0, -3.0):
        result = propagate_strokes(spectrum, torch.full_like(mask, value), mask)
        torch.testing.assert_close(result, torch.full_like(mask, value), atol=1e-5, rtol=0)


def test_it_is_linear_in_the_strokes_and_reads_only_painted_ones(spectrum: Spectrum) -> None:
    mask = spots(*PLACES)
    colours, other = noise(1, 1, 20, 24), noise(1, 1, 20, 24, seed=1)

    def spread(strokes: torch.Tensor) -> torch.Tensor:
        return propagate_strokes(spectrum, strokes, mask)

    torch.testing.assert_close(spread(2 * colours - other), 2 * spread(colours) - spread(other))
    torch.testing.assert_close(spread(colours), spread(colours * mask + 99 * (1 - mask)))


def test_values_go_to_their_likes_and_fade_on_request() -> None:
    thirds = torch.full((1, 1, 18, 30), 0.1)
    thirds[..., 10:20], thirds[..., 20:] = 0.5, 0.9
    spectrum = nonlocal_operator(thirds, photometric_bandwidth=0.1, num_landmarks=60, generator=seeded()).spectrum()
    strokes, mask = torch.zeros(1, 1, 18, 30), torch.zeros(1, 1, 18, 30)
    mask[..., 4:6, 2:4] = mask[..., 4:6, 14:16] = 1
    strokes[..., 4:6, 2:4], strokes[..., 4:6, 14:16] = 1.0, 0.5
    full = propagate_strokes(spectrum, strokes, mask)
    none = propagate_strokes(spectrum, strokes, mask, strength=0.0)
    for result in (full, none):  # away from the borders, where patches contain both sides
        torch.testing.assert_close(result[..., 2:7], torch.ones(1, 1, 18, 5), atol=0.05, rtol=0)
        torch.testing.assert_close(result[..., 13:17], torch.full((1, 1, 18, 4), 0.5), atol=0.05, rtol=0)
    assert (none[..., 23:].abs() < 0.05).all()
    torch.testing.assert_close(full[..., 23:], torch.full((1, 1, 18, 7), 0.75), atol=0.1, rtol=0)
    half = propagate_strokes(spectrum, strokes, mask, strength=0.5)
    torch.testing.assert_close(half, (full + none) / 2, atol=1e-5, rtol=0)


def test_a_dot_counts_beside_broad_strokes() -> None:
    """On a large image a single painted pixel still has an effect."""
    side = 256  # a spot is 43 pixels here
    image = torch.full((1, 1, side, side), 0.2)
    image[..., side // 2 :] = 0.8
    spectrum = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=30, generator=seeded()).spectrum()
    strokes, mask = torch.zeros(1, 1, side, side), torch.zeros(1, 1, side, side)
    mask[..., :100] = 1
    mask[..., 128, 200] = strokes[..., 128, 200] = 1
    result = propagate_strokes(spectrum, strokes, mask)
    assert result[..., 150:].min() > 0.85
    assert result[..., :100].max() < 0.05


def test_every_pixel_may_be_painted(spectrum: Spectrum) -> None:
    strokes = picture("coffee", 20, 24)
    result = propagate_strokes(spectrum, strokes, torch.ones_like(strokes), smoothness=1e-3)
    assert (result - strokes).abs().mean() < 0.05


def test_a_batch_is_its_images() -> None:
    guide, strokes = torch.cat([picture(name, 16, 18) for name in ("coffee", "moon")]), noise(2, 3, 16, 18)
    mask = torch.cat([spots((1, 2), (9, 9), height=16, width=18), spots((4, 12), height=16, width=18)])
    together = propagate_strokes(build(guide, num_landmarks=40).spectrum(), strokes, mask)
    for i in range(2):
        part = slice(i, i + 1)
        alone = propagate_strokes(build(guide[part], num_landmarks=40).spectrum(), strokes[part], mask[part])
        torch.testing.assert_close(together[part], alone, atol=1e-6, rtol=0)


def test_one_operator_serves_several_strokes_and_one_stroke_several_operators(spectrum: Spectrum) -> None:
    strokes, masks = noise(2, 1, 20, 24), torch.cat([spots(*PLACES), spots((1, 1), (14, 20))])
    together = propagate_strokes(spectrum, strokes, masks)
    alone = [propagate_strokes(spectrum, strokes[i : i + 1], masks[i : i + 1]) for i in range(2)]
    torch.testing.assert_close(together, torch.cat(alone))
    several = build(noise(2, 1, 20, 24), num_landmarks=40).spectrum()
    assert propagate_strokes(several, strokes[:1], masks[:1]).shape == (2, 1, 20, 24)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_strokes_keep_their_dtype(spectrum: Spectrum, dtype: torch.dtype) -> None:
    result = propagate_strokes(spectrum, noise(1, 1, 20, 24, dtype=dtype), spots(*PLACES).to(dtype))
    assert result.dtype == dtype


@pytest.mark.parametrize("degenerate", [False, True])
def test_gradients(degenerate: bool) -> None:
    """Gradients end to end, including mask and parameters, also with repeated eigenvalues."""
    image = torch.from_numpy(two_colours(6, 7))[None, None] if degenerate else noise(2, 1, 6, 7)
    batch = image.shape[0]

    def way(image: torch.Tensor, strokes: torch.Tensor, mask: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        operator = nonlocal_operator(image, photometric_bandwidth=0.5, num_landmarks=10, landmarks="uniform")
        strength, reach, smoothness = parameters
        return propagate_strokes(
            operator.spectrum(), strokes, mask, strength=strength, reach=reach, smoothness=smoothness
        )

    strokes = noise(batch, 2, 6, 7, seed=1).requires_grad_()
    mask = (0.1 + 0.8 * noise(batch, 1, 6, 7, seed=2)).requires_grad_()
    parameters = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.7, 0.8, 1.3)]
    # If all pixels are equal, any change alters the rank: the gradient in the image only has to be finite.
    image.requires_grad_(not degenerate)
    assert torch.autograd.gradcheck(way, (image, strokes, mask, *parameters), fast_mode=True)
    if degenerate:
        image.requires_grad_()
        way(image, strokes, mask, *parameters).square().sum().backward()
        assert image.grad is not None
        assert image.grad.isfinite().all()
        assert image.grad.abs().max() > 0


def test_unpainted_pixels_have_a_gradient_too(spectrum: Spectrum) -> None:
    mask = spots(*PLACES).requires_grad_()
    strokes = noise(1, 1, 20, 24)
    with_grad = propagate_strokes(spectrum, strokes, mask)
    torch.testing.assert_close(with_grad.detach(), propagate_strokes(spectrum, strokes, mask.detach()))
    with_grad.square().sum().backward()
    assert mask.grad is not None
    assert mask.grad.isfinite().all()
    assert (mask.grad[mask == 0] != 0).any()


@pytest.mark.parametrize("recorded", [False, True])
def test_isolated_pixels_do_not_make_values_nan(recorded: bool) -> None:
    """The columns of isolated pixels are zero, and so is their captured variance."""
    features, mask = noise(1, 2, 1700), torch.zeros(1, 1, 1, 1700, dtype=torch.float64)
    operator = operator_from_features(features / 0.2, size=(1700,), num_landmarks=20)
    alone = torch.zeros(1, 1, 1700, dtype=torch.bool)
    alone[..., -40:] = True
    spectrum = replace(operator, factor=operator.factor * ~alone).spectrum()
    mask[..., :5], mask[..., -40:] = 1, 1 - recorded
    result = propagate_strokes(spectrum, noise(1, 2, 1, 1700, seed=2), mask.requires_grad_(recorded))
    assert result.isfinite().all()
    if recorded:
        result.sum().backward()
        assert mask.grad is not None
        assert mask.grad.isfinite().all()


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")
def test_forward_mode_in_the_mask_is_reverse_mode() -> None:
    image = noise(1, 1, 20, 20)
    spectrum = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=20).spectrum()
    mask, tangent = torch.zeros_like(image), noise(1, 1, 20, 20, seed=2)
    mask[..., 3:6, 3:6] = 0.5

    def total(mask: torch.Tensor) -> torch.Tensor:
        return propagate_strokes(spectrum, image, mask).sum()

    forward, reverse = torch.func.jvp(total, (mask,), (tangent,))[1], torch.func.grad(total)(mask)
    torch.testing.assert_close(forward, (reverse * tangent).sum(), rtol=1e-9, atol=0)
