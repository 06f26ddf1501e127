"""What of a layer learns, and the training conventions that the README's table promises, a test for each row."""

import copy
import io
import math
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor, nn
from torch.func import grad, hessian, jvp, vmap
from torch.utils.checkpoint import checkpoint

from nlfilter_torch import (
    DiffusionMask,
    NonlocalAffinity,
    NonlocalFilter,
    NonlocalOperator,
    PolynomialSliders,
    detail_layers,
    diffusion_mask,
    estimate_bandwidth,
    nonlocal_operator,
    polynomial_filter,
    spectral_filter,
)
from nlfilter_torch.features import patch_window
from tests.problems import noise, seeded

ALPHA = (3.0, 0.5, 4.0, 1.05)
OPTIONS = {"photometric_bandwidth": 0.2, "num_landmarks": 20}
EVERYTHING = ("alpha", "residual", "photometric_bandwidth", "spatial_bandwidth", "patch_weights")


def image(seed: int = 0, batch: int = 2) -> Tensor:
    return noise(batch, 3, 12, 13, seed=seed, dtype=torch.float32)


def everything(**options: object) -> NonlocalFilter:
    return NonlocalFilter(ALPHA, learn=EVERYTHING, **(OPTIONS | {"spatial_bandwidth": 9.0} | options))  # type: ignore[arg-type]


def backward(layer: nn.Module, *arguments: Tensor) -> dict[str, Tensor]:
    """The gradients of a loss in the layer's parameters, by name."""
    layer.zero_grad()
    layer(*arguments).square().mean().backward()
    return {name: p.grad.clone() for name, p in layer.named_parameters() if p.grad is not None}


@contextmanager
def untouched(layer: nn.Module) -> Iterator[None]:
    """Parameters and gradients are afterwards what they were before."""
    before = copy.deepcopy(layer.state_dict())
    yield
    for name, value in layer.state_dict().items():
        torch.testing.assert_close(value, before[name], atol=0, rtol=0)
    assert all(p.grad is None for p in layer.parameters())


# What learns --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVERYTHING)
def test_only_what_is_named_learns(name: str) -> None:
    layer = NonlocalFilter(ALPHA, learn=(name,), spatial_bandwidth=9.0, **OPTIONS)
    assert len(list(layer.parameters())) == 1
    for gradient in backward(layer, image()).values():
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 0


def test_every_parameter_gets_a_gradient() -> None:
    assert set(backward(everything(), image())) == {
        "affinity.photometric_bandwidth.logarithm",
        "affinity.spatial_bandwidth.logarithm",
        "affinity.patch_weights.logits",
        "sliders.alpha",
        "sliders.residual",
    }


def test_learning_starts_from_the_function() -> None:
    operator = nonlocal_operator(image(), spatial_bandwidth=9.0, **OPTIONS)
    expected = polynomial_filter(operator, image(), torch.tensor(ALPHA), residual=ALPHA[0])
    torch.testing.assert_close(everything()(image()), expected, atol=1e-5, rtol=0)


def test_automatic_bandwidth_learns_a_factor() -> None:
    layer = NonlocalFilter(ALPHA, learn=("photometric_bandwidth",), num_landmarks=20)
    expected = NonlocalFilter(ALPHA, num_landmarks=20)(image())
    torch.testing.assert_close(layer(image()), expected, atol=1e-5, rtol=0)
    with torch.no_grad():
        layer.affinity.photometric_bandwidth.logarithm += math.log(1.5)
    wider = nonlocal_operator(image(), photometric_bandwidth=1.5 * estimate_bandwidth(image()), num_landmarks=20)
    torch.testing.assert_close(
        layer(image()), polynomial_filter(wider, image(), torch.tensor(ALPHA)), atol=1e-5, rtol=0
    )
    assert "photometric_bandwidth=1.5 * auto" in repr(layer)


def test_learned_numbers_are_shown_as_they_are() -> None:
    text = repr(everything())
    for part in ("photometric_bandwidth=0.2", "spatial_bandwidth=9", "residual=3.0", "5x5"):
        assert part in text
    assert "time=2.5, width=3" in repr(DiffusionMask(time=2.5, width=3.0, learn=("time", "width")))


@pytest.mark.parametrize("rate", [1.0, 30.0])
def test_positive_things_stay_positive_under_any_step(rate: float) -> None:
    layer = everything()
    optimizer = torch.optim.SGD(layer.parameters(), lr=rate)
    mask = DiffusionMask(learn=("time", "width"))
    for parameter in (*layer.parameters(), *mask.parameters()):
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    torch.optim.SGD(mask.parameters(), lr=rate).step()
    for positive in (layer.affinity.photometric_bandwidth(), mask.time(), mask.width(), layer.affinity.patch_weights()):
        assert (positive > 0).all()
    torch.testing.assert_close(layer.affinity.patch_weights().sum(), torch.tensor(1.0))


