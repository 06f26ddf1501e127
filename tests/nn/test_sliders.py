"""The layers: results equal to those of the functions, and parameters that can be saved, moved and learned."""

import copy
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

import nlfilter_torch
from nlfilter_torch import (
    DiffusionMask,
    NonlocalAffinity,
    NonlocalFilter,
    PolynomialSliders,
    SegmentMask,
    detail_layers,
    nonlocal_operator,
    polynomial_filter,
)
from nlfilter_torch.photo import Look
from tests.layers import ALPHA, OPTIONS, image
from tests.pairwise import each_value
from tests.problems import noise, picture


@pytest.mark.parametrize("residual", [None, 0.0, 1.0])
def test_filter_is_the_function(residual: float | None) -> None:
    layer = NonlocalFilter(ALPHA, residual=residual, **OPTIONS)
    expected = polynomial_filter(nonlocal_operator(image(), **OPTIONS), image(), torch.tensor(ALPHA), residual=residual)
    torch.testing.assert_close(layer(image()), expected, atol=0, rtol=0)


@pytest.mark.parametrize(("channels", "guide_channels"), each_value([1, 2, 5], [1, 2, 3]))
def test_guide_may_be_another_picture(channels: int, guide_channels: int) -> None:
    guide, picture_ = noise(2, guide_channels, 12, 13, seed=1), noise(2, channels, 12, 13)
    result = NonlocalFilter(ALPHA, **OPTIONS)(picture_, guide=guide)
    operator = nonlocal_operator(guide, guide_channels="all", **OPTIONS)
    torch.testing.assert_close(result, polynomial_filter(operator, picture_, torch.tensor(ALPHA)))


def test_mask_blends() -> None:
    layer, mask = NonlocalFilter(ALPHA, **OPTIONS), noise(2, 1, 12, 13, seed=2, dtype=torch.float32)
    filtered = layer(image())
    expected = image() + mask * (filtered - image())
    torch.testing.assert_close(layer(image(), mask=mask), expected)
    torch.testing.assert_close(layer(image(), mask=torch.zeros_like(mask)), image(), atol=0, rtol=0)
    torch.testing.assert_close(layer(image(), mask=torch.ones_like(mask)), filtered)


def test_ones_are_the_identity() -> None:
    torch.testing.assert_close(NonlocalFilter(**OPTIONS)(image()), image(), atol=1e-5, rtol=0)


