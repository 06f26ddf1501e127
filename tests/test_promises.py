"""Guarantees of operators against W in float64: row sums, residuals, eigenvalues and the certificate."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NonlocalOperator,
    detail_layers,
    fit_filter,
    nonlocal_operator,
    operator_from_features,
    polynomial_filter,
)
from nlfilter_torch.operator.scaling import LARGEST, KernelMatrix, PixelScaling, Solution, damped, scaling_from_moment
from nlfilter_torch.operator.sinkhorn import sinkhorn_balance
from nlfilter_torch.photo.tiled import stream_detail
from tests import reference
from tests.problems import noise, picture, seeded

FLOATS = (torch.float32, torch.float64)
PRECISION = {torch.float32: 2e-5, torch.float64: 1e-11}


def dense(operator: NonlocalOperator) -> Tensor:
    """W in float64, from what the operator stores."""
    scaled = operator.factor.double() * operator.scaling.double().unsqueeze(1)
    return scaled.mT @ scaled + torch.diag_embed(operator.remainder.double())


def assert_sound(operator: NonlocalOperator) -> None:
    matrix, precision = dense(operator), PRECISION[operator.factor.dtype]
    errors = (matrix.sum(2) - 1).abs().amax(1)
    assert (errors < precision).all()
    assert (errors < 1.5 * operator.residual + precision).all()
    values = torch.linalg.eigvalsh(matrix)
    assert values.min() > -1e-6
    assert values.max() < 1.0001
    certificate, diagnostics = operator.certify(), operator.diagnostics()
    assert max(certificate.row_sums) < 2 * precision
    assert max(certificate.symmetry) < precision
    for figures in (certificate.largest_eigenvalue, diagnostics.largest_eigenvalue):
        torch.testing.assert_close(torch.tensor(figures).double(), values.amax(1), atol=1e-4, rtol=0)
    assert (torch.tensor(certificate.smallest_eigenvalue) <= values.amin(1) + 1e-6).all()


def checkerboard(height: int, width: int, dtype: torch.dtype) -> Tensor:
    return ((torch.arange(height)[:, None] + torch.arange(width)) % 2).to(dtype)[None, None]


# --- balancing


@pytest.mark.parametrize("dtype", FLOATS)
def test_row_sums_hold_where_affinities_to_the_landmarks_are_negative(dtype: torch.dtype) -> None:
    image = picture("coffee", 40, 40, dtype)
    options = {"photometric_bandwidth": 5 / 255, "landmarks": "uniform", "num_landmarks": 40, "patch_size": 1}
    operator = nonlocal_operator(image, **options)
    assert (operator.factor.mT @ operator.factor).min() < -1e-3
    assert_sound(operator)


@pytest.mark.parametrize("dtype", FLOATS)
def test_the_reproduction_of_a_false_residual(dtype: torch.dtype) -> None:
    import skimage.data
    from skimage.color import rgb2gray
    from skimage.transform import resize

    grey = resize(rgb2gray(skimage.data.stereo_motorcycle()[0]), (96, 96), anti_aliasing=True)
    image = torch.from_numpy(grey).to(dtype)[None, None]
    operator = nonlocal_operator(image, photometric_bandwidth=10 / 255, landmarks="uniform")
    scaled = operator.factor.double() * operator.scaling.double().unsqueeze(1)
    sums = (scaled.mT @ scaled.sum(2, keepdim=True)).squeeze(2) + operator.remainder.double()
    assert (sums - 1).abs().max() < min(1e-4, 1.5 * operator.residual.max() + PRECISION[dtype])


@pytest.mark.parametrize("half", [-3.0, -1e-3, 0.0, 1e-3, 3.0])
@pytest.mark.parametrize("diagonal", [1e-3, 0.1, 1.0])
def test_the_scaling_is_the_root_for_either_sign(half: float, diagonal: float) -> None:
    factor, rest = torch.ones(1, 1, 1, dtype=torch.float64), torch.full((1, 1), diagonal, dtype=torch.float64)
    scaling = scaling_from_moment(factor, rest, torch.full((1, 1, 1), 2 * half, dtype=torch.float64))
    assert scaling > 0
    torch.testing.assert_close(scaling * (2 * half + diagonal * scaling), torch.ones_like(scaling), atol=0, rtol=1e-9)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("seed", range(4))
def test_periodic_images_are_balanced(seed: int, dtype: torch.dtype) -> None:
    image = checkerboard(64, 9, dtype)
    options = {"photometric_bandwidth": 10 / 255, "landmarks": "random", "num_landmarks": 1}
    assert_sound(nonlocal_operator(image, generator=seeded(seed), **options))


@pytest.mark.parametrize("dtype", FLOATS)
def test_a_ramp_of_unlike_pixels_is_balanced(dtype: torch.dtype) -> None:
    ramp = torch.linspace(0, 1, 24, dtype=dtype).view(1, 1, 1, 24)
    options = {"photometric_bandwidth": 0.003, "num_landmarks": 3, "landmarks": "uniform", "patch_size": 1}
    assert_sound(nonlocal_operator(ramp, **options))


@pytest.mark.parametrize("start", [1e-6, 1.0, 1e6])
def test_the_damped_method_converges_from_any_start(start: float) -> None:
    factor = noise(2, 5, 60, seed=3) - 0.3  # with negative affinities
    factor = factor / factor.norm(dim=1, keepdim=True).clamp(min=1.0)
    diagonal = (1 - factor.square().sum(1)).clamp(min=0.01)
    assert (factor.mT @ factor).min() < -0.05
    scaling = torch.full((2, 60), start, dtype=torch.float64)
    infinite = torch.full((2,), torch.inf, dtype=torch.float64)
    begun = Solution(scaling, factor @ scaling.unsqueeze(2), infinite, 0, torch.eye(5).double().expand(2, -1, -1))
    found = damped(KernelMatrix(factor, diagonal), begun, 1e-12)
    sums = found.scaling * ((factor.mT @ found.moment).squeeze(2) + diagonal * found.scaling)
    torch.testing.assert_close(sums, torch.ones_like(sums), atol=1e-11, rtol=0)
    assert found.residual.max() < 1e-11


def test_damped_steps_take_over_where_sweeps_do_not_converge() -> None:
    """The scaling d of a pixel exceeds the bound of the sweeps."""
    factor = torch.tensor([[[1.0, -0.9, -0.9, 0.4]]], dtype=torch.float64)
    diagonal = 1 - factor.square().sum(1) + 1e-3
    result = sinkhorn_balance(factor, diagonal, completed=True)
    assert result.scaling.max() > LARGEST
    sums = result.scaling * ((factor.mT @ result.moment).squeeze(2) + diagonal * result.scaling)
    torch.testing.assert_close(sums, torch.ones_like(sums), atol=1e-11, rtol=0)


def test_a_warning_names_a_remedy_that_is_not_in_force() -> None:
    factor = torch.tensor([[[1.0, 1.0, -1.0, 1e-3]]])
    with pytest.warns(UserWarning, match="row sums that differ from 1 by up to .*num_landmarks$") as caught:
        sinkhorn_balance(factor, torch.zeros(1, 4), completed=True)
    assert "completion" not in str(caught[0].message)


def test_a_tolerance_that_was_asked_for_is_no_reason_to_warn(recwarn: pytest.WarningsRecorder) -> None:
    operator = nonlocal_operator(picture("camera", 40, 40), tolerance=5e-2)
    assert 1e-12 < operator.residual.max() < 5e-2
    assert not recwarn


# --- eigenvalues


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize(
    ("image", "options"),
    [
        ("noise", {"photometric_bandwidth": 25 / 255, "num_landmarks": 5, "landmarks": "uniform", "patch_size": 1}),
        ("camera", {"spatial_bandwidth": 3.0, "num_landmarks": 50, "landmarks": "random"}),
        ("camera", {"photometric_bandwidth": 2 / 255, "num_landmarks": 60, "landmarks": "uniform"}),
    ],
)
def test_no_eigenvalue_exceeds_one(image: str, options: dict[str, object], dtype: torch.dtype) -> None:
    guides = (
        [noise(1, 1, 18, 5, seed=seed, dtype=dtype) for seed in range(12)]
        if image == "noise"
        else [picture(image, 40, 40, dtype)]
    )
    for guide in guides:
        assert_sound(nonlocal_operator(guide, **options))


def limited() -> tuple[Tensor, NonlocalOperator]:
    """An operator whose eigenvalues would exceed 1."""
    image = picture("camera", 40, 40)
    operator = nonlocal_operator(image, spatial_bandwidth=3.0, num_landmarks=50, landmarks="random")
    assert operator.kernel.limiter is not None
    return image, operator


def test_a_limited_operator_is_the_unlimited_one_below_one() -> None:
    """Only eigenvalues above 1 change, to 1; repeated products stay bounded."""
    image, operator = limited()
    whole = operator.kernel.recipe(image, origin=(0, 0), halo=(0, 0))
    factor, _ = replace(operator.kernel, limiter=None).factor(whole)
    scaled = factor * operator.scaling.unsqueeze(1)
    before = torch.linalg.eigvalsh(scaled.mT @ scaled + torch.diag_embed(operator.remainder))[0]
    after = torch.linalg.eigvalsh(dense(operator))[0]
    assert before.max() > 1.001
    exceeded = int((before > 1 + 1e-9).sum())
    torch.testing.assert_close(after[-exceeded:], torch.ones(exceeded, dtype=after.dtype), atol=1e-6, rtol=0)
    assert (after <= before + 1e-9).all()
    powers = operator.powers(image, 50)
    assert powers.abs().max() <= image.norm()


def test_other_pixels_follow_a_limited_operator() -> None:
    image, operator = limited()
    fitted = fit_filter(operator, image)
    torch.testing.assert_close(fitted.layers(image), detail_layers(operator, image), atol=1e-9, rtol=0)
    again = operator.balancing(*operator.kernel.factor(operator.kernel.recipe(image, origin=(0, 0), halo=(0, 0))))
    torch.testing.assert_close(again[1], operator.remainder, atol=1e-9, rtol=0)


def test_tiles_follow_a_limited_operator() -> None:
    image, operator = limited()
    alpha, rows = (
        torch.tensor([3.0, 3.0, 4.0, 1.05], dtype=torch.float64),
        image[0].permute(1, 2, 0).contiguous().numpy(),
    )
    out = rows.copy()
    options = {"spatial_bandwidth": 3.0, "num_landmarks": 50, "landmarks": "random"}
    options |= {"photometric_bandwidth": "auto", "limits": "none", "threshold": 0.0}
    stream_detail(rows, out, alpha, tile_rows=16, statistics="full", **options)
    expected = polynomial_filter(operator, image, alpha)[0].permute(1, 2, 0)
    torch.testing.assert_close(torch.from_numpy(out), expected, atol=1e-6, rtol=0)


def test_a_pixel_whose_affinities_sum_to_less_than_zero_keeps_its_value() -> None:
    moment = torch.tensor([[[-0.5]]], dtype=torch.float64)
    factor, diagonal = torch.full((1, 1, 1), 0.6, dtype=torch.float64), torch.full((1, 1), 0.64, dtype=torch.float64)
    scaling, remainder = PixelScaling(moment, completed=True)(factor, diagonal)
    assert (scaling.item(), remainder.item()) == (0.0, 1.0)
    scaling, remainder = PixelScaling(-3 * moment, completed=True, before=(moment,))(factor, diagonal)
    assert (scaling.item(), remainder.item()) == (0.0, 1.0)
    scaling, _ = PixelScaling(-3 * moment, completed=True)(factor, diagonal)
    assert scaling.item() > 0


@pytest.mark.parametrize("landmarks", ["uniform", "random"])
def test_the_gradient_of_a_limited_operator_is_exact(landmarks: str) -> None:
    guide = noise(1, 1, 12, 11, seed=5)
    weights = noise(1, 1, 12, 11, seed=1)

    def loss(bandwidth: Tensor) -> Tensor:
        options = {"num_landmarks": 8, "patch_size": 1, "landmarks": landmarks}
        operator = nonlocal_operator(guide, photometric_bandwidth=bandwidth, **options)
        found.append(operator.kernel.limiter is not None)
        return (weights * (operator @ (operator @ guide))).sum()

    found: list[bool] = []
    bandwidth = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(loss, (bandwidth,), eps=1e-6, atol=1e-6)
    assert all(found)


# --- gradients without completion, orthogonality, distances


@pytest.mark.parametrize("dtype", FLOATS)
def test_gradients_without_completion_are_finite_where_scalings_are_huge(dtype: torch.dtype) -> None:
    guide = noise(1, 1, 8, 8, dtype=dtype).requires_grad_()
    options = {"photometric_bandwidth": 4 / 255, "num_landmarks": 5, "landmarks": "uniform", "completion": "none"}
    operator = nonlocal_operator(guide, **options)
    assert operator.scaling.max() > 1e20
    operator.matmul(guide.detach()).square().sum().backward()
    assert guide.grad is not None
    assert guide.grad.isfinite().all()
    assert guide.grad.abs().max() > 0


def test_gradients_without_completion_agree_between_precisions() -> None:
    gradients = []
    for dtype in FLOATS:
        guide = noise(1, 1, 8, 8).to(dtype).requires_grad_()
        options = {"photometric_bandwidth": 4 / 255, "num_landmarks": 5, "landmarks": "uniform", "completion": "none"}
        operator = nonlocal_operator(guide, **options)
        (operator.matmul(guide.detach()) * noise(1, 1, 8, 8, seed=1).to(dtype)).sum().backward()
        gradients.append(guide.grad.double())
    assert (gradients[0] - gradients[1]).norm() < 1e-2 * gradients[1].norm()


@pytest.mark.parametrize("side", [33, 64, 128])
@pytest.mark.parametrize("bandwidth", [0.1, 0.3, 1.0])
def test_eigenvectors_of_a_single_spike_are_orthonormal(side: int, bandwidth: float) -> None:
    image = torch.zeros(1, 1, side, side)
    image[..., side // 2, side // 3] = 1
    vectors = nonlocal_operator(image, photometric_bandwidth=bandwidth, num_landmarks=5).spectrum().eigenvectors
    flat = vectors.flatten(2).double()
    torch.testing.assert_close(flat @ flat.mT, torch.eye(flat.shape[1]).double()[None], atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", ["rocket", "moon", "coffee"])
def test_eigenvectors_of_photographs_are_orthonormal(name: str) -> None:
    image = picture(name, 96, 96, torch.float32)
    assert max(nonlocal_operator(image).diagnostics().orthogonality) < 1e-4


@pytest.mark.parametrize("options", [{"photometric_bandwidth": 2e-4}, {"spatial_bandwidth": 0.05}])
def test_tiny_bandwidths_are_right_in_float32(options: dict[str, float]) -> None:
    """Features are so large that squared distances would lose all digits in float32."""
    image = picture("camera", 40, 40).float()
    options = {"photometric_bandwidth": 0.1, "num_landmarks": 1600, "patch_size": 1, **options}
    operator = nonlocal_operator(image, **options)
    rows = reference.features(
        image[0, 0].double().numpy(), 1, options["photometric_bandwidth"], options.get("spatial_bandwidth")
    )
    exact = reference.balanced(reference.affinity(rows, rows))
    torch.testing.assert_close(operator.to_dense()[0].double(), torch.from_numpy(exact), atol=1e-3, rtol=0)


def test_landmarks_far_apart_for_their_bandwidth_have_a_cholesky_factor() -> None:
    # At 1e10 bandwidths, squared distances computed by products have errors of 1e4 in float64.
    points = 1e10 + torch.rand(1, 1, 60, generator=seeded(0), dtype=torch.float64).sort().values * 3
    features = torch.cat([points, -points], dim=2)
    operator = operator_from_features(features, size=(10, 12), num_landmarks=80)
    assert_sound(operator)


def test_a_loose_tolerance_bounds_the_eigenvalues_as_well() -> None:
    ramp, tolerance = torch.linspace(0, 1, 49 * 34, dtype=torch.float64).view(1, 1, 49, 34), 0.01
    for seed in range(2):
        operator = nonlocal_operator(
            ramp,
            photometric_bandwidth=0.01,
            num_landmarks=40,
            landmarks="random",
            completion="none",
            tolerance=tolerance,
            spatial_bandwidth=50.0,
            generator=seeded(seed),
        )
        assert torch.linalg.eigvalsh(dense(operator)).max() < 1 + tolerance
