"""Layers and fitted operators under torch.compile, torch.export and torch.func, as listed in docs/training.md."""

import io
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import hessian, jvp, vmap

from nlfilter_torch import (
    NonlocalFilter,
    NonlocalOperator,
    PolynomialSliders,
    detail_layers,
    nonlocal_operator,
    polynomial_filter,
    spectral_filter,
)
from tests.layers import ALPHA, EVERYTHING, OPTIONS, image
from tests.problems import noise


def compiled(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    torch.compiler.reset()
    # The eager backend traces, differentiates and runs the graphs without writing C++, which takes a minute.
    return torch.compile(function, backend="aot_eager")


# Warnings of the compiler itself.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
def test_compiled_layer_gives_the_same() -> None:
    """With a spectrum, which :func:`test_the_whole_layer_compiles_as_one_graph` leaves out."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Conv2d(3, 4, 3, padding=1, bias=False)
    layer = NonlocalFilter(
        ALPHA,
        learn=("alpha", "residual"),
        photometric_bandwidth=0.5,
        spatial_bandwidth=9.0,
        patch_size=3,
        num_landmarks=20,
        guide_channels="all",
    )
    parameters = [*network.parameters(), *layer.parameters()]

    def run(picture: Tensor) -> Tensor:
        return layer(picture, network(picture))

    fast = compiled(run)
    for seed in (0, 1):
        expected, result = run(image(seed)), fast(image(seed))
        torch.testing.assert_close(result, expected, atol=3e-6, rtol=0)  # its pixels are summed in another order
        gradients = [torch.autograd.grad(y.square().mean(), parameters) for y in (result, expected)]
        for ours, theirs in zip(*gradients, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * theirs.abs().max().item())


@pytest.mark.client(
    "`torch.compile(fullgraph=True)`",
    "building included, for images of any size with `dynamic=True`; a `generator`, a `group`, `weights`, `residual` "
    "and spectra break the graph",
)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
def test_the_whole_layer_compiles_as_one_graph() -> None:
    learn = tuple(name for name in EVERYTHING if name != "residual")  # a spectrum has a graph of its own
    layer = NonlocalFilter(
        ALPHA, learn=learn, photometric_bandwidth=0.2, spatial_bandwidth=9.0, num_landmarks=20, guide_channels="all"
    )
    torch.compiler.reset()
    fast = torch.compile(layer, backend="aot_eager", fullgraph=True)
    picture, second = (image(seed).to(memory_format=torch.channels_last).requires_grad_() for seed in (0, 1))
    expected, result = layer(picture), fast(picture)
    torch.testing.assert_close(result, expected, atol=1e-5, rtol=0)
    assert result.stride() == expected.stride() == picture.stride()
    gradients = [torch.autograd.grad(y.square().mean(), [picture, *layer.parameters()]) for y in (result, expected)]
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5 * theirs.abs().max().item())
    torch.testing.assert_close(fast(second), layer(second), atol=1e-5, rtol=0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
def test_a_compiled_layer_takes_other_sizes_without_compiling_again() -> None:
    # Two sliders and small patches, since tracing with symbolic sizes takes time in proportion to the operations.
    layer = NonlocalFilter(
        (2.0, 1.0), photometric_bandwidth=0.2, num_landmarks=20, patch_size=3, learn=("photometric_bandwidth",)
    )
    torch.compiler.reset()
    fast = torch.compile(layer, backend="aot_eager", fullgraph=True, dynamic=True)
    fast(noise(2, 3, 24, 32, dtype=torch.float32))
    with torch.compiler.set_stance("fail_on_recompile"):
        for shape in ((3, 3, 40, 29), (2, 3, 96, 90), (2, 3, 150, 130)):
            picture = noise(*shape, dtype=torch.float32)
            expected, result = layer(picture), fast(picture)
            torch.testing.assert_close(result, expected, atol=1e-5, rtol=0)
            gradients = [torch.autograd.grad(y.square().mean(), list(layer.parameters())) for y in (result, expected)]
            torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-8)


@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
def test_a_generator_keeps_building_out_of_the_graph() -> None:
    def landmarks(guide: Tensor) -> Tensor:
        options = OPTIONS | {"generator": torch.Generator().manual_seed(5)}
        return nonlocal_operator(guide, **options).kernel.landmarks

    torch.testing.assert_close(compiled(landmarks)(image()), landmarks(image()), atol=0, rtol=0)
    assert not torch.equal(landmarks(image()), nonlocal_operator(image(), **OPTIONS).kernel.landmarks)


@pytest.mark.client(
    "`torch.export`",
    "building included, for images of any size, without `weights`; import `nlfilter_torch.operator.build` before a "
    "program is loaded, or export `Portable`",
)
@pytest.mark.slow
@pytest.mark.parametrize("changed", [{}, {"landmarks": "uniform", "spatial_bandwidth": 9.0}])
def test_export_of_a_layer_that_builds_its_operator(changed: dict[str, Any]) -> None:
    layer = NonlocalFilter(ALPHA, **(OPTIONS | changed))
    limits = {"images": (1, 64), "height": (8, 512), "width": (8, 512)}
    batch, height, width = (torch.export.Dim(name, min=low, max=high) for name, (low, high) in limits.items())
    sizes = {"image": {0: batch, 2: height, 3: width}}
    program = torch.export.export(layer, (image(batch=2),), dynamic_shapes=sizes)
    stream = io.BytesIO()
    torch.export.save(program, stream)
    stream.seek(0)
    loaded = torch.export.load(stream).module()
    for shape in ((1, 3, 8, 8), (2, 3, 24, 32), (5, 3, 40, 29), (1, 3, 200, 150)):
        picture = noise(*shape, dtype=torch.float32)
        torch.testing.assert_close(loaded(picture), layer(picture), atol=1e-5, rtol=0)


# --- operators that a graph calls


class Fitted(nn.Module):
    """A fixed operator, applied with sliders."""

    def __init__(self, operator: NonlocalOperator) -> None:
        super().__init__()
        self.operator = operator
        self.sliders = PolynomialSliders(ALPHA)

    def forward(self, picture: Tensor) -> Tensor:
        return self.sliders(self.operator, picture)


@pytest.mark.client("`torch.export` of a fitted operator", "yes")
@pytest.mark.parametrize("strict", [False, True])
def test_export_of_applying_a_fitted_operator(strict: bool) -> None:
    fitted = Fitted(nonlocal_operator(image(batch=1), **OPTIONS))
    sizes = {"picture": {0: torch.export.Dim("images", min=1, max=64)}}
    program = torch.export.export(fitted, (image(batch=2),), dynamic_shapes=sizes, strict=strict)
    stream = io.BytesIO()
    torch.export.save(program, stream)
    stream.seek(0)
    loaded = torch.export.load(stream).module()
    for batch in (1, 2, 5):
        # The exported program sums pixels in another order, and the sliders amplify its rounding fourfold.
        torch.testing.assert_close(loaded(image(3, batch)), fitted(image(3, batch)), atol=3e-6, rtol=0)


@pytest.mark.client("`vmap`, `jvp`, `hessian` of a fitted operator", "in image and alpha")
def test_vmap_over_images_and_over_sliders_of_a_fitted_operator() -> None:
    operator = nonlocal_operator(image(batch=1), **OPTIONS)
    spectrum = operator.spectrum()
    images, alphas = noise(4, 1, 3, 12, 13, dtype=torch.float32), noise(5, 4, seed=1, dtype=torch.float32)
    alpha, picture = torch.tensor(ALPHA), image(batch=1)
    cases: list[tuple[Callable[[Tensor], Tensor], Tensor]] = [
        (lambda y: polynomial_filter(operator, y, alpha), images),
        (lambda y: polynomial_filter(operator, y, alpha, residual=0.5), images),
        (lambda a: polynomial_filter(operator, picture, a), alphas),
        (lambda y: detail_layers(operator, y), images),
        (lambda y: operator @ y, images),
        (lambda y: spectral_filter(spectrum, y, torch.sqrt), images),
    ]
    for function, inputs in cases:
        torch.testing.assert_close(vmap(function)(inputs), torch.stack([function(x) for x in inputs]))


@pytest.mark.client("`vmap`, `jvp`, `hessian` of a fitted operator", "in image and alpha")
@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")  # in torch.func itself
def test_jvp_and_hessian_in_image_and_sliders_of_a_fitted_operator() -> None:
    operator = nonlocal_operator(image(batch=1), **OPTIONS)
    picture, alpha = image(1, 1), torch.tensor(ALPHA)
    moves = noise(1, 3, 12, 13, seed=2, dtype=torch.float32), noise(4, seed=3, dtype=torch.float32)
    value, derivative = jvp(lambda y, a: polynomial_filter(operator, y, a), (picture, alpha), moves)
    torch.testing.assert_close(value, polynomial_filter(operator, picture, alpha))
    product = polynomial_filter(operator, moves[0], alpha) + polynomial_filter(operator, picture, moves[1])
    torch.testing.assert_close(derivative, product)

    layers = detail_layers(operator, picture).flatten(2)[0]
    result = hessian(lambda a: polynomial_filter(operator, picture, a).square().sum() / 2)(alpha)
    torch.testing.assert_close(result, layers @ layers.mT, atol=1e-4, rtol=1e-4)


def test_exported_programs_refuse_weights_in_one_sentence() -> None:
    layer, image = NonlocalFilter((1.5, 1.0), num_landmarks=7, photometric_bandwidth=0.3), torch.rand(1, 1, 8, 9)
    with pytest.raises(ValueError, match=r"^weights must be None in an exported program"):
        torch.export.export(layer, (image,), {"weights": torch.ones_like(image)})
