"""Layers and fitted operators under torch.compile, torch.export and torch.func, as docs/training.md promises."""

import io
import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.func import grad, hessian, jvp, vmap

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


# The compiler's own.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.* should not be instantiated:DeprecationWarning")
@pytest.mark.parametrize("learn", [("alpha",), EVERYTHING])
def test_compiled_layer_gives_the_same(learn: tuple[str, ...]) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Conv2d(3, 4, 3, padding=1, bias=False)
    layer = NonlocalFilter(
        ALPHA, learn=learn, photometric_bandwidth=0.5, spatial_bandwidth=9.0, num_landmarks=20, guide_channels="all"
    )
    parameters = [*network.parameters(), *layer.parameters()]

    def run(picture: Tensor) -> Tensor:
        return layer(picture, network(picture))

    fast = compiled(run)
    for seed in (0, 1):
        expected, found = run(image(seed)), fast(image(seed))
        torch.testing.assert_close(found, expected, atol=3e-6, rtol=0)  # its pixels are added up in another order
        gradients = [torch.autograd.grad(y.square().mean(), parameters) for y in (found, expected)]
        for ours, theirs in zip(*gradients, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * theirs.abs().max().item())


def test_compiled_layer_breaks_where_the_operator_is_built_and_nowhere_else() -> None:
    from torch._dynamo.utils import counters

    layer = NonlocalFilter(ALPHA, **OPTIONS)
    fast = compiled(layer)
    counters.clear()
    fast(image())
    disabled = [reason for reason in counters["graph_break"] if "Skip calling" in reason]
    others = [reason for reason in counters["graph_break"] if "disable" not in reason]
    assert len(disabled) == 1
    assert "nonlocal_operator" in disabled[0]
    assert not others


def test_importing_and_running_does_not_load_the_compiler() -> None:
    import subprocess

    program = (
        "import sys, torch, nlfilter_torch\n"
        "before = 'torch._dynamo' in sys.modules\n"
        "nlfilter_torch.NonlocalFilter(num_landmarks=4)(torch.rand(1, 1, 8, 8)).sum().backward()\n"
        "assert before or 'torch._dynamo' not in sys.modules\n"
        "assert not before"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


class Fitted(nn.Module):
    """An operator that is held, and sliders that it is applied with."""

    def __init__(self, operator: NonlocalOperator) -> None:
        super().__init__()
        self.operator = operator
        self.sliders = PolynomialSliders(ALPHA)

    def forward(self, picture: Tensor) -> Tensor:
        return self.sliders(self.operator, picture)


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
        # The exported program adds pixels up in another order, and the sliders raise its rounding fourfold.
        torch.testing.assert_close(loaded(image(3, batch)), fitted(image(3, batch)), atol=3e-6, rtol=0)


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
    found = hessian(lambda a: polynomial_filter(operator, picture, a).square().sum() / 2)(alpha)
    torch.testing.assert_close(found, layers @ layers.mT, atol=1e-4, rtol=1e-4)


def test_function_transforms_of_building_an_operator_are_refused() -> None:
    with pytest.raises(TypeError, match=r"must not be transformed by torch\.func"):
        grad(lambda y: NonlocalFilter(**OPTIONS)(y).square().mean())(image())
