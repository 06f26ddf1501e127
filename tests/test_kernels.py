"""The operators of ``torch.ops.nlfilter`` meet torch's requirements, with and without the kernels in C."""

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.kernels import columns, convolution, definitions_only, grams, stencil, tall_skinny
from nlfilter_torch.core.kernels.clusters import lloyd, pivots  # noqa: F401, registers both
from nlfilter_torch.operator import build  # noqa: F401, registers two
from nlfilter_torch.operator.nystrom import inverse_cholesky

BATCH, SIZE, LANDMARKS, PIXELS, ROWS = 2, 4, 5, 33, 3
DERIVED = ("spread", "moment", "invert", "convolve", "solve")


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def arguments(dtype: torch.dtype) -> dict[str, tuple[Any, ...]]:
    """Arguments of every operator, by name."""
    features, landmarks = random(BATCH, SIZE, PIXELS).to(dtype), random(BATCH, SIZE, LANDMARKS, seed=1).to(dtype)
    inputs = (features, landmarks, inverse_cholesky(landmarks))
    factor, norms = columns.columns(*inputs, limited=True)
    vector, rows = random(BATCH, LANDMARKS, seed=2).to(dtype), random(BATCH, ROWS, LANDMARKS, seed=3).to(dtype)
    images = random(BATCH, ROWS, PIXELS, seed=4).to(dtype)
    weights = images[:, 0].exp()
    images16, weight = random(BATCH, 16, 7, 9, seed=5).to(dtype), random(5, 16, 3, 3, seed=6).to(dtype)
    coefficients = random(BATCH, 3, 3, 6, 7, seed=9).to(dtype)
    coefficients[:, 1, 1] = coefficients.abs().sum((1, 2))
    backward = (*inputs, True, factor, norms.clamp(min=1.0).rsqrt())
    return {
        "columns": (*inputs, True),
        "columns_backward": (*backward, [rows.mT.contiguous(), images], weights),
        "spread": (rows, factor, weights),
        "moment": (factor, images),
        "sweep": (factor, weights, vector, 2.0, weights),
        "weigh": (factor, weights, vector),
        "grams": (factor, weights, weights, 2),
        "gram": (factor, weights),
        "pivots": (features, torch.linspace(0.1, 0.9, LANDMARKS, dtype=dtype), 1e-4),
        "lloyd": (features, landmarks, 3, 1e-6),
        "invert": (factor @ factor.mT + torch.eye(LANDMARKS, dtype=dtype),),
        "choose": (features, 1, PIXELS, LANDMARKS, "kmeans"),
        "without": (factor, norms > norms.median()),
        "convolve": (images16, weight, random(5, seed=7).to(dtype), 2, random(BATCH, 5, 7, 9, seed=8).to(dtype)),
        "solve": (coefficients, random(BATCH, 2, 6, 7, seed=10).to(dtype)),
        "sinkhorn": (factor, (1 - norms).clamp(min=0.0), 1e-5, True, False),
    }


NAMES = sorted(arguments(torch.float32))


def test_every_operator_is_checked() -> None:
    registered = {
        name.split("::")[1] for name in torch._C._dispatch_get_all_op_names() if name.startswith("nlfilter::")
    }
    assert registered == set(NAMES)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")