def test_a_given_window_is_the_start_of_patch_weights() -> None:
    window = patch_window(3) + 0.01
    layer = NonlocalAffinity(patch_weights=window, learn="patch_weights", **OPTIONS)
    torch.testing.assert_close(layer.patch_weights(), (window / window.sum()).float())
    fixed = NonlocalAffinity(patch_weights=window, **OPTIONS)
    torch.testing.assert_close(fixed(image()) @ image(), layer(image()) @ image(), atol=1e-5, rtol=0)
    assert not list(fixed.parameters())


def test_mask_learns_time_and_width() -> None:
    spectrum = nonlocal_operator(image(), **OPTIONS).spectrum()
    region = noise(2, 1, 12, 13, dtype=torch.float32)
    layer = DiffusionMask(time=1.5, width=6.0, learn=("time", "width"))
    torch.testing.assert_close(layer(spectrum, region), diffusion_mask(spectrum, region, time=1.5, width=6.0))
    for gradient in backward(layer, spectrum, region).values():
        assert gradient.isfinite()
        assert gradient != 0


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


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: NonlocalFilter(learn=("alpha", "gamma")), ValueError, r"learn must name 'alpha', .*, got 'gamma'"),
        (lambda: NonlocalFilter(learn="bandwidth"), ValueError, "got 'bandwidth'"),
        (lambda: NonlocalAffinity(learn=("alpha",)), ValueError, "learn must name 'photometric_bandwidth'"),
        (lambda: PolynomialSliders(learn=("time",)), ValueError, "learn must name 'alpha', 'residual'"),
        (lambda: DiffusionMask(learn=("alpha",)), ValueError, "learn must name 'time', 'width'"),
        (lambda: NonlocalFilter(photometric_bandwidth=0.0), ValueError, "photometric_bandwidth must be positive"),
        (
            lambda: NonlocalFilter(photometric_bandwidth=-1.0, learn="photometric_bandwidth"),
            ValueError,
            "photometric_bandwidth must be positive and finite, got -1",
        ),
        (
            lambda: NonlocalFilter(photometric_bandwidth="car"),
            ValueError,
            "photometric_bandwidth must be one of 'auto'",
        ),
        (lambda: NonlocalFilter(spatial_bandwidth=-3.0), ValueError, "spatial_bandwidth must be positive"),
        (lambda: NonlocalFilter(learn="spatial_bandwidth"), ValueError, "spatial_bandwidth must be a number of pixels"),
        (lambda: NonlocalFilter(patch_size=4, learn="patch_weights"), ValueError, "patch_size must be odd"),
        (lambda: DiffusionMask(width=0.0), ValueError, "width must be positive"),
        (lambda: DiffusionMask(time=-1.0, learn="time"), ValueError, "time must be positive"),
        (lambda: NonlocalFilter((1.0,)), ValueError, "alpha must have at least two entries"),
        (lambda: NonlocalFilter((1.0, math.nan)), ValueError, "alpha must be finite"),
    ],
)
def test_bad_construction_is_one_clear_sentence(
    make: Callable[[], nn.Module], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda f: f(image(), alpha=torch.ones(3, 4)),
            ValueError,
            "alpha must have the batch size of the layers, 2, got 3",
        ),
        (lambda f: f(image(), alpha=torch.ones(2, 4, 5, 5)), ValueError, "alpha must have the height and width"),
        (lambda f: f(image(), alpha=torch.ones(2, 1)), ValueError, "alpha must have at least two entries"),
        (lambda f: f(image(), alpha=torch.ones(2, 2, 2)), ValueError, "alpha must have shape"),
        (lambda f: f(image(), guide=image(batch=3)), ValueError, "batch size"),
        (lambda f: f(image(), mask=torch.ones(2, 1, 5, 5)), ValueError, "mask must have the height and width"),
        (lambda f: f(image().to(torch.float8_e4m3fn)), TypeError, "must be of a floating-point dtype .*float8"),
        (lambda f: f(image(), guide=image().to(torch.int32)), TypeError, "guide must be of a floating-point dtype"),
        (lambda f: f(image().to(torch.complex64)), TypeError, "must be of a floating-point dtype"),
    ],
)
def test_bad_call_leaves_the_parameters_untouched(
    call: Callable[[nn.Module], Tensor], error: type[Exception], message: str
) -> None:
    layer = everything()
    with untouched(layer), pytest.raises(error, match=message):
        call(layer).mean().backward()


def test_a_bandwidth_that_left_its_range_is_told() -> None:
    layer = everything()
    with torch.no_grad():
        layer.affinity.photometric_bandwidth.logarithm.fill_(math.nan)
    with pytest.raises(ValueError, match="photometric_bandwidth must be positive and finite"):
        layer(image())


