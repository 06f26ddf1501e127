"""Volumes and points: operators of guides (B, C, D, H, W), operators of any size, and values (B, C, N)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist
from torch import Tensor

import nlfilter_torch as nlf
from nlfilter_torch.operator.features import GuideFeatures, gradients, pad_border, patch_window
from tests import reference
from tests.pairwise import each_value, pairwise
from tests.ranks import run_ranks

SIZE = (4, 5, 6)
OPTIONS: dict[str, Any] = {"patch_size": 3, "photometric_bandwidth": 0.4, "num_landmarks": 30}


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture(scope="module")
def volume() -> Tensor:
    return noise(1, 1, *SIZE)


@pytest.fixture(scope="module")
def operator(volume: Tensor) -> nlf.NonlocalOperator:
    return nlf.nonlocal_operator(volume, **OPTIONS)


@pytest.mark.parametrize(
    ("channels", "spatial", "patch_size"), pairwise([1, 2], [None, 2.5, (2.0, 3.0, 4.0)], [1, 3, 5])
)
def test_features_are_those_of_the_reference(
    channels: int, spatial: float | tuple[float, ...] | None, patch_size: int
) -> None:
    guides = noise(2, channels, *SIZE)
    features = GuideFeatures(patch_window(patch_size, 3), 0.1, spatial, "all")(guides)
    for result, guide in zip(features, guides, strict=True):
        expected = reference.features(guide.numpy(), patch_size, 0.1, spatial)
        np.testing.assert_allclose(result.T, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 2e-4)])
def test_an_operator_with_all_landmarks_is_the_dense_one(dtype: torch.dtype, tolerance: float) -> None:
    spatial = (2.0, 3.0, 4.0)
    guide = noise(1, 1, *SIZE).to(dtype)
    options = OPTIONS | {"num_landmarks": guide.numel(), "spatial_bandwidth": spatial}
    operator = nlf.nonlocal_operator(guide, **options)
    points = reference.features(guide[0].double().numpy(), 3, 0.4, spatial)
    dense = reference.balanced(reference.affinity(points, points))
    assert abs(operator.to_dense()[0].double().numpy() - dense).max() < tolerance


def test_a_volume_of_one_slice_is_an_image(volume: Tensor) -> None:
    image = volume[:, :, 0]
    flat = nlf.nonlocal_operator(image, **OPTIONS, spatial_bandwidth=(3.0, 4.0))
    deep = nlf.nonlocal_operator(image.unsqueeze(2), **OPTIONS, spatial_bandwidth=(1.0, 3.0, 4.0))
    torch.testing.assert_close((deep @ image.unsqueeze(2)).squeeze(2), flat @ image)


def test_the_order_of_the_axes_does_not_matter(volume: Tensor) -> None:
    options = OPTIONS | {"num_landmarks": volume.numel()}
    turned = nlf.nonlocal_operator(volume.permute(0, 1, 4, 2, 3), **options, spatial_bandwidth=(4.0, 2.0, 3.0))
    operator = nlf.nonlocal_operator(volume, **options, spatial_bandwidth=(2.0, 3.0, 4.0))
    expected = (operator @ volume).permute(0, 1, 4, 2, 3)
    torch.testing.assert_close(turned @ volume.permute(0, 1, 4, 2, 3), expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("margin", [1, 2, 4, 7])
def test_borders_are_those_of_the_reference(volume: Tensor, margin: int) -> None:
    np.testing.assert_array_equal(pad_border(volume, margin)[0, 0], reference.pad(volume[0, 0].numpy(), margin))


def test_the_bandwidth_is_that_of_the_mean_gradient() -> None:
    slope = (0.03 * torch.arange(4.0)).view(1, 1, 4, 1, 1).expand(1, 1, *SIZE)
    magnitude = gradients(slope, (0, 0))
    assert magnitude.shape == slope.shape
    torch.testing.assert_close(magnitude[0, 0, 1:3], torch.full((2, 5, 6), 0.03))
    torch.testing.assert_close(nlf.estimate_bandwidth(slope), torch.tensor([2.5 * 0.75 * 0.03]))  # half at both ends
    turned = noise(1, 1, *SIZE).permute(0, 1, 3, 4, 2)
    torch.testing.assert_close(nlf.estimate_bandwidth(turned), nlf.estimate_bandwidth(noise(1, 1, *SIZE)))


@pytest.mark.parametrize(("landmarks", "completion"), each_value(["kmeans", "uniform", "random"], ["diagonal", "none"]))
def test_products_keep_constants_and_means(volume: Tensor, landmarks: Any, completion: Any) -> None:
    options = OPTIONS | {"landmarks": landmarks, "completion": completion, "photometric_bandwidth": 1.0}
    operator = nlf.nonlocal_operator(volume, **options)
    assert operator.size == SIZE
    torch.testing.assert_close(operator.row_sums(), torch.ones(1, 1, *SIZE, dtype=torch.float64), atol=1e-9, rtol=0)
    values = noise(1, 3, *SIZE, seed=1)
    torch.testing.assert_close((operator @ values).mean((2, 3, 4)), values.mean((2, 3, 4)))
    dense = operator.to_dense()[0]
    torch.testing.assert_close((operator @ values).flatten(2)[0], values.flatten(2)[0] @ dense.mT)
    certificate = operator.certify()
    assert certificate.largest_eigenvalue[0] < 1 + 1e-9
    assert operator.diagnostics().eigenvector_residual[0] < 1


@pytest.mark.parametrize("count", [1, 2, 7, 20, 119])
def test_uniform_landmarks_are_distinct_and_spread(count: int) -> None:
    numbers = torch.arange(120.0).view(1, 1, *SIZE)
    operator = nlf.nonlocal_operator(
        numbers,
        patch_size=1,
        photometric_bandwidth=1e3,
        num_landmarks=count,
        landmarks="uniform",
    )
    chosen = (operator.kernel.landmarks[0, 0] * 1e3).round().long()
    assert len(chosen.unique()) == count
    places = torch.stack(torch.unravel_index(chosen, SIZE), dim=1).double()
    everywhere = torch.stack(torch.unravel_index(torch.arange(120), SIZE), dim=1).double()
    farthest = torch.cdist(everywhere, places).amin(1).max()
    assert farthest <= max(1.0, 2.2 * (120 / count) ** (1 / 3))


def flat(tensor: Tensor) -> Tensor:
    return tensor.flatten(2)


FUNCTIONS: dict[str, Callable[[nlf.NonlocalOperator, Tensor, Callable[[Tensor], Tensor]], Tensor]] = {
    "product": lambda op, x, shape: op @ x,
    "powers": lambda op, x, shape: op.powers(x, 3)[:, 2],
    "detail_layers": lambda op, x, shape: nlf.detail_layers(op, x)[:, 1],
    "polynomial_filter": lambda op, x, shape: nlf.polynomial_filter(op, x, torch.tensor([3.0, 2.0, 1.0])),
    "residual": lambda op, x, shape: nlf.polynomial_filter(op, x, torch.tensor([3.0, 1.0]), residual=0.5),
    "sliders of pixels": lambda op, x, shape: nlf.polynomial_filter(op, x, shape(3 * noise(1, 3, *SIZE, seed=2))),
    "spectral_filter": lambda op, x, shape: nlf.spectral_filter(op.spectrum(), x, torch.sqrt, residual=0.0),
    "spectral_filter with f(r)": lambda op, x, shape: nlf.spectral_filter(op.spectrum(), x, lambda s: s**0.3),
    "f(W)": lambda op, x, shape: nlf.spectral_filter(op, x, lambda s: s**0.3),
    "spectral_filter with residual": lambda op, x, shape: nlf.spectral_filter(
        op.spectrum(), x, torch.sqrt, residual=torch.tensor([0.5])
    ),
    "filter_regions": lambda op, x, shape: nlf.filter_regions(
        op, x, shape((noise(1, 1, *SIZE, seed=3) > 0.5).double()), torch.tensor([[3.0, 1.0]])
    ),
    "diffusion_mask": lambda op, x, shape: nlf.diffusion_mask(op.spectrum(), x, negative=1 - x, width=20.0),
    "segment_mask": lambda op, x, shape: nlf.segment_mask(op.spectrum(), x),
    "propagate_strokes": lambda op, x, shape: nlf.propagate_strokes(op.spectrum(), x, x[:, :1].clamp(0, 1)),
    "sliders": lambda op, x, shape: nlf.PolynomialSliders((2.0, 1.0))(op, x),
    "combine": lambda op, x, shape: nlf.PolynomialSliders((2.0, 1.0)).combine(nlf.detail_layers(op, x, order=1)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_of_points_give_what_volumes_give(operator: nlf.NonlocalOperator, name: str) -> None:
    values = noise(1, 2, *SIZE, seed=4)
    result = FUNCTIONS[name](operator, values, lambda tensor: tensor)
    row = FUNCTIONS[name](operator, values.flatten(2), flat)
    assert result.shape == values.shape
    assert torch.equal(row, result.flatten(2))
    assert result.isfinite().all()


@pytest.mark.parametrize("size", [(120,), (8, 15), (4, 5, 6), (2, 2, 5, 6)])
def test_operators_of_any_size_filter_the_same(operator: nlf.NonlocalOperator, volume: Tensor, size: Any) -> None:
    features = GuideFeatures(patch_window(3, 3), 0.4, None, "all")(volume)
    of_size = nlf.operator_from_features(features, size=size, num_landmarks=30)
    values = noise(2, 3, 120, seed=5)
    torch.testing.assert_close(of_size @ values, (operator @ values.unflatten(2, SIZE)).flatten(2))
    shaped = values.view(2, 3, *of_size.size)
    assert torch.equal((of_size @ shaped).flatten(2), of_size @ values)
    assert of_size.spectrum().eigenvectors.shape[2:] == of_size.size
    assert nlf.diffusion_map(of_size.spectrum(), time=1.0).shape[2:] == of_size.size
    assert of_size.row_sums().shape == (1, 1, *of_size.size)
    assert 0 < float(nlf.captured_energy(of_size.spectrum(), shaped)[0]) <= 1


def test_alpha_is_found_from_two_volumes(operator: nlf.NonlocalOperator) -> None:
    values, alpha = noise(1, 1, *SIZE, seed=6), torch.tensor([3.0, 1.5, 1.0], dtype=torch.float64)
    edited = nlf.polynomial_filter(operator, values, alpha)
    mask = (noise(1, 1, *SIZE, seed=7) > 0.3).double()
    torch.testing.assert_close(nlf.fit_alpha(operator, values, edited, order=2, mask=mask)[0], alpha, atol=1e-6, rtol=0)
    by_rows = nlf.fit_alpha(operator, values.flatten(2), edited.flatten(2), order=2, mask=mask.flatten(2))
    torch.testing.assert_close(by_rows[0], alpha, atol=1e-6, rtol=0)


def test_a_filter_fitted_to_a_volume_filters_others(operator: nlf.NonlocalOperator, volume: Tensor) -> None:
    fitted = nlf.fit_filter(operator, volume)
    torch.testing.assert_close(fitted.layers(volume), nlf.detail_layers(operator, volume))
    alpha = torch.tensor([3.0, 2.0, 1.5, 1.0], dtype=torch.float64)
    expected = nlf.polynomial_filter(operator, volume, alpha, residual=0.5)
    torch.testing.assert_close(fitted(volume, alpha, residual=0.5), expected)
    other = noise(2, 1, 3, 7, 5)
    torch.testing.assert_close(fitted.layers(other).sum(1), other)
    # Slices with a halo, as tiles of the volume.
    tile = fitted.layers(volume[:, :, 1:4], origin=(1, 0), halo=(1, 1))
    torch.testing.assert_close(tile[:, :, :, 0], fitted.layers(volume)[:, :, :, 2])


@pytest.mark.parametrize("learnt", ["guide", "bandwidths", "window"])
def test_gradients_are_those_of_differences(volume: Tensor, learnt: str) -> None:
    guide = volume[:, :, :3, :3, :3].contiguous()
    values, window = noise(1, 1, 3, 3, 3, seed=8), patch_window(3, 3)
    bandwidths = torch.tensor([0.4, 2.0, 3.0, 4.0], dtype=torch.float64)
    sources = {"guide": guide, "bandwidths": bandwidths, "window": window}
    sources[learnt] = sources[learnt].clone().requires_grad_()

    def filtered(_: Tensor) -> Tensor:
        h_y, *h_x = sources["bandwidths"].unbind()
        operator = nlf.nonlocal_operator(
            sources["guide"],
            photometric_bandwidth=h_y,
            spatial_bandwidth=tuple(h_x),
            patch_weights=sources["window"],
            num_landmarks=9,
            landmarks="uniform",
            tolerance=1e-13,
        )
        return operator @ values

    assert torch.autograd.gradcheck(filtered, (sources[learnt],), atol=1e-6)


@pytest.mark.parametrize("landmarks", ["uniform", "random", "kmeans"])
def test_the_layer_filters_volumes_and_trains(landmarks: Any) -> None:
    layer = nlf.NonlocalFilter(
        (2.0, 1.0),
        patch_size=3,
        photometric_bandwidth=0.4,
        spatial_bandwidth=3.0,
        num_landmarks=20,
        landmarks=landmarks,
        learn=("alpha", "photometric_bandwidth", "spatial_bandwidth"),
    )
    volumes = noise(2, 3, *SIZE).float()
    mask = torch.ones(2, 1, *SIZE)
    result = layer(volumes, mask=mask)
    assert result.shape == volumes.shape
    torch.testing.assert_close(result[:1], layer(volumes[:1]))
    result.square().sum().backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in layer.parameters())


def test_the_window_of_a_volume_can_be_learned() -> None:
    layer = nlf.NonlocalAffinity(patch_weights=patch_window(3, 3), learn=("patch_weights",), num_landmarks=20)
    (layer(noise(1, 1, *SIZE).float()) @ noise(1, 1, *SIZE, seed=1).float()).square().sum().backward()
    assert layer.patch_weights.logits.grad.shape == (3, 3, 3)
    with pytest.raises(ValueError, match=r"^patch_weights must have the 2 axes of the guide, got \(3, 3, 3\); pass"):
        layer(noise(1, 1, 8, 8).float())


@pytest.mark.parametrize("size", [(1, 1, 1), (1, 1, 5), (2, 1, 1)])
def test_degenerate_volumes_are_kept(size: tuple[int, ...]) -> None:
    for guide in (torch.full((1, 1, *size), 0.5), noise(1, 1, *size).float()):
        operator = nlf.nonlocal_operator(guide, num_landmarks=1, spatial_bandwidth=2.0)
        ones = nlf.NonlocalFilter((1.0, 1.0), num_landmarks=1)(guide)
        torch.testing.assert_close(ones, guide)
        torch.testing.assert_close(operator @ torch.ones_like(guide), torch.ones_like(guide), atol=1e-5, rtol=0)


def test_an_empty_batch_of_volumes_stays_empty() -> None:
    operator = nlf.nonlocal_operator(torch.zeros(0, 1, *SIZE), num_landmarks=5)
    assert (operator @ torch.zeros(0, 2, *SIZE)).shape == (0, 2, *SIZE)
    assert nlf.detail_layers(operator, torch.zeros(0, 2, *SIZE)).shape == (0, 4, 2, *SIZE)


def test_the_layout_of_a_volume_is_kept(operator: nlf.NonlocalOperator) -> None:
    values = noise(1, 3, *SIZE).float().contiguous(memory_format=torch.channels_last_3d)
    result = operator @ values
    assert result.is_contiguous(memory_format=torch.channels_last_3d)
    torch.testing.assert_close(result, operator @ values.contiguous())
    strided = noise(1, 6, 120)[:, ::2]
    torch.testing.assert_close(operator @ strided, operator @ strided.contiguous())


def test_compiled_layers_give_the_same(volume: Tensor) -> None:
    layer = nlf.NonlocalFilter((2.0, 1.0), patch_size=3, photometric_bandwidth=0.4, num_landmarks=20)
    program = torch.export.export(layer, (volume.float(),)).module()
    torch.testing.assert_close(program(volume.float()), layer(volume.float()))


@pytest.mark.parametrize("landmarks", ["kmeans", "uniform"])
def test_a_padded_volume_gives_what_the_volume_gives(volume: Tensor, landmarks: Any) -> None:
    options = OPTIONS | {"landmarks": landmarks, "spatial_bandwidth": (2.0, 3.0, 4.0), "photometric_bandwidth": "auto"}
    weights = torch.zeros(1, 1, 6, 7, 8)
    weights[..., :4, :5, :6] = 1
    padded = torch.nn.functional.pad(volume, (0, 2, 0, 2, 0, 2), value=3.0)
    operator = nlf.nonlocal_operator(padded, weights=weights, **options)
    expected = nlf.nonlocal_operator(volume, **options) @ volume
    torch.testing.assert_close((operator @ padded)[..., :4, :5, :6], expected, atol=1e-9, rtol=0)


def test_a_layer_holds_the_assignment_of_a_volume(volume: Tensor) -> None:
    layer = nlf.NonlocalFilter((2.0, 1.0), patch_size=3, photometric_bandwidth=0.4, num_landmarks=20, hold="assignment")
    first = layer(volume)
    assert torch.equal(layer(volume), first)
    torch.testing.assert_close(layer(volume + 1e-9), first, atol=1e-7, rtol=0)
    with pytest.raises(
        ValueError, match=r"^guide must be images \(B, C, H, W\) for a layer that keeps landmarks as fea"
    ):
        nlf.NonlocalFilter(hold="features").affinity.renew(volume)


@pytest.mark.parametrize("completion", ["none", "diagonal"])
def test_nystrom_blocks_of_pixels_are_those_of_the_reference(completion: Any) -> None:
    guide = noise(1, 1, 6, 7)
    options: dict[str, Any] = {"patch_size": 3, "photometric_bandwidth": 0.8, "landmarks": "uniform"}
    operator = nlf.nonlocal_operator(guide, **options, num_landmarks=12, completion=completion, tolerance=1e-12)
    within, across = (block[0].numpy() for block in operator.nystrom_blocks())
    a = reference.uniform_samples(6, 7, 12)
    b = np.setdiff1d(np.arange(42), a)
    if completion == "none":  # the paper's method
        w_a, w_ab = reference.nystrom_blocks(reference.features(guide[0].numpy(), 3, 0.8), a)
        tolerance = 2e-5  # of the small number that is added to the diagonal of K_A
    else:
        dense = operator.to_dense()[0].numpy()
        w_a, w_ab, tolerance = dense[np.ix_(a, a)], dense[np.ix_(a, b)], 1e-9
    np.testing.assert_allclose(within, w_a, atol=tolerance)
    np.testing.assert_allclose(across[:, b], w_ab, atol=tolerance)


@pytest.mark.parametrize(("landmarks", "weighted"), each_value(["kmeans", "uniform", "random"], [False, True]))
def test_the_operator_follows_from_its_nystrom_blocks(volume: Tensor, landmarks: Any, weighted: bool) -> None:
    features = GuideFeatures(patch_window(3, 3), 0.4, None, "all")(volume.expand(2, -1, -1, -1, -1))
    weights = 0.5 + noise(120, seed=9) if weighted else None
    operator = nlf.operator_from_features(features, size=SIZE, num_landmarks=20, landmarks=landmarks, weights=weights)
    within, across = operator.nystrom_blocks()
    assert within.shape == (2, 20, 20)
    assert across.shape == (2, 20, 120)
    own = torch.diag_embed(operator.at(operator.landmarks).remainder)
    product = across.mT @ torch.linalg.solve(within - own, across)
    dense = product * (1 if weights is None else weights) + torch.diag_embed(operator.remainder)
    torch.testing.assert_close(dense, operator.to_dense(), atol=1e-9, rtol=0)


def test_nystrom_blocks_have_a_gradient() -> None:
    guide = noise(1, 1, 4, 4).requires_grad_()

    def blocks(source: Tensor) -> tuple[Tensor, ...]:
        operator = nlf.nonlocal_operator(
            source, patch_size=1, photometric_bandwidth=0.5, num_landmarks=4, landmarks="uniform", tolerance=1e-13
        )
        return operator.nystrom_blocks()

    assert torch.autograd.gradcheck(blocks, (guide,), atol=1e-6)


@pytest.mark.parametrize("completion", ["diagonal", "none"])
@pytest.mark.parametrize("batch", [1, 2])
def test_eigenvectors_are_functions_of_the_features(completion: Any, batch: int) -> None:
    points = noise(batch, 2, 200) / 0.3
    operator = nlf.operator_from_features(points, size=(200,), num_landmarks=20, completion=completion)
    spectrum = operator.spectrum()
    extended = spectrum.eigenvectors_at(operator.at(points[..., ::5]))
    torch.testing.assert_close(extended, spectrum.eigenvectors.flatten(2)[..., ::5], atol=1e-7, rtol=0)
    with pytest.raises(ValueError, match=r"^columns must be of an operator with 20 landmarks, got 7; take them"):
        spectrum.eigenvectors_at(nlf.operator_from_features(points, size=(200,), num_landmarks=7).at(points))
    with pytest.raises(TypeError, match=r"^columns must be a Columns, got Tensor; take operator.at\(features\)"):
        spectrum.eigenvectors_at(points)  # type: ignore[arg-type]


def test_extended_eigenvectors_have_a_gradient() -> None:
    points, others = noise(1, 2, 30).requires_grad_(), noise(1, 2, 5, seed=1)

    def extended(source: Tensor, at: Tensor) -> Tensor:
        operator = nlf.operator_from_features(
            source / 0.3, size=(30,), num_landmarks=5, landmarks="uniform", tolerance=1e-13
        )
        return operator.spectrum().eigenvectors_at(operator.at(at / 0.3)).square()  # whatever the sign

    assert torch.autograd.gradcheck(extended, (points, others.requires_grad_()), atol=1e-5)


SLICES = (slice(0, 3), slice(3, 4))  # of the two ranks


def filter_slices(rank: int, folder: str) -> None:
    """One of the processes, which holds some slices of a volume."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    try:
        own = noise(1, 1, *SIZE)[:, :, SLICES[rank]].requires_grad_()
        operator = nlf.nonlocal_operator(own, **OPTIONS | {"photometric_bandwidth": "auto"}, spatial_bandwidth=3.0,
                                         group=dist.group.WORLD)  # fmt: skip
        filtered = operator @ own
        filtered.square().sum().backward()
        torch.save((filtered.detach(), own.grad), f"{folder}/{rank}.pt")
    finally:
        dist.destroy_process_group()


@pytest.mark.slow
@pytest.mark.skipif(not dist.is_available() or not dist.is_gloo_available(), reason="this torch has no gloo")
def test_slices_on_two_ranks_give_what_the_volume_gives(tmp_path: Path) -> None:
    run_ranks(filter_slices, (str(tmp_path),), 2)
    parts = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2)]
    whole = noise(1, 1, *SIZE).requires_grad_()
    operator = nlf.nonlocal_operator(whole, **OPTIONS | {"photometric_bandwidth": "auto"}, spatial_bandwidth=3.0)
    expected = operator @ whole
    expected.square().sum().backward()
    torch.testing.assert_close(torch.cat([part[0] for part in parts], dim=2), expected.detach(), atol=1e-9, rtol=0)
    torch.testing.assert_close(torch.cat([part[1] for part in parts], dim=2), whole.grad, atol=1e-8, rtol=0)