def test_alpha_is_the_parameter_and_is_saved() -> None:
    layer = NonlocalFilter(ALPHA, **OPTIONS)
    assert [tuple(p.shape) for p in layer.parameters()] == [(4,)]
    assert next(layer.parameters()) is layer.alpha
    other = NonlocalFilter((1, 1, 1, 1), **OPTIONS)
    other.load_state_dict(layer.state_dict())
    torch.testing.assert_close(other(image()), layer(image()), atol=0, rtol=0)
    torch.testing.assert_close(copy.deepcopy(layer)(image()), layer(image()), atol=0, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_layer_converts_and_images_keep_their_dtype(dtype: torch.dtype) -> None:
    layer = NonlocalFilter(ALPHA, **OPTIONS).to(dtype)
    assert layer.sliders.alpha.dtype == dtype
    filtered = layer(image(dtype=dtype))
    assert filtered.dtype == dtype
    assert filtered.isfinite().all()
    assert layer(image()).dtype == torch.float32


def test_every_option_is_shown() -> None:
    layer = NonlocalFilter(ALPHA, patch_size=3, landmarks="uniform", spatial_bandwidth=7.5, **OPTIONS)
    text = repr(layer)
    for part in ("3.0, 0.5, 4.0, 1.05", "patch_size=3", "'uniform'", "spatial_bandwidth=7.5", "num_landmarks=20"):
        assert part in text
    assert "time=2.5" in repr(DiffusionMask(time=2.5))
    assert "time=2.5" in repr(SegmentMask(time=2.5))


def test_layer_is_part_of_a_network_that_learns() -> None:
    clean = picture("camera", 24, 26, torch.float32)
    target = polynomial_filter(nonlocal_operator(clean, **OPTIONS), clean, torch.tensor([2.0, 1.5, 1.0, 1.0]))
    layer = NonlocalFilter(**OPTIONS)
    optimizer = torch.optim.Adam(layer.parameters(), lr=0.05)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = (layer(clean) - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 20


def test_gradients_reach_the_network_before_the_layer() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Conv2d(3, 4, 3, padding=1)
    layer = NonlocalFilter(ALPHA, guide_channels="all", **OPTIONS)
    layer(image(), guide=network(image())).square().mean().backward()
    for parameter in [*network.parameters(), *layer.parameters()]:
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all()
    assert network.weight.grad.abs().max() > 0
    assert layer.sliders.alpha.grad.abs().min() > 0


def test_modules_without_values_can_be_printed() -> None:
    with torch.device("meta"):
        layer = NonlocalFilter(learn=("alpha", "photometric_bandwidth"), photometric_bandwidth=0.1)
    assert "alpha=(4,) without values" in repr(layer)


def test_an_unknown_option_of_a_look_is_refused() -> None:
    with pytest.raises(TypeError, match="num_landmark"):
        Look(num_landmark=3)


@pytest.mark.parametrize("shape", [(4,), (2, 4), (2, 4, 12, 13), (1, 4, 12, 13), (2, 6)])
def test_sliders_of_a_call_come_from_elsewhere(shape: tuple[int, ...]) -> None:
    layer = NonlocalFilter(ALPHA, learn=(), **OPTIONS)
    alpha = noise(*shape, seed=5, dtype=torch.float32).requires_grad_()
    filtered = layer(image(), alpha=alpha)
    torch.testing.assert_close(filtered, polynomial_filter(nonlocal_operator(image(), **OPTIONS), image(), alpha))
    filtered.square().mean().backward()
    assert (alpha.grad != 0).all()


def test_sliders_of_a_call_train_the_network_that_finds_them() -> None:
    layer = NonlocalFilter(learn=(), **OPTIONS)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Conv2d(3, 4, 3, padding=1)
    layer(image(), alpha=network(image())).square().mean().backward()
    assert all((p.grad != 0).any() for p in network.parameters())


def test_held_layers_take_sliders_of_a_call() -> None:
    operator, alpha = nonlocal_operator(image(), **OPTIONS), noise(2, 4, seed=5, dtype=torch.float32)
    sliders = PolynomialSliders(ALPHA)
    layers = detail_layers(operator, image())
    torch.testing.assert_close(sliders.combine(layers, alpha), sliders(operator, image(), alpha))


@pytest.mark.parametrize("changed", [{}, {"photometric_bandwidth": "auto", "spatial_bandwidth": 9.0}])
def test_a_padded_batch_is_filtered_as_its_images_are(changed: dict[str, object]) -> None:
    layer = NonlocalFilter(ALPHA, learn=(), **(OPTIONS | changed))  # type: ignore[arg-type]
    images = [image(0, 1)[..., :9, :], image(1, 1)[..., :11]]
    weights = torch.zeros(2, 1, 12, 13)
    weights[0, :, :9], weights[1, ..., :11] = 1, 1
    batch = torch.where(weights > 0, image(2), 5.0)
    for number, small in enumerate(images):
        batch[number, :, : small.shape[2], : small.shape[3]] = small[0]
    filtered = layer(batch, weights=weights)
    for number, small in enumerate(images):
        size = (slice(None), slice(small.shape[2]), slice(small.shape[3]))
        torch.testing.assert_close(filtered[number][size], layer(small)[0], atol=1e-5, rtol=0)
        torch.testing.assert_close(layer(batch[number], weights=weights[number]), filtered[number], atol=1e-5, rtol=0)


def test_values_are_assigned_through_the_layer() -> None:
    layer = NonlocalFilter(
        (2.0, 1.0, 1.0), residual=0.5, photometric_bandwidth=0.2, learn=("alpha", "photometric_bandwidth")
    )
    parameters = list(layer.parameters())
    layer.alpha, layer.residual = (3.0, 2.0, 1.0), 0.7
    layer.photometric_bandwidth, layer.spatial_bandwidth = 0.3, 9.0
    assert layer.sliders.alpha.tolist() == [3.0, 2.0, 1.0]
    assert layer.residual is not None
    torch.testing.assert_close(layer.residual, torch.tensor([0.7]))
    torch.testing.assert_close(layer.affinity.photometric_bandwidth, torch.tensor(0.3))
    assert layer.affinity.spatial_bandwidth == 9.0
    assert all(before is after for before, after in zip(parameters, layer.parameters(), strict=True))


REFUSED = [
    ("alpha", (1.0, 2.0), r"alpha must keep its shape, \(4,\), got \(2,\); construct a layer"),
    ("alpha", "bright", "alpha must be numbers or rows of numbers"),
    ("alpha", [float("nan")] * 4, "alpha must be finite"),
    ("residual", 1.0, "residual must be a number in the constructor to be changed later, got None there"),
    ("photometric_bandwidth", -1.0, "photometric_bandwidth must be positive"),
]


def test_assigned_values_that_do_not_fit_are_refused() -> None:
    for name, value, message in REFUSED:
        layer = NonlocalFilter(photometric_bandwidth=0.2, learn=("alpha", "photometric_bandwidth"))
        with pytest.raises((TypeError, ValueError), match=message):
            setattr(layer, name, value)


def test_a_misspelt_option_names_the_class_that_was_called() -> None:
    for layer in (NonlocalFilter, NonlocalAffinity, PolynomialSliders, SegmentMask):
        with pytest.raises(TypeError, match=rf"^{layer.__name__}\.__init__\(\) got .*'num_landmark'"):
            layer(num_landmark=32)  # type: ignore[call-arg, operator]


@pytest.mark.slow
def test_type_checkers_refuse_misspelt_names(tmp_path: Path) -> None:
    lines = [
        "NonlocalFilter(num_landmark=32)",
        'NonlocalFilter(patch_size="5")',
        'NonlocalFilter(learn=("bandwidth",))',
        'NonlocalAffinity(learn=["alpha"])',
        'SegmentMask(learn=("width",))',
        'Refine(learn=("alpha",))',
        'NonlocalBlock(4, learn="strength")',
        'Look(learn=("curve",))',
    ]
    legal = 'NonlocalFilter(learn=("alpha", "spatial_bandwidth"), spatial_bandwidth=3.0).alpha = (1.0, 2.0)'
    script = tmp_path / "user.py"
    script.write_text("\n".join(["from nlfilter_torch import *", *lines, legal, ""]))
    root = Path(nlfilter_torch.__file__).parents[1]
    # With the project's settings, which are strict, mypy reads what it stored when it checked the project.
    command = [sys.executable, "-m", "mypy", str(script)]
    output = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False).stdout
    refused = {int(number) for number in re.findall(r"user.py:(\d+): error", output)}
    assert refused == set(range(2, 2 + len(lines))), output


def test_a_guide_counts_with_all_its_channels_and_an_image_by_its_luminance() -> None:
    """As a learned guide of three channels, whose gradient would otherwise be that of one."""
    picture_ = image()
    learned = noise(*picture_.shape, seed=4, dtype=picture_.dtype)
    alpha, layer = torch.tensor(ALPHA), NonlocalFilter(ALPHA, **OPTIONS)

    def expected(guide: torch.Tensor, channels: str) -> torch.Tensor:
        operator = nonlocal_operator(guide, guide_channels=channels, **OPTIONS)  # type: ignore[arg-type]
        return polynomial_filter(operator, picture_, alpha)

    torch.testing.assert_close(layer(picture_, guide=learned), expected(learned, "all"), atol=0, rtol=0)
    torch.testing.assert_close(layer(picture_), expected(picture_, "luminance"), atol=0, rtol=0)
    for channels in ("luminance", "all"):
        chosen = NonlocalFilter(ALPHA, guide_channels=channels, **OPTIONS)  # type: ignore[arg-type]
        torch.testing.assert_close(chosen(picture_, guide=learned), expected(learned, channels), atol=0, rtol=0)
    held = NonlocalFilter(ALPHA, hold="features", **OPTIONS)
    held.renew(learned, guide_channels="all")
    assert held(picture_, guide=learned).shape == picture_.shape


def test_a_guide_of_another_size_is_named() -> None:
    with pytest.raises(ValueError, match="guide must have the height and width of the image, 12x13, got 6x13"):
        NonlocalFilter(ALPHA, **OPTIONS)(image(), guide=image()[:, :, :6])