@pytest.mark.parametrize("in_c", [True, False], ids=["C", "torch"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", NAMES)
def test_opcheck(name: str, dtype: torch.dtype, in_c: bool) -> None:
    operator, given = getattr(torch.ops.nlfilter, name).default, arguments(dtype)[name]
    with nullcontext() if in_c else definitions_only():
        torch.library.opcheck(operator, given)
        if name in DERIVED:
            torch.library.opcheck(
                operator, tuple(t.clone().requires_grad_() if isinstance(t, Tensor) else t for t in given)
            )


@pytest.mark.parametrize("name", NAMES)
def test_accelerators_have_the_definitions(name: str) -> None:
    assert torch._C._dispatch_has_computed_kernel_for_dispatch_key(f"nlfilter::{name}", "CUDA")


def test_weights_count_pixels() -> None:
    factor, diagonal = random(2, 6, 40).abs() / 10, random(2, 40).sigmoid()
    half, copies = random(2, 6, seed=1).abs(), torch.arange(40) % 3 + 1
    repeated = (part.repeat_interleave(copies, dim=-1) for part in (factor, diagonal))
    for context in (nullcontext(), definitions_only()):
        with context:
            scaling, found = tall_skinny.sweep(factor, diagonal, half, 2.0, copies.expand(2, -1).float())
    many, expected = tall_skinny.sweep(*repeated, half, 2.0)
    torch.testing.assert_close(scaling.repeat_interleave(copies, dim=1), many)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)


def test_a_gram_matrix_of_weighted_columns() -> None:
    factor, weights = random(2, 6, 400), random(2, 400, seed=1).exp()
    exact = (factor.double() * weights.double().unsqueeze(1)) @ factor.double().mT
    torch.testing.assert_close(grams.gram(factor, weights), exact.float(), rtol=1e-4, atol=1e-3)
    with definitions_only():
        torch.testing.assert_close(grams.gram(factor, weights), exact.float(), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("size", [(1, 1), (3, 4), (4, 5), (13, 40), (37, 65)])
@pytest.mark.parametrize("dilation", [1, 2, 3, 5])
@pytest.mark.parametrize(("channels", "outputs"), [(16, 16), (48, 48), (32, 28), (16, 1), (6, 48)])
def test_convolution(size: tuple[int, int], dilation: int, channels: int, outputs: int) -> None:
    given = (
        random(2, channels, *size),
        random(outputs, channels, 3, 3, seed=1) / (3 * channels**0.5),
        random(outputs, seed=2),
        dilation,
        random(2, outputs, *size, seed=3),
    )
    features, weight, bias, _, added = (t.double() if isinstance(t, Tensor) else t for t in given)
    rectified = torch.where(features < 0, 0.1 * features, features)
    exact = torch.nn.functional.conv2d(rectified, weight, bias, padding=dilation, dilation=dilation)
    for context in (nullcontext(), definitions_only()):
        with context:
            torch.testing.assert_close(convolution.convolve(*given).double(), exact + added, atol=3e-5, rtol=0)
            torch.testing.assert_close(convolution.convolve(*given[:4]).double(), exact, atol=3e-5, rtol=0)


def test_convolution_under_autocast_and_vmap() -> None:
    features, weight = random(2, 16, 9, 7), random(16, 16, 3, 3, seed=1) / 12
    wanted = convolution.convolve(features, weight)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(convolution.convolve(features, weight).float(), wanted, atol=0.05, rtol=0)
    each = torch.vmap(lambda one: convolution.convolve(one[None], weight)[0])(features)
    torch.testing.assert_close(each, wanted)


def test_convolution_of_other_shapes_is_left_to_the_definition() -> None:
    features, weight = random(1, 16, 9, 7), random(16, 16, 3, 3, seed=1) / 12
    wanted = convolution.convolve(features, weight)
    torch.testing.assert_close(convolution.convolve(features, weight, added=torch.ones(1, 16, 1, 1)), wanted + 1)
    with pytest.raises(RuntimeError, match="bias"):
        convolution.convolve(features, weight, torch.ones(3))
    with pytest.raises(RuntimeError, match="channels"):
        convolution.convolve(features[:, :8], weight)


@pytest.mark.parametrize("size", [(1, 1), (1, 90), (11, 1), (5, 6), (23, 51), (64, 40)], ids=str)
def test_systems_of_pixels(size: tuple[int, int]) -> None:
    coefficients = random(2, 3, 3, *size).double()
    coefficients[:, 1, 1] = coefficients.abs().sum((1, 2))
    right = random(2, 3, *size, seed=1).double()
    found = stencil.solve_stencil(coefficients, right)
    with definitions_only():
        torch.testing.assert_close(stencil.solve_stencil(coefficients, right), found, rtol=1e-11, atol=1e-11)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert torch.equal(stencil.solve_stencil(coefficients, right), found)
    finally:
        torch.set_num_threads(threads)