# Training conventions -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_leaves_the_filter_in_full_precision(dtype: torch.dtype) -> None:
    layer = everything()
    expected, exact = layer(image()), backward(layer, image())
    layer.zero_grad()
    with torch.autocast("cpu", dtype=dtype):
        filtered = layer(image())
        inside = backward(layer, image())  # torch advises against it: what is not of this package is rounded
    torch.testing.assert_close(filtered, expected, atol=0, rtol=0)
    layer.zero_grad()
    filtered.square().mean().backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, exact[name], atol=0, rtol=0)
        assert (inside[name] - exact[name]).abs().max() <= 0.01 * exact[name].abs().max()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_network_before_the_layer_learns(dtype: torch.dtype) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Conv2d(3, 4, 3, padding=1)
    layer = everything(photometric_bandwidth=0.5)
    with torch.autocast("cpu", dtype=dtype):
        guide = network(image())
        assert guide.dtype == dtype
        filtered = layer(image(), guide)
        assert filtered.dtype == torch.float32
        loss = filtered.square().mean()
    loss.backward()
    for parameter in (*network.parameters(), *layer.parameters()):
        assert parameter.grad.isfinite().all()
    assert network.weight.grad.abs().max() > 0


def test_autocast_on_a_dtype_that_cannot_work_is_told() -> None:
    layer = everything()
    with untouched(layer):
        # torch itself refuses to cast to it, says so, and goes on without autocast.
        with pytest.warns(UserWarning, match="autocast"), torch.autocast("cpu", dtype=torch.float64):
            torch.testing.assert_close(layer(image()), everything()(image()), atol=0, rtol=0)
        with pytest.raises(TypeError, match="guide must be of a floating-point dtype"):
            layer(image(), guide=image().to(torch.float8_e5m2))


@pytest.mark.parametrize("reentrant", [False, True])
def test_gradient_checkpointing(reentrant: bool) -> None:
    layer = everything()
    exact = backward(layer, image())
    layer.zero_grad()
    tracked = image().requires_grad_()  # the reentrant variant wants an input that needs a gradient
    checkpoint(layer, tracked, use_reentrant=reentrant).square().mean().backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, exact[name], atol=0, rtol=0)


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
    with pytest.raises(RuntimeError, match="setup_context"):
        grad(lambda y: NonlocalFilter(**OPTIONS)(y).square().mean())(image())


@pytest.mark.parametrize("generator", [False, True])
def test_state_dict_pickle_and_deep_copy(generator: bool) -> None:
    layer = everything(generator=seeded(3) if generator else None)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter += 0.1
    copies = [copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)), everything()]
    copies[2].load_state_dict(layer.state_dict())
    if generator:
        copies[2].affinity.generator = seeded(3)
    expected = [layer(image()), layer(image())]
    assert torch.equal(*expected) != generator  # a generator moves on, and each copy has its own
    for other in copies:
        for output in expected:
            torch.testing.assert_close(other(image()), output, atol=0, rtol=0)
        assert not {id(p) for p in other.parameters()} & {id(p) for p in layer.parameters()}


@pytest.mark.parametrize("frozen", ["sliders.alpha", "affinity.photometric_bandwidth.logarithm"])
def test_frozen_parameters_stay_and_the_others_move(frozen: str) -> None:
    layer = everything()
    layer.get_parameter(frozen).requires_grad_(False)
    before = copy.deepcopy(layer.state_dict())
    found = backward(layer, image())
    assert frozen not in found
    torch.optim.SGD(layer.parameters(), lr=0.1).step()
    for name, value in layer.state_dict().items():
        assert torch.equal(value, before[name]) == (name == frozen), name


def test_a_layer_that_is_frozen_whole_costs_no_graph() -> None:
    layer = everything().requires_grad_(False)
    assert not layer(image()).requires_grad
    tracked = image().requires_grad_()
    layer(tracked).sum().backward()
    assert tracked.grad is not None


def test_gradient_accumulation_is_the_gradient_of_the_sum() -> None:
    layer = everything()
    images = [image(seed) for seed in range(3)]
    separate = [backward(layer, picture) for picture in images]
    layer.zero_grad()
    for picture in images:
        layer(picture).square().mean().backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, sum(g[name] for g in separate))


def test_gradient_of_a_batch_is_that_of_its_images() -> None:
    layer = everything()
    together = backward(layer, image())
    alone = [backward(layer, picture.unsqueeze(0)) for picture in image()]
    for name, gradient in together.items():
        torch.testing.assert_close(gradient, (alone[0][name] + alone[1][name]) / 2, rtol=1e-3, atol=1e-6)


def test_evaluation_keeps_nothing_from_call_to_call() -> None:
    layer = everything().eval()
    attributes = {name: set(vars(module)) for name, module in layer.named_modules()}
    with torch.inference_mode():
        first = layer(image())
        layer(image(1), guide=image(2))
        torch.testing.assert_close(layer(image()), first, atol=0, rtol=0)
        layer.sliders.alpha.mul_(2.0)
        assert not torch.allclose(layer(image()), first)
    assert {name: set(vars(module)) for name, module in layer.named_modules()} == attributes
    torch.testing.assert_close(layer.train()(image()), layer.eval()(image()), atol=0, rtol=0)


def test_the_global_generator_is_not_used() -> None:
    before = torch.random.get_rng_state()
    backward(everything(), image())
    backward(everything(generator=seeded(1), landmarks="random"), image())
    assert torch.equal(torch.random.get_rng_state(), before)
